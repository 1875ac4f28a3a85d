"""Known methods, written out in numpy, that schemes with one micro step reduce to."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.check.measures import difference, nodes, run
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import ConstantMass
from vmri_jax.schemes.scheme import Scheme


class Flat:
    """A problem with slow and fast variables joined: force, its derivative, constraints and their Jacobian."""

    def __init__(self, problem: Problem):
        system, n_s, state = problem.system, problem.q_s.size, problem.state()
        zeros = jnp.zeros_like(state.p_s), jnp.zeros_like(state.p_f)

        def potential(q):
            return diagnostics.energy(system, q[:n_s], q[n_s:], *zeros)

        def rows(q):
            return system.constraints(state.t, q[:n_s], q[n_s:])

        kinetic = system.kinetic
        assert isinstance(kinetic, ConstantMass)
        self.mass = np.concatenate([kinetic.slow, kinetic.fast])
        self.q = np.concatenate([state.q_s, state.q_f])
        self.p = np.concatenate([state.p_s, state.p_f])
        self._force, self._slope = jax.jit(jax.grad(potential)), jax.jit(jax.hessian(potential))
        self._rows, self._jacobian = jax.jit(rows), jax.jit(jax.jacrev(rows))

    def force(self, q):
        return -np.asarray(self._force(q))

    def slope(self, q):
        return -np.asarray(self._slope(q))

    def rows(self, q):
        return np.asarray(self._rows(q))

    def jacobian(self, q):
        return np.asarray(self._jacobian(q))


def midpoint_integrator(flat: Flat, h: float, q, p):
    """``p = M (q+ - q)/h - h/2 F(qm)``, ``p+ = M (q+ - q)/h + h/2 F(qm)``, qm the midpoint."""
    new = q + h * p / flat.mass
    for _ in range(8):
        middle = (q + new) / 2
        residual = flat.mass * (new - q) / h - h / 2 * flat.force(middle) - p
        new = new - np.linalg.solve(np.diag(flat.mass) / h - h / 4 * flat.slope(middle), residual)
    return new, flat.mass * (new - q) / h + h / 2 * flat.force((q + new) / 2)


def rattle(flat: Flat, h: float, q, p):
    """Verlet's step with ``g(q+) = 0`` and ``G M^-1 p+ = 0`` (Andersen 1983); Verlet itself without constraints."""
    free, jacobian = p + h / 2 * flat.force(q), flat.jacobian(q)
    multiplier = np.zeros(len(jacobian))
    for _ in range(12):
        new = q + h / flat.mass * (free - h / 2 * jacobian.T @ multiplier)
        slope = -(h**2) / 2 * flat.jacobian(new) / flat.mass @ jacobian.T
        multiplier = multiplier - np.linalg.solve(slope, flat.rows(new))
    p, jacobian = free - h / 2 * jacobian.T @ multiplier + h / 2 * flat.force(new), flat.jacobian(new)
    return new, p - jacobian.T @ np.linalg.solve(jacobian / flat.mass @ jacobian.T, jacobian @ (p / flat.mass))


def apart_from(method, problem: Problem, scheme: Scheme, h: float, steps: int) -> float:
    """Largest difference of a run from a known method, relative to the positions and momenta."""
    flat, trajectory = Flat(problem), run(problem, scheme, h, steps)
    q, p, found, momenta = flat.q, flat.p, nodes(trajectory), np.concatenate([trajectory.p_s, trajectory.p_f], axis=1)
    worst = 0.0
    for k in range(1, steps + 1):
        q, p = method(flat, h, q, p)
        worst = max(worst, difference(found[k], q) / abs(q).max(), difference(momenta[k], p) / abs(p).max())
    return worst
