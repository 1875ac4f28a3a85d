"""Free flight: straight motion at constant momentum, for kinetic energy of constant masses alone."""

from dataclasses import dataclass

import jax.numpy as jnp

from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.steppers.interval import constant_mass
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus


@dataclass(frozen=True)
class FreeFlight(Stepper):
    """``q+ = q + H M^-1 p``."""

    system: System

    def advance(self, state: State, memory: tuple, macro_dt) -> tuple[State, StepInfo, tuple]:
        v_s, v_f = constant_mass(self.system).velocity(state.p_s, state.p_f)
        q_s, q_f = state.q_s + macro_dt * v_s, state.q_f + macro_dt * v_f
        info = StepInfo(*StepStatus.direct(Method.EXPLICIT), q_f[None], jnp.zeros((1, 1, 0)), jnp.zeros((1, 0)))
        return State(state.t + macro_dt, q_s, q_f, state.p_s, state.p_f), info, memory

    def describe(self) -> list[str]:
        return ["free flight: q + H v, nothing to solve"]
