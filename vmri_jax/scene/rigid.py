"""Rigid bodies by directors: a point and three axes, constrained to stay orthonormal.

The coordinates of a body are ``q = (phi, d_1, d_2, d_3)``, its centre of mass and its principal axes of inertia in space.
A point X of the body, along its principal axes, is at ``phi + sum_i X_i d_i``: linear in q. So is the velocity, and the
kinetic energy ``m |phi'|^2 / 2 + sum_i E_i |d_i'|^2 / 2`` has the constant masses ``E_i = (J_1 + J_2 + J_3) / 2 - J_i`` of the
principal moments of inertia J. Rigidity is six constraints, ``d_i . d_j = delta_ij``.

Source: P. Betsch, S. Leyendecker, The discrete null space method for the energy consistent integration of constrained
mechanical systems, part II: multibody dynamics, Int. J. Numer. Meth. Engng 67 (2006).
"""

from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vmri_jax.mechanics.arrays import is_concrete, library
from vmri_jax.scene.body import AnyBody, Pace, Point, joined
from vmri_jax.scene.declare import effect_class, names
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.shapes import Ball, Rod, Shape, box_of

THIN = 1e-12
"""Masses E below this part of the largest one are zero: the body has no width in that direction."""
COVERED = 1.01
"""Points as far out as this, in half the size of a body, are drawn within it."""
ORTHONORMAL = 1e-9
"""How far a matrix may be from a rotation, and a quaternion from length one."""


