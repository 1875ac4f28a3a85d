"""Rigid bodies by directors: a point and three axes, constrained to stay orthonormal.

The coordinates of a body are ``q = (phi, d_1, d_2, d_3)``, its centre of mass and its principal axes of inertia in
space. A point with the components X along the principal axes is at ``phi + sum_i X_i d_i``, which is linear in q. The
kinetic energy ``m |phi'|^2 / 2 + sum_i E_i |d_i'|^2 / 2`` has constant masses ``E_i = (J_1 + J_2 + J_3) / 2 - J_i``
with the principal moments of inertia J. Rigidity is six constraints, ``d_i . d_j = delta_ij``.

Source: P. Betsch, S. Leyendecker, The discrete null space method for the energy consistent integration of constrained
mechanical systems, part II: multibody dynamics, Int. J. Numer. Meth. Engng 67 (2006).
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vmri_jax.mechanics.arrays import is_concrete, library
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import AnyBody, Pace, joined
from vmri_jax.scene.declare import names
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.products import FRAME, products
from vmri_jax.scene.shapes import Ball, Rod, Shape, box_of
from vmri_jax.scene.terms import split

THIN = 1e-12
"""A mass E below this fraction of the largest is round-off: the body has no width in this direction, and no director. A
larger value takes the width of thin plates away."""
COVERED = 1.01
"""A point within this multiple of half the size of the drawn shape counts as inside it; slightly above 1, so that
points on the surface do. With a larger one a point that is visibly outside gets no line to the body."""
ORTHONORMAL = 1e-9
"""Largest difference of ``R^T R`` from the identity, of the length of a quaternion from 1, and of an inertia matrix
from its transpose relative to its largest entry. A larger value accepts rotations that stretch bodies; a smaller one
refuses numbers with ten digits."""


@dataclass(frozen=True, eq=False)
class RigidBody(AnyBody):
    """A rigid body: ``q = (phi, d_1, d_2, d_3)``, its centre of mass and its principal axes of inertia.

    Effects between points that name the body act at its centre. With ``(name, [x, y, z])`` they act at a point that is
    fixed in the body, this far from the centre of mass along the axes of the body. Rods and plates have directors only
    along the axes in which they have width.

    Args:
        name: of the body in effects.
        mass: m, kg, positive.
        inertia: about the centre of mass, kg m^2: (3,) principal moments J, a symmetric matrix (3, 3) in the axes of
            the body, or a `Shape`: `Box`, `Cylinder`, `Ball`, `Rod`.
        position: (3,) centre of mass at the start, m.
        rotation: of the axes of the body at the start: a matrix (3, 3) with these as columns, a quaternion
            (w, x, y, z), or a rotation vector (3,), angle times axis, rad; the axes of space by default.
        velocity: (3,) of the centre of mass, m/s; at rest by default.
        spin: (3,) angular velocity at the start in space, rad/s; none by default.
        pace: "slow", "fast" or "auto", as of `Body`.
        shape: of the drawing; by default the shape of `inertia`.

    Attributes:
        moments: (3,) principal moments of inertia, kg m^2.
        axes: (3, 3) principal axes as columns, in the axes of the body.

    Raises:
        TypeError: an argument that is no real number.
        ValueError: a mass that is not positive, a negative moment of inertia, moments that no body has (the largest
            above the sum of the other two), a matrix that is no rotation, numbers that are not finite or of float32,
            other shapes, another pace.
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
            raise Refused(f"RigidBody {self.name}: mass is {mass}; it must be one positive number.")
        shape = self.inertia if isinstance(self.inertia, Shape) else self.shape
        inertia = self.inertia
        tensor = inertia.inertia(mass) if isinstance(inertia, Shape) else self._numbers("inertia", inertia)
        moments, axes = self._principal(tensor)
        for name in ("position", "velocity", "spin"):
            value = getattr(self, name)
            vars(self)[name] = np.zeros(3) if value is None else self._numbers(name, value, (3,))
        vars(self).update(mass=mass, shape=shape, moments=moments, axes=axes, rotation=self._matrix())

    def _principal(self, inertia) -> tuple[Any, np.ndarray]:
        """Principal moments (3,), and the principal axes as columns, in the axes of the body, of the argument `inertia`
        as an array."""
        about = f"RigidBody {self.name}: inertia"
        axes = np.eye(3)
        if inertia.shape == (3, 3) and is_concrete(inertia):
            if np.abs(inertia - inertia.T).max() > ORTHONORMAL * np.abs(inertia).max():
                raise Refused(f"{about} is {inertia.tolist()}; it must be a symmetric matrix.")
            if np.count_nonzero(inertia - np.diag(np.diagonal(inertia))):
                inertia, axes = np.linalg.eigh(inertia)
                axes[:, 2] *= np.linalg.det(axes)  # eigenvectors may form a left-handed triad
            else:
                inertia = np.diagonal(inertia)  # keeps the order of the axes, which eigh would sort
        if inertia.shape != (3,):
            raise Refused(f"{about} has shape {inertia.shape}; give (3,) principal moments, a matrix, or a shape.")
        if is_concrete(inertia):
            inertia = np.asarray(inertia)
            largest, other_two = inertia.max(), inertia.sum() - inertia.max()
            if inertia.min() < 0 or largest <= 0:
                raise Refused(
                    f"{about} has the principal moments {inertia}; they must not be negative, nor all be zero."
                )
            if largest > other_two * (1 + ORTHONORMAL):
                raise Refused(
                    f"{about} has the principal moments {inertia}, which no body has: the largest, {largest:g}, must "
                    f"not be larger than the sum of the others, {other_two:g}."
                )
        return inertia, axes

    def _matrix(self):
        """The rotation as a matrix (3, 3)."""
        if self.rotation is None:
            return np.eye(3)
        about, rotation = f"RigidBody {self.name}: rotation", self._numbers("rotation", self.rotation)
        if rotation.shape not in ((3, 3), (4,), (3,)):
            raise Refused(
                f"{about} has shape {rotation.shape}; give a matrix (3, 3), a quaternion (w, x, y, z) or a rotation "
                "vector (3,)."
            )
        if not is_concrete(rotation):
            return matrix_of(rotation)
        if rotation.shape == (4,) and abs(np.linalg.norm(rotation) - 1) > ORTHONORMAL:
            raise Refused(
                f"{about} is the quaternion {rotation} of length {np.linalg.norm(rotation):.12g}; divide it by its "
                "length, which must be 1."
            )
        if rotation.shape == (3, 3):
            error = np.abs(rotation.T @ rotation - np.eye(3)).max()
            if error > ORTHONORMAL or np.linalg.det(rotation) < 0:
                raise Refused(
                    f"{about} is {rotation.tolist()}, which is no rotation: R^T R differs from 1 by {error:.2g} and "
                    f"the determinant is {np.linalg.det(rotation):.3g}."
                )
        return np.asarray(matrix_of(rotation))

    @property
    def inertias(self):
        """(3,) masses ``E_i = (J_1 + J_2 + J_3) / 2 - J_i`` of the directors."""
        masses = self.moments.sum() / 2 - self.moments
        return np.where(masses > THIN * masses.max(), masses, 0.0) if is_concrete(masses) else masses

    @property
    def wide(self) -> tuple[int, ...]:
        """Indices of the directors of the body: of the principal axes in which it has width, all three of a traced
        inertia."""
        return tuple(np.flatnonzero(self.inertias).tolist()) if is_concrete(self.moments) else (0, 1, 2)

    @property
    def directors(self):
        """(3, 3) principal axes in space at the start, one per row."""
        return (self.rotation @ self.axes).T

    @property
    def rates(self):
        """(n,) velocity of the centre of mass, ``d_i' = spin x d_i``."""
        return joined([self.velocity, self._turns() @ self.spin])

    @property
    def masses(self):
        """(n,) the mass m three times, then every E_i three times."""
        inertias = self.inertias
        return joined([self.mass + np.zeros(3), *(inertias[i] + np.zeros(3) for i in self.wide)])

    @property
    def motions(self) -> np.ndarray:
        """(n, 6) matrix from the velocity of the centre and the angular velocity to q'; (6, 5) basis of the same space
        for a rod."""
        turns = self._turns()
        matrix = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((len(turns), 3)), turns]])
        return matrix if len(self.wide) > 1 else np.linalg.svd(matrix)[0][:, :5]  # a rod does not turn about itself

    def _turns(self) -> Any:
        """(3 k, 3) matrix from the angular velocity to the rates of the k directors, ``d_i' = -d_i x spin``."""
        return joined([-_cross_matrix(self.directors[i]) for i in self.wide])

    def with_rates(self, rates: np.ndarray) -> "RigidBody":
        """The same body with other velocities; the spin of a rod about its axis is zero."""
        return replace(self, velocity=rates[:3], spin=np.linalg.lstsq(self._turns(), rates[3:], rcond=None)[0])

    def weights(self, offset: Any) -> Any:
        """(3,) components X of a point ``phi + sum_i X_i d_i``, first those along the directors that the body has, then
        zeros.

        Refused along an axis without width and director.
        """
        components = offset @ self.axes
        thin = [i for i in range(3) if i not in self.wide]
        if thin and is_concrete(components):
            sizes = np.abs(np.asarray(components))
            if np.any(sizes[thin] > ORTHONORMAL * sizes.max()):
                raise Refused(
                    f"{np.asarray(offset)} sticks out of {self.name}: with the moments of inertia "
                    f"{np.asarray(self.moments)} it is a plate or a rod without width in this direction. Give the "
                    "body some width."
                )
        return joined([components[np.array(self.wide)], np.zeros(len(thin))])

    @property
    def _drawn_shape(self) -> Shape:
        return self.shape or box_of(float(self.mass), self.moments)

    def covers(self, weights) -> bool:
        """Whether a point with these components along the directors is inside the bounding box of the drawn shape."""
        shape = self._drawn_shape
        if isinstance(shape, Ball):
            return bool(np.linalg.norm(weights) <= shape.radius)
        if isinstance(shape, Rod):
            return bool(abs(weights[0]) <= COVERED * shape.length / 2)
        corners = (shape.polyhedron()[0] @ self.axes)[:, list(self.wide)]
        return bool(np.all(np.abs(weights[: len(self.wide)]) <= COVERED * np.abs(corners).max(axis=0)))

    def drawing(self, part: str, start: int) -> dict[str, list]:
        """Entries in the lists of `Scene.drawing`; the coordinates begin at number `start` of `part`, "s" or "f"."""
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
        components = (corners @ self.axes)[:, list(self.wide)].tolist()
        coordinates = [[part, start + i] for i in range(self.size)]
        return {"solids": [{"name": self.name, "coordinates": coordinates, "corners": components, "faces": faces}]}


