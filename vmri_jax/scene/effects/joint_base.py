"""Base classes of joints: two bodies, the points and triads of the joint in them, and its freedoms, functions of the
coordinates of both bodies.

For the letters see `vmri_jax.scene.effects.joints`.
"""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import chain, islice, repeat
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, numbers_of, real_array
from vmri_jax.mechanics.constraints import START_TOLERANCE
from vmri_jax.mechanics.kinematics import UNMOVED
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.rows import Rows
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import Key
from vmri_jax.scene.body import GROUND, Attachment, body_of, joined, label_of
from vmri_jax.scene.declare import names, stacked
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.products import products
from vmri_jax.scene.rigid import RigidBody
from vmri_jax.scene.terms import Applied, Role

GAP = (("D", "x"), ("D", "y"), ("D", "z"))
"""Rows that keep the points of both bodies at one place: the components of D along the axes of space."""
PARALLEL = (("n", "e"), ("n", "e'"))
"""Rows that keep the axes n and f parallel."""
AXES = dict(zip("xyz", np.eye(3), strict=True))
"""The axes of space, which a row may have as one of its two vectors."""
VECTORS = ["D", "m", "m'", "n"], ["D", "e", "e'", "f"]
"""The vectors that a row may have from a and from b; the gap D is the point of b less the point of a."""

Freedom = Literal["turn", "slide", "tilt", "along", "across"]
"""In this order: the angle about the axis n, the distance along n, the angle about the second axis e, the distances
along m and m'."""
FREEDOMS: dict[str, tuple[tuple[str, str], ...]] = {
    "turn": (("m'", "e"), ("m", "e")),
    "slide": (("n", "D"),),
    "tilt": (("n", "e'"), ("n", "f")),
    "along": (("m", "D"),),
    "across": (("m'", "D"),),
}
"""For each freedom, the pairs of vectors whose products are its value against the given position, m; of an angle its
sine and its cosine, times a common factor near 1."""
ANGLES = ("turn", "tilt")
"""The freedoms that are angles."""
AXES_OF = {"turn": 2, "slide": 2, "tilt": 0, "along": 0, "across": 1}
"""For each freedom, the number of the vector of the triad (m, m', n) about which or along which b moves."""
REACH = 5 * np.pi / 6
"""rad: an effect that counts whole turns may take an angle from directors up to this size. Directors know angles up to
whole turns; the gap of a third of a turn between REACH and -REACH is too wide to be jumped over by a run with six steps
in a turn. A larger value narrows the gap."""


def sine_and_cosine(q, params):
    """Sine and cosine of an angle, times a common factor near 1."""
    values = products(2, q, params)
    return values[..., 0], values[..., 1]


def angle(q, params):
    """An angle, rad, between -pi and pi."""
    sine, cosine = sine_and_cosine(q, params)
    return library(sine).arctan2(sine, cosine)


def within_reach(q, params):
    """An angle, rad; beyond `REACH` NaN with all its derivatives, which ends a run in place of a wrong number of
    turns."""
    x = angle(q, params)
    return x * jnp.where(jnp.abs(x) < REACH, 1.0, jnp.nan)


def distance(q, params):
    """A displacement, m."""
    return products(1, q, params)[..., 0]


def coordinate(q, params):
    """A freedom that is a coordinate of the scene, ``q = ((..., 1),)``."""
    return q[0][..., 0]


def freedoms_of(functions: tuple[Any, ...], q: Iterable[Any], params: Mapping[str, Any]) -> tuple[Any, ...]:
    """Freedoms by these functions, of the coordinate of each or of the coordinates of both bodies of its joint."""
    roles, numbers = iter(q), params.get("joints", (params,))
    sizes = (1 if function is coordinate else 2 for function in functions)
    of_each = zip(functions, sizes, numbers, strict=True)
    return tuple(function(tuple(islice(roles, size)), of_joint) for function, size, of_joint in of_each)


