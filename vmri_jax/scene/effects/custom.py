"""Custom effects: a function of the user, and the bodies that it takes:

def magnet(q, params):
    ball, coil = q
    return -params["strength"] / jnp.linalg.norm(ball - coil) ** 3

Potential(magnet, ("ball", "coil"), {"strength": 2.0}, drawn_as="spring")
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, Literal

from vmri_jax.mechanics.functions import NO_TIME, NO_VELOCITY, check_arguments
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import end_of, entry, is_entry
from vmri_jax.scene.declare import real_tree
from vmri_jax.scene.effect import Effect

_INSTEAD = {
    "force": "Force(function, bodies), function(t, q, v, params)",
    "moving": "Constraint(..., timed=True), whose function gets t first",
}


class CustomEffect(Effect):
    """An effect with a single element, whose function the user gives.

    Args:
        function: see `Effect`.
        bodies: names of the bodies, in the order in which the function takes them. The function gets all coordinates of
            a rigid body; with ``(name, [x, y, z])`` the position of this point in it, and with
            ``("ground", [x, y, z])`` a fixed point.
        params: of the function: numbers, arrays, or lists and dictionaries of them. They may change without a new
            compilation, and runs have derivatives with respect to them.
        name: the name of the function by default.
        drawn_as: "link" or "spring", drawn between each of the bodies and the next; None draws nothing.
    """

    function: Callable  # pyright: ignore[reportIncompatibleVariableOverride]
    bodies: Any
    params: Any = field(default_factory=dict)
    drawn_as: Literal["link", "spring"] | None = field(default=None, kw_only=True)  # pyright: ignore[reportIncompatibleVariableOverride]

    same_size = False
    whole = True

    def __post_init__(self):
        if not callable(self.function):
            raise Refused(f"{type(self).__name__}: function is {self.function!r}; give a function of (q, ...).")
        if not self.name:
            object.__setattr__(self, "name", getattr(self.function, "__name__", type(self).__name__.lower()))
        instead = {"constraint": NO_VELOCITY, "force": ""}.get(self.kind, NO_TIME).format(**_INSTEAD)
        arguments = ", ".join((*self.arguments, "params"))
        check_arguments(f"{type(self).__name__}: function", self.function, arguments, instead)
        super().__post_init__()
        if self.drawn_as not in (None, "link", "spring"):
            raise Refused(f"{self.name}: drawn_as is {self.drawn_as!r}; it must be 'link', 'spring' or None.")

    def _elements(self):
        names = (self.bodies,) if is_entry(self.bodies) else tuple(self.bodies)
        if not names or not all(map(is_entry, names)):
            kind = type(self).__name__
            raise Refused(
                f"{self.name}: bodies is {self.bodies!r}; give the names of the bodies that the function takes. A "
                f"custom effect has one element: for several tuples of bodies write a {kind}(...) for each, with "
                "name=..."
            )
        return (tuple(map(entry, names)),)

    def _parameters(self):
        params, points = real_tree(f"{self.name}: params", self.params), self.points
        if points and not isinstance(params, dict):
            raise Refused(
                f"{self.name}: params is {self.params!r}; with points in rigid bodies it must be a dictionary."
            )
        return params | points if points else params

    def check_bodies(self):
        super().check_bodies()
        if self.drawn_as is None:
            return
        (element,) = self.elements
        alone = f"it is drawn between bodies, and {element[0]} is alone; leave it out"
        self.require(len(element) > 1, "drawn_as", repr(self.drawn_as), alone)
        for name in element:
            end = end_of(self.by_name, name)
            sized = f"it is drawn between points, and {name} has {end.size} coordinates; leave it out"
            self.require(not end.block, "drawn_as", repr(self.drawn_as), sized)


class Potential(CustomEffect):
    """A custom potential, ``function(q, params) -> ()``; for the arguments see `CustomEffect`."""

    kind = "potential"


class Constraint(CustomEffect):
    """A custom holonomic constraint, ``function(q, params) -> (k,)``, kept zero.

    For the other arguments see `CustomEffect`.

    Args:
        timed: whether the constraint depends on time, ``function(t, q, params)``.
    """

    timed: bool = field(default=False, kw_only=True)  # pyright: ignore[reportIncompatibleVariableOverride]

    kind = "constraint"


class Kinetic(CustomEffect):
    """A velocity-dependent part of the Lagrangian, ``function(q, v, params) -> ()``, added to the kinetic energy; see
    `CustomEffect`."""

    kind = "kinetic"


class Force(CustomEffect):
    """A custom force, ``function(t, q, v, params)``, which returns a tuple with a force for each body, shaped like q.

    For the arguments see `CustomEffect`.
    """

    kind = "force"
