"""Bodies: points of a scene, blocks of general coordinates, frames, the ground, and the points of a body that effects
act on."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, real_array
from vmri_jax.refusals import Refused

Pace = Literal["slow", "fast", "auto"]
LARGEST_POINT = 3
"""Most coordinates of a point; a body with more is a block of general coordinates."""
GROUND = "ground"
"""Name in effects of the body that does not move."""


class Attachment(str):
    """The name of a rigid body, and a point that is fixed in it; users write ``("hub", [0.5, 0, 0])``."""

    offset: Any
    """(3,) m from the centre of mass to the point, in the axes of the body; for the ground (d,) m, in space."""

    def __new__(cls, body: str, offset: Any):
        attached = super().__new__(cls, body)
        attached.offset = real_array(f"the point in {body}", offset, 1)
        return attached

    @property
    def label(self) -> str:
        """``hub (0.5, 0, 0)``."""
        if not is_concrete(self.offset):
            return f"{self} (a point)"
        round_off = 1e-12 * np.max(np.abs(self.offset))
        return f"{self} ({', '.join(f'{x:g}' if abs(x) > round_off else '0' for x in self.offset)})"


def is_entry(item: Any) -> bool:
    """Whether the item is the name of a body, or a pair of a name and a point in this body."""
    if isinstance(item, str):
        return True
    pair = isinstance(item, tuple | list) and len(item) == 2 and isinstance(item[0], str)
    return pair and not is_entry(item[1]) and not any(isinstance(x, str) for x in jax.tree.leaves(item[1]))


def entry(item: Any) -> str:
    """The name of a body, or an `Attachment`."""
    return item if isinstance(item, str) else Attachment(*item)


def label_of(name: str) -> str:
    """The name of a body, or of a point in a body, in messages and drawings."""
    return name.label if isinstance(name, Attachment) else name


def moving(names: Iterable[str]) -> tuple[str, ...]:
    """The names without repetitions and without the ground."""
    return tuple(dict.fromkeys(str(name) for name in names if name != GROUND))


class Point(NamedTuple):
    """A body, or a point in a body, as an effect between points takes it; a point in a body has no mass."""

    name: str
    position: Any
    mass: Any = None
    block: bool = False

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.position.shape[0]


class AnyBody:
    """Base class of bodies.

    Attributes:
        name, pace: see `Body`.
        mass: kg; None of a body without mass.
        directors: (3, 3) principal axes in space at the start, one per row.
        rates: (n,) v at the start.
        masses: (n,) m of the kinetic energy ``sum_i m_i v_i^2 / 2``.
        block: whether it has general coordinates, not the position of a point.
        rigid: whether its coordinates are a centre and directors.
        rotation: (3, 3) axes of the body in space at the start as columns; None for a body without axes.
        wide: indices of the directors that are among its coordinates: of the axes along which the body has a width.
    """

    name: str
    pace: Pace
    mass: Any
    position: Any
    directors: Any
    rates: Any
    masses: Any
    radius: float | None
    block: bool
    rigid: bool = False
    rotation: Any = None
    wide: tuple[int, ...] = ()

    @property
    def coordinates(self) -> Any:
        """(n,) centre of mass and directors."""
        return joined([self.position, *(self.directors[i] for i in self.wide)])

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.coordinates.shape[0]

    @property
    def motions(self) -> np.ndarray:
        """(n, f) basis of the velocities that the rigidity of the body allows at the start."""
        return np.eye(self.size)

    def weights(self, offset: Any) -> Any:
        """(3,) components X along the directors of a point ``phi + sum_i X_i d_i`` fixed in the body, see `point`."""
        return joined([offset, np.zeros(3 - offset.shape[0])])

    def point(self, offset: Any = None) -> Point:
        """The centre of the body, or the point at `offset` (3,) m from it in the axes of the body, at the start."""
        if offset is None:
            return Point(self.name, self.position, self.mass, self.block)
        if not self.rigid:
            raise Refused(f"{self.name} is no rigid body, so that no point is fixed in it; give its name alone.")
        if offset.shape != (3,):
            raise Refused(f"the point in {self.name} has shape {offset.shape}; give (3,), in the axes of the body.")
        self.weights(offset)  # refuses a point outside a plate or a rod
        return Point(self.name, self.position + self.rotation @ offset)

    def with_rates(self, rates: np.ndarray) -> "AnyBody":
        """The same body with other rates (n,) of its coordinates at the start; a body without mass has none."""
        return self

    def _check_names(self) -> None:
        kind = type(self).__name__
        if not isinstance(self.name, str) or not self.name:
            raise Refused(f"{kind}: name is {self.name!r}; it must be a string that is not empty.")
        if self.name == GROUND:
            raise Refused(
                f"{kind}: name is {GROUND!r}, which effects call the body that does not move; take another name."
            )
        if self.pace not in ("slow", "fast", "auto"):
            raise Refused(f"{kind} {self.name}: pace is {self.pace!r}; it must be 'slow', 'fast' or 'auto'.")

    def _numbers(self, name: str, argument, shape: tuple[int, ...] | None = None):
        """An argument as an array of float64; of NumPy unless it is traced, so that the precision does not depend on
        JAX's mode."""
        about = f"{type(self).__name__} {self.name}: {name}"
        numbers = real_array(about, argument)
        if shape not in (None, numbers.shape):
            raise Refused(f"{about} has shape {numbers.shape}; give {shape}.")
        if not is_concrete(numbers):
            return numbers
        if not np.isfinite(numbers).all():
            raise Refused(f"{about} is {np.asarray(numbers)}, which is not finite.")
        return np.asarray(numbers)