@dataclass(frozen=True, eq=False)
class RigidBody(AnyBody):
    """A rigid body: ``q = (phi, d_1, d_2, d_3)``, its centre of mass and its principal axes of inertia.

    Effects between points act at its centre where they are given its name, and at a point that is fixed in it where they
    are given ``(name, [x, y, z])``: from the centre of mass, along the axes of the body. A body without width, a rod or a
    plate, has fewer axes: only those along which it is wide.

    Args:
        name: what effects call it.
        mass: m, kg, positive.
        inertia: about the centre of mass, kg m^2: (3,) principal moments J, a symmetric matrix (3, 3) in the axes of the
            body, or a `Shape`: `Box`, `Cylinder`, `Ball`, `Rod`.
        position: (3,) centre of mass at the start, m.
        rotation: of the axes of the body at the start: a matrix (3, 3) with these as columns, a quaternion (w, x, y, z),
            or a rotation vector (3,), angle times axis, rad; the axes of space by default.
        velocity: (3,) of the centre of mass, m/s; at rest by default.
        spin: (3,) angular velocity at the start in space, rad/s; none by default.
        pace: "slow", "fast" or "auto", as of `Body`.
        shape: how it is drawn; that of `inertia` by default.

    Attributes:
        moments: (3,) principal moments of inertia.
        axes: (3, 3) principal axes in those of the body, as columns.

    Raises:
        TypeError: what is no real number.
        ValueError: a mass or moment of inertia that is not positive, moments that no body has (one larger than the sum of
            the others), a rotation that is none, numbers that are not finite or of float32, other shapes, another pace.
    """

    name: str
    mass: Any
    inertia: Any
    position: Any
    rotation: Any = None
    velocity: Any = None
    spin: Any = None
    pace: Pace = "auto"
    shape: Shape | None = None
    moments: Any = field(init=False, repr=False)
    axes: np.ndarray = field(init=False, repr=False)

    rigid = True
    block = False
    radius = None

    def __post_init__(self):
        self._check_names()
        mass = self._numbers("mass", self.mass)
        if mass.shape or (is_concrete(mass) and not mass > 0):
            raise ValueError(f"RigidBody {self.name}: mass is {mass}; it must be one positive number.")
        shape = self.inertia if isinstance(self.inertia, Shape) else self.shape
        given = (
            self.inertia.inertia(mass) if isinstance(self.inertia, Shape) else self._numbers("inertia", self.inertia)
        )
        moments, axes = self._principal(given)
        found = {"mass": mass, "shape": shape, "moments": moments, "axes": axes}
        for name in ("position", "velocity", "spin"):
            value = np.zeros(3) if getattr(self, name) is None else self._numbers(name, getattr(self, name))
            if value.shape != (3,):
                raise ValueError(f"RigidBody {self.name}: {name} has shape {value.shape}; give (3,).")
            found[name] = value
        found["rotation"] = self._matrix()
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def _principal(self, inertia) -> tuple[Any, np.ndarray]:
        """Principal moments (3,), and the principal axes in those of the body, as columns."""
        what = f"RigidBody {self.name}: inertia"
        axes = np.eye(3)
        if inertia.shape == (3, 3) and is_concrete(inertia):
            if np.abs(inertia - inertia.T).max() > ORTHONORMAL * np.abs(inertia).max():
                raise ValueError(f"{what} is {inertia.tolist()}; it must be a symmetric matrix.")
            if np.count_nonzero(inertia - np.diag(np.diagonal(inertia))):
                inertia, axes = np.linalg.eigh(inertia)
                axes[:, 2] *= np.linalg.det(axes)
            else:
                inertia = np.diagonal(inertia)
        if inertia.shape != (3,):
            raise ValueError(f"{what} has shape {inertia.shape}; give (3,) principal moments, a matrix, or a shape.")
        if is_concrete(inertia):
            inertia = np.asarray(inertia)
            largest, others = inertia.max(), inertia.sum() - inertia.max()
            if inertia.min() < 0 or largest <= 0:
                raise ValueError(f"{what} has the principal moments {inertia}; they must be positive.")
            if largest > others * (1 + ORTHONORMAL):
                raise ValueError(
                    f"{what} has the principal moments {inertia}, which no body has: the largest, {largest:g}, must not be larger than "
                    f"the sum of the others, {others:g}."
                )
        return inertia, axes

    def _matrix(self):
        """The rotation as a matrix."""
        if self.rotation is None:
            return np.eye(3)
        what, given = f"RigidBody {self.name}: rotation", self._numbers("rotation", self.rotation)
        if given.shape not in ((3, 3), (4,), (3,)):
            raise ValueError(
                f"{what} has shape {given.shape}; give a matrix (3, 3), a quaternion (w, x, y, z) or a rotation vector (3,)."
            )
        if not is_concrete(given):
            return matrix_of(given)
        if given.shape == (4,) and abs(np.linalg.norm(given) - 1) > ORTHONORMAL:
            raise ValueError(
                f"{what} is the quaternion {given} of length {np.linalg.norm(given):.12g}; divide it by its length, which must be 1."
            )
        if given.shape == (3, 3):
            away = np.abs(given.T @ given - np.eye(3)).max()
            if away > ORTHONORMAL or np.linalg.det(given) < 0:
                raise ValueError(
                    f"{what} is {given.tolist()}, which is no rotation: R^T R differs from 1 by {away:.2g} and the determinant is "
                    f"{np.linalg.det(given):.3g}."
                )
        return np.asarray(matrix_of(given))

    @property
    def inertias(self):
        """(3,) masses ``E_i = (J_1 + J_2 + J_3) / 2 - J_i`` of the directors."""
        return jnp.sum(self.moments) / 2 - self.moments if not is_concrete(self.moments) else self._inertias()

    def _inertias(self) -> np.ndarray:
        found = np.sum(self.moments) / 2 - self.moments
        return np.where(found > THIN * found.max(), found, 0.0)

    @property
    def wide(self) -> tuple[int, ...]:
        """Which directors it has: those along which it is wide."""
        return tuple(range(3)) if not is_concrete(self.moments) else tuple(np.flatnonzero(self._inertias()).tolist())

    @property
    def directors(self):
        """(3, 3) principal axes in space at the start, one per row."""
        return (self.rotation @ self.axes).T

    @property
    def coordinates(self):
        """(n,) centre of mass and directors."""
        return joined([self.position, *(self.directors[i] for i in self.wide)])

    @property
    def rates(self):
        """(n,) velocity of the centre of mass, ``d_i' = spin x d_i``."""
        turned = library(self.spin, self.directors).cross(self.spin, self.directors)
        return joined([self.velocity, *(turned[i] for i in self.wide)])

    @property
    def masses(self):
        """(n,) m three times, every E_i three times."""
        inertias = self.inertias
        return joined([self.mass + np.zeros(3), *(inertias[i] + np.zeros(3) for i in self.wide)])

    @property
    def motions(self) -> np.ndarray:
        """(n, 6) velocities by those of the centre and the angular velocity; (6, 5) of a rod."""
        turns = self._turns()
        whole = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((len(turns), 3)), turns]])
        return whole if len(self.wide) > 1 else np.linalg.svd(whole)[0][:, :5]

    def _turns(self) -> np.ndarray:
        """Rates of the directors by the angular velocity, ``d_i' = -d_i x spin``."""
        return np.concatenate([-_cross_matrix(np.asarray(self.directors[i])) for i in self.wide])

    def with_rates(self, rates: np.ndarray) -> "RigidBody":
        """The same body with other velocities; a rod gets no spin about itself."""
        return replace(self, velocity=rates[:3], spin=np.linalg.lstsq(self._turns(), rates[3:], rcond=None)[0])

    def components(self, vector):
        """(3,) components along the principal axes of a vector in the axes of the body.

        Raises:
            ValueError: a vector that sticks out of a body without width.
        """
        along = vector @ self.axes
        out = [i for i in range(3) if i not in self.wide]
        if out and is_concrete(along) and np.any(np.abs(np.asarray(along)[out]) > ORTHONORMAL * np.abs(along).max()):
            raise ValueError(
                f"{np.asarray(vector)} sticks out of {self.name}: with the moments of inertia {np.asarray(self.moments)} it is a plate or a "
                "rod, without width there. Give it some."
            )
        return along

    @property
    def _drawn_shape(self) -> Shape:
        return self.shape or box_of(float(self.mass), self.moments)

    def covers(self, weights) -> bool:
        """Whether a point in the body, by weights of its directors, is in the box around what is drawn of it."""
        shape = self._drawn_shape
        if isinstance(shape, Ball):
            return bool(np.linalg.norm(weights) <= shape.radius)
        if isinstance(shape, Rod):
            return bool(abs(weights[0]) <= COVERED * shape.length / 2)
        corners = (shape.polyhedron()[0] @ self.axes)[:, list(self.wide)]
        return bool(np.all(np.abs(weights[: len(self.wide)]) <= COVERED * np.abs(corners).max(axis=0)))

    def drawing(self, part: str, start: int) -> dict[str, list]:
        """What there is to see of it: entries of `Scene.drawing`.

        Args:
            part, start: where its coordinates are, "s" or "f" and the first.
        """
        shape = self._drawn_shape
        centre = {"name": self.name, "coordinates": [[part, start + i] for i in range(3)]}
        if isinstance(shape, Ball):
            return {"bodies": [centre | {"radius": float(shape.radius)}]}
        if isinstance(shape, Rod):
            half, names = shape.length / 2, [f"{self.name} start", f"{self.name} end"]
            ends = [
                [[[1.0, part, start + i], [sign * half, part, start + 3 + i]] for i in range(3)] for sign in (-1.0, 1.0)
            ]
            hidden = [{"name": name, "coordinates": form, "shown": ""} for name, form in zip(names, ends, strict=True)]
            return {"bodies": [centre | {"shown": "name"}, *hidden], "links": [names]}
        corners, faces = shape.polyhedron()
        along = (corners @ self.axes)[:, list(self.wide)]
        coordinates = [[part, start + i] for i in range(self.size)]
        return {"solids": [{"name": self.name, "coordinates": coordinates, "corners": along.tolist(), "faces": faces}]}

    def weights(self, at: Any) -> Any:
        """(3,) of the directors in a point ``phi + sum_i X_i d_i``."""
        along = self.components(at)
        return joined([along[np.array(self.wide)], np.zeros(3 - len(self.wide))])

    def point(self, at: Any = None) -> Point:
        """The centre of mass, or a point fixed in the body, at the start."""
        if at is None:
            return Point(self.name, self.position, self.mass)
        if at.shape != (3,):
            raise ValueError(f"the point in {self.name} has shape {at.shape}; give (3,), in the axes of the body.")
        self.components(at)
        return Point(self.name, self.position + self.rotation @ at)


