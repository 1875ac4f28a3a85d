"""Mechanisms in the plane as data, and their equations in coordinates chosen by hand: nothing here comes from the
package.

With the poses X(q) = (x, y, angle) of all bars, masses W and the potential V(X),

    T = |X'|_W^2 / 2,   M = J^T W J,   M a = J^T (F - V'(X) - W J' v),   J = dX/dq

and with loops c(q) = 0 that the coordinates leave, their multipliers beside a.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

GROUND = "ground"


class Bar(NamedTuple):
    """A body: mass (kg), moment of inertia about its centre (kg m^2), None of a point mass; whether it is fast."""

    mass: float
    moment: float | None
    fast: bool = False


class Hinge(NamedTuple):
    """Two bodies at a point of space (m) at the start; the spring in it (N m/rad), at rest there."""

    a: str
    b: str
    at: tuple[float, float]
    stiffness: float = 0.0


class Slide(NamedTuple):
    """A body that moves along a direction of the ground and does not turn."""

    body: str
    axis: tuple[float, float]


class Coil(NamedTuple):
    """A spring (N/m, m) between points of two bodies, given in space at the start."""

    a: str
    at_a: tuple[float, float]
    b: str
    at_b: tuple[float, float]
    stiffness: float
    length: float


class Contact(NamedTuple):
    """A potential of two bodies more: of their poses, and of their coordinates as rigid bodies with params."""

    bodies: tuple[str, str]
    of_poses: Callable
    of_bodies: Callable
    params: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Mechanism:
    """Bars, what joins them and what acts on them; poses and loops in coordinates chosen by hand.

    Args:
        poses: q (n,) to (bars, 3).
        q, v: coordinates and their rates at the start.
        t_end: s.
        size: m, errors are relative to it.
        steps: macro steps of the coarsest run.
        loops: q to what is zero, where the coordinates are not independent.
        gravity: m/s^2 along -y.
        torque: N m on the second body of the first hinge.
    """

    name: str
    bars: dict[str, Bar]
    hinges: tuple[Hinge, ...]
    poses: Callable
    q: np.ndarray
    v: np.ndarray
    t_end: float
    size: float
    steps: int
    slides: tuple[Slide, ...] = ()
    coils: tuple[Coil, ...] = ()
    contact: Contact | None = None
    loops: Callable | None = None
    gravity: float = 0.0
    torque: float = 0.0

    # --- in the coordinates chosen by hand ----------------------------------------------------------------------------
    @property
    def has_fast(self) -> bool:
        """Whether a part of it is fast."""
        return any(bar.fast for bar in self.bars.values())

    @property
    def is_tree(self) -> bool:
        """Whether no joint closes a loop."""
        return len(self.hinges) + len(self.slides) <= len(self.bars) and self.loops is None

    @cached_property
    def masses(self) -> np.ndarray:
        """(bars, 3) masses and moments."""
        return np.array([[bar.mass, bar.mass, bar.moment or 0.0] for bar in self.bars.values()])

    @cached_property
    def start(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Poses of the bars and their rates at the start."""
        with jax.ensure_compile_time_eval():  # functions that are traced ask for it, too
            poses, rates = jax.jvp(self.poses, (jnp.asarray(self.q),), (jnp.asarray(self.v),))
        return dict(zip(self.bars, zip(np.asarray(poses), np.asarray(rates), strict=True), strict=True))

    def kinetic(self, q, v):
        """T of coordinates and rates."""
        return jnp.sum(self.masses * jax.jvp(self.poses, (q,), (v,))[1] ** 2) / 2

    def potential(self, poses):
        """V of the poses."""
        energy = self.gravity * jnp.sum(self.masses[:, 0] * poses[:, 1])
        for hinge in self.hinges:
            if hinge.stiffness:
                energy += hinge.stiffness / 2 * (self._turned(poses, hinge.b) - self._turned(poses, hinge.a)) ** 2
        for coil in self.coils:
            apart = self._point(poses, coil.a, coil.at_a) - self._point(poses, coil.b, coil.at_b)
            energy += coil.stiffness / 2 * (jnp.sqrt(jnp.sum(apart**2)) - coil.length) ** 2
        if self.contact is not None:
            a, b = (self._pose(poses, body) for body in self.contact.bodies)
            energy += self.contact.of_poses(a, b, self.contact.params)
        return energy

    def drive(self, q):
        """(n,) generalised forces of the torque."""
        hinge = self.hinges[0]
        turned = jax.grad(lambda q: self._turned(self.poses(q), hinge.b) - self._turned(self.poses(q), hinge.a))
        return self.torque * turned(q) if self.torque else jnp.zeros_like(q)

    def acceleration(self, q, v):
        """a (n,)."""
        jacobian = jax.jacfwd(self.poses)(q).reshape(-1, q.size)
        bent = jax.jvp(lambda q: jax.jvp(self.poses, (q,), (v,))[1], (q,), (v,))[1]
        weights = self.masses.reshape(-1)
        mass = jacobian.T @ (weights[:, None] * jacobian)
        force = self.drive(q) - jax.grad(lambda q: self.potential(self.poses(q)))(q)
        force = force - jacobian.T @ (weights * bent.reshape(-1))
        if self.loops is None:
            return jnp.linalg.solve(mass, force)
        loops: Callable = self.loops
        rows = jax.jacfwd(loops)(q)
        across = jax.jvp(lambda q: jax.jvp(loops, (q,), (v,))[1], (q,), (v,))[1]
        matrix = jnp.block([[mass, rows.T], [rows, jnp.zeros((len(rows), len(rows)))]])
        return jnp.linalg.solve(matrix, jnp.concatenate([force, -across]))[: q.size]

    def end(self, method: str) -> np.ndarray:
        """(bars, 2) centres at the end, by a method of scipy with its smallest tolerance."""
        n = self.q.size

        @jax.jit
        def rates(y):
            return jnp.concatenate([y[n:], self.acceleration(y[:n], y[n:])])

        y = np.concatenate([self.q, self.v])
        tight: dict = {"rtol": 1e-13, "atol": 1e-13 * self.size}
        found = solve_ivp(lambda t, y: np.asarray(rates(y)), (0.0, self.t_end), y, method, [self.t_end], **tight)
        return self.centres(found.y[:n, -1])

    def centres(self, q) -> np.ndarray:
        """(bars, 2) centres of the bars."""
        return np.asarray(self.poses(jnp.asarray(q)))[:, :2]

    def local(self, body: str, at) -> np.ndarray:
        """A point of space at the start in the axes of a body, from its centre."""
        x, y, angle = np.zeros(3) if body == GROUND else self.start[body][0]
        dx, dy = np.asarray(at) - (x, y)
        return np.array([dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)])

    def _pose(self, poses, body: str):
        return jnp.zeros(3) if body == GROUND else poses[list(self.bars).index(body)]

    def _turned(self, poses, body: str):
        """Since the start, rad."""
        return 0.0 if body == GROUND else self._pose(poses, body)[2] - self.start[body][0][2]

    def _point(self, poses, body: str, at):
        x, y, angle = self._pose(poses, body)
        return jnp.stack([x, y]) + turn(angle, *self.local(body, at))


def turn(angle, x, y):
    """A vector of a bar at this angle."""
    return jnp.stack([x * jnp.cos(angle) - y * jnp.sin(angle), x * jnp.sin(angle) + y * jnp.cos(angle)])


def bar(mass: float, length: float, fast: bool = False) -> Bar:
    """A thin bar."""
    return Bar(mass, mass * length**2 / 12, fast)
