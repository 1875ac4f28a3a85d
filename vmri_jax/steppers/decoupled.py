"""Slow equations that do not see the fast unknowns: the slow variables make one step, then the fast ones num_micro steps."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp

from vmri_jax.mechanics.state import State
from vmri_jax.steppers.kicked import Kicked
from vmri_jax.steppers.stepper import StepInfo, Stepper, indented


class DecoupledState(NamedTuple):
    """What the steppers of the slow and of the fast variables carry."""

    slow: Any
    fast: Any


@dataclass(frozen=True)
class Decoupled(Stepper):
    """Each part is a system of fast variables alone on a single interval; kicks that join them stay outside.

    slow: takes one step over the macro interval.
    fast: takes `num_micro` steps over the micro intervals.
    """

    slow: Kicked
    fast: Kicked
    num_micro: int

    def init(self, state: State, macro_dt) -> DecoupledState:
        slow, fast = apart(state)
        return DecoupledState(self.slow.init(slow, macro_dt), self.fast.init(fast, macro_dt / self.num_micro))

    def renew(self, state: State, own: DecoupledState, macro_dt) -> DecoupledState:
        slow, fast = apart(state)
        micro_dt = macro_dt / self.num_micro
        return DecoupledState(self.slow.renew(slow, own.slow, macro_dt), self.fast.renew(fast, own.fast, micro_dt))

    def move(self, state: State, own: DecoupledState, macro_dt) -> tuple[State, StepInfo, DecoupledState]:
        slow, fast = apart(state)
        slow, slow_info, own_slow = self.slow.move(slow, own.slow, macro_dt)
        fast, info, own_fast = self.fast.move_many(fast, own.fast, macro_dt / self.num_micro, self.num_micro)
        status = slow_info.status.worse(info.status)
        end = State(state.t + macro_dt, slow.q_f, fast.q_f, slow.p_f, fast.p_f)
        info = StepInfo(*status, info.q_f_micro, info.multiplier, slow_info.multiplier[0])
        return end, info, DecoupledState(own_slow, own_fast)

    def project(self, state: State, own: DecoupledState) -> tuple[State, DecoupledState]:
        slow, fast = apart(state)
        slow, own_slow = self.slow.project(slow, own.slow)
        fast, own_fast = self.fast.project(fast, own.fast)
        return State(state.t, state.q_s, state.q_f, slow.p_f, fast.p_f), DecoupledState(own_slow, own_fast)

    def continued(self, own: DecoupledState, last: DecoupledState, state: State, macro_dt) -> DecoupledState:
        slow, fast = apart(state)
        return DecoupledState(
            self.slow.continued(own.slow, last.slow, slow, macro_dt),
            self.fast.continued(own.fast, last.fast, fast, macro_dt / self.num_micro),
        )

    def lines(self) -> list[str]:
        return [
            "slow variables, one step:",
            *indented(self.slow.lines()),
            f"fast variables, {self.num_micro} micro step{'s' * (self.num_micro > 1)}:",
            *indented(self.fast.lines()),
        ]


def apart(state: State) -> tuple[State, State]:
    """The slow and the fast variables as states of fast variables alone."""
    none = jnp.zeros(0)
    return State(state.t, none, state.q_s, none, state.p_s), State(state.t, none, state.q_f, none, state.p_f)