class Joint(Effect):
    """Base class of joints between two bodies, or between a body and the ground.

    Args:
        between: names (a, b), or a list of such pairs. A name may come with a point that is fixed in the body,
            ``(("hub", [1, 0, 0]), ("arm", [-1, 0, 0]))``: the body is joined there, and both points must coincide at
            the start. Along the axes of a joint both bodies need directors.
        at: (3,) m, the point of the joint in space at the start; or a point for each pair, (n, 3). It takes the place
            of points in `between`.
    """

    between: Any = names(2)
    at: Any = None

    kind = "constraint"
    is_analytic = True
    whole = True
    same_size = False
    derived = ("factors", "offsets")
    rows: ClassVar[tuple[tuple[str, str], ...]] = GAP
    """Pairs of vectors whose scalar products are the rows: of the gap D, both triads, and the axes x, y, z of space."""
    carries: ClassVar[bool] = False
    """Whether the joint can carry a body, whose position is then a function of the freedoms: these must be coordinates
    without a singularity."""
    freedoms: ClassVar[tuple[Freedom, ...]] = ()
    """The motions of the triad of b against the triad of a, applied one after the other."""

    def _elements(self):
        return tuple(tuple(map(str, element)) for element in super()._elements())

    @property
    def function(self):
        return Applied(products, (len(self.rows),))

    @cached_property
    def attached(self):
        # the numbers of a row hold what it has from the ground, so that the other body may stand in for it: joints to
        # the ground and joints between bodies are one term
        return tuple((b if a == GROUND else a, a if b == GROUND else b) for a, b in self.elements)

    def _parameters(self):
        return super()._parameters() | self.numbers(self.rows)

    def numbers(self, pairs: Sequence[tuple[str, str]]) -> dict[str, Any]:
        """The numbers of the products of pairs of `VECTORS` and axes of space for all elements, see `products`."""
        named, halves = [name for side in zip(*pairs, strict=True) for name in side], []
        offsets = np.stack([AXES.get(name, np.zeros(3)) for name in named])
        for role, vectors in enumerate(self.vectors):
            half = (np.array(named)[:, None] == VECTORS[role][: vectors.shape[1]]) @ vectors
            is_ground = np.array([pair[role] == GROUND for pair in self.elements])[:, None, None]
            offsets = offsets + is_ground * (half @ UNMOVED)
            halves.append(~is_ground * half)
        factors = library(halves).concatenate(halves, axis=-1)
        return {"factors": stacked([*factors]), "offsets": stacked([*offsets])}

    def label(self, i: int, freedom: str = "") -> str:
        """The name of the joint, followed by the names of both bodies of the i-th pair if there are several, and by the
        freedom likewise."""
        pair = "" if len(self.elements) == 1 else f" {'-'.join(self.elements[i])}"
        return f"{self.name}{pair}" + (f" {freedom}" if freedom and len(self.freedoms) > 1 else "")

    def value(self, freedom: str, i: int, coordinates: Mapping[str, Any]):
        """A freedom of the i-th pair, (...) rad or m, by the coordinates (..., n) of bodies by name; an angle is
        between -pi and pi."""
        function, *arguments = self._of_freedom(freedom, i, coordinates)
        return function(*arguments)

    def value_and_rate(self, freedom: str, i: int, coordinates: Mapping[str, Any], rates: Mapping[str, Any]):
        """As `value`, with its rate, for rates (..., n) of the coordinates of bodies."""
        function, q, params = self._of_freedom(freedom, i, coordinates)
        along = tuple(rates[name] for name in self.attached[i]), jax.tree.map(np.zeros_like, params)
        return numbers_of(jax.jit(jax.jvp, static_argnums=0)(function, (q, params), along))

    def _of_freedom(self, freedom: str, i: int, coordinates: Mapping[str, Any]) -> tuple:
        q, function = (coordinates[name] for name in self.attached[i]), angle if freedom in ANGLES else distance
        return function, *numbers_of((tuple(q), self.params_of((i,), self.numbers(FREEDOMS[freedom]))))

    @cached_property
    def triads(self) -> Any:
        """(n, 3, 3) axes (m, m', n) of the joint in space, for all pairs, where the freedoms are zero; None if the
        joint has no axis."""
        return None

    def check_bodies(self):
        super().check_bodies()
        for name in chain(*self.elements):
            body = body_of(self.by_name, name)
            if not body.rigid and (body.block or body.size != 3):
                raise Refused(
                    f"{self.name}: {name} has {body.size} coordinates; joints are between rigid bodies and points in "
                    "space."
                )

    def check_parameters(self):
        super().check_parameters()
        for (a, b), points in zip(super()._elements(), self.joining_points, strict=True):
            if not is_concrete(points):
                continue
            distance = np.linalg.norm(points[1] - points[0])
            coincide = distance <= START_TOLERANCE * max(np.max(np.abs(points[0])), 1.0)
            first, second = (f"{label_of(name)} is at {np.asarray(p)}" for name, p in zip((a, b), points, strict=True))
            expected = f"{first} and {second}; they must coincide at the start"
            self.require(coincide, f"the distance of the points of {a}-{b}", f"{float(distance):.6g}", expected)

    def drawing(self):
        points = [vectors[:, 0, :1] * vectors[:, 0, 1:] for vectors in self.vectors]  # their signs are those of D
        ends = {
            f"{self.name} {'-'.join(element)} in {name}": (name, points[role][i])
            for i, element in enumerate(self.elements)
            for role, name in enumerate(element)
            # a line to a point outside the drawn shape of a body is drawn from the centre
            if isinstance(body := body_of(self.by_name, name), RigidBody) and not body.covers(points[role][i])
        }
        return {"links": [[name, end] for end, (name, _) in ends.items()], "points": ends}

    @cached_property
    def joining_points(self):
        """For each pair the point of the joint in space as a has it and as b has it, at the start: [((3,), (3,)),
        ...]."""
        pairs = super()._elements()  # as the user wrote them: `Attachment` where a name came with a point
        if self.at is not None:
            if any(isinstance(name, Attachment) for pair in pairs for name in pair):
                raise Refused(f"{self.name}: between has points in the bodies, and at is given too; give one of them.")
            return [(point, point) for point in _vectors(f"{self.name}: at", self.at, len(pairs))]
        joining = []
        for pair in pairs:
            # a point mass is joined at its position; a rigid body that came without a point, at the point of the other
            # body
            points = [
                body_of(self.by_name, name).point(getattr(name, "offset", None)).position
                for name in pair
                if isinstance(name, Attachment) or (name != GROUND and not self.by_name[name].rigid)
            ]
            if not points:
                raise Refused(
                    f"{self.name}: nothing says where {pair[0]} and {pair[1]} are joined; give at=[x, y, z], or a "
                    f"point in one of them, as in ({pair[0]!r}, ({pair[1]!r}, [x, y, z]))."
                )
            joining.append((points[0], points[-1]))
        return joining

    @cached_property
    def vectors(self) -> list[Any]:
        """Of a and of b: the `VECTORS` of all pairs as factors (c, X) of the centre and the directors of the body,
        (n, 4, 4); (n, 1, 4) without axes."""
        ends: list[list] = [[], []]
        for element, points, triad in zip(self.elements, self.joining_points, self.triads or repeat(()), strict=False):
            for of_role, name, point, sign in zip(ends, element, points, (-1.0, 1.0), strict=True):
                body = body_of(self.by_name, name)
                if not body.rigid and self.triads:
                    raise Refused(
                        f"{self.name}: {name} is a point, which has no axes; a point can be joined by Spherical alone."
                    )
                # X = R^T (x - phi): the point in the axes of the body
                offset = (point - body.position) @ body.rotation if body.rigid else np.zeros(3)
                rows = [sign * joined([np.ones(1), body.weights(offset)])]
                try:
                    rows += [joined([np.zeros(1), body.weights(vector @ body.rotation)]) for vector in triad]
                except ValueError as error:
                    raise Refused(f"{self.name}: {error}") from None
                of_role.append(library(rows).stack(rows))
        return [library(end).stack(end) for end in ends]


