# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""diffrax: adaptive Runge-Kutta methods, Dopri8 and Tsit5."""

from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from benchmarks.peers import equations as by_hand
from benchmarks.peers.cases import Case, Ladder, tolerances

MOST_STEPS = 20_000
"""Per unit of time, and at least: the methods may go on for ever with a step size that is no number."""
SOLVERS: tuple[Any, ...] = (diffrax.Dopri8, diffrax.Tsit5)


def ladders(case: Case, equations=by_hand) -> list[Ladder]:
    """Tolerances of both methods."""
    start = (jnp.asarray(case.q), jnp.asarray(case.v))

    def ladder(solver) -> Ladder:
        solve, settings = jax.jit(solution(case, solver(), equations)), tolerances(1e-2, 1e-14)
        return Ladder(solver.__name__, "tol", settings, lambda tol: partial(solve, start, jnp.asarray(tol)))

    return [ladder(solver) for solver in SOLVERS]


def solution(case: Case, solver, equations):
    """``solve(y, tol)``: positions at the end from ``y = (q, v)``, with relative and absolute tolerance tol."""
    accelerate = equations.acceleration(case)
    term: Any = diffrax.ODETerm(lambda t, y, args: (y[1], accelerate(*y)))
    most = round(MOST_STEPS * max(1.0, case.t_end))

    def solve(y, tol):
        how = {"stepsize_controller": diffrax.PIDController(rtol=tol, atol=tol), "max_steps": most, "throw": False}
        solved = diffrax.diffeqsolve(term, solver, 0.0, case.t_end, None, y, **how)
        ys: Any = solved.ys
        return jnp.where(solved.result == diffrax.RESULTS.successful, ys[0][-1], jnp.nan)

    return solve


energy = by_hand.energy
