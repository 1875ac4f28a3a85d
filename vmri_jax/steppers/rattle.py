"""RATTLE: a step with kinetic energy of constant masses and constraints alone.

The increments are explicit functions of the multipliers mu, which are the only unknowns:

    x = M^-1 (h p - G_0^T mu)        g(q + x) = 0        dmu = (G_1 M^-1 G_0^T)^-1 g(q + x)

G_0 is the Jacobian at the start of the step, G_1 at the predicted end. The prediction extrapolates the multipliers of the last two
steps, ``mu = s (2 lambda_n - lambda_(n-1))`` with the scale s of `StepEquations.multiplier_scales`. With kicks before and after the step this is
RATTLE (Andersen 1983).
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import max_abs
from vmri_jax.kernels.band import Full, Sparsity
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.accept import Accepted
from vmri_jax.steppers.interval import constant_mass, weighted_sum
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import Solver, iterated

RattleState: TypeAlias = Float[Array, "2 n_g+n_gs"]
"""Multipliers lambda of all constraints in the last two steps, the last step first."""


class Correction(NamedTuple):
    """Increments x of all variables, scaled multipliers mu, constraint values ``g(q + x)``, and the next corrections -dx and dmu."""

    x: Float[Array, "n_s+n_f"]
    mu: Float[Array, "n_g+n_gs"]
    g: Float[Array, "n_g+n_gs"]
    dx: Float[Array, "n_s+n_f"]
    dmu: Float[Array, "n_g+n_gs"]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Rattle(StepSolver):
    """Corrects the multipliers until the next correction would change no increment (`Accepted`).

    sparsity: of ``G M^-1 G^T`` with all constraints.
    """

    newton: Solver
    sparsity: Sparsity

    def init(self, equations: StepEquations) -> RattleState:
        return jnp.zeros((2, sum(equations.system.num_constraints(equations.q_s, equations.q_f))))

    def solve(self, equations: StepEquations, guess: Unknowns, memory: RattleState) -> tuple[Solution, RattleState]:
        system, h, newton = equations.system, equations.macro_dt, self.newton
        q, n_s = jnp.concatenate([equations.q_s, equations.q_f]), equations.q_s.size
        kinetic = constant_mass(system)
        velocity_s, velocity_f = kinetic.slow_mass.inverse().times, kinetic.fast_mass.inverse().times

        def constraints(t, q):
            return system.constraints(t, q[:n_s], q[n_s:])

        # M^-1 forces
        def moves(forces):
            return jnp.concatenate([velocity_s(forces[..., :n_s]), velocity_f(forces[..., n_s:])], axis=-1)

        seeds = self.sparsity.seeds
        pull = jax.vjp(partial(constraints, equations.t), q)[1]
        forces = jax.vmap(lambda seed: pull(seed)[0])(seeds)
        columns = moves(forces)
        # mu -> G_0^T mu and mu -> M^-1 G_0^T mu. A full pattern has all rows of G_0 at hand; else one product by reverse mode is cheaper.
        if isinstance(self.sparsity, Full):
            force, move = partial(weighted_sum, increments=forces), partial(weighted_sum, increments=columns)
        else:
            force, move = (lambda mu: pull(mu)[0]), (lambda mu: moves(pull(mu)[0]))
        straight = h * velocity_s(equations.p_s), h * velocity_f(equations.p_f)
        counts = n_g, _ = system.num_constraints(equations.q_s, equations.q_f)
        scales = equations.multiplier_scales()
        scale = jnp.concatenate([jnp.broadcast_to(a.reshape(-1), n) for a, n in zip(scales, counts, strict=True)])
        mu = scale * (2 * memory[0] - memory[1])
        x = jnp.concatenate(straight) - move(mu)  # M^-1 (h p - G_0^T mu)
        g, push = jax.linearize(lambda x: constraints(equations.t + h, q + x), x)
        schur = self.sparsity.inverse(jax.vmap(push)(columns))  # (G_1 M^-1 G_0^T)^-1
        accepted = Accepted.of(equations, newton)

        def judged(x, mu, g, iterations) -> Correction:
            dmu = schur.times(g)
            dx = move(dmu)
            changes, motions = ((max_abs(a[:n_s]), max_abs(a[n_s:])) for a in (dx, x))
            ratio = accepted.ratio(changes, motions, iterations)
            return Correction(x, mu, g, dx, dmu, jnp.asarray(iterations), newton.status(ratio, iterations))

        def corrected(last: Correction) -> Correction:
            x = last.x - last.dx
            return judged(x, last.mu + last.dmu, constraints(equations.t + h, q + x), last.iterations + 1)

        # nearly all steps need one correction: outside of the loop it is cheaper
        first = corrected(judged(x, mu, g, 0))
        done = iterated(corrected, first)

        impulse = force(done.mu) / h  # p+ = p - G_0^T mu / h
        end = equations.q_f + done.x[n_s:], equations.p_s - impulse[:n_s], equations.p_f - impulse[n_s:]
        status = status_of(
            equations,
            done.result,
            Method.MASSES,
            done.iterations,
            rows=max_abs(force(done.dmu)),
            end=end,
        )
        x, mu = done.x[None], done.mu[None]
        unknowns = Unknowns(x[:, :n_s], mu[:, n_g:], x[None, :, n_s:], mu[None, :, :n_g])
        multipliers = equations.multipliers(unknowns, memory[0, :n_g], memory[0, n_g:])
        last = jnp.concatenate([a.reshape(-1) for a in multipliers])
        return Solution(unknowns, end, status), jnp.stack([last, memory[0]])

    def continued(self, memory: RattleState, last: RattleState) -> RattleState:
        return last

    def describe(self) -> list[str]:
        return ["masses: drift along the constraints (RATTLE), Newton's iteration on the multipliers"]
