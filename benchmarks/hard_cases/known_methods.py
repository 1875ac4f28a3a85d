"""Known methods, written in NumPy, to which schemes with one micro step reduce."""

from collections.abc import Callable

import jax
import numpy as np
from jax.scipy.linalg import block_diag

from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.hard_cases.measures import difference, run
from vmri_jax.mechanics.invariants import potential_energy
from vmri_jax.mechanics.state import Problem
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.study.reference_solution import joined

ROUND_OFF = 4 * np.finfo(float).eps
"""Round-off of a position in a step, as a part of the largest position; a larger value hides differences of momenta."""


class Flat:
    """A problem with slow and fast variables joined, as functions of q that return arrays of NumPy.

    q, p: (n,) start.
    mass, inverse_mass: (n, n).
    force, slope: ``-grad U`` and its derivative, with the sum U of all potentials.
    rows, jacobian: values and Jacobian of the constraints.
    """

    def __init__(self, problem: Problem):
        system, n_s, state = problem.system, problem.q_s.size, problem.state()

        def potential(q):
            return potential_energy(system, q[:n_s], q[n_s:])

        def rows(q):
            return system.constraints(state.t, q[:n_s], q[n_s:])

        self.q, self.p = (np.asarray(x) for x in np.split(phase_vector(state), 2))
        self.mass = np.asarray(block_diag(system.kinetic.slow_mass.matrix, system.kinetic.fast_mass.matrix))
        self.inverse_mass = np.linalg.inv(self.mass)
        gradient = jax.grad(potential)
        self.force = _compiled(lambda q: -gradient(q))
        self.slope = _compiled(lambda q: -jax.jacfwd(gradient)(q))
        self.rows, self.jacobian = _compiled(rows), _compiled(jax.jacrev(rows))


def _compiled(function) -> Callable[[np.ndarray], np.ndarray]:
    """The function of q, compiled, with results in NumPy."""
    compiled = jax.jit(function)
    return lambda q: np.asarray(compiled(q))


def midpoint_integrator(flat: Flat, h: float, q, p):
    """``p = M (q+ - q)/h - h/2 F(qm)`` by Newton's iteration, ``p+ = M (q+ - q)/h + h/2 F(qm)``, qm the midpoint."""
    new = q + h * flat.inverse_mass @ p
    for _ in range(8):
        middle = (q + new) / 2
        residual = flat.mass @ (new - q) / h - h / 2 * flat.force(middle) - p
        new = new - np.linalg.solve(flat.mass / h - h / 4 * flat.slope(middle), residual)
    return new, flat.mass @ (new - q) / h + h / 2 * flat.force((q + new) / 2)


def rattle(flat: Flat, h: float, q, p):
    """Verlet's step with ``g(q+) = 0`` and ``G M^-1 p+ = 0`` (Andersen 1983); Verlet itself without constraints."""
    free, jacobian = p + h / 2 * flat.force(q), flat.jacobian(q)
    multiplier = np.zeros(len(jacobian))
    for _ in range(12):
        new = q + h * flat.inverse_mass @ (free - h / 2 * jacobian.T @ multiplier)
        slope = -(h**2) / 2 * flat.jacobian(new) @ flat.inverse_mass @ jacobian.T
        multiplier = multiplier - np.linalg.solve(slope, flat.rows(new))
    p, jacobian = free - h / 2 * jacobian.T @ multiplier + h / 2 * flat.force(new), flat.jacobian(new)
    weighted = jacobian @ flat.inverse_mass
    return new, p - jacobian.T @ np.linalg.solve(weighted @ jacobian.T, weighted @ p)


def apart_from(method, problem: Problem, scheme: Scheme, h: float, steps: int) -> float:
    """Largest difference of a run from a known method, relative to the largest positions and momenta, less round-off.

    Momenta are ``M (q+ - q) / h`` in both: round-off of the positions is divided by h.
    """
    flat, trajectory = Flat(problem), run(problem, scheme, h, steps)
    positions, momenta = joined(trajectory)
    momentum = abs(momenta).max()
    floor = ROUND_OFF * abs(flat.mass).max() * abs(positions).max() / h
    q, p, worst = flat.q, flat.p, 0.0
    for k in range(1, steps + 1):
        q, p = method(flat, h, q, p)
        of_momenta = max(difference(momenta[k], p) - k * floor, 0.0)
        worst = max(worst, difference(positions[k], q) / abs(q).max(), of_momenta / momentum)
    return worst
