"""Joints between rigid bodies: what they leave free is what the bodies can do.

With the point of the joint at ``phi + rho`` in each body, the gap ``D = phi_b + rho_b - phi_a - rho_a``, and the triads
``(m, m', n)`` fixed in a and ``(e, e', f)`` fixed in b, which coincide at the start, n along the axis:

| joint | rows |
|---|---|
| spherical | ``D`` |
| universal | ``D``, ``n . e``, e along a second axis |
| revolute | ``D``, ``n . e``, ``n . e'`` |
| fixed | ``D``, ``n . e``, ``n . e'``, ``m . e'`` |
| cylindrical | ``m . D``, ``m' . D``, ``n . e``, ``n . e'`` |
| prismatic | ``m . D``, ``m' . D``, ``n . e``, ``n . e'``, ``m . e'`` |
| screw | those of the cylindrical joint, and the turn that belongs to the way ``n . D`` |
| planar | ``n . D``, ``n . e``, ``n . e'`` |

Rows of axes are homogeneous in the directors of each body: between macro nodes, where the interpolated directors of a slow
body are a little too short, they still mean the same direction.

Source: P. Betsch, S. Leyendecker, Int. J. Numer. Meth. Engng 67 (2006).
"""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, real_array
from vmri_jax.mechanics.kinematics import Move
from vmri_jax.scene.body import GROUND, GROUND_COORDINATES, Attachment, Bodies, body_of, label_of
from vmri_jax.scene.declare import effect_class, names, number, squeeze
from vmri_jax.scene.effect import START, Effect
from vmri_jax.scene.effects.freedoms import (
    FREEDOMS,
    M_PRIME,
    PARALLEL,
    UNTURNED,
    Freedom,
    M,
    N,
    across,
    aligned,
    gap,
    slide,
    turn_by_sine,
)
from vmri_jax.scene.rigid import RigidBody


