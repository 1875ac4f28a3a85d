"""The linear-quadratic problem of a stage structure under inequalities, by the interior-point method of PIQP: O(N).

    min  sum_k (1/2 (dz, du) H_k (dz, du) + h_k . (dz, du))_k + 1/2 dz_N S dz_N + s . dz_N
    dz_{k+1} = A_k dz_k + B_k du_k + c_k        dz_0 = 0        G dz_N + g = 0
    lower <= u_k + du_k <= upper        C_k dz_{k+1} + D_k du_k + l_k <= 0

Where these have no common solution, the goal and the limits are relaxed: what they are missed by is added to the cost, ``RELAXED``
times. Unknowns are ordered by stages, so that the solver's matrices are banded.

Source: R. Schwan, Y. Jiang, D. Kuhn, C. N. Jones, PIQP: a proximal interior-point quadratic programming solver, CDC (2023);
relaxation: R. Fletcher, Practical methods of optimization, Wiley (1987), section 14.4.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy import sparse

from vmri_jax.control.riccati import Final, Solution, Stages
from vmri_jax.mechanics.arrays import Numbers

RELAXED = 1e4
"""Cost of a miss of goal and limits, over the largest slope of the cost, where they cannot be kept."""
ACCURACY = 1e-10


class Limits(NamedTuple):
    """All inequalities at some nodes and controls.

    C, D, value: derivatives by the node at the end of an interval and by its controls, and the value.
    lower, upper: what may be added to the controls.
    """

    C: Float[Numbers, "N c n"]
    D: Float[Numbers, "N c m"]
    value: Float[Numbers, "N c"]
    lower: Float[Numbers, "N m"]
    upper: Float[Numbers, "N m"]


class Unsolved(RuntimeError):
    """PIQP finds no solution, although the relaxed problem has one."""


def solve(stages: Stages, final: Final, limits: Limits) -> tuple[Solution, float]:
    """The solution, and its largest multiplier.

    Raises:
        ImportError: without the package piqp.
        Unsolved: the solver fails.
    """
    stages, final, limits = jax.tree.map(np.asarray, (stages, final, limits))
    found = _solved(stages, final, limits, None)
    if found is None:
        slopes = [np.abs(part).max(initial=0.0) for part in (stages.gradient, final.s)]
        found = _solved(stages, final, limits, RELAXED * max(1.0, *slopes))
    if found is None:
        raise Unsolved(
            "minimize: PIQP solves neither the linear-quadratic problem of an iteration nor its relaxation. Look at the sizes of cost, "
            "goal and limits: they should be of one order."
        )
    return found


def _solved(stages: Stages, final: Final, limits: Limits, relaxed: float | None) -> tuple[Solution, float] | None:
    """The solution of the problem as it is, or relaxed at this price; None if there is none."""
    piqp = _piqp()
    (count, n, m), c, e = stages.B.shape, limits.value.shape[1], len(final.g)
    slack = 0 if relaxed is None else c
    at = (m + n + slack) * np.arange(count)[:, None]
    U, Z, S = at + np.arange(m), at + m + np.arange(n), at + m + n + np.arange(slack)
    size = count * (m + n + slack)
    E = size + np.arange(0 if relaxed is None else 2 * e).reshape(2, -1)  # missed above, and below
    size += E.size

    before = np.concatenate([Z[:-1], U[1:]], axis=1)  # (z_k, u_k) of all stages but the first
    first, last = U[:1], Z[-1:]
    hessian = [
        (stages.hessian[1:], before, before),
        (stages.hessian[:1, n:, n:], first, first),
        (final.S[None], last, last),
    ]
    P = _sparse(hessian, (size, size))
    slope = np.zeros(size)
    slope[before], slope[first], slope[last] = stages.gradient[1:], stages.gradient[:1, n:], slope[last] + final.s

    rows, goal = np.arange(count * n).reshape(count, n), count * n + np.arange(e)[None]
    steps = [(stages.B, rows, U), (stages.A[1:], rows[1:], Z[:-1]), (-np.eye(n) + np.zeros((count, 1, 1)), rows, Z)]
    ends: list[Any] = [(final.G[None], goal, last)]
    under = np.arange(count * c).reshape(count, c)
    kept: list[Any] = [(limits.C, under, Z), (limits.D, under, U)]
    lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
    lower[U], upper[U] = limits.lower, limits.upper
    if relaxed is not None:
        ends += [(-np.eye(e)[None], goal, E[:1]), (np.eye(e)[None], goal, E[1:])]
        kept += [(-np.eye(c) + np.zeros((count, 1, 1)), under, S)]
        for extra in (S, E):
            slope[extra], lower[extra] = relaxed, 0.0
    A = _sparse(steps + ends, (count * n + e, size))
    b = -np.concatenate([stages.c.ravel(), final.g])
    G = _sparse(kept, (count * c, size)) if c else None

    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = ACCURACY
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    solver.setup(P, slope, A, b, G, None, -limits.value.ravel() if c else None, lower, upper)
    if solver.solve() != piqp.PIQP_SOLVED:
        return None
    x, y = solver.result.x, solver.result.y
    largest = max(np.abs(given).max(initial=0.0) for given in (y, solver.result.z_u))
    return Solution(x[Z], x[U], y[count * n :]), float(largest)


def _sparse(blocks, shape) -> sparse.csc_matrix:
    """The sum of blocks (k, r, c) with the numbers of their rows (k, r) and columns (k, c)."""
    values, i, j = [], [], []
    for block, rows, columns in blocks:
        down, across = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
        values, i, j = [*values, block.ravel()], [*i, down.ravel()], [*j, across.ravel()]
    made = sparse.csc_matrix((np.concatenate(values), (np.concatenate(i), np.concatenate(j))), shape)
    made.eliminate_zeros()
    return made


def _piqp():
    try:
        import piqp
    except ImportError:
        raise ImportError(
            "bounds and limits of controls need the package piqp; install it with: pip install 'vmri_jax[control]'"
        ) from None
    return piqp
