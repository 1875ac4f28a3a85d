"""Effects: each adds a function of positions, velocities and time of some bodies to the Lagrangian, the constraints or
the forces."""

from collections.abc import Sequence
from dataclasses import fields
from inspect import getattr_static, isfunction
from itertools import chain, pairwise
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library
from vmri_jax.mechanics.checks import describe, shape_of
from vmri_jax.mechanics.constraints import START_TOLERANCE
from vmri_jax.mechanics.functions import check_arguments
from vmri_jax.mechanics.names import unknown
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import MOST_ROLES, Bindable
from vmri_jax.scene.body import GROUND, Attachment, end_of, label_of, moving, weights_of
from vmri_jax.scene.declare import arrays, lasting

Kind = Literal["kinetic", "potential", "constraint", "force", "control"]
LIBRARY = "vmri_jax."
"""Beginning of the names of modules whose functions are not checked: the tests of the package do that."""


class Effect(Bindable):
    """Base class of effects: a function, the bodies that it depends on, and its parameters.

    An effect has one or more *elements*, and an element has a body in each *role*:
    ``Spring([("hub", "tip"), ("tip", "load")], 1.0)`` has two elements; "hub" and "tip" have the role a in them, "tip"
    and "load" the role b. The signature of its function depends on `kind`:

    | kind | function | returns |
    |---|---|---|
    | "potential" | ``function(q, params)`` | energy, () |
    | "constraint" | ``function(q, params)`` | values that the scene keeps zero, (k,) or () for each element |
    | "kinetic" | ``function(q, v, params)`` | energy added to ``sum m v^2 / 2``, () |
    | "force" | ``function(t, q, v, params)`` | tuple of forces, shaped like q |
    | "control" | ``function(q, u, params)`` | tuple of forces of the controls u, shaped like q |

    A `timed` constraint has ``function(t, q, params)``. q and v are tuples with an entry for each role: the coordinates
    (d,) of its body or, with n > 1 elements, (n, d). A rigid body enters with the coordinates of its centre, or of the
    point in ``(name, [x, y, z])``. The ground is a body, too. params holds the fields that a class declares as numbers,
    vectors or arrays (see `vmri_jax.scene.declare`), by name.

    The effects that a user gives to a scene are declarations. The scene works with *bound* effects, copies that know
    the bodies of the scene, `by_name`: only these have `elements`, `parameters`, and the other quantities that depend
    on bodies. Each is computed once.

    Args:
        name: of this effect in its scene; by default `default_name` of its class, or the name of the class in small
            letters.
        rate: how often a potential is evaluated: "slow" (as part of V), "fast" (on the micro grid, with the rule of W),
            a whole number k (on every k-th micro node), or "auto" (the scene decides by stiffness). A potential with
            the rate "fast" or k makes its bodies fast, except bodies with the pace "slow": the positions of these slow
            bodies are then solved for by iteration over the macro step. Of a kinetic effect "slow", "fast" or "auto";
            here the rate decides only whether its bodies are fast, since all kinetic effects are on the micro grid.

    Raises:
        TypeError, ValueError: arguments other than the docstring of the class says; of the scene, see `check`: wrong
            shapes or signs, unknown names, points at one place where a line between them is needed, constraints that
            the start violates.
    """

    kind: ClassVar[Kind]
    default_name: ClassVar[str] = ""
    dimensions: ClassVar[tuple[int, ...]] = ()
    """The effect is between points of one of these dimensions; () also allows blocks of general coordinates."""
    same_size: ClassVar[bool] = True
    """Whether all bodies of an element must have the same dimension."""
    apart: ClassVar[bool] = False
    """Whether neighbouring bodies of an element, or a body and the fixed point it is tied to, must start at different
    places."""
    drawn_as: ClassVar[Literal["link", "spring"] | None] = None
    """The symbol that is drawn between neighbouring bodies of an element."""

    def __new__(cls, *args, **kwargs):
        """A new effect, of a class that is complete.

        Raises:
            TypeError: the class has no `kind`, no field with names of bodies, or a `function` that would get the effect
                itself.
        """
        about = f"the class of effects {cls.__name__}"
        if getattr(cls, "kind", None) not in get_args(Kind):
            raise Refused(f"{about} has no kind; write kind = one of {', '.join(map(repr, get_args(Kind)))} in it.")
        if cls._elements is Effect._elements and not any("names" in f.metadata for f in fields(cls)):
            raise Refused(f"{about} has no field with names of bodies; declare one, bodies: Any = names(2) for pairs.")
        if isfunction(getattr_static(cls, "function", None)):
            raise Refused(
                f"{about} has a function without @staticmethod; write it above the function, which gets no self."
            )
        return super().__new__(cls)

    def __post_init__(self):
        if not self.name:
            object.__setattr__(self, "name", self.default_name or type(self).__name__.lower())
        for argument in fields(self):
            object.__setattr__(self, argument.name, lasting(getattr(self, argument.name)))
        for name, function in self.functions_of_time.items():
            if not callable(function):
                raise Refused(f"{self.name}: {name} is {function!r}; give a function of (t, params).")
            check_arguments(f"{self.name}: {name}", function, "t, params")
        is_number = isinstance(self.rate, int) and not isinstance(self.rate, bool) and self.rate > 0
        if not (is_number and self.kind == "potential") and self.rate not in ("slow", "fast", "auto"):
            number = ", or of a potential a whole number k, for every k-th micro node"
            raise Refused(f"{self.name}: rate is {self.rate!r}; it must be 'slow', 'fast' or 'auto'{number}.")

    def check(self, moved: bool = False) -> None:
        """Refuse bodies and parameters that do not fit this effect, which is bound.

        Args:
            moved: whether the scene moves the bodies onto the constraints later, so that these may be violated now.

        Raises:
            TypeError: parameters that are no real numbers.
            ValueError: unknown bodies, a body twice in one element, bodies of different dimension, at one point, or of
                general coordinates where points are needed; parameters of another shape, sign or precision, and
                arguments that the class of the effect forbids.
        """
        self.check_bodies()
        for name, function in self.functions_of_time.items():
            about = f"{self.name}: {name}"
            self.check_of_time(about, shape_of(about, function, jnp.zeros(()), self.params_of_time))
        self.check_parameters()
        self.check_function()
        if self.kind == "constraint" and not moved:
            self.check_start()

    def check_bodies(self) -> None:
        """Refuse names of no body, and bodies whose coordinates the function cannot take."""
        for element in self.elements:
            if len(element) > MOST_ROLES:
                raise Refused(
                    f"{self.name}: an element of {len(element)} bodies, {', '.join(map(str, element[:3]))}, ...; at "
                    f"most {MOST_ROLES} bodies may share a function. Write the function with vmri_jax.System, or join "
                    "bodies to one with more coordinates."
                )
            if not moving(element):
                raise Refused(f"{self.name}: {element} is about the ground alone, which does not move; name a body.")
            for name in element:
                if name not in self.by_name and name != GROUND:
                    raise Refused(f"{self.name}: {unknown('body', str(name), [*self.by_name, GROUND])}")
                if element.count(name) > 1:
                    raise Refused(
                        f"{self.name}: {name} occurs twice in {element}; an element is between different bodies."
                    )
                try:
                    end = end_of(self.by_name, name, self.whole)
                except ValueError as error:
                    raise Refused(f"{self.name}: {error}") from None
                if self.dimensions and (end.block or end.size not in self.dimensions):
                    general, allowed = "general " if end.block else "", " or ".join(map(str, self.dimensions))
                    raise Refused(
                        f"{self.name}: {name} has {end.size} {general}coordinates; this effect is between points of "
                        f"dimension {allowed}."
                    )
            if self.same_size:
                self._check_sizes(element)
        if any(parameter.shape == "vector" for parameter in self.declared.values()):
            self._check_sizes([element[0] for element in self.elements])

    def check_of_time(self, about: str, value: Any) -> None:
        """Refuse a function of time whose value, as shapes, does not have the dimension of the bodies; `about` begins
        messages."""
        shape = getattr(value, "shape", None)
        for (body,), (end,) in zip(self.elements, self.ends, strict=True):
            if shape != (end.size,) and (shape, end.size) != ((), 1):
                raise Refused(f"{about} returns shape {shape}; {body} has dimension {end.size}, return ({end.size},).")

    def check_function(self) -> None:
        """Refuse a function of the user with a wrong value; it gets each group of equal elements, as the terms of the
        system do."""
        if self.kind == "control" or getattr(self.function, "__module__", "").startswith(LIBRARY):
            return
        for group in self.groups():
            *arguments, params = self.arguments_at_start(group)
            value = shape_of(f"{self.name}: function", self.called, *jax.device_put(arguments), arrays(params))
            _check_value(self, value, [x.shape for x in self.positions(group)], len(group))

    def check_parameters(self) -> None:
        """Refuse bodies at one place, parameters of another shape or sign, or that are not finite."""
        if self.apart:
            self.require_apart()
        for name, value in self.parameters.items():
            for leaf in jax.tree.leaves(value):
                if is_concrete(leaf) and not np.isfinite(leaf).all():
                    raise Refused(f"{self.name}: {name} is {np.asarray(leaf)}, which is not finite.")
        for name, parameter in self.declared.items():
            value = getattr(self, name)
            if parameter.sign and value is not None and is_concrete(value):
                value = np.asarray(value, dtype=float)
                fits = value > 0 if parameter.sign == "positive" else value >= 0
                self.require(fits, name, value, f"it must be {parameter.sign}")

    def curvature(self):
        """Largest second derivative of the energy of each element, () or (n,), if the start does not show it
        (contacts that are open); else None."""
        return None

    def drawing(self) -> dict[str, Any]:
        """Entries of this effect in the lists of `Scene.drawing`, "radii" of bodies as pairs (name, number), and
        "points": by label the points in rigid bodies where a drawn link or spring ends, with the body and the
        components of the point in it."""
        if self.drawn_as is None:
            return {}
        points = {
            name.label: (str(name), weights_of(self.by_name, name))
            for name in chain(*self.elements)
            if isinstance(name, Attachment) and name != GROUND
        }
        pairs = [pair for element in self.elements for pair in pairwise(element)]
        between = [[label_of(a), label_of(b)] for a, b in pairs if GROUND not in (a, b)]
        to_ground = [(a, b) if b == GROUND else (b, a) for a, b in pairs if GROUND in (a, b)]
        anchors = [
            {"body": label_of(body), "point": end_of(self.by_name, ground).position.tolist(), "kind": self.drawn_as}
            for body, ground in to_ground
        ]
        return {f"{self.drawn_as}s": between, "anchors": anchors, "points": points}

    def require(self, condition: Any, quantity: str, value: Any, expected: str) -> None:
        """Raise ValueError, "{quantity} is {value}; {expected}.", unless a condition is true everywhere, or traced."""
        if is_concrete(condition) and not np.all(condition):
            shown = np.asarray(value) if is_concrete(value) else value
            raise Refused(f"{self.name}: {quantity} is {shown}; {expected}.")

    def require_apart(self) -> None:
        """Refuse elements whose neighbouring bodies are at the same point at the start."""
        for element, ends in zip(self.elements, self.ends, strict=True):
            for (a, b), (from_a, to_b) in zip(pairwise(element), pairwise(ends), strict=True):
                differs = library(from_a, to_b).any(to_b.position != from_a.position)
                expected = "they must not start at the same point; move one of them"
                self.require(differs, f"the distance of {a} and {b}", 0.0, expected)

    def _check_sizes(self, names: Sequence[str]) -> None:
        sizes = {name: end_of(self.by_name, name, self.whole).size for name in names}
        if len(set(sizes.values())) > 1:
            described = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise Refused(f"{self.name}: bodies of different dimension ({described}); they must have the same.")

    def check_start(self) -> None:
        """Refuse a constraint that the start violates, such as a link whose length is not the distance of its ends."""
        for name in (name for name, parameter in self.declared.items() if parameter.measured):
            kept = self.parameters[name]
            if getattr(self, name) is None or not is_concrete((kept, start := self.at_start(self.parameters))):
                continue
            values = np.broadcast_arrays(np.atleast_1d(kept), start)
            for element, kept, measured in zip(self.elements, *values, strict=True):
                agrees = abs(kept - measured) <= START_TOLERANCE * kept
                expected = (
                    f"it starts as {measured:.12g}; give this value, move a body, or let the scene do so, project=True"
                )
                self.require(agrees, f"{name} of {'-'.join(map(label_of, element))}", f"{kept:g}", expected)


def _check_value(effect: Any, value: Any, sizes: list[tuple[int, ...]], count: int) -> None:
    """Refuse a value of a function of `count` elements, as shapes, whose roles have the shapes `sizes`."""
    shape = getattr(value, "shape", None)
    if effect.kind == "force":
        fits = isinstance(value, tuple | list) and [getattr(x, "shape", None) for x in value] == sizes
        expected = (
            f"a tuple with a force for each body, of shapes {', '.join(map(str, sizes))}: (force,) of a single body"
        )
    elif effect.kind == "constraint":
        fits = shape is not None and (len(shape) < 2 or count > 1)
        expected = "a vector (k,) of values that are kept zero, or one value ()"
    else:
        fits, expected = shape == (), "an energy, a scalar of shape (), the sum over all elements"
    if not fits:
        raise Refused(f"{effect.name}: function returns {describe(value)}; it must return {expected}.")
