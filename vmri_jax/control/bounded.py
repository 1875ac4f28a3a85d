"""The linear-quadratic problem of a stage structure under inequalities, by the interior-point method of PIQP: O(N).

    min  sum_k (1/2 (dz, du) H_k (dz, du) + h_k . (dz, du))_k + 1/2 dz_N S dz_N + s . dz_N
    dz_{k+1} = A_k dz_k + B_k du_k + c_k        dz_0 = 0        G dz_N + g = 0
    lower <= u_k + du_k <= upper        C_k dz_{k+1} + D_k du_k + l_k <= 0

If the goal and the inequalities have no common solution, slack variables take up the violation of the goal and of the
limits, and their sum enters the cost with a large weight. Unknowns are ordered by stages: matrices are banded.

Source: R. Schwan, Y. Jiang, D. Kuhn, C. N. Jones, PIQP: a proximal interior-point QP solver, CDC (2023);
relaxation: R. Fletcher, Practical methods of optimization, Wiley (1987), section 14.4.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy import sparse

from vmri_jax.control.riccati import Final, Solution, Stages
from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.running import export

RELAXATION_WEIGHT = 1e4
"""Cost of one unit of slack, relative to the largest slope of the cost. It has to exceed the multipliers of goal and
limits, else the solution violates goals and limits that it could fulfil; a larger cost spoils the condition."""
TOLERANCE = 1e-10
"""Absolute and relative tolerance of PIQP, two decades below the default tolerance of `minimize`; with a larger one the
updates of the last iterations would be errors of PIQP."""


class Limits(NamedTuple):
    """All inequalities at some nodes and controls.

    C, D, value: derivatives with respect to the node at the end of an interval and to its controls, and the value.
    lower, upper: bounds of the change of the controls.
    """

    C: Float[Numbers, "N c n"]
    D: Float[Numbers, "N c m"]
    value: Float[Numbers, "N c"]
    lower: Float[Numbers, "N m"]
    upper: Float[Numbers, "N m"]


class Unsolved(RuntimeError):
    """The linear-quadratic problem of an iteration has no solution, or PIQP finds none."""


def solve(stages: Stages, final: Final, limits: Limits) -> tuple[Solution, float]:
    """The solution, and the largest absolute multiplier of its equations and limits; `Unsolved` if the solver fails."""
    stages, final, limits = jax.tree.map(np.asarray, (stages, final, limits))
    solution = _solved(stages, final, limits, None)
    if solution is None:
        slopes = [np.abs(part).max(initial=0.0) for part in (stages.gradient, final.s)]
        solution = _solved(stages, final, limits, RELAXATION_WEIGHT * max(1.0, *slopes))
    if solution is None:
        problem = "neither the linear-quadratic problem of an iteration nor its relaxation"
        raise Unsolved(f"minimize: PIQP solves {problem}; cost, goal and limits should be of one order.")
    return solution


def _solved(stages: Stages, final: Final, limits: Limits, weight: float | None) -> tuple[Solution, float] | None:
    """Solution and largest multiplier of the problem or its relaxation with this weight; None if PIQP fails."""
    piqp = export.extra("piqp", "minimize with bounds or limits of controls", "control")
    (count, n, m), c, e = stages.B.shape, limits.value.shape[1], len(final.g)
    num_slacks = 0 if weight is None else c
    # Unknowns, stage by stage: the control du_k, the node dz_{k+1}, the slacks of its limits; slacks of the goal at the
    # end. U, Z, SLACK (count, ...) and GOAL_SLACK (2, e) hold their numbers in the vector of unknowns x of
    #     min 1/2 x P x + slope . x    with    A x = b,    G x <= -value,    lower <= x <= upper.
    offset = (m + n + num_slacks) * np.arange(count)[:, None]
    U, Z, SLACK = offset + np.arange(m), offset + m + np.arange(n), offset + m + n + np.arange(num_slacks)
    size = count * (m + n + num_slacks)
    GOAL_SLACK = size + np.arange(0 if weight is None else 2 * e).reshape(2, -1)  # goal missed above, and below
    size += GOAL_SLACK.size

    before = np.concatenate([Z[:-1], U[1:]], axis=1)  # (dz_k, du_k) of all stages but the first, whose dz_0 is 0
    first, last = U[:1], Z[-1:]
    hessian = [
        (stages.hessian[1:], before, before),
        (stages.hessian[:1, n:, n:], first, first),
        (final.S[None], last, last),
    ]
    P = _sparse(hessian, (size, size))
    slope = np.zeros(size)
    slope[before], slope[first], slope[last] = stages.gradient[1:], stages.gradient[:1, n:], slope[last] + final.s

    # A dz_k + B du_k - dz_{k+1} = -c    and    G dz_N = -g, where the relaxation has  G dz_N - e_+ + e_- = -g  with
    # e_+, e_- >= 0
    rows, goal = np.arange(count * n).reshape(count, n), count * n + np.arange(e)[None]
    step_blocks = [
        (stages.B, rows, U),
        (stages.A[1:], rows[1:], Z[:-1]),
        (-np.eye(n) + np.zeros((count, 1, 1)), rows, Z),
    ]
    goal_blocks: list[Any] = [(final.G[None], goal, last)]
    # C dz_{k+1} + D du_k <= -l, where the relaxation has  C dz_{k+1} + D du_k - slack <= -l  with slack >= 0
    under = np.arange(count * c).reshape(count, c)
    limit_blocks: list[Any] = [(limits.C, under, Z), (limits.D, under, U)]
    lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
    lower[U], upper[U] = limits.lower, limits.upper
    if weight is not None:
        goal_blocks += [(-np.eye(e)[None], goal, GOAL_SLACK[:1]), (np.eye(e)[None], goal, GOAL_SLACK[1:])]
        limit_blocks += [(-np.eye(c) + np.zeros((count, 1, 1)), under, SLACK)]
        for extra in (SLACK, GOAL_SLACK):
            slope[extra], lower[extra] = weight, 0.0
    A = _sparse(step_blocks + goal_blocks, (count * n + e, size))
    b = -np.concatenate([stages.c.ravel(), final.g])
    G = _sparse(limit_blocks, (count * c, size)) if c else None

    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = TOLERANCE
    solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
    solver.setup(P, slope, A, b, G, None, -limits.value.ravel() if c else None, lower, upper)
    if solver.solve() != piqp.PIQP_SOLVED:
        return None
    x, y = solver.result.x, solver.result.y
    largest = max(np.abs(multipliers).max(initial=0.0) for multipliers in (y, solver.result.z_u))
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