@effect_class
class Rigidity(Effect):
    """What keeps rigid bodies rigid, ``g = (d_i . d_j - delta_ij) / (1 + delta_ij)``; every scene with such bodies has it.

    Args:
        bodies: names of the rigid bodies.
    """

    bodies: Any = names()

    kind = "constraint"
    default_name = "rigid"
    whole = True

    @staticmethod
    def function(q, params):
        d = split(q[0])[1]
        products = d @ jnp.swapaxes(d, -1, -2)
        rows, columns = np.triu_indices(d.shape[-2])
        return jnp.stack(
            [
                (products[..., i, j] - 1) / 2 if i == j else products[..., i, j]
                for i, j in zip(rows, columns, strict=True)
            ],
            axis=-1,
        )


def split(q):
    """Centre (..., 3) and directors (..., 3, 3), one per row, of the coordinates of a rigid body (..., 12)."""
    triples = q.reshape(*q.shape[:-1], -1, 3)
    return triples[..., 0, :], triples[..., 1:, :]


def matrix_of(rotation):
    """(3, 3) matrix of a rotation: itself, a quaternion (w, x, y, z), or a rotation vector."""
    if rotation.shape == (3, 3):
        return rotation
    if rotation.shape == (4,):
        w, u = rotation[0], _cross_matrix(rotation[1:])
        return jnp.eye(3) + 2 * w * u + 2 * u @ u
    if is_concrete(rotation):
        return Rotation.from_rotvec(np.array(rotation)).as_matrix()
    angle = jnp.sqrt(jnp.sum(rotation**2))
    u = _cross_matrix(rotation)
    return jnp.eye(3) + jnp.sinc(angle / np.pi) * u + jnp.sinc(angle / (2 * np.pi)) ** 2 / 2 * u @ u