class AboutAxis(Joint):
    """Joints with an axis: (3,) its direction in space at the start, of any length; or a direction for each of k pairs,
    (k, 3)."""

    axis: Any = (0.0, 0.0, 1.0)

    carries = True
    rows = (*GAP, *PARALLEL)

    @cached_property
    def triads(self):
        return [_triad(axis) for axis in self._directions("axis")]

    def _directions(self, name: str):
        """(n, 3) the vectors of the field `name` for all pairs, scaled to length one."""
        vectors = _vectors(f"{self.name}: {name}", getattr(self, name), len(self.elements))
        lengths = library(vectors).linalg.norm(vectors, axis=-1, keepdims=True)
        self.require(lengths > 0, name, getattr(self, name), "it must not be zero")
        return vectors / lengths


def joint_named(about: str, name: str, effects: Iterable[Effect]) -> Joint:
    """The joint with a name among effects; `about` begins the message if there is none."""
    joints = {effect.name: effect for effect in effects if isinstance(effect, Joint)}
    if not isinstance(name, str):
        raise Refused(
            f"{about}: joint is {name!r}; give the name of one joint. Each joint has an effect of its own with a "
            "name=, or several pairs of bodies are one joint."
        )
    if name not in joints:
        raise Refused(f"{about}: {unknown('joint', name, joints)}")
    return joints[name]


