"""Bodies: points of a scene, blocks of general coordinates, and what effects see of a body."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array

Pace = Literal["slow", "fast", "auto"]
LARGEST_POINT = 3
"""Coordinates of a point at most."""
GROUND = "ground"
"""What effects call the body that does not move."""
GROUND_COORDINATES = np.concatenate([np.zeros(3), np.eye(3).ravel()])
"""Its coordinates as those of a rigid body."""


class Attachment(str):
    """The name of a rigid body, and a point that is fixed in it; users write ``("hub", [0.5, 0, 0])``."""

    at: Any
    """(3,) from the centre of mass, in the axes of the body; of the ground (d,), in space."""

    def __new__(cls, body: str, at: Any):
        attached = super().__new__(cls, body)
        attached.at = real_array(f"the point in {body}", at, 1)
        return attached

    @property
    def label(self) -> str:
        """``hub (0.5, 0, 0)``."""
        numbers = ", ".join(f"{x:g}" for x in self.at) if is_concrete(self.at) else "a point"
        return f"{self} ({numbers})"


def is_entry(item: Any) -> bool:
    """Whether it names a body, or a body and a point in it."""
    if isinstance(item, str):
        return True
    pair = isinstance(item, tuple | list) and len(item) == 2 and isinstance(item[0], str)
    return pair and not is_entry(item[1]) and not any(isinstance(x, str) for x in jax.tree.leaves(item[1]))


def entry(item: Any) -> str:
    """The name of a body, or an `Attachment`."""
    return item if isinstance(item, str) else Attachment(*item)


def label_of(name: str) -> str:
    """How messages and drawings call a body or a point in one."""
    return name.label if isinstance(name, Attachment) else name


def moving(names: Iterable[str]) -> tuple[str, ...]:
    """Those of bodies that move, each once: all but the ground."""
    return tuple(dict.fromkeys(str(name) for name in names if name != GROUND))


class Point(NamedTuple):
    """What an effect between points sees of a body.

    mass: None of a point that is only a part of a body.
    """

    name: str
    position: Any
    mass: Any = None
    block: bool = False

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.position.shape[0]


class AnyBody(ABC):
    """What every body of a scene says.

    Attributes:
        name, pace: see `Body`.
        coordinates, rates, masses: (n,) at the start, and the masses of ``sum_i m_i v_i^2 / 2``.
        block: its coordinates are general ones, not those of points.
        rigid: they are those of a rigid body.
        rotation: (3, 3) its axes in space at the start as columns; None of what has no axes.
        wide: which directors are among its coordinates.
    """

    name: str
    pace: Pace
    position: Any
    radius: float | None
    block: bool
    rigid: bool = False
    rotation: Any = None
    wide: tuple[int, ...] = ()

    @property
    @abstractmethod
    def coordinates(self) -> Any: ...

    @property
    @abstractmethod
    def rates(self) -> Any: ...

    @property
    @abstractmethod
    def masses(self) -> Any: ...

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.coordinates.shape[0]

    @property
    def motions(self) -> np.ndarray:
        """(n, f) basis of the velocities that its own constraints allow at the start."""
        return np.eye(self.size)

    def weights(self, at: Any) -> Any:
        """(3,) of the directors in a point ``phi + sum_i X_i d_i`` that is fixed in the body.

        Args:
            at: as of `point`.
        """
        return joined([at, np.zeros(3 - at.shape[0])])

    @abstractmethod
    def point(self, at: Any = None) -> Point:
        """The point itself, or a point fixed in the body.

        Args:
            at: (3,) from the centre of mass, in the axes of the body; None for the centre itself.
        """

    @abstractmethod
    def with_rates(self, rates: np.ndarray) -> "AnyBody":
        """The same body with other velocities.

        Args:
            rates: (n,) of its coordinates.
        """

    def _check_names(self) -> None:
        kind = type(self).__name__
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"{kind}: name is {self.name!r}; it must be a string that is not empty.")
        if self.name == GROUND:
            raise ValueError(
                f"{kind}: name is {GROUND!r}, which effects call the body that does not move; take another."
            )
        if self.pace not in ("slow", "fast", "auto"):
            raise ValueError(f"{kind} {self.name}: pace is {self.pace!r}; it must be 'slow', 'fast' or 'auto'.")

    def _numbers(self, name: str, given):
        """Numbers as an array of float64, of NumPy where they are not traced: so the mode of JAX does not matter."""
        what = f"{type(self).__name__} {self.name}: {name}"
        value = real_array(what, given)
        if not is_concrete(value):
            return value
        if not np.isfinite(value).all():
            raise ValueError(f"{what} is {np.asarray(value)}, which is not finite.")
        return np.asarray(value)


@dataclass(frozen=True, eq=False)
class Body(AnyBody):
    """A point mass in one, two or three dimensions, or a block of n general coordinates with n masses.

    Its kinetic energy is ``sum_i m_i v_i^2 / 2``.

    Args:
        name: what effects call it.
        mass: kg, positive; one for all coordinates, or (n,) one for each.
        position: (n,) at the start, n = 1, 2, 3 for a point. A number is a vector of length one.
        velocity: (n,) at the start; at rest by default.
        pace: "slow" coordinates take macro steps, "fast" ones micro steps; "auto" lets the scene decide from
            estimates of frequencies.
        radius: how large it is drawn, in the unit of its position; by default as suits the picture. Of no effect on the
            motion: contacts have a radius of their own.
        block: its coordinates are general ones, not those of a point; more than three always are.

    Raises:
        TypeError: what is no real number.
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
            raise ValueError(
                f"Body {self.name}: velocity has shape {velocity.shape}, position has {position.shape}; they must be equal."
            )
        if mass.shape not in ((), position.shape):
            raise ValueError(
                f"Body {self.name}: mass has shape {mass.shape}; give one number, or one for each of {position.size} coordinates."
            )
        if is_concrete(mass) and not np.all(mass > 0):
            raise ValueError(f"Body {self.name}: mass is {mass}; every mass must be positive.")
        if self.radius is not None and is_concrete(self.radius) and not 0 < self.radius < np.inf:
            raise ValueError(f"Body {self.name}: radius is {self.radius!r}; it must be a positive number, or None.")
        block = self.block or position.size > LARGEST_POINT
        for name, value in (("position", position), ("velocity", velocity), ("mass", mass), ("block", block)):
            object.__setattr__(self, name, value)

    def _vector(self, name: str, given):
        value = self._numbers(name, given)
        value = value[None] if value.ndim == 0 else value
        if value.ndim != 1 or not value.size:
            raise ValueError(f"Body {self.name}: {name} has shape {value.shape}; give a vector of coordinates, (n,).")
        return value

    @property
    def coordinates(self):
        """(n,) position."""
        return self.position

    @property
    def rates(self):
        """(n,) velocity."""
        return self.velocity

    @property
    def masses(self):
        """(n,) masses."""
        return self.mass + np.zeros(self.size)

    def point(self, at: Any = None) -> Point:
        """The point itself.

        Raises:
            ValueError: a point in it.
        """
        if at is not None:
            raise ValueError(f"{self.name} is no rigid body, so that no point is fixed in it; give its name alone.")
        return Point(self.name, self.position, self.mass, self.block)

    def with_rates(self, rates: np.ndarray) -> "Body":
        return replace(self, velocity=rates)


