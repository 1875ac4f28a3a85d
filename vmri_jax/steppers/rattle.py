"""RATTLE: a step of fast variables with kinetic energy of constant masses and constraints alone.

The increments are explicit functions of the multipliers mu, which are the only unknowns:

    x = M^-1 (h p - G_0^T mu)        g(q + x) = 0        dmu = (G_1 M^-1 G_0^T)^-1 g(q + x)

G_0 is the Jacobian at the start of the step, G_1 at the predicted end. The prediction extrapolates the multipliers of
the last two steps, ``mu = s (2 lambda_n - lambda_(n-1))`` with the scale s of `StepEquations.multiplier_scales`. With
kicks before and after the step this is RATTLE (Andersen 1983).
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
from vmri_jax.steppers.results import RUNNING, Method
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import Solver, iterated

RattleMemory: TypeAlias = Float[Array, "2 n_g"]
"""Multipliers lambda in the last two steps, the last step first."""


class Correction(NamedTuple):
    """Increments x, scaled multipliers mu, constraint values ``g(q + x)``, and the next corrections -dx and dmu."""

    x: Float[Array, "n_f"]
    mu: Float[Array, "n_g"]
    g: Float[Array, "n_g"]
    dx: Float[Array, "n_f"]
    dmu: Float[Array, "n_g"]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Rattle(StepSolver):
    """Corrects the multipliers until the next correction would change no increment (`Accepted`).

    sparsity: of ``G M^-1 G^T``.
    """

    settings: Solver
    sparsity: Sparsity

    def init(self, equations: StepEquations) -> RattleMemory:
        return jnp.zeros((2, equations.system.num_constraints(equations.q_s, equations.q_f)[0]))

    def solve(self, equations: StepEquations, guess: Unknowns, memory: RattleMemory) -> tuple[Solution, RattleMemory]:
        system, h, q, settings = equations.system, equations.macro_dt, equations.q_f, self.settings
        move_by = system.kinetic.fast_mass.inverse().times  # M^-1

        def constraints(t, q):
            return system.g(t, equations.q_s, q)

        seeds = self.sparsity.seeds
        pull = jax.vjp(partial(constraints, equations.t), q)[1]
        forces = jax.vmap(lambda seed: pull(seed)[0])(seeds)
        columns = move_by(forces)
        # mu -> G_0^T mu and mu -> M^-1 G_0^T mu. A full pattern has all rows of G_0 at hand; else one product by
        # reverse mode is cheaper.
        if isinstance(self.sparsity, Full):
            force, move = partial(_weighted_sum, increments=forces), partial(_weighted_sum, increments=columns)
        else:
            force, move = (lambda mu: pull(mu)[0]), (lambda mu: move_by(pull(mu)[0]))
        scale = equations.multiplier_scales()[0].reshape(())
        mu = scale * (2 * memory[0] - memory[1])
        x = h * move_by(equations.p_f) - move(mu)  # M^-1 (h p - G_0^T mu)
        g, push = jax.linearize(lambda x: constraints(equations.t + h, q + x), x)
        schur = self.sparsity.inverse(jax.vmap(push)(columns))  # (G_1 M^-1 G_0^T)^-1
        accepted = Accepted.of(equations, settings)

        def judged(x, mu, g, iterations) -> Correction:
            dmu = schur.times(g)
            dx = move(dmu)
            ratio = accepted.ratio((0.0, max_abs(dx)), (0.0, max_abs(x)), iterations)
            return Correction(x, mu, g, dx, dmu, jnp.asarray(iterations), settings.status(ratio, iterations))

        def corrected(last: Correction) -> Correction:
            x = last.x - last.dx
            return judged(x, last.mu + last.dmu, constraints(equations.t + h, q + x), last.iterations + 1)

        start = judged(x, mu, g, 0)._replace(result=jnp.asarray(RUNNING))  # at least one correction, of multipliers too
        done = iterated(corrected, start)

        # p+ = p - G_0^T mu / h
        end = q + done.x, equations.p_s, equations.p_f - force(done.mu) / h
        rows = max_abs(force(done.dmu))
        status = status_of(equations, done.result, Method.MASSES, done.iterations, rows=rows, end=end)
        none = jnp.zeros((1, 0))
        unknowns = Unknowns(none, none, done.x[None, None], done.mu[None, None])
        last = equations.multipliers(unknowns, memory[0], jnp.zeros(0))[0].reshape(-1)
        return Solution(unknowns, end, status), jnp.stack([last, memory[0]])

    def continued(self, memory: RattleMemory, last: RattleMemory) -> RattleMemory:
        return last

    def describe(self) -> list[str]:
        return ["masses: drift along the constraints (RATTLE), Newton's iteration on the multipliers"]


def _weighted_sum(weights, increments):
    """``sum_i weights_i increments_i`` over the last axis of weights and the first of increments."""
    return jnp.sum(weights[..., None] * increments, axis=-2)
