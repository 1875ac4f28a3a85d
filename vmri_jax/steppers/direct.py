"""Steps without iteration: free flight, and linear equations of fast variables alone on one interval."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.interval import Interval, Matrix, constant_mass
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus


@dataclass(frozen=True)
class FreeFlight(Stepper):
    """Straight motion at constant momentum, ``q+ = q + H M^-1 p``, for kinetic energy of constant masses alone."""

    system: System

    def advance(self, state: State, memory: tuple, macro_dt) -> tuple[State, StepInfo, tuple]:
        v_s, v_f = constant_mass(self.system).velocity(state.p_s, state.p_f)
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
    interval: Interval

    def init(self, state: State, macro_dt) -> Matrix:
        return self.interval.matrix(StepEquations.of(self.system, self.scheme, state, macro_dt))

    def advance(self, state: State, memory: Matrix, macro_dt) -> tuple[State, StepInfo, Matrix]:
        equations = StepEquations.of(self.system, self.scheme, state, macro_dt)
        h, zero = macro_dt, jnp.zeros((self.scheme.degree, state.q_f.size))

        def gradient(increments):
            path = equations.path_of(jnp.zeros((self.scheme.degree, 0)), increments[None])
            return jax.grad(equations.without_kinetic)(path, path)

        # r(0): h p_f + h D_{F_0} L and h D_{F_j} L, 0 < j < r
        d, change = jax.linearize(gradient, zero)
        rows = jnp.concatenate([d.fast_start - d.fast[0].sum(0) + h * state.p_f, d.fast[0, :-1]])
        increments = -memory.solve(rows)

        # h p_f + h D_{F_0} L + ... + h D_{F_r} L: the impulses of the potentials over the step
        p_f = state.p_f + (d.fast_start + change(increments).fast_start)[0] / h
        q_f = state.q_f + increments[-1]
        none = jnp.zeros((1, self.scheme.degree, 0)), jnp.zeros((self.scheme.degree, 0))
        info = StepInfo(*StepStatus.direct(Method.LINEAR), q_f[None], *none)
        return State(state.t + macro_dt, state.q_s, q_f, state.p_s, p_f), info, memory

    def describe(self) -> list[str]:
        return ["linear equations: one product with a matrix computed once"]
