"""Drift along the constraints: a step on which nothing is left but kinetic energy of constant masses and constraints.

The increments ``x = M^-1 (h p - G_0^T mu)`` follow from the multipliers, so that ``g(q + x) = 0`` is solved for these alone.
The matrix is ``G_1 M^-1 G_0^T`` at the position that the multipliers of the steps before lead to. With kicks before and
after this is RATTLE (Andersen 1983).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from vmri_jax.kernels.cpu import inverse, largest, matvec, regularized
from vmri_jax.schemes.equations import StepEquations, Unknowns, multiplier_scales
from vmri_jax.steppers.newton.interval import Accepted, constant_mass, inverse_mass

LEAST = 0.1
"""Where two steps of a composition undo each other but for so much, their common multiplier says nothing about the force."""


class Warm(NamedTuple):
    """What a step hands to the next one.

    multiplier: (2, n_g + n_gs) multipliers of the last steps, the last one first.
    before: length of the last step, 0 where the momenta have been projected since. Its half of the constraint force at the
        node between the two is left to the next one otherwise.
    """

    multiplier: Any
    before: Any

    @classmethod
    def none(cls, num_constraints: int) -> "Warm":
        """The start of a run."""
        return cls(jnp.zeros((2, num_constraints)), jnp.zeros(()))

    def after(self, last: "Warm") -> "Warm":
        """What a stage of a composition starts from: all of it belongs to the stage before."""
        return last

    def projected(self) -> "Warm":
        """With momenta on the hidden constraints."""
        return self._replace(before=jnp.zeros_like(self.before))


class Drift(NamedTuple):
    """State of the iteration: increments x (n_s + n_f,), scaled multipliers mu, constraint values g there, and its result.

    dx, dmu: the corrections that g asks for.
    """

    x: Any
    mu: Any
    g: Any
    dx: Any
    dmu: Any
    iterations: Any
    result: Any


def solve(equations: StepEquations, warm: Warm, newton):
    """Correct the multipliers until one more correction would change no increment.

    Accepted are changes relative to the motion of the slow and of the fast variables, and round-off of the positions (`Accepted`).

    Returns:
        (state of the iteration, unknowns, (q_f, p_s, p_f) at the end, warm)
    """
    system, h = equations.system, equations.macro_dt
    q, n_s = jnp.concatenate([equations.q_s, equations.q_f]), equations.q_s.size
    mass = constant_mass(system)
    velocity_s, velocity_f = inverse_mass(mass.slow), inverse_mass(mass.fast)

    def constraints(t, q):
        return system.constraints(t, q[:n_s], q[n_s:])

    jacobian = jax.jacrev(constraints, argnums=1)(equations.t, q)
    columns = jnp.concatenate([velocity_s(jacobian[:, :n_s]), velocity_f(jacobian[:, n_s:])], axis=1)
    straight = h * velocity_s(equations.p_s), h * velocity_f(equations.p_f)
    free = jnp.concatenate(straight)

    n_g, n_gs = system.num_constraints(equations.q_s, equations.q_f)
    scales = multiplier_scales(equations.scheme, h, warm.before)
    scale = jnp.concatenate([jnp.broadcast_to(a.reshape(-1)[:1], n) for a, n in zip(scales, (n_g, n_gs), strict=True)])
    mu = scale * (2 * warm.multiplier[0] - warm.multiplier[1])
    x = free - _combined(mu, columns)
    g, push = jax.linearize(lambda x: constraints(equations.t + h, q + x), x)
    schur = inverse(regularized(jax.vmap(push)(columns).T))
    per_slow, per_fast = (1 / size for size in Accepted.of(equations, newton).sizes(tuple(map(largest, straight))))

    def at(x, mu, g, iterations) -> Drift:
        dmu = matvec(schur, g)
        dx = _combined(dmu, columns)
        change = jnp.maximum(per_slow * largest(dx[:n_s]), per_fast * largest(dx[n_s:]))
        return Drift(x, mu, g, dx, dmu, jnp.asarray(iterations), newton.status(change, iterations))

    def corrected(last: Drift) -> Drift:
        x = last.x - last.dx
        return at(x, last.mu + last.dmu, constraints(equations.t + h, q + x), last.iterations + 1)

    first = corrected(at(x, mu, g, 0))  # nearly all steps take one: outside of the loop it is cheaper
    done = newton.iterate(corrected, first, done=1)
    impulse = _combined(done.mu, jacobian) / h
    x, mu = done.x, done.mu
    end = equations.q_f + x[n_s:], equations.p_s - impulse[:n_s], equations.p_f - impulse[n_s:]
    unknowns = Unknowns(x[None, :n_s], mu[None, n_g:], x[None, None, n_s:], mu[None, None, :n_g])
    tells = jnp.abs(scale) > LEAST * h**2
    multiplier = jnp.where(tells, mu / jnp.where(tells, scale, 1.0), warm.multiplier[0])
    return done, unknowns, end, Warm(jnp.stack([multiplier, warm.multiplier[0]]), jnp.asarray(h, dtype=float))


def _combined(mu, rows):
    """``sum_j mu_j rows_j``."""
    return jnp.sum(mu[:, None] * rows, axis=0)
