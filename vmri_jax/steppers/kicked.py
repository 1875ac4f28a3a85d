"""Kicks: potentials at the ends of an interval, which only shift the momenta before and after the motion inside."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers, is_concrete
from vmri_jax.mechanics.state import State
from vmri_jax.schemes.discrete_lagrangian import TermOnNodes
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus, indented


class KickedMemory(NamedTuple):
    """Memory that a step hands to the next one.

    gradients: ``(dL/dq_s, dL/dq_f)`` of every kick at the node that two steps share.
    inner: memory of the inner stepper.
    """

    gradients: tuple[tuple[Float[Numbers, "n_s"], Float[Numbers, "n_f"]], ...]
    inner: Any


@dataclass(frozen=True)
class Kicked(Stepper):
    """Kicks before and after an inner step, ``p <- p - H w dV/dq`` with the weight w of the rule at that end of the
    interval.

    Corrections have the factor H^3 instead of H, see `TermOnNodes.times_step`.

    kicks: the terms with nodes at the ends of the interval; may be empty.
    inner: the stepper between the kicks.
    average: the filter of mollified kicks, ``average(macro_dt)(q_s, q_f) -> q_f``; None without mollified kicks.
    """

    kicks: tuple[TermOnNodes, ...]
    inner: Stepper
    average: Callable | None = None

    def init(self, state: State, macro_dt) -> KickedMemory:
        return KickedMemory(self._gradients(state, macro_dt), self.inner.init(state, macro_dt))

    def renew(self, state: State, memory: KickedMemory, macro_dt) -> KickedMemory:
        return memory._replace(inner=self.inner.renew(state, memory.inner, macro_dt))

    def advance(self, state: State, memory: KickedMemory, macro_dt) -> tuple[State, StepInfo, KickedMemory]:
        inner = self.inner.renew(state, memory.inner, macro_dt)
        state = kicked(state, self.kicks, memory.gradients, macro_dt, start=1.0)
        end, info, inner = self.inner.advance(state, inner, macro_dt)
        state = replace(end, t=state.t + macro_dt)  # whatever time a stepper of the user returns
        gradients = self._gradients(state, macro_dt)
        memory = KickedMemory(gradients, inner)
        state = kicked(state, self.kicks, gradients, macro_dt, end=1.0)
        return state, info, memory

    def advance_many(
        self, state: State, memory: KickedMemory, macro_dt, count: int
    ) -> tuple[State, StepInfo, KickedMemory]:
        """`count` steps with the matrices in `memory`; the two kicks at a node that two steps share are one."""

        def step(state, inner, start: float):
            state, info, inner = self.inner.advance(state, inner, macro_dt)
            gradients = self._gradients(state, macro_dt)
            state = kicked(state, self.kicks, gradients, macro_dt, start=start, end=1.0)
            return state, info, KickedMemory(gradients, inner)

        def between(carry, _):
            state, inner, worst = carry
            state, info, memory = step(state, inner, 1.0)
            return (state, memory.inner, worst.worse(info.status)), (info.q_f_micro, info.multiplier)

        inner = memory.inner
        state = kicked(state, self.kicks, memory.gradients, macro_dt, start=1.0)
        best = StepStatus(jnp.asarray(0), jnp.asarray(0), jnp.asarray(0), jnp.zeros(()))
        (state, inner, worst), (q_f, multiplier) = jax.lax.scan(between, (state, inner, best), length=count - 1)
        # The last step stands outside of the loop: a weight that depends on the number of the step, and a carry with
        # its gradients, would cost as much as half of a short step.
        state, last, memory = step(state, inner, 0.0)
        is_same = is_concrete(last.status)  # a stepper with a constant status, known while tracing, has it in all steps
        status = last.status if is_same else worst.worse(last.status)
        q_f, multiplier = _all_steps(q_f, last.q_f_micro), _all_steps(multiplier, last.multiplier)
        return state, StepInfo(*status, q_f, multiplier, last.slow_multiplier), memory

    def continued(self, memory: KickedMemory, last: KickedMemory, state: State, macro_dt) -> KickedMemory:
        gradients = last.gradients if self.average is None else self._gradients(state, macro_dt)
        return KickedMemory(gradients, self.inner.continued(memory.inner, last.inner, state, macro_dt))

    def _gradients(self, state: State, macro_dt):
        q_s, q_f = state.q_s, state.q_f

        def gradient(term: TermOnNodes):
            if self.average is None or not term.mollified:
                return term.gradient(q_s, q_f)
            # mollified: gradient of V(q_s, a(q_s, q_f)), dV/dq_s + (da/dq_s)^T dV/da and (da/dq_f)^T dV/da
            averaged, pull = jax.vjp(self.average(macro_dt), q_s, q_f)
            d_s, d_f = term.gradient(q_s, averaged)
            through_average_s, through_average_f = pull(d_f)
            return d_s + through_average_s, through_average_f

        return tuple(map(gradient, self.kicks))

    def describe(self) -> list[str]:
        if not self.kicks:
            return self.inner.describe()
        places: dict[str, list[str]] = {"both ends": [], "the start": [], "the end": []}
        for term in self.kicks:
            at_start, at_end = (w is not None and not (is_concrete(w) and w == 0) for w in (term.start, term.end))
            places["both ends" if at_start and at_end else "the start" if at_start else "the end"].append(term.name)
        averaged = ", at averaged fast positions" if self.average is not None else ""
        kicks = [f"kicks of {', '.join(names)} at {place}{averaged}" for place, names in places.items() if names]
        return [*kicks, *indented(self.inner.describe())]


@dataclass(frozen=True)
class Repeated(Stepper):
    """`count` shorter steps of a kicked stepper: the steps of the fast variables in a macro step, or the steps between
    two kicks of a potential with a longer interval."""

    inner: Kicked
    count: int

    def init(self, state: State, macro_dt) -> KickedMemory:
        return self.inner.init(state, macro_dt / self.count)

    def renew(self, state: State, memory: KickedMemory, macro_dt) -> KickedMemory:
        return self.inner.renew(state, memory, macro_dt / self.count)

    def advance(self, state: State, memory: KickedMemory, macro_dt) -> tuple[State, StepInfo, KickedMemory]:
        return self.inner.advance_many(state, memory, macro_dt / self.count, self.count)

    def continued(self, memory: KickedMemory, last: KickedMemory, state: State, macro_dt) -> KickedMemory:
        return self.inner.continued(memory, last, state, macro_dt / self.count)

    def describe(self) -> list[str]:
        are_micro = not isinstance(self.inner.inner, Repeated)  # no shorter steps inside
        steps = f"{self.count} {'micro ' * are_micro}step{'s' * (self.count > 1)}:"
        return [steps, *indented(self.inner.describe())]


def _all_steps(before, last):
    """Values along all steps: of the steps before, (count - 1, k, ...), then of the last, (k, ...)."""
    before = before.reshape(before.shape[0] * len(last), *last.shape[1:])
    return jnp.concatenate([before, last])


def kicked(
    state: State, kicks: tuple[TermOnNodes, ...], gradients, macro_dt, start: float = 0.0, end: float = 0.0
) -> State:
    """The state after kicks with these gradients: `start` times the weight at the start of an interval plus `end` times
    that at its end."""
    p_s, p_f = state.p_s, state.p_f
    for term, (d_s, d_f) in zip(kicks, gradients, strict=True):
        weights = [part * w for part, w in ((start, term.start), (end, term.end)) if part and w is not None]
        if weights:
            impulse = term.times_step(macro_dt) * sum(weights)
            p_s, p_f = p_s + impulse * d_s, p_f + impulse * d_f
    return State(state.t, state.q_s, state.q_f, p_s, p_f)


def average_over_fast_motion(stepper_of: Callable, num_micro: int) -> Callable:
    """The filter of a mollified slow potential, ``average(macro_dt)(q_s, q_f) -> a``.

    ``a = (x_0 / 2 + x_1 + ... + x_{n - 1} + x_n / 2) / n`` over the n + 1 micro nodes ``x_0 = q_f, ..., x_n``, n =
    num_micro, of the fast motion from rest at q_f with the slow variables at rest: the trapezoidal rule on the micro
    grid. A harmonic vibration whose discrete phase advances by k pi over the macro step, with a whole number k that is
    no multiple of 2 n, has the average zero, so that V cannot excite it.

    Args:
        stepper_of: ``(q_s, q_f) -> Kicked``, the stepper of one micro interval of the fast variables with the slow
            variables at rest.
        num_micro: micro steps per macro step.
    """

    @jax.jit  # a step needs it at its start and at its end: it is traced once
    def averaged(macro_dt, q_s, q_f):
        stepper, micro_dt, none = stepper_of(q_s, q_f), macro_dt / num_micro, jnp.zeros(0)
        start = State(jnp.zeros(()), none, q_f, none, jnp.zeros_like(q_f))
        memory = stepper.renew(start, stepper.init(start, micro_dt), micro_dt)
        _, info, _ = stepper.advance_many(start, memory, micro_dt, num_micro)
        x = info.q_f_micro
        a = (q_f / 2 + jnp.sum(x[:-1], axis=0) + x[-1] / 2) / num_micro
        return jnp.where(info.result <= Result.CONVERGED_AT_ROUNDOFF, a, jnp.nan)

    return lambda macro_dt: partial(averaged, macro_dt)