@effect_class
class Joint(Effect):
    """What all joints share: two bodies, one of them perhaps the ground, and the point where they are joined.

    Args:
        between: names (a, b), or a list of such pairs; with points in them, ``(("hub", [1, 0, 0]), ("arm", [-1, 0, 0]))``,
            these are the points of the joint, and must coincide at the start.
        at: (3,) the point of the joint in space at the start; or one for each pair, (n, 3). Instead of points in the bodies.

    Raises:
        ValueError: (of the scene) no point, or points that do not coincide; directions that a body does not have.
    """

    between: Any = names(2)
    at: Any = None

    kind = "constraint"
    whole = True
    same_size = False
    derived = ("point_a", "point_b", "frame_a", "frame_b")
    carries: ClassVar[bool] = False
    """Whether b may be a function of its freedoms: whether these are coordinates without a pole."""
    moves: ClassVar[tuple[Move, ...]] = ()
    """What these do with the triad of a, one after the other."""
    freedoms: ClassVar[tuple[Freedom, ...]] = ()
    """What it leaves free, in the order of the coordinates of its moves."""

    def elements(self, bodies):
        return tuple(tuple(map(str, element)) for element in super().elements(bodies))

    def parameters(self, bodies):
        return {name: squeeze(library(values).stack(values)) for name, values in self._frames(bodies).items()}

    def points(self, bodies):
        return {}

    def label(self, i: int, bodies: Bodies) -> str:
        """What the i-th pair is called: the name of the joint, where it has several with that of its bodies."""
        elements = self.elements(bodies)
        return self.name if len(elements) == 1 else f"{self.name} {'-'.join(elements[i])}"

    def pitch_of(self, i: int):
        """How far b moves along the axis in a turn of the i-th pair, m; zero of joints that are no screws."""
        return np.zeros(())

    def frame(self, count: int) -> list | None:
        """(n, 3, 3) the triads (m, m', n) in space where its freedoms are zero, None where the joint needs no direction."""
        return None

    def check_bodies(self, bodies):
        super().check_bodies(bodies)
        for element in self.elements(bodies):
            for name in element:
                body = body_of(bodies, name)
                if not body.rigid and (body.block or body.size != 3):
                    raise ValueError(
                        f"{self.name}: {name} has {body.size} coordinates; joints are between rigid bodies and points in space."
                    )

    def check_parameters(self, bodies):
        super().check_parameters(bodies)
        for a, b, points in zip(*zip(*self._given(bodies), strict=True), self.joining_points(bodies), strict=True):
            if not is_concrete(points):
                continue
            away = np.linalg.norm(points[1] - points[0])
            size = max(np.max(np.abs(points[0])), 1.0)
            where = " and ".join(
                f"{label_of(name)} is at {np.asarray(p)}" for name, p in zip((a, b), points, strict=True)
            )
            what = f"the distance of the points of {a}-{b}"
            self.require(away <= START * size, what, f"{float(away):.6g}", f"{where}; they must coincide at the start")

    def drawn_points(self, bodies):
        params = self.parameters(bodies)
        points = {role: np.atleast_2d(params[f"point_{role}"]) for role in "ab"}
        return {
            self._end(element, name): (name, points[role][i])
            for i, element in enumerate(self.elements(bodies))
            for role, name in zip("ab", element, strict=True)
            if self._sticks_out(name, points[role][i], bodies)
        }

    def drawing(self, bodies):
        return {"links": [[name, end] for end, (name, _) in self.drawn_points(bodies).items()]}

    @staticmethod
    def _sticks_out(name: str, point, bodies) -> bool:
        """Whether an arm is drawn from the centre of a body to the point of the joint."""
        body = body_of(bodies, name)
        return isinstance(body, RigidBody) and not body.covers(point)

    def _end(self, element, name: str) -> str:
        """What the point of the joint in a body is called in drawings."""
        return f"{self.name} {'-'.join(element)} in {name}"

    def _given(self, bodies):
        return super().elements(bodies)

    def joining_points(self, bodies):
        """The points of the joint in space, one in each body, pair by pair."""
        given = self._given(bodies)
        if self.at is not None:
            for element in given:
                if any(isinstance(name, Attachment) for name in element):
                    raise ValueError(
                        f"{self.name}: between has points in the bodies, and at is given too; give one of them."
                    )
            at = _rows(f"{self.name}: at", self.at, len(given))
            return [(point, point) for point in at]
        found = []
        for element in given:
            inside = [isinstance(name, Attachment) for name in element]
            points = [
                body_of(bodies, name).point(getattr(name, "at", None)).position
                for name, attached in zip(element, inside, strict=True)
                if attached or (name != GROUND and not bodies[name].rigid)
            ]
            if not points:
                raise ValueError(
                    f"{self.name}: nothing says where {element[0]} and {element[1]} are joined; give at=[x, y, z], or a point in one of "
                    f"them, as in ({element[0]!r}, ({element[1]!r}, [x, y, z]))."
                )
            found.append((points[0], points[-1]))
        return found

    def _frames(self, bodies) -> dict[str, list]:
        """Points and triads of every pair, as weights of the directors of each body."""
        elements, points = self.elements(bodies), self.joining_points(bodies)
        frames = self.frame(len(elements))
        found: dict[str, list] = {}
        for i, element in enumerate(elements):
            for role, name, point in zip("ab", element, points[i], strict=True):
                body = body_of(bodies, name)
                if not body.rigid:
                    if frames is not None:
                        raise ValueError(
                            f"{self.name}: {name} is a point, which has no axes; a point can be joined by Spherical alone."
                        )
                    found.setdefault(f"point_{role}", []).append(np.zeros(3))
                    continue
                found.setdefault(f"point_{role}", []).append(body.weights((point - body.position) @ body.rotation))
                if frames is not None:
                    try:
                        own = [body.weights(vector @ body.rotation) for vector in frames[i]]
                    except ValueError as error:
                        raise ValueError(f"{self.name}: {error}") from None
                    found.setdefault(f"frame_{role}", []).append(library(own).stack(own))
        return found


@effect_class
class Spherical(Joint):
    """Ball joints: the bodies share a point; three rows, ``D = 0``.

    Args:
        between, at: as of `Joint`. A body that is a point is joined by itself.
    """

    default_name = "spherical"
    function = staticmethod(gap)


