# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""diffrax: adaptive Runge-Kutta methods (Dopri8, Tsit5) and the semi-implicit Euler method."""

from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from benchmarks.peers import equations as by_hand
from benchmarks.peers.cases import Case, Ladder, steps_ladder, tolerances

CHUNK = 64
"""Lanes at once that fit into the cache."""
MOST_STEPS = 20_000
"""Of the adaptive methods per unit of time, and at least: they may go on for ever with a step size that is no number."""
SOLVERS: tuple[Any, ...] = (diffrax.Dopri8, diffrax.Tsit5)


def ladders(case: Case, equations=by_hand) -> list[Ladder]:
    """Tolerances for the adaptive methods, steps for the semi-implicit one."""
    start = (jnp.asarray(case.q), jnp.asarray(case.v))

    def adaptive(solver) -> Ladder:
        solve = jax.jit(solution(case, solver(), equations))
        name, settings = solver.__name__, tolerances(1e-2, 1e-14)
        return Ladder(name, "tol", settings, lambda tol: partial(solve, start, jnp.asarray(tol)))

    found = [adaptive(solver) for solver in SOLVERS]
    if case.is_chain:
        solve = jax.jit(semi_implicit(case, equations))

        def build(num_steps: int):
            return partial(solve, start, jnp.asarray(case.t_end / num_steps))

        found.append(steps_ladder(case, "SemiImplicitEuler", build, first=32.0))
    return found


def solution(case: Case, solver, equations):
    """``solve(y, tol)``: positions at the end from ``y = (q, v)``, with relative and absolute tolerance tol."""
    accelerate = equations.acceleration(case)
    term: Any = diffrax.ODETerm(lambda t, y, args: (y[1], accelerate(*y)))

    def solve(y, tol):
        controller, most = diffrax.PIDController(rtol=tol, atol=tol), round(MOST_STEPS * max(1.0, case.t_end))
        return _end(term, solver, y, case.t_end, None, stepsize_controller=controller, max_steps=most)

    return solve


def semi_implicit(case: Case, equations):
    """``solve(y, dt)``: the same by the symplectic Euler method, the velocity first."""
    accelerate = equations.acceleration(case)
    drift: Any = diffrax.ODETerm(lambda t, v, args: v)
    kick: Any = diffrax.ODETerm(lambda t, q, args: accelerate(q, None))

    def solve(y, dt):
        return _end((drift, kick), diffrax.SemiImplicitEuler(), y, case.t_end, dt, max_steps=None)

    return solve


def _end(terms, solver, y, t_end: float, dt, **options):
    found = diffrax.diffeqsolve(terms, solver, 0.0, t_end, dt, y, throw=False, **options)
    ys: Any = found.ys
    return jnp.where(found.result == diffrax.RESULTS.successful, ys[0][-1], jnp.nan)


energy = by_hand.energy


def batch_ladders(case: Case, states, q, v, equations=by_hand) -> list[Ladder]:
    """The adaptive methods under ``jax.vmap``, all lanes at once or in chunks."""
    starts = (jnp.asarray(q), jnp.asarray(v))

    def ladder(solver, chunk: int | None) -> Ladder:
        solve = solution(case, solver(), equations)

        @jax.jit
        def run(starts, tol):
            if chunk is None:
                return jax.vmap(lambda y: solve(y, tol))(starts)
            return jax.lax.map(lambda y: solve(y, tol), starts, batch_size=chunk)

        name = f"{solver.__name__} {'all' if chunk is None else chunk}"
        return Ladder(name, "tol", tolerances(1e-2, 1e-12), lambda tol: partial(run, starts, jnp.asarray(tol)))

    return [ladder(solver, chunk) for solver in SOLVERS for chunk in (None, CHUNK)]
