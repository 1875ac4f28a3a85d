"""Steps without iteration: free flight, and linear equations of fast variables alone on one interval."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.interval import IntervalStructure, Matrix
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus


@dataclass(frozen=True)
class FreeFlight(Stepper):
    """Straight motion at constant momentum, ``q+ = q + H M^-1 p``, for kinetic energy of constant masses alone."""

    system: System

    def advance(self, state: State, memory: tuple, macro_dt) -> tuple[State, StepInfo, tuple]:
        v_s, v_f = self.system.kinetic.velocity(state.p_s, state.p_f)
        q_s, q_f = state.q_s + macro_dt * v_s, state.q_f + macro_dt * v_f
        info = StepInfo(*StepStatus.direct(Method.EXPLICIT), q_f[None], jnp.zeros((1, 1, 0)), jnp.zeros((1, 0)))
        return State(state.t + macro_dt, q_s, q_f, state.p_s, state.p_f), info, memory

    def describe(self) -> list[str]:
        return ["free flight: q + H v, nothing to solve"]


@dataclass(frozen=True)
class Linear(Stepper):
    """The step ``x = -K^-1 r(0)``, with the residual r at zero increments; the memory is K, computed once per run."""

    system: System
    scheme: Scheme
    interval: IntervalStructure

    def init(self, state: State, macro_dt) -> Matrix:
        return self.interval.matrix(StepEquations.of(self.system, self.scheme, state, macro_dt))

    def advance(self, state: State, memory: Matrix, macro_dt) -> tuple[State, StepInfo, Matrix]:
        intervals = Intervals(StepEquations.of(self.system, self.scheme, state, macro_dt))
        start, none = intervals.start(), jnp.zeros((self.scheme.degree, 0))
        path = intervals.path(start, none, jnp.zeros((self.scheme.degree, state.q_f.size)))
        # r(0): h p_f + h D_{F_0} L and h D_{F_j} L, 0 < j < r
        d, change = jax.linearize(lambda fast: intervals.gradient(0, path._replace(fast=fast)), path.fast)
        increments = -memory.solve(intervals.rows(d, start.p_f))

        # h p_f + h D_{F_0} L + ... + h D_{F_r} L: the impulses of the potentials over the step
        p_f = state.p_f + (d.fast_start + change(increments).fast_start) / macro_dt
        q_f = state.q_f + increments[-1]
        info = StepInfo(*StepStatus.direct(Method.LINEAR), q_f[None], none[None], none)
        return State(state.t + macro_dt, state.q_s, q_f, state.p_s, p_f), info, memory

    def describe(self) -> list[str]:
        return ["linear equations: one product with a matrix computed once"]