@dataclass(frozen=True, eq=False)
class Body(AnyBody):
    """A point mass in one, two or three dimensions, or a block of n general coordinates with n masses.

    Its kinetic energy is ``sum_i m_i v_i^2 / 2``.

    Args:
        name: of the body in effects.
        mass: kg, positive; a number for all coordinates, or (n,).
        position: (n,) at the start, n = 1, 2, 3 and in m for a point. A number is a vector of length one.
        velocity: (n,) at the start; at rest by default.
        pace: "slow" coordinates take macro steps, "fast" coordinates micro steps; "auto" lets the scene decide from
            estimates of frequencies.
        radius: of the drawn ball, m; by default the drawing chooses it. It does not change the motion: contacts have an
            argument `radius` of their own.
        block: whether the coordinates are general coordinates of any kind, not the position of a point; more than three
            always are. Effects between points refuse a block; custom effects take it.

    Raises:
        TypeError: an argument that is no real number.
        ValueError: an empty name, a mass or radius that is not positive, numbers that are not finite or of float32,
            shapes that do not match, another pace.
    """

    name: str
    mass: Any
    position: Any
    velocity: Any = None
    pace: Pace = "auto"
    radius: float | None = None
    block: bool = False

    def __post_init__(self):
        self._check_names()
        position = self._vector("position", self.position)
        velocity = np.zeros(position.shape) if self.velocity is None else self._vector("velocity", self.velocity)
        mass = self._numbers("mass", self.mass)
        if velocity.shape != position.shape:
            raise Refused(
                f"Body {self.name}: velocity has shape {velocity.shape}, position has {position.shape}; they must be "
                "equal."
            )
        if mass.shape not in ((), position.shape):
            raise Refused(
                f"Body {self.name}: mass has shape {mass.shape}; give one number, or one for each of {position.size} "
                "coordinates."
            )
        if is_concrete(mass) and not np.all(mass > 0):
            raise Refused(f"Body {self.name}: mass is {mass}; every mass must be positive.")
        if self.radius is not None and is_concrete(self.radius) and not 0 < self.radius < np.inf:
            raise Refused(f"Body {self.name}: radius is {self.radius!r}; it must be a positive number, or None.")
        block = self.block or position.size > LARGEST_POINT
        vars(self).update(position=position, velocity=velocity, mass=mass, block=block)

    def _vector(self, name: str, argument):
        value = self._numbers(name, argument)
        value = value[None] if value.ndim == 0 else value
        if value.ndim != 1 or not value.size:
            raise Refused(f"Body {self.name}: {name} has shape {value.shape}; give a vector of coordinates, (n,).")
        return value

    @property
    def rates(self):
        """(n,) velocity."""
        return self.velocity

    @property
    def masses(self):
        """(n,) masses."""
        return self.mass + np.zeros(self.size)

    def with_rates(self, rates: np.ndarray) -> "Body":
        return replace(self, velocity=rates)


class Ground(AnyBody):
    """The body that does not move, with the axes of space."""

    name, block, rigid, wide = GROUND, False, True, (0, 1, 2)
    position, rotation, directors = np.zeros(3), np.eye(3), np.eye(3)

    def point(self, offset: Any = None) -> Point:
        """A point in space that does not move."""
        if offset is None:
            raise Refused('the ground has no centre; give a point of it, ("ground", [x, y, z]).')
        return Point(GROUND, offset)


@dataclass(frozen=True, eq=False)
class Frame(AnyBody):
    """A frame without mass between two joints: a hip is three hinges with frames between them, a planar robot two
    slides and a hinge.

        bodies = [Frame("yoke", [0, 0, 1]), RigidBody("thigh", 4.0, Cylinder(0.06, 0.4), [0, 0, 0.8])]
        joints = [
            Revolute(("ground", "yoke"), [0, 0, 1], axis=[1, 0, 0], name="roll"),
            Revolute(("yoke", "thigh"), [0, 0, 1], axis=[0, 1, 0], name="pitch"),
        ]
        Scene(bodies, joints)

    A frame hangs on a body or on the ground by a joint and carries at least one body; it always has joint coordinates.

    Args:
        name: of the frame in joints.
        position: (3,) m at the start, where its axes are parallel to the axes of space.
        pace: "slow", "fast" or "auto", as of `Body`: of the coordinates of the joint that the frame hangs on.
    """

    name: str
    position: Any
    pace: Pace = "auto"

    rigid, block, radius, wide = True, False, None, (0, 1, 2)
    mass, rotation, directors, rates, masses = None, np.eye(3), np.eye(3), np.zeros(12), np.zeros(12)

    def __post_init__(self):
        self._check_names()
        vars(self).update(position=self._numbers("position", self.position, (3,)))


Bodies = Mapping[str, AnyBody]
"""The bodies of a scene by name."""


def body_of(bodies: Bodies, name: str) -> AnyBody:
    """A body by name, or the ground."""
    return Ground() if name == GROUND else bodies[name]


def end_of(bodies: Bodies, name: str, whole: bool = False) -> Point:
    """The point that an effect acts on, see `AnyBody.point`; if `whole` all coordinates of a rigid body."""
    body, offset = body_of(bodies, name), getattr(name, "offset", None)
    if whole and body.rigid and offset is None:
        return Point(name, body.coordinates)
    return body.point(offset)


def weights_of(bodies: Bodies, name: str) -> Any:
    """(3,) components of the point in a body that a name stands for, see `AnyBody.weights`; zeros for the body
    itself."""
    offset = getattr(name, "offset", None)
    return np.zeros(3) if offset is None else body_of(bodies, name).weights(offset)


def joined(vectors):
    """Vectors one after the other in one array; of NumPy unless an entry is traced."""
    return library(vectors).concatenate(vectors)