class Rigidity(Effect):
    """The constraints of rigid bodies by directors, ``g = (d_i . d_j - delta_ij) / (1 + delta_ij)``; every scene adds
    this effect itself.

    Args:
        bodies: names of the rigid bodies.
    """

    bodies: Any = names()

    kind = "constraint"
    is_analytic = True
    default_name = "rigid"
    whole = True

    @staticmethod
    def function(q, params):
        i, j = np.triu_indices(q[0].shape[-1] // 3 - 1)
        is_same, directors = i == j, np.eye(FRAME)[1:]
        weights = 1 / (1.0 + is_same)
        factors = np.concatenate([weights[:, None] * directors[i], directors[j]])
        return products(i.size, q, {"factors": factors, "offsets": np.zeros((2 * i.size, 3))}) - weights * is_same


def matrix_of(rotation):
    """(3, 3) matrix of a rotation, which is such a matrix, a quaternion (w, x, y, z) or a rotation vector (3,)."""
    if rotation.shape == (3, 3):
        return rotation
    xp = library(rotation)
    if rotation.shape == (3,):
        # r of length a is the quaternion (cos(a / 2), sin(a / 2) r / a)
        half = xp.sqrt(xp.sum(rotation**2)) / 2
        rotation = xp.append(xp.cos(half), xp.sinc(half / np.pi) / 2 * rotation)
    # R = 1 + 2 w U + 2 U^2 with the matrix U of x -> u x x, u the vector part
    w, u = rotation[0], _cross_matrix(rotation[1:])
    return xp.eye(3) + 2 * w * u + 2 * u @ u


def _cross_matrix(u):
    """The matrix of ``x -> u x x``."""
    return library(u).cross(np.eye(3), u)


def rotation(q):
    """Rotation matrices (..., 3, 3) of a rigid body from its coordinates: its directors, the principal axes of inertia,
    as columns.

    The columns of ``rotation(q) @ body.axes.T`` are the axes of `RigidBody.rotation` along the run.

    Args:
        q: (..., 12) coordinates, ``run.position("hub")``.

    Raises:
        ValueError: coordinates of another number.
    """
    if np.shape(q)[-1] != 12:
        raise Refused(f"rotation: q has shape {np.shape(q)}; give the 12 coordinates of a rigid body, (..., 12).")
    return np.swapaxes(np.asarray(split(np.asarray(q))[1]), -1, -2)


def quaternion(q):
    """Quaternions (..., k, 4), (w, x, y, z), of a rigid body; their signs are such that they do not jump along a run.

    Args:
        q: (..., k, 12) coordinates along a run.
    """
    matrices = rotation(q)
    quaternions = (
        Rotation.from_matrix(np.array(matrices.reshape(-1, 3, 3)))
        .as_quat(scalar_first=True)
        .reshape(*matrices.shape[:-2], 4)
    )
    if quaternions.ndim > 1:
        # p and -p are the same rotation: a negative product with the quaternion before asks for the other sign from
        # there on
        products = np.sum(quaternions[..., 1:, :] * quaternions[..., :-1, :], axis=-1)
        changes = np.where(products < 0, -1, 1)
        signs = np.concatenate([np.ones_like(products[..., :1]), np.cumprod(changes, axis=-1)], axis=-1)
        quaternions = quaternions * signs[..., None]
    return quaternions


def angular_velocity(q, v):
    """``omega`` of ``d_i' = omega x d_i``, in space, (..., 3) rad/s, from directors d_i of length 1.

    The sum over i of ``d_i x d_i' = (1 - d_i d_i^T) omega`` is solved for omega. A body with two directors, a plate,
    has all three components; a body with one, a rod, has no spin about itself, and gets the omega across it.

    Args:
        q, v: (..., 12), (..., 9) or (..., 6) coordinates and velocities, ``run.position("hub")`` and
            ``run.velocity("hub")``.
    """
    (_, d), (_, rate) = split(np.asarray(q)), split(np.asarray(v))
    matrix = np.sum(np.eye(3) - d[..., :, None] * d[..., None, :], axis=-3)
    return np.squeeze(np.linalg.pinv(matrix, hermitian=True) @ np.sum(np.cross(d, rate), axis=-2)[..., None], -1)


def angular_momentum(q, p):
    """``L = phi x p_phi + sum_i d_i x p_i`` about the origin, in space, (..., 3) kg m^2/s.

    Args:
        q: (..., n) coordinates, ``run.position("hub")``.
        p: (..., n) momenta, ``run.momentum("hub")``.
    """
    (phi, d), (push, turn) = split(np.asarray(q)), split(np.asarray(p))
    return np.cross(phi, push) + np.sum(np.cross(d, turn), axis=-2)
