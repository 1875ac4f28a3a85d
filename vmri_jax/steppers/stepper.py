"""The interface of all steppers, and the record of a macro step."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.state import State
from vmri_jax.steppers.results import Method, Result


class StepInfo(eqx.Module):
    """The record of a macro step.

    result: status code, see `Result`.
    method: see `Method`; with the matrix "auto" EXACT says that cheaper matrices are not possible, or did not converge.
    iterations: most Newton iterations or passes of a solve in the step; 0 for explicit steps.
    residual: ``max |R| / max |p|`` with the residual R of the momentum equations; 0 for linear equations. The matrices
        "masses" and "exact" estimate R after their last correction, a drift takes the next impulse of the constraints,
        "modes" evaluates it.
    q_f_micro: fast positions at the micro nodes, the start excluded.
    multiplier, slow_multiplier: Lagrange multipliers at the control nodes, with num_micro and the degree r of the
        scheme. A composition of s stages of this scheme joins the multipliers of its stages:
        ``(s num_micro, r, n_g)`` and ``(s r, n_gs)``.
    """

    result: Int[Numbers, ""]
    method: Int[Numbers, ""]
    iterations: Int[Numbers, ""]
    residual: Float[Numbers, ""]
    q_f_micro: Float[Numbers, "num_micro n_f"]
    multiplier: Float[Numbers, "num_micro r n_g"]
    slow_multiplier: Float[Numbers, "r n_gs"]

    @property
    def status(self) -> "StepStatus":
        """The fields without the arrays along the step."""
        return StepStatus(self.result, self.method, self.iterations, self.residual)


class StepStatus(NamedTuple):
    """How a step ended: the first four fields of `StepInfo`."""

    result: Int[Numbers, ""]
    method: Int[Numbers, ""]
    iterations: Int[Numbers, ""]
    residual: Float[Numbers, ""]

    @classmethod
    def direct(cls, method: Method) -> "StepStatus":
        """The status of a step without iteration, as constants that are known while JAX traces."""
        return cls(np.asarray(int(Result.CONVERGED)), np.asarray(int(method)), np.asarray(0), np.zeros(()))

    def worse(self, other: "StepStatus") -> "StepStatus":
        """The larger value of every field."""
        return StepStatus(*(jnp.maximum(a, b) for a, b in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Stepper(ABC):
    """Takes macro steps: ``memory = init(state, dt)``, then ``state, info, memory = step(state, memory, dt)`` again and
    again.

    The methods take the `State` at the start of a step, the `memory` that the stepper carries from step to step, and
    the length of the step. A memory is a pytree whose structure, shapes and types do not change: it is the carry of a
    loop. Only `advance` and `describe` must be written.
    """

    def init(self, state: State, macro_dt) -> Any:
        """The memory of the first step."""
        return ()

    def renew(self, state: State, memory, macro_dt) -> Any:
        """The memory with new matrices, which all steps until the next `renew` share.

        `Kicked` calls it before the first kick.
        """
        return memory

    @abstractmethod
    def advance(self, state: State, memory, macro_dt) -> tuple[State, StepInfo, Any]:
        """One step: (state at its end, with the momenta of the discrete Legendre transform; record; memory)."""

    def step(self, state: State, memory, macro_dt) -> tuple[State, StepInfo, Any]:
        """A macro step: `advance`, with the result NON_FINITE if a momentum at its end is not finite."""
        state, info, memory = self.advance(state, memory, macro_dt)
        finite = jnp.all(jnp.isfinite(state.p_s)) & jnp.all(jnp.isfinite(state.p_f))
        has_result = finite | (info.result > Result.CONVERGED_AT_ROUNDOFF)  # a solver that failed has said why
        return state, replace(info, result=jnp.where(has_result, info.result, Result.NON_FINITE)), memory

    def continued(self, memory, last, state: State, macro_dt) -> Any:
        """The memory of a stage of a composition; by default `init`, as if the stage were a first step.

        Args:
            memory: of the same stage in the macro step before.
            last: memory of the stage that has just ended, at the state where this stage starts.
            state: at the start of this stage.
            macro_dt: length of this stage.
        """
        return self.init(state, macro_dt)

    @abstractmethod
    def describe(self) -> list[str]:
        """This stepper and its inner steppers in words, one line each."""

    def __str__(self) -> str:
        return "\n".join(self.describe())


def indented(lines: list[str]) -> list[str]:
    """The lines of an inner stepper, indented."""
    return ["  " + line for line in lines]
