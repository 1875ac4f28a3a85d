"""Monodromy: the derivative of many steps along a trajectory, and its multipliers."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from vmri_jax.diagnostics.linear import change_of_form, derivative_along, phase_splits, phase_vector
from vmri_jax.mechanics.arrays import is_concrete, whole_number
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solvers import Newton


@dataclass(frozen=True)
class Monodromy:
    """Derivative of the end of a trajectory with respect to its start, between the tangent spaces of the constraint manifold at both.

    matrix: M, (k, k) with k = 2 (n_s + n_f - n_g - n_gs), in the orthonormal bases `start_basis` and `end_basis`.
    start_basis, end_basis: (k, 2 n) tangent vectors (q_s, q_f, p_s, p_f), one per row.
    start, end: states.
    closure: distance of the end from the start, relative to the larger norm of the two.
    symplectic_defect: largest entry of ``M^T J M - J`` on the tangent spaces, relative to the larger of 1 and the largest ``|M_ij|^2``.
    """

    matrix: np.ndarray
    start_basis: np.ndarray
    end_basis: np.ndarray
    start: State
    end: State
    closure: float
    symplectic_defect: float

    @property
    def multipliers(self) -> np.ndarray:
        """(k,) Floquet multipliers, the largest first.

        They are meaningful only for a trajectory that closes, or ends near its start (small `closure`): then both ends
        share a tangent space.
        """
        values = np.linalg.eigvals(self.start_basis @ self.end_basis.T @ self.matrix)
        return values[np.argsort(-np.abs(values), kind="stable")]

    @property
    def stretch(self) -> np.ndarray:
        """(k,) singular values of M, the largest first: the growth of disturbances of the start, for closed and open trajectories."""
        return np.linalg.svd(self.matrix, compute_uv=False)


def monodromy(
    system: Movable,
    scheme: Scheme | Composition,
    state: State | None = None,
    *,
    macro_dt,
    num_steps: int,
    solver: Newton | None = None,
) -> Monodromy:
    """Product of the step's derivatives along a trajectory, ``M = DPhi(z_(N-1)) ... DPhi(z_0)``.

    With constraints, every factor maps between the tangent spaces of the constraint manifold at the two ends of its step.

    Args:
        system, scheme, macro_dt, solver: as in `macro_step`.
        state: consistent start; None for the start of the problem or scene.
        num_steps: macro steps; one period of a periodic orbit gives its Floquet multipliers.

    Raises:
        ValueError: num_steps below 1, a macro step that is not positive.
        RuntimeError: a step failed; with its number and reason.
    """
    system, state = start_of("monodromy", system, state)
    whole_number("monodromy: num_steps", num_steps)
    if is_concrete(macro_dt) and not (np.ndim(macro_dt) == 0 and np.isfinite(macro_dt) and macro_dt > 0):
        raise ValueError(f"monodromy: macro_dt is {macro_dt}; it must be a positive number.")
    start = State(*(jnp.asarray(a, dtype=float) for a in (state.t, state.q_s, state.q_f, state.p_s, state.p_f)))
    product = derivative_along(system, scheme, start, macro_dt, solver, num_steps)
    last, M, at_start, at_end, steps, result = (np.asarray(a) for a in product)
    if result > Result.CONVERGED_AT_ROUNDOFF:
        raise RuntimeError(f"monodromy: macro step {steps - 1} failed: {Result(int(result)).message}")
    first = np.asarray(phase_vector(start))
    defect = change_of_form(M, at_start, at_end)
    return Monodromy(
        matrix=M,
        start_basis=at_start,
        end_basis=at_end,
        start=start,
        end=State(start.t + num_steps * macro_dt, *jnp.split(last, phase_splits(start))),
        closure=float(np.linalg.norm(last - first) / max(np.linalg.norm(first), np.linalg.norm(last), 1e-300)),
        symplectic_defect=float(np.abs(defect).max() / max(1.0, np.abs(M).max() ** 2)),
    )
