"""Slow and fast variables apart, or joined.

*Decoupled*: slow equations that do not depend on the fast unknowns; the slow variables make one step, then the fast
variables several shorter ones. *Joined*: on one micro interval slow and fast unknowns are of one kind.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp

from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.state import State
from vmri_jax.steppers.kicked import Kicked, Repeated
from vmri_jax.steppers.stepper import StepInfo, Stepper, indented


class DecoupledMemory(NamedTuple):
    """Memories of the steppers of the slow and of the fast variables."""

    slow: Any
    fast: Any


@dataclass(frozen=True)
class Decoupled(Stepper):
    """Two independent parts, the slow and the fast variables.

    Each part is a `System` of its own in which all variables count as fast (slow variables are stored as q_f), on a
    single interval, so that the same steppers apply. Kicks that depend on both parts are applied outside of this
    stepper.

    slow: stepper of the slow variables, one step over the macro interval.
    fast: steps of the fast variables.
    """

    slow: Kicked
    fast: Repeated

    def init(self, state: State, macro_dt) -> DecoupledMemory:
        slow, fast = apart(state)
        return DecoupledMemory(self.slow.init(slow, macro_dt), self.fast.init(fast, macro_dt))

    def advance(self, state: State, memory: DecoupledMemory, macro_dt) -> tuple[State, StepInfo, DecoupledMemory]:
        slow, fast = apart(state)
        slow, slow_info, slow_memory = self.slow.advance(slow, memory.slow, macro_dt)
        renewed = self.fast.renew(fast, memory.fast, macro_dt)
        fast, info, fast_memory = self.fast.advance(fast, renewed, macro_dt)
        status = slow_info.status.worse(info.status)
        end = State(state.t + macro_dt, slow.q_f, fast.q_f, slow.p_f, fast.p_f)
        info = StepInfo(*status, info.q_f_micro, info.multiplier, slow_info.multiplier[0])
        return end, info, DecoupledMemory(slow_memory, fast_memory)

    def continued(self, memory: DecoupledMemory, last: DecoupledMemory, state: State, macro_dt) -> DecoupledMemory:
        slow, fast = apart(state)
        return DecoupledMemory(
            self.slow.continued(memory.slow, last.slow, slow, macro_dt),
            self.fast.continued(memory.fast, last.fast, fast, macro_dt),
        )

    def describe(self) -> list[str]:
        steps, *inner = self.fast.describe()
        return ["slow variables, one step:", *indented(self.slow.describe()), f"fast variables, {steps}", *inner]


@dataclass(frozen=True)
class Joined(Stepper):
    """All variables as fast ones of a `System` of its own, the slow variables and the constraints g first.

    num_slow: number of slow variables.
    num_constraints: number of rows of g, before those of g_s.
    """

    inner: Stepper
    num_slow: int
    num_constraints: int

    def init(self, state: State, macro_dt) -> Any:
        return self.inner.init(together(state), macro_dt)

    def renew(self, state: State, memory, macro_dt) -> Any:
        return self.inner.renew(together(state), memory, macro_dt)

    def advance(self, state: State, memory, macro_dt) -> tuple[State, StepInfo, Any]:
        end, info, memory = self.inner.advance(together(state), memory, macro_dt)
        n_s, (q_s, q_f), (p_s, p_f) = self.num_slow, *(split_at(a, self.num_slow) for a in (end.q_f, end.p_f))
        multiplier, slow_multiplier = split_at(info.multiplier, self.num_constraints)
        info = replace(
            info, q_f_micro=info.q_f_micro[:, n_s:], multiplier=multiplier, slow_multiplier=slow_multiplier[0]
        )
        return State(end.t, q_s, q_f, p_s, p_f), info, memory

    def continued(self, memory, last, state: State, macro_dt) -> Any:
        return self.inner.continued(memory, last, together(state), macro_dt)

    def describe(self) -> list[str]:
        return self.inner.describe()


def together(state: State) -> State:
    """The slow and then the fast variables as a state in which all variables count as fast."""
    none = jnp.zeros(0)
    q, p = jnp.concatenate([state.q_s, state.q_f]), jnp.concatenate([state.p_s, state.p_f])
    return State(state.t, none, q, none, p)


def apart(state: State) -> tuple[State, State]:
    """The slow and the fast variables, each as a state in which all variables count as fast."""
    none = jnp.zeros(0)
    return State(state.t, none, state.q_s, none, state.p_s), State(state.t, none, state.q_f, none, state.p_f)