@effect_class
class _AboutAxis(Joint):
    """Joints with an axis.

    Args:
        between, at: as of `Joint`.
        axis: (3,) direction n in space at the start, of any length; or one for each pair, (n, 3).
    """

    axis: Any = (0.0, 0.0, 1.0)

    def frame(self, count: int):
        return [triad(axis) for axis in self._directions("axis", count)]

    def _directions(self, name: str, count: int):
        """(n, 3) unit vectors of a field."""
        rows = _rows(f"{self.name}: {name}", getattr(self, name), count)
        lengths = library(rows).linalg.norm(rows, axis=-1, keepdims=True)
        self.require(lengths > 0, name, getattr(self, name), "it must not be zero")
        return rows / lengths


@effect_class
class Revolute(_AboutAxis):
    """Hinges: b turns about an axis that is fixed in both bodies; five rows, ``D = 0, n . e = n . e' = 0``.

    Args:
        between, at, axis: as of `Joint`, and the axis in space at the start.
    """

    default_name = "revolute"
    carries = True
    moves = (Move("turn", N),)
    freedoms = ("turn",)

    @staticmethod
    def function(q, params):
        return jnp.concatenate([gap(q, params), aligned(q, params, *PARALLEL)], axis=-1)


@effect_class
class Universal(_AboutAxis):
    """Cardan joints: an axis n of a and an axis e of b stay perpendicular; four rows, ``D = 0, n . e = 0``.

    Args:
        between, at, axis: as of `Joint`; axis is that of a.
        second: (3,) the axis of b, perpendicular to `axis` at the start; or one for each pair, (n, 3).

    Raises:
        ValueError: (of the scene) axes that are not perpendicular.
    """

    second: Any = (1.0, 0.0, 0.0)

    default_name = "universal"
    carries = True
    moves = (Move("turn", N), Move("turn", M))
    freedoms = ("turn", "tilt")

    @staticmethod
    def function(q, params):
        return jnp.concatenate([gap(q, params), aligned(q, params, (N, M))], axis=-1)

    def frame(self, count: int):
        first, second = self._directions("axis", count), self._directions("second", count)
        tilt, xp = (first * second).sum(axis=-1), library(first, second)
        self.require(abs(tilt) < START, "axis . second", tilt, "the axes must be perpendicular")
        return [xp.stack([m, xp.cross(n, m), n]) for n, m in zip(first, second, strict=True)]


@effect_class
class Fixed(_AboutAxis):
    """Two bodies that move as one; six rows, ``D = 0, n . e = n . e' = m . e' = 0``.

    Args:
        between, at: as of `Joint`.
    """

    default_name = "fixed"
    carries = True

    @staticmethod
    def function(q, params):
        return jnp.concatenate([gap(q, params), aligned(q, params, *PARALLEL, UNTURNED)], axis=-1)


@effect_class
class Cylindrical(_AboutAxis):
    """b slides along an axis and turns about it; four rows, ``m . D = m' . D = 0, n . e = n . e' = 0``.

    Args:
        between, at, axis: as of `Revolute`.
    """

    default_name = "cylindrical"
    carries = True
    moves = (Move("turn", N), Move("slide", N))
    freedoms = ("turn", "slide")

    @staticmethod
    def function(q, params):
        return jnp.concatenate([across(q, params), aligned(q, params, *PARALLEL)], axis=-1)


@effect_class
class Screw(_AboutAxis):
    """Nuts on bolts: b moves along the axis as it turns; five rows, those of `Cylindrical` and ``m' . e cos a = m . e sin a``.

    a is the angle that belongs to the way, ``2 pi n . D / pitch``.

    Args:
        between, at, axis: as of `Revolute`.
        pitch: how far b moves along the axis in a turn, m, not zero, negative for a left-handed one; one number, or one for each pair.
            A millimetre by default.

    Raises:
        ValueError: (of the scene) a pitch of zero.
    """

    pitch: Any = number(default=1e-3)

    default_name = "screw"
    carries = True
    moves = (Move("screw", N),)
    freedoms = ("turn",)

    def parameters(self, bodies):
        return super().parameters(bodies) | {"pitch": self._pitch(len(self.elements(bodies)))}

    def check_parameters(self, bodies):
        super().check_parameters(bodies)
        pitch = self._pitch(len(self.elements(bodies)))
        self.require(pitch != 0, "pitch", pitch, "it must not be zero; without one take Revolute")

    def pitch_of(self, i):
        pitch = real_array(f"{self.name}: pitch", self.pitch)
        return pitch[i] if pitch.ndim else pitch

    def _pitch(self, count: int):
        pitch = real_array(f"{self.name}: pitch", self.pitch)
        if pitch.shape not in ((), (count,)):
            raise ValueError(
                f"{self.name}: pitch has shape {pitch.shape}; give one number, or one for each of {count} pairs."
            )
        return pitch

    @staticmethod
    def function(q, params):
        angle = 2 * jnp.pi * slide(q, params) / params["pitch"]
        sine, cosine = turn_by_sine(q, params)
        turned = sine * jnp.cos(angle) - cosine * jnp.sin(angle)
        return jnp.concatenate([across(q, params), aligned(q, params, *PARALLEL), turned[..., None]], axis=-1)


