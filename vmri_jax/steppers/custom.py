"""Whole steps from a user's stepper, and checks of shapes."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from vmri_jax.mechanics.checks import check_type
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.kicked import Kicked
from vmri_jax.steppers.solved import Solved
from vmri_jax.steppers.stepper import Stepper


def with_kicks(made: Any, system: System, scheme: Scheme, average: Callable | None) -> Kicked:
    """The stepper of a run from `made`, the value of ``Solver.stepper``.

    A `Solved` stepper solves the equations between the kicks, so that the kicks of the scheme are added, mollified ones
    with their `average`; any other stepper takes the whole step.
    """
    check_type("plan: the value of Solver.stepper", made, Stepper, "a vmri_jax.steppers.stepper.Stepper")
    if isinstance(made, Solved):
        made = Kicked(lagrangian(system, scheme).kicks, made, average)
    if type(made) is not Kicked:  # a subclass may have an `advance` of its own
        made = Kicked((), made)
    return made


def check_shapes(stepper: Stepper, system: System, scheme: Scheme, state: State) -> None:
    """Refuse a stepper of a user whose end state or record has wrong shapes."""
    (n_g, n_gs), n_f, r = system.num_constraints(state.q_s, state.q_f), state.q_f.size, scheme.degree

    def step(state: State):
        end, info, _ = stepper.step(state, stepper.init(state, 1.0), 1.0)
        return end, info

    end, info = jax.eval_shape(step, state)
    micro = scheme.num_micro
    of_info = {"q_f_micro": (micro, n_f), "multiplier": (micro, r, n_g), "slow_multiplier": (r, n_gs)}
    expected = [(end, name, np.shape(value)) for name, value in vars(state).items()]
    expected += [(info, name, shape) for name, shape in of_info.items()]
    for owner, name, shape in expected:
        returned = np.shape(getattr(owner, name))
        if returned != shape:
            raise Refused(
                f"plan: advance of the stepper of Solver.stepper returns {type(owner).__name__}.{name} of shape "
                f"{returned}; it must be {shape} for num_micro = {micro}, degree = {r}, {n_g} constraints and {n_gs} "
                "slow ones."
            )
