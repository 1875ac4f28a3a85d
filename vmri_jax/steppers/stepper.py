"""What every stepper offers, and what a macro step tells about itself."""

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
    """What a macro step did.

    result: status code, see `Result`.
    method: code of the stepper that ran, see `Method`; with "auto" ARROWHEAD says that the cheaper choices are not possible, or did not converge.
    iterations: Newton iterations or passes, the most that any of its solves took; 0 for explicit steps.
    residual: largest residual left, relative to the momentum, and of the constraints; 0 where equations are linear.
    q_f_micro: fast positions at the micro nodes, the start excluded.
    multiplier, slow_multiplier: Lagrange multipliers at the control nodes; of a composition with s stages those of all, s r
        slow ones.
    """

    result: Int[Numbers, ""]
    method: Int[Numbers, ""]
    iterations: Int[Numbers, ""]
    residual: Float[Numbers, ""]
    q_f_micro: Float[Numbers, "num_micro n_f"]
    multiplier: Float[Numbers, "num_micro r n_g"]
    slow_multiplier: Float[Numbers, "r n_gs"]

    @property
    def status(self) -> "Status":
        """Without the arrays along the step."""
        return Status(self.result, self.method, self.iterations, self.residual)


class Status(NamedTuple):
    """How a step ended: the first four fields of `StepInfo`."""

    result: Int[Numbers, ""]
    method: Int[Numbers, ""]
    iterations: Int[Numbers, ""]
    residual: Float[Numbers, ""]

    @classmethod
    def direct(cls, method: Method) -> "Status":
        """Of a step that solves nothing by iteration: known before it is taken."""
        return cls(np.asarray(int(Result.CONVERGED)), np.asarray(int(method)), np.asarray(0), np.zeros(()))

    def worse(self, other: "Status") -> "Status":
        """Field by field the larger one."""
        return Status(*(jnp.maximum(a, b) for a, b in zip(self, other, strict=True)))


@dataclass(frozen=True)
class Stepper(ABC):
    """Takes macro steps: ``memory = init(state, dt)``, then ``state, info, memory = step(state, memory, dt)`` again and again.

    Arguments of its methods are the `State` at the start of a step, `memory`, which is what a stepper carries from step to step, a
    NamedTuple that its file documents, and the length of the step.
    """

    def init(self, state: State, macro_dt) -> Any:
        """What the first step starts from besides the state."""
        return ()

    def renew(self, state: State, memory, macro_dt) -> Any:
        """`memory` with the matrices that all steps until the next `renew` share. Whoever kicks a stepper calls it before the first kick."""
        return memory

    @abstractmethod
    def advance(self, state: State, memory, macro_dt) -> tuple[State, StepInfo, Any]:
        """The step itself; its momenta are those of the discrete Legendre transform."""

    def step(self, state: State, memory, macro_dt) -> tuple[State, StepInfo, Any]:
        """A macro step: `advance`, and NON_FINITE where a momentum is, since positions follow momenta."""
        state, info, memory = self.advance(state, memory, macro_dt)
        finite = jnp.all(jnp.isfinite(state.p_s)) & jnp.all(jnp.isfinite(state.p_f))
        stands = finite | (info.result > Result.CONVERGED_AT_ROUNDOFF)  # a failure has been named already
        return state, replace(info, result=jnp.where(stands, info.result, Result.NON_FINITE)), memory

    def project(self, state: State, memory) -> tuple[State, Any]:
        """Momenta onto the hidden constraints, ``G v + dg/dt = 0``."""
        return state, memory

    def continued(self, memory, last, state: State, macro_dt) -> Any:
        """For a stage of a composition: what it learned in the macro step before, going on where the last stage ended."""
        return memory

    @abstractmethod
    def describe(self) -> list[str]:
        """This stepper and what is inside of it in words, one line each."""

    def __str__(self) -> str:
        return "\n".join(self.describe())


def indented(lines: list[str]) -> list[str]:
    """Lines of an inner stepper."""
    return ["  " + line for line in lines]
