"""A step that solves its equations by iteration: initial guess, solver, derivative of the solution."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from vmri_jax.kernels.band import Sparsity
from vmri_jax.mechanics.arrays import Number, Numbers
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.projection import is_quadratic, masses_of_function, project_momentum
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.accept import NO_WEIGHTS, Weights
from vmri_jax.steppers.implicit import differentiable
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus

ROOT = "root"
"""Name of the solution and the status of a step for `jax.checkpoint`: a policy that saves this name lets derivatives
reuse the solution."""


class Solution(NamedTuple):
    """Unknowns x of a macro step, (q_f, p_s, p_f) at its end, and the status of the solver."""

    x: Unknowns
    end: tuple[Float[Numbers, "n_f"], Float[Numbers, "n_s"], Float[Numbers, "n_f"]]
    status: StepStatus


@dataclass(frozen=True)
class StepSolver(ABC):
    """Solves the equations of a step.

    First ``memory = init(equations)``, then ``solution, memory = solve(equations, guess, memory)`` for every step.
    """

    @property
    def is_exact(self) -> bool:
        """Whether its matrices are exact, so that no other ones may solve what it does not solve."""
        return False

    def init(self, equations: StepEquations) -> Any:
        """The memory of the first step."""
        return ()

    def renew(self, equations: StepEquations, memory) -> Any:
        """`memory` with the matrices that are computed once for a whole macro step."""
        return memory

    @abstractmethod
    def solve(self, equations: StepEquations, guess: Unknowns, memory) -> tuple[Solution, Any]:
        """The root of ``Intervals(equations).residual`` (`vmri_jax.schemes.intervals`).

        Args:
            equations: of the step.
            guess: straight motion with the multipliers of the last step; a solver may predict its unknowns from
                `memory` instead.
            memory: from `init`, or of the step before.
        """

    def continued(self, memory, last) -> Any:
        """The memory of a stage of a composition, see `Stepper.continued`."""
        return memory

    @abstractmethod
    def describe(self) -> list[str]:
        """In words, one line each."""


class SolvedMemory(NamedTuple):
    """Memory from which the next iteration starts.

    multiplier, slow_multiplier: Lagrange multipliers of the step before, at its last control node with multipliers.
    last_dt: length of the step before, 0 before the first step.
    velocity: mean velocities (v_s, v_f) of the last intervals, ``(q_s(H) - q_s(0)) / H`` and
        ``(q_f(H) - q_f(H - h)) / h``; before the first step those of the first guess; () for constant masses.
    solver: memory of the solver.
    """

    multiplier: Float[Array, "n_g"]
    slow_multiplier: Float[Array, "n_gs"]
    last_dt: Number
    velocity: tuple
    solver: Any


@dataclass(frozen=True)
class Solved(Stepper):
    """A step whose unknowns a solver computes; differentiable in both modes, twice; third derivatives are NaN.

    Derivatives follow from the implicit function theorem, ``dx = -(dR/dx)^-1 (dR/de) de`` with the data e of the
    equations: iterations are never differentiated.

    sparsity: of ``G M^-1 G^T`` with all constraints.
    """

    system: System
    scheme: Scheme
    solver: StepSolver
    sparsity: Sparsity

    def init(self, state: State, macro_dt) -> SolvedMemory:
        n_g, n_gs = self.system.num_constraints(state.q_s, state.q_f)
        solver = self.solver.init(StepEquations.of(self.system, self.scheme, state, macro_dt))
        return SolvedMemory(jnp.zeros(n_g), jnp.zeros(n_gs), jnp.zeros(()), self._first_velocity(state), solver)

    def _first_velocity(self, state: State) -> tuple:
        """Velocities (v_s, v_f) of the first guess: none for constant masses. At rest where T is quadratic: the first
        correction by its masses leads to the velocities of the momenta."""
        if self.system.has_constant_mass:
            return ()
        if is_quadratic(self.system, state.q_s, state.q_f):
            return jnp.zeros_like(state.q_s), jnp.zeros_like(state.q_f)
        return jax.lax.stop_gradient(velocity(self.system, state.q_s, state.q_f, state.p_s, state.p_f))

    def renew(self, state: State, memory: SolvedMemory, macro_dt) -> SolvedMemory:
        return memory._replace(
            solver=self.solver.renew(StepEquations.of(self.system, self.scheme, state, macro_dt), memory.solver)
        )

    def advance(self, state: State, memory: SolvedMemory, macro_dt) -> tuple[State, StepInfo, SolvedMemory]:
        equations = StepEquations.of(self.system, self.scheme, state, macro_dt, memory.last_dt)
        # no derivative enters the iteration; `differentiable` attaches the derivative of the root
        solution, solver = self._solve(*jax.lax.stop_gradient((equations, memory)))
        root, status = checkpoint_name(((solution.x, solution.end), solution.status), ROOT)
        x, (q_f, p_s, p_f) = differentiable(equations, *root)

        lambdas = equations.multipliers(x, memory.multiplier, memory.slow_multiplier)
        q_f_micro = jnp.concatenate([equations.q_f + jnp.cumsum(x.fast[:-1, -1], axis=0), q_f[None]])
        info = StepInfo(*StepStatus(*status), q_f_micro, *lambdas)
        end = State(state.t + macro_dt, state.q_s + x.slow[-1], q_f, p_s, p_f)
        last_dt = jnp.asarray(macro_dt, dtype=float)
        velocity = jax.lax.stop_gradient((x.slow[-1] / macro_dt, x.fast[-1, -1] / equations.micro_dt))
        velocity = () if self.system.has_constant_mass else velocity
        memory = SolvedMemory(lambdas[0][-1, -1], lambdas[1][-1], last_dt, velocity, solver)
        return end, info, memory

    def _solve(self, equations: StepEquations, memory: SolvedMemory) -> tuple[Solution, Any]:
        """The solution, from straight motion: at the velocities of the projected momenta for constant masses; else,
        since near poles of angles a velocity ``M^-1 p`` says little about the next step, at the mean velocities of the
        last intervals."""
        system, q_s, q_f, masses = equations.system, equations.q_s, equations.q_f, None
        if system.has_constant_mass:
            state = State(equations.t, q_s, q_f, equations.p_s, equations.p_f)
            _, _, v_s, v_f, _ = project_momentum(system, state, sparsity=self.sparsity)
        else:
            v_s, v_f = memory.velocity
            masses, _ = masses_of_function(system, q_s, q_f, jnp.concatenate(memory.velocity))
        guess = equations.guess(v_s, v_f, memory.multiplier, memory.slow_multiplier)
        return self.solver.solve(replace(equations, masses=masses), guess, memory.solver)

    def continued(self, memory: SolvedMemory, last: SolvedMemory, state: State, macro_dt) -> SolvedMemory:
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
