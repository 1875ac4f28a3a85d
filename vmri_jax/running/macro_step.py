"""A single macro step, without a run."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.checks import check_system, check_type
from vmri_jax.mechanics.state import A_SYSTEM, State
from vmri_jax.mechanics.system import System
from vmri_jax.running.engine import solved_again
from vmri_jax.running.observables import Observables, fault, is_right, observed
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver
from vmri_jax.steppers.stepper import StepInfo


def macro_step(
    system: System, scheme: SchemeLike, state: State, macro_dt, solver: Solver | None = None
) -> tuple[State, StepInfo]:
    """One macro step, ``(state, info) = macro_step(system, scheme, state, macro_dt)``; a pure function.

    Compiled once for all systems, schemes and states of the same structure. The momenta returned are projected onto the
    hidden constraints, ``G v + dg/dt = 0``. `simulate` takes many steps faster: it reuses gradients and starts Newton
    from the step before.

    Args:
        system: the system.
        scheme: a scheme or composition.
        state: a consistent state, from `initial_state` or a former step.
        macro_dt: length H of the macro step, positive.
        solver: for implicit equations; None for ``Solver()``. What "auto" does not solve is solved again with exact
            matrices.

    Returns:
        The state at the end of the step, and the status, method, iterations and micro nodes of the step.

    Raises:
        TypeError: no System, or no State.
        ValueError: bad arguments, as of `simulate`.
    """
    check_type("macro_step: system", system, System, A_SYSTEM)
    check_type("macro_step: state", state, State, "a State, e.g. problem.state()")
    return _macro_step(simulation(system, scheme, state, solver, macro_dt, num_steps=1))


@jax.jit
def _macro_step(run: Simulation):
    check_system(run.system, run.state.q_s, run.state.q_f)  # once for each program: a check takes longer than a step
    if not run.plan.has_fallback:
        return _step(run)
    return solved_again(_step, lambda run: _step(run.exact), lambda end: end[1].status[:2], run)


def _step(run: Simulation):
    state, info, _ = run.plan.step(run.state, run.plan.init(run.state, run.macro_dt), run.macro_dt)
    state, table = observed(run.system, state, run.macro_dt, run.solver.tolerance)
    now = Observables.of(table)
    # rows that contradict each other leave increments that converge
    fails = (info.result <= Result.CONVERGED_AT_ROUNDOFF) & ~is_right(now)
    return state, replace(info, result=jnp.where(fails, fault(now), info.result))
