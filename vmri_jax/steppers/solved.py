"""A step that solves its equations by iteration: initial guess, solver, derivative of the solution."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from vmri_jax.kernels.band import Sparsity
from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.projection import project_momentum
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.equations import StepEquations, Unknowns, multiplier_scales
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.accept import NO_WEIGHTS, Weights
from vmri_jax.steppers.interval import constant_mass
from vmri_jax.steppers.newton.implicit import differentiable, differentiable_reverse_only
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus

ROOT = "root"
"""Name of the solution and the status of a step for `jax.checkpoint`: a policy that saves this name lets derivatives reuse the solution."""


class Solution(NamedTuple):
    """Unknowns x of a macro step, (q_f, p_s, p_f) at its end, and the status of the solver."""

    x: Unknowns
    end: tuple[Float[Numbers, "n_f"], Float[Numbers, "n_s"], Float[Numbers, "n_f"]]
    status: StepStatus


@dataclass(frozen=True)
class StepSolver(ABC):
    """Solves the equations of a step.

    First ``memory = init(equations, velocity)``, then ``solution, memory = solve(equations, guess, memory)`` for every step.
    """

    @property
    def is_exact(self) -> bool:
        """Whether its matrices are exact, so that no other ones may solve what it does not solve."""
        return False

    def init(self, equations: StepEquations, velocity) -> Any:
        """The memory of the first step.

        Args:
            equations: of the first step.
            velocity: (v_s, v_f) at the start of the run.
        """
        return ()

    def renew(self, equations: StepEquations, memory) -> Any:
        """`memory` with the matrices that are computed once for a whole macro step."""
        return memory

    @abstractmethod
    def solve(self, equations: StepEquations, guess: Unknowns, memory) -> tuple[Solution, Any]:
        """The root of ``equations.residual``.

        Args:
            equations: of the step.
            guess: straight motion with the multipliers of the last step; a solver may predict its unknowns from `memory` instead.
            memory: from `init`, or of the step before.
        """

    def continued(self, memory, last) -> Any:
        """The memory of a stage of a composition, see `Stepper.continued`."""
        return memory

    def projected(self, memory) -> Any:
        """The memory after a projection of the momenta."""
        return memory

    @abstractmethod
    def describe(self) -> list[str]:
        """In words, one line each."""


class SolvedState(NamedTuple):
    """Memory from which the next iteration starts.

    velocity: (v_s, v_f) of the guess. Used only if masses are not constant (else the guess takes ``M^-1 p``): the mean velocities
        ``(q_s(H) - q_s(0)) / H`` and ``(q_f(H) - q_f(H - h)) / h`` of the last step, or the velocities of the projected momenta.
    multiplier, slow_multiplier: Lagrange multipliers of the step before, at its last control node with multipliers.
    solver: memory of the solver.
    """

    velocity: tuple[Float[Numbers, "n_s"], Float[Numbers, "n_f"]]
    multiplier: Float[Array, "n_g"]
    slow_multiplier: Float[Array, "n_gs"]
    solver: Any


@dataclass(frozen=True)
class Solved(Stepper):
    """A step whose unknowns a solver computes; differentiable in both modes, twice; third derivatives are NaN.

    Derivatives follow from the implicit function theorem, ``dx = -(dR/dx)^-1 (dR/de) de`` with the data e of the equations: iterations are
    never differentiated.

    sparsity: of ``G M^-1 G^T`` with all constraints.
    reverse_only: allows one derivative in reverse mode only, in half the time.
    """

    system: System
    scheme: Scheme
    solver: StepSolver
    sparsity: Sparsity
    reverse_only: bool = False

    def init(self, state: State, macro_dt) -> SolvedState:
        if self.system.has_constant_mass:
            velocity = constant_mass(self.system).velocity(state.p_s, state.p_f)
        else:
            velocity = project_momentum(self.system, state)[2:]
        n_g, n_gs = self.system.num_constraints(state.q_s, state.q_f)
        solver = self.solver.init(StepEquations.of(self.system, self.scheme, state, macro_dt), velocity)
        return SolvedState(velocity, jnp.zeros(n_g), jnp.zeros(n_gs), solver)

    def renew(self, state: State, memory: SolvedState, macro_dt) -> SolvedState:
        return memory._replace(
            solver=self.solver.renew(StepEquations.of(self.system, self.scheme, state, macro_dt), memory.solver)
        )

    def advance(self, state: State, memory: SolvedState, macro_dt) -> tuple[State, StepInfo, SolvedState]:
        equations = StepEquations.of(self.system, self.scheme, state, macro_dt)
        v_s, v_f = memory.velocity
        if self.system.has_constant_mass:
            v_s, v_f = constant_mass(self.system).velocity(state.p_s, state.p_f)  # momenta after the kicks
        guess = equations.guess(v_s, v_f, memory.multiplier, memory.slow_multiplier)
        # no derivative enters the iteration; `derivative` attaches the one of the root
        solution, solver = self.solver.solve(*jax.lax.stop_gradient((equations, guess, memory.solver)))
        root, status = checkpoint_name(((solution.x, solution.end), solution.status), ROOT)
        derivative = differentiable_reverse_only if self.reverse_only else differentiable
        x, (q_f, p_s, p_f) = derivative(equations, *root)

        scale, slow_scale = multiplier_scales(self.scheme, macro_dt)
        lambdas = x.multiplier / scale, x.slow_multiplier / slow_scale
        q_f_micro = jnp.concatenate([equations.path(x).fast_start[1:], q_f[None]])
        info = StepInfo(*StepStatus(*status), q_f_micro, *lambdas)
        end = State(state.t + macro_dt, state.q_s + x.slow[-1], q_f, p_s, p_f)
        velocity = memory.velocity
        if not self.system.has_constant_mass:  # mean velocities of the last intervals: guess of the next step
            velocity = jax.lax.stop_gradient((x.slow[-1] / macro_dt, x.fast[-1, -1] / equations.micro_dt))
        return end, info, SolvedState(velocity, lambdas[0][-1, -1], lambdas[1][-1], solver)

    def project(self, state: State, memory: SolvedState) -> tuple[State, SolvedState]:
        p_s, p_f, v_s, v_f = project_momentum(self.system, state, memory.velocity, self.sparsity)
        memory = memory._replace(velocity=(v_s, v_f), solver=self.solver.projected(memory.solver))
        return State(state.t, state.q_s, state.q_f, p_s, p_f), memory

    def continued(self, memory: SolvedState, last: SolvedState, state: State, macro_dt) -> SolvedState:
        return last._replace(solver=self.solver.continued(memory.solver, last.solver))

    def describe(self) -> list[str]:
        return self.solver.describe()


def status_of(
    equations: StepEquations, result, method, iterations, *, rows, end, weights: Weights = NO_WEIGHTS
) -> StepStatus:
    """The status of a step, with the residual relative to the momenta.

    Args:
        equations: of the step.
        result, method, iterations: as in `StepInfo`.
        rows: largest residual of the momentum equations, times h, with the weights of momenta.
        end: (q_f, p_s, p_f) at the end of the step.
        weights: of the variables.
    """
    weights, (_, p_s, p_f) = weights.of_momenta(), end
    momenta = *weights.largest(equations.p_s, equations.p_f), *weights.largest(p_s, p_f)
    momentum = equations.micro_dt * jnp.max(jnp.stack(momenta))
    residual = jnp.where(momentum > 0, rows / jnp.where(momentum > 0, momentum, 1.0), 0.0)
    return StepStatus(result, jnp.asarray(int(method)), iterations, residual)
