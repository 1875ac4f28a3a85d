"""Slow equations that do not depend on the fast unknowns: the slow variables make one step, then the fast variables several shorter ones."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp

from vmri_jax.mechanics.state import State
from vmri_jax.steppers.kicked import Kicked, steps_in_words
from vmri_jax.steppers.stepper import StepInfo, Stepper, indented


class DecoupledState(NamedTuple):
    """Memories of the steppers of the slow and of the fast variables."""

    slow: Any
    fast: Any


@dataclass(frozen=True)
class Decoupled(Stepper):
    """Two independent parts, the slow and the fast variables.

    Each part is a `System` of its own in which all variables count as fast (slow variables are stored as q_f), on a single interval, so that
    the same steppers apply. Kicks that depend on both parts are applied outside of this stepper.

    slow: stepper of the slow variables, one step over the macro interval.
    fast: stepper of the fast variables, `num_fast` steps.
    """

    slow: Kicked
    fast: Kicked
    num_fast: int

    def init(self, state: State, macro_dt) -> DecoupledState:
        slow, fast = apart(state)
        return DecoupledState(self.slow.init(slow, macro_dt), self.fast.init(fast, macro_dt / self.num_fast))

    def advance(self, state: State, memory: DecoupledState, macro_dt) -> tuple[State, StepInfo, DecoupledState]:
        slow, fast = apart(state)
        slow, slow_info, slow_memory = self.slow.advance(slow, memory.slow, macro_dt)
        fast, info, fast_memory = self.fast.advance_many(fast, memory.fast, macro_dt / self.num_fast, self.num_fast)
        status = slow_info.status.worse(info.status)
        end = State(state.t + macro_dt, slow.q_f, fast.q_f, slow.p_f, fast.p_f)
        info = StepInfo(*status, info.q_f_micro, info.multiplier, slow_info.multiplier[0])
        return end, info, DecoupledState(slow_memory, fast_memory)

    def continued(self, memory: DecoupledState, last: DecoupledState, state: State, macro_dt) -> DecoupledState:
        slow, fast = apart(state)
        return DecoupledState(
            self.slow.continued(memory.slow, last.slow, slow, macro_dt),
            self.fast.continued(memory.fast, last.fast, fast, macro_dt / self.num_fast),
        )

    def describe(self) -> list[str]:
        return [
            "slow variables, one step:",
            *indented(self.slow.describe()),
            f"fast variables, {steps_in_words(self.num_fast, self.fast)}:",
            *indented(self.fast.describe()),
        ]


def apart(state: State) -> tuple[State, State]:
    """The slow and the fast variables, each as a state in which all variables count as fast."""
    none = jnp.zeros(0)
    return State(state.t, none, state.q_s, none, state.p_s), State(state.t, none, state.q_f, none, state.p_f)
