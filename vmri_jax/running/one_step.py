"""One macro step as a call of its own."""

import jax

from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.plan import plan
from vmri_jax.steppers.step import StepInfo


@jax.jit
def macro_step(
    system: System, scheme: Scheme | Composition, state: State, macro_dt, newton: Newton | None = None
) -> tuple[State, StepInfo]:
    """One macro step, ``(state, info) = macro_step(system, scheme, state, macro_dt)``; pure, compiled once per structure.

    The momenta returned are projected onto the hidden constraints, ``G v + dg/dt = 0``. `simulate` takes many steps faster:
    it reuses gradients and starts Newton from the step before.

    Args:
        system, scheme: what moves, and how.
        state: a consistent state, from `initial_state` or a former step.
        macro_dt: length H of the macro step, positive.
        newton: how implicit equations are solved.
    """
    stepper = plan(system, scheme, newton or Newton(), state)
    state, info, own = stepper.step(state, stepper.init(state, macro_dt), macro_dt)
    return stepper.project(state, own)[0], info