@effect_class
class Planar(_AboutAxis):
    """b moves in a plane: along two directions across the axis, and about the axis; three rows, ``n . D = 0, n . e = n . e' = 0``.

    Its freedoms are "along" and "across", the ways along m and m', and "turn".

    Args:
        between, at: as of `Joint`.
        axis: as of `Revolute`, across the plane.
    """

    default_name = "planar"
    carries = True
    moves = (Move("slide", M), Move("slide", M_PRIME), Move("turn", N))
    freedoms = ("along", "across", "turn")

    @staticmethod
    def function(q, params):
        return jnp.concatenate([slide(q, params)[..., None], aligned(q, params, *PARALLEL)], axis=-1)


@effect_class
class Prismatic(_AboutAxis):
    """Slides: b moves along an axis and does not turn; five rows, those of `Cylindrical` and ``m . e' = 0``.

    Args:
        between, at, axis: as of `Revolute`.
    """

    default_name = "prismatic"
    carries = True
    moves = (Move("slide", N),)
    freedoms = ("slide",)

    @staticmethod
    def function(q, params):
        return jnp.concatenate([across(q, params), aligned(q, params, *PARALLEL, UNTURNED)], axis=-1)


def freedom_of(joint: Joint, of: str) -> Freedom:
    """The freedom that a joint leaves: that which is asked for, or with "auto" the one that there is.

    Raises:
        ValueError: it leaves another one, several, or none.
    """
    fitting: list[Freedom] = [freedom for freedom in joint.freedoms if of in (freedom, "auto")]
    if len(fitting) == 1:
        return fitting[0]
    left = " and ".join(joint.freedoms) or "neither an angle nor a way along an axis"
    raise ValueError(f"of is {of!r}; {joint.name} leaves {left} free.")


def along_run(joint: Joint, run, bodies: Bodies, of: str, pair: int) -> np.ndarray:
    """The freedom of a joint along a run, (k,), angles without jumps; see `Scene.joint_motion`.

    Args:
        joint, bodies: of the scene.
        run: of the scene.
        of: as of `freedom_of`.
        pair: number of the pair of bodies, where it joins several.

    Raises:
        IndexError: no such pair.
    """
    name, element = freedom_of(joint, of), joint.elements(bodies)[pair]
    _, params = joint.one(pair, bodies, joint.parameters(bodies))
    q = tuple(GROUND_COORDINATES if body == GROUND else np.asarray(run.position(body)) for body in element)
    values = np.asarray(FREEDOMS[name](q, params))
    return np.unwrap(values) if name == "turn" else values


def triad(axis):
    """(3, 3) orthonormal (m, m', n) with n along a unit vector."""
    xp = library(axis)
    helper = xp.eye(3)[xp.argmin(xp.abs(axis))]
    m = xp.cross(helper, axis)
    m = m / xp.linalg.norm(m)
    return xp.stack([m, xp.cross(axis, m), axis])


def _rows(what: str, given, count: int):
    """(n, 3) vectors of one or of n."""
    rows = real_array(what, given)
    if rows.shape not in ((3,), (count, 3)):
        more = f", or one for each pair, ({count}, 3)" if count > 1 else ""
        raise ValueError(f"{what} has shape {rows.shape}; give (3,){more}.")
    return library(rows).broadcast_to(rows, (count, 3))