def _cross_matrix(u):
    """The matrix of ``x -> u x x``."""
    zero = u[0] * 0
    rows = [[zero, -u[2], u[1]], [u[2], zero, -u[0]], [-u[1], u[0], zero]]
    return np.array(rows) if is_concrete(u) else jnp.array(rows)


# Where a body is along a run


def rotation(q):
    """Rotation matrices (..., 3, 3) of a rigid body from its coordinates, its principal axes as columns.

    Args:
        q: (..., 12) coordinates, ``run.position("hub")``.

    Raises:
        ValueError: coordinates of another number.
    """
    if np.shape(q)[-1] != 12:
        raise ValueError(f"rotation: q has shape {np.shape(q)}; give the 12 coordinates of a rigid body, (..., 12).")
    return np.swapaxes(np.asarray(split(np.asarray(q))[1]), -1, -2)


def quaternion(q):
    """Quaternions (..., 4), (w, x, y, z), of a rigid body; neighbours along the last axis but one do not change sign.

    Args:
        q: (..., k, 12) coordinates along a run.
    """
    matrices = rotation(q)
    found = (
        Rotation.from_matrix(np.array(matrices.reshape(-1, 3, 3)))
        .as_quat(scalar_first=True)
        .reshape(*matrices.shape[:-2], 4)
    )
    if found.ndim > 1:
        turned = np.sign(np.sum(found[..., 1:, :] * found[..., :-1, :], axis=-1))
        signs = np.concatenate(
            [np.ones_like(turned[..., :1]), np.cumprod(np.where(turned < 0, -1, 1), axis=-1)], axis=-1
        )
        found = found * signs[..., None]
    return found


def angular_velocity(q, v):
    """``omega`` of ``d_i' = omega x d_i``, in space, (..., 3) rad/s, from directors d_i of length 1.

    Their sum of ``d_i x d_i' = (1 - d_i d_i^T) omega`` is solved for omega. A body with two directors, a plate, has all three components; a
    body with one, a rod, has no spin about itself, and gets the omega across it.

    Args:
        q, v: (..., 12), (..., 9) or (..., 6) coordinates and velocities, ``run.position("hub")`` and ``run.velocity("hub")``.
    """
    (_, d), (_, rate) = split(np.asarray(q)), split(np.asarray(v))
    matrix = np.sum(np.eye(3) - d[..., :, None] * d[..., None, :], axis=-3)
    return np.squeeze(np.linalg.pinv(matrix, hermitian=True) @ np.sum(np.cross(d, rate), axis=-2)[..., None], -1)


def angular_momentum(q, p):
    """``L = phi x p_phi + sum_i d_i x p_i`` about the origin, in space, (..., 3) kg m^2/s.

    Args:
        q: (..., 12) coordinates, ``run.position("hub")``.
        p: (..., 12) momenta, ``run.momentum("hub")``.
    """
    (phi, d), (push, turn) = split(np.asarray(q)), split(np.asarray(p))
    return np.cross(phi, push) + np.sum(np.cross(d, turn), axis=-2)
