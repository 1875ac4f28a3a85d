"""A composition: its stages one after the other, each over its part of the macro step, some of them backwards."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.state import State
from vmri_jax.steppers.stepper import StepInfo, Stepper, indented


class ComposedMemory(NamedTuple):
    """Memory of a composition.

    last: memory of the last stage.
    stages: memories of all stages, stacked.
    """

    last: Any
    stages: Any


@dataclass(frozen=True)
class Composed(Stepper):
    """``Psi_H = Phi_{c_s H} o ... o Phi_{c_1 H}``.

    coefficients: parts c_i of the macro step.
    stage: the stepper Phi.
    """

    coefficients: Float[Numbers, "s"]
    stage: Stepper

    def init(self, state: State, macro_dt) -> ComposedMemory:
        stages = jax.vmap(lambda c: self.stage.init(state, c * macro_dt))(jnp.asarray(self.coefficients))
        return ComposedMemory(jax.tree.map(lambda a: a[0], stages), stages)

    def advance(self, state: State, memory: ComposedMemory, macro_dt) -> tuple[State, StepInfo, ComposedMemory]:
        def stage(carry, coefficient_and_memory):
            (state, last), (c, memory) = carry, coefficient_and_memory
            memory = self.stage.continued(memory, last, state, c * macro_dt)
            end, info, memory = self.stage.step(state, memory, c * macro_dt)
            return (end, memory), (memory, info)

        stages = jnp.asarray(self.coefficients), memory.stages
        (state, last), (stage_memories, infos) = jax.lax.scan(stage, (state, memory.last), stages)
        worst = jax.tree.map(jnp.max, infos.status)
        along = map(jnp.concatenate, (infos.q_f_micro, infos.multiplier, infos.slow_multiplier))
        return state, StepInfo(*worst, *along), ComposedMemory(last, stage_memories)

    def describe(self) -> list[str]:
        return [f"composition of {len(self.coefficients)} stages, each:", *indented(self.stage.describe())]
