"""RATTLE: a step on which nothing is left but kinetic energy of constant masses and constraints.

The increments ``x = M^-1 (h p - G_0^T mu)`` follow from the multipliers, so that ``g(q + x) = 0`` is solved for these alone.
The matrix is ``G_1 M^-1 G_0^T`` at the position that the multipliers of the steps before lead to. With kicks before and
after this is RATTLE (Andersen 1983).
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import Full, Sparsity, max_abs
from vmri_jax.schemes.equations import StepEquations, Unknowns, multiplier_scales
from vmri_jax.steppers.accept import Accepted
from vmri_jax.steppers.interval import constant_mass, weighted_sum
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.solved import Solution, Solver, status_of
from vmri_jax.steppers.solvers import Newton

LEAST_SCALE = 0.1
"""If the forward and the backward step of a composition cancel to less than this part of h^2, their common multiplier is round-off: it is
skipped as a prediction. With more, predictions are lost; with less, round-off is multiplied."""


class RattleState(NamedTuple):
    """What a step hands to the next one.

    multiplier: of all constraints in the last two steps, the last one first.
    before: length of the last step, 0 where the momenta have been projected since. Otherwise its half of the constraint force at
        the node between the two steps is left to the next one.
    """

    multiplier: Float[Array, "2 n_g+n_gs"]
    before: Float[Array, ""]


class Correction(NamedTuple):
    """Increments x of all variables, scaled multipliers mu, constraint values g there, and the corrections that g asks for."""

    x: Float[Array, "n_s+n_f"]
    mu: Float[Array, "n_g+n_gs"]
    g: Float[Array, "n_g+n_gs"]
    dx: Float[Array, "n_s+n_f"]
    dmu: Float[Array, "n_g+n_gs"]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Rattle(Solver):
    """Corrects the multipliers until one more correction would change no increment.

    Accepted are changes relative to the motion of the slow and of the fast variables, and round-off of the positions (`Accepted`).

    sparsity: of ``G M^-1 G^T`` with all constraints.
    """

    newton: Newton
    sparsity: Sparsity

    def init(self, equations: StepEquations, velocity) -> RattleState:
        count = sum(equations.system.num_constraints(equations.q_s, equations.q_f))
        return RattleState(jnp.zeros((2, count)), jnp.zeros(()))

    def solve(self, equations: StepEquations, guess: Unknowns, memory: RattleState) -> tuple[Solution, RattleState]:
        system, h, newton = equations.system, equations.macro_dt, self.newton
        q, n_s = jnp.concatenate([equations.q_s, equations.q_f]), equations.q_s.size
        kinetic = constant_mass(system)
        velocity_s, velocity_f = kinetic.slow_mass.inverse().times, kinetic.fast_mass.inverse().times

        def constraints(t, q):
            return system.constraints(t, q[:n_s], q[n_s:])

        def moves(forces):
            return jnp.concatenate([velocity_s(forces[..., :n_s]), velocity_f(forces[..., n_s:])], axis=-1)

        seeds = self.sparsity.seeds
        pull = jax.vjp(partial(constraints, equations.t), q)[1]
        forces = jax.vmap(lambda seed: pull(seed)[0])(seeds)
        columns = moves(forces)
        if isinstance(self.sparsity, Full):  # few rows: these are all of them
            force, move = partial(weighted_sum, increments=forces), partial(weighted_sum, increments=columns)
        else:
            force, move = (lambda mu: pull(mu)[0]), (lambda mu: moves(pull(mu)[0]))
        straight = h * velocity_s(equations.p_s), h * velocity_f(equations.p_f)
        scale = self._scale(equations, memory)
        mu = scale * (2 * memory.multiplier[0] - memory.multiplier[1])
        x = jnp.concatenate(straight) - move(mu)
        g, push = jax.linearize(lambda x: constraints(equations.t + h, q + x), x)
        schur = self.sparsity.inverse(jax.vmap(push)(columns))
        accepted, motions = Accepted.of(equations, newton), tuple(map(max_abs, straight))

        def at(x, mu, g, iterations) -> Correction:
            dmu = schur.times(g)
            dx = move(dmu)
            change = accepted.over((max_abs(dx[:n_s]), max_abs(dx[n_s:])), motions, iterations)
            return Correction(x, mu, g, dx, dmu, jnp.asarray(iterations), newton.status(change, iterations))

        def corrected(last: Correction) -> Correction:
            x = last.x - last.dx
            return at(x, last.mu + last.dmu, constraints(equations.t + h, q + x), last.iterations + 1)

        first = corrected(at(x, mu, g, 0))  # nearly all steps take one: outside of the loop it is cheaper
        done = newton.iterate(corrected, first, done=1)

        impulse = force(done.mu) / h
        end = equations.q_f + done.x[n_s:], equations.p_s - impulse[:n_s], equations.p_f - impulse[n_s:]
        status = status_of(
            equations, done.result, Method.RATTLE, done.iterations, 0.0, max_abs(done.g), newton.tolerance
        )
        n_g, _ = system.num_constraints(equations.q_s, equations.q_f)
        x, mu = done.x[None], done.mu[None]
        unknowns = Unknowns(x[:, :n_s], mu[:, n_g:], x[None, :, n_s:], mu[None, :, :n_g])
        tells = jnp.abs(scale) > LEAST_SCALE * h**2
        multiplier = jnp.where(tells, done.mu / jnp.where(tells, scale, 1.0), memory.multiplier[0])
        multipliers = jnp.stack([multiplier, memory.multiplier[0]])
        return Solution(unknowns, end, status), RattleState(multipliers, jnp.asarray(h, dtype=float))

    def _scale(self, equations: StepEquations, memory: RattleState):
        """What turns multipliers (n_g + n_gs,) into unknowns."""
        counts = equations.system.num_constraints(equations.q_s, equations.q_f)
        scales = multiplier_scales(equations.scheme, equations.macro_dt, memory.before)
        return jnp.concatenate([jnp.broadcast_to(a.reshape(-1)[:1], n) for a, n in zip(scales, counts, strict=True)])

    def continued(self, memory: RattleState, last: RattleState) -> RattleState:
        return last

    def projected(self, memory: RattleState) -> RattleState:
        return memory._replace(before=jnp.zeros_like(memory.before))

    def describe(self) -> list[str]:
        return ["drift along the constraints (RATTLE): Newton's iteration on the multipliers"]
