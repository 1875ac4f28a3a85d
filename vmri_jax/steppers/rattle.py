"""RATTLE: a step with kinetic energy of constant masses and constraints alone.

The increments are explicit functions of the multipliers mu, which are the only unknowns:

    x = M^-1 (h p - G_0^T mu)        g(q + x) = 0        dmu = (G_1 M^-1 G_0^T)^-1 g(q + x)

G_0 is the Jacobian at the start of the step, G_1 at the predicted end. The prediction extrapolates the multipliers of the last two
steps, ``mu = s (2 lambda_n - lambda_(n-1))`` with the scale s of `multiplier_scales`. With kicks before and after the step this is
RATTLE (Andersen 1983).
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import max_abs
from vmri_jax.kernels.band import Full, Sparsity
from vmri_jax.schemes.equations import StepEquations, Unknowns, multiplier_scales
from vmri_jax.steppers.accept import Accepted
from vmri_jax.steppers.interval import constant_mass, weighted_sum
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import Solver, iterated

LEAST_SCALE = 0.1
"""Smallest scale s of a multiplier, in units of h^2, that is used for predictions. If a forward and a backward step of a composition nearly cancel,
their common multiplier is round-off, divided by a small s. A larger value loses predictions, a smaller one amplifies round-off."""


class RattleState(NamedTuple):
    """Memory that a step hands to the next one.

    multiplier: multipliers lambda of all constraints in the last two steps, the last step first.
    last_dt: length of the last step, 0 after a projection of the momenta. Without a projection, the scaled multipliers mu of the next step
        also contain the half of the constraint force that the last step left out at the common node. Predictions therefore convert lambda
        to mu by factors that depend on last_dt, see `multiplier_scales`.
    """

    multiplier: Float[Array, "2 n_g+n_gs"]
    last_dt: Float[Array, ""]


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
        scale = self._scale(equations, memory)
        mu = scale * (2 * memory.multiplier[0] - memory.multiplier[1])
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
        n_g, _ = system.num_constraints(equations.q_s, equations.q_f)
        x, mu = done.x[None], done.mu[None]
        unknowns = Unknowns(x[:, :n_s], mu[:, n_g:], x[None, :, n_s:], mu[None, :, :n_g])
        is_meaningful = jnp.abs(scale) > LEAST_SCALE * h**2
        multiplier = jnp.where(is_meaningful, done.mu / jnp.where(is_meaningful, scale, 1.0), memory.multiplier[0])
        multipliers = jnp.stack([multiplier, memory.multiplier[0]])
        return Solution(unknowns, end, status), RattleState(multipliers, jnp.asarray(h, dtype=float))

    def _scale(self, equations: StepEquations, memory: RattleState):
        """The factors mu / lambda (n_g + n_gs,)."""
        counts = equations.system.num_constraints(equations.q_s, equations.q_f)
        scales = multiplier_scales(equations.scheme, equations.macro_dt, memory.last_dt)
        return jnp.concatenate([jnp.broadcast_to(a.reshape(-1)[:1], n) for a, n in zip(scales, counts, strict=True)])

    def continued(self, memory: RattleState, last: RattleState) -> RattleState:
        return last

    def projected(self, memory: RattleState) -> RattleState:
        return memory._replace(last_dt=jnp.zeros_like(memory.last_dt))

    def describe(self) -> list[str]:
        return ["masses: drift along the constraints (RATTLE), Newton's iteration on the multipliers"]