def freedom_of(joint: Joint, of: str, about: str = "") -> Freedom:
    """The freedom of a joint with the name `of`; with "auto" its only freedom.

    `about` begins the message if there is none, or several.
    """
    fitting: list[Freedom] = [freedom for freedom in joint.freedoms if of in (freedom, "auto")]
    if len(fitting) == 1:
        return fitting[0]
    free = " and ".join(joint.freedoms) or "neither an angle nor a displacement along an axis"
    raise Refused(f"{about}of is {of!r}; {joint.name} leaves {free} free.")


class OfFreedoms(Effect):
    """Base class of effects whose functions get freedoms of joints, () each or (n,) of n elements, as q, and their
    rates as v."""

    whole = True
    same_size = False
    counts_turns: ClassVar[bool] = True
    """Whether another number of whole turns of an angle changes the effect. A joint with such an effect is the last one
    that a loop is cut at; where its angle comes from directors all the same, it is `within_reach`."""
    marks: ClassVar[tuple[str, ...]] = ()
    """Names of parameters that are values of the freedom, such as limits."""

    @property
    @abstractmethod
    def joint_freedoms(self) -> Sequence[tuple[Joint, Freedom]]:
        """The joints, of as many pairs each, and the freedom in each, of which an element takes one."""

    def freedoms_of(self, i: int) -> tuple[Key, ...]:
        return tuple((joint.name, i, freedom) for joint, freedom in self.joint_freedoms)

    def by_directors(self, freedom: str) -> Any:
        """The function of the coordinates of both bodies for a freedom that is no coordinate of the scene."""
        if freedom not in ANGLES:
            return distance
        return within_reach if self.counts_turns else angle

    def _elements(self):
        pairs = zip(*(joint.elements for joint, _ in self.joint_freedoms), strict=False)
        return tuple(tuple(chain(*names)) for names in pairs)

    @cached_property
    def attached(self):
        pairs = zip(*(joint.attached for joint, _ in self.joint_freedoms), strict=False)
        return tuple(tuple(chain(*names)) for names in pairs)

    def positions(self, group):
        """The freedoms at the positions in `bodies`, which are zero."""
        return tuple(stacked([0.0] * len(group)) for _ in self.freedoms_of(group[0]))

    def kind_of(self, i, layout=None):
        is_free = tuple(layout is not None and key in layout.freedoms for key in self.freedoms_of(i))
        # elements whose freedoms are all coordinates are one term, whatever their bodies are
        return is_free if all(is_free) else (*is_free, super().kind_of(i))

    def term(self, group, layout):
        roles, freedoms = [], []
        for j, keys in enumerate(zip(*map(self.freedoms_of, group), strict=True)):
            if keys[0] in layout.freedoms:
                freedoms.append(coordinate)
                roles.append(Role(Rows.of([layout.freedoms[key] for key in keys]), len(group), 1))
                continue
            freedoms.append(self.by_directors(keys[0][2]))
            for role in (2 * j, 2 * j + 1):
                roles.append(self._role("", [self.attached[i][role] for i in group], layout.bodies))
        # freedoms that are coordinates need no numbers of joints
        unused = self.derived if set(freedoms) == {coordinate} else ()
        return self._term(roles, group, Applied(freedoms_of, (tuple(freedoms),)), unused)

    def check_bodies(self):
        """Nothing: the joints check their bodies themselves."""


def _triad(axis):
    """(3, 3) orthonormal (m, m', n) with n along a unit vector."""
    xp = library(axis)
    # the axis of space furthest from n: its part across n is not small
    i = xp.argmin(xp.abs(axis))
    m = xp.eye(3)[i] - axis[i] * axis
    m = m / xp.linalg.norm(m)
    return xp.stack([m, xp.cross(axis, m), axis])


def _vectors(argument: str, numbers, count: int):
    """(count, 3) vectors from a single vector (3,), or from a vector for each pair; `argument` begins messages."""
    vectors = for_pairs(argument, numbers, count, "(3,)", (3,))
    return library(vectors).broadcast_to(vectors, (count, 3))


def for_pairs(about: str, numbers: Any, count: int, form: str, shape: tuple[int, ...] = ()) -> Any:
    """Finite numbers of a shape, or (count, *shape) for the pairs of a joint; `form` is the form of a single one, for
    messages."""
    values = real_array(about, numbers)
    if values.shape not in (shape, (count, *shape)):
        for_each = f", or one for each pair, {(count, *shape)}" if count > 1 else ""
        raise Refused(f"{about} has shape {values.shape}; give {form}{for_each}.")
    if is_concrete(values) and not np.isfinite(values).all():
        raise Refused(f"{about} is {values}; it must be finite.")
    return values