class Ground(AnyBody):
    """The body that does not move: its axes are those of space."""

    name, pace, radius, block, rigid = GROUND, "slow", None, False, True
    position, rotation = np.zeros(3), np.eye(3)
    coordinates = property(lambda self: GROUND_COORDINATES)
    rates = property(lambda self: np.zeros(12))
    masses = property(lambda self: np.full(12, np.inf))

    def point(self, at: Any = None) -> Point:
        """A point that stays where it is."""
        if at is None:
            raise ValueError('the ground has no centre; give a point of it, ("ground", [x, y, z]).')
        return Point(GROUND, at)

    def with_rates(self, rates: np.ndarray) -> "Ground":
        return self


@dataclass(frozen=True, eq=False)
class Frame(AnyBody):
    """A frame without mass between joints of one body: three hinges in a row make a hip, two slides and a hinge a planar robot.

        bodies = [Frame("yoke", [0, 0, 1]), RigidBody("thigh", 4.0, Rod(0.4), [0, 0, 0.8])]
        joints = [
            Revolute(("ground", "yoke"), [0, 0, 1], axis=[1, 0, 0], name="roll"),
            Revolute(("yoke", "thigh"), [0, 0, 1], axis=[0, 1, 0], name="pitch"),
        ]
        Scene(bodies, joints, coordinates="joint")

    It moves with the joints that it hangs on, so that it needs joint coordinates, and it must carry a body.

    Args:
        name: what joints call it.
        position: (3,) at the start, m; its axes are those of space there.
        pace: "slow", "fast" or "auto", as of `Body`: that of the joint that it hangs on.
    """

    name: str
    position: Any
    pace: Pace = "auto"

    rigid, block, radius, wide = True, False, None, (0, 1, 2)
    rotation = np.eye(3)

    def __post_init__(self):
        self._check_names()
        position = self._numbers("position", self.position)
        if position.shape != (3,):
            raise ValueError(f"Frame {self.name}: position has shape {position.shape}; give (3,).")
        object.__setattr__(self, "position", position)

    @property
    def coordinates(self):
        """(12,) origin and axes."""
        return joined([self.position, np.eye(3).ravel()])

    rates = property(lambda self: np.zeros(12))
    masses = property(lambda self: np.zeros(12))

    def point(self, at: Any = None) -> Point:
        """The origin, or a point fixed in it, at the start."""
        return Point(self.name, self.position if at is None else self.position + at)

    def with_rates(self, rates: np.ndarray) -> "Frame":
        return self


Bodies = Mapping[str, AnyBody]
"""The bodies of a scene by name."""


def body_of(bodies: Bodies, name: str) -> AnyBody:
    """A body by name, also the ground.

    Args:
        bodies: of the scene.
        name: of one of them.
    """
    return Ground() if name == GROUND else bodies[name]


def end_of(bodies: Bodies, name: str, whole: bool = False) -> Point:
    """What an effect sees of a body: the point that it is, the centre of a rigid one, or a point in that.

    Args:
        bodies: of the scene.
        name: of one of them, perhaps an `Attachment`.
        whole: all coordinates of a rigid body instead of its centre.
    """
    body, at = body_of(bodies, name), getattr(name, "at", None)
    if whole and body.rigid and at is None:
        return Point(name, body.coordinates)
    return body.point(at)


def joined(vectors):
    """One vector of several, of NumPy where they are not traced."""
    return np.concatenate(vectors) if is_concrete(vectors) else jnp.concatenate(vectors)
