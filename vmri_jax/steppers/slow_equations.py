"""The slow equations of a macro step, linearised by a cheap matrix: masses, tied masses and the slow constraint.

In the first micro interval the constraints give the fast variables the velocity that the slow path asks for, and later ones let
them keep it. So a change dx of the slow increments changes the multipliers of the first interval by ``-S G dx``, with S its
small matrix and G the Jacobian by the slow variables, and those of the others hardly. That is the inertia of what is tied to
the slow variables; the rest of what the fast ones answer is small.

What this matrix leaves out is the derivative of the slow forces by the slow path, H^2 times their curvature beside the masses: it
costs passes where the macro step is long for the slow motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import BandInverse, FullInverse, inverse, matmul, solve
from vmri_jax.schemes.discrete_lagrangian import QuadraticKinetic, lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns, slow_basis_at_control_nodes
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.interval import constant_mass, solve_saddle


class ConstraintInertia(NamedTuple):
    """The masses K_s of the slow variables and those tied to them have the inverse ``(1 - U P) K_s^-1``.

    responses: U, slow increments by each multiplier of the first micro interval.
    multipliers: P, those multipliers by the slow increments that K_s alone would give.
    """

    responses: Float[Array, "r*n_g r n_s"]
    multipliers: Float[Array, "r*n_g r n_s"]


class SlowEquations(NamedTuple):
    """inverse_form, inverse_mass: K_s^-1 is one on the slots times the other on the coordinates."""

    equations: StepEquations
    kinetic: QuadraticKinetic
    inverse_form: Float[Array, "r r"]
    inverse_mass: Callable

    @classmethod
    def of(cls, equations: StepEquations) -> "SlowEquations":
        """With the inverse of the masses."""
        kinetic = lagrangian(equations.system, equations.scheme).kinetic
        inverse_form = equations.scheme.num_micro * inverse(kinetic.slow_form[:-1, 1:])
        return cls(equations, kinetic, inverse_form, constant_mass(equations.system).slow_mass.inverse().times)

    def constraint_inertia(self, schur: FullInverse | BandInverse) -> ConstraintInertia | None:
        """The masses tied by the constraints of the first micro interval, with its matrix S (r n_g, r n_g)."""
        equations, r, n_s = self.equations, self.equations.scheme.degree, self.equations.q_s.shape[0]
        jacobian = jax.jacrev(equations.system.g, argnums=1)(equations.t, equations.q_s, equations.q_f)
        if not jacobian.size:
            return None
        jacobian = jax.lax.optimization_barrier(jacobian)  # round-off is not to depend on how the constraint is written
        basis = slow_basis_at_control_nodes(equations.scheme.num_micro, r)[0]
        forces, values = (b[:, None, :, None] * jacobian[:, None, :] for b in (basis[:-1, :-1], basis[1:, 1:]))
        responses = jax.vmap(self._by_masses)(forces.reshape(-1, r, n_s))
        multipliers = jax.vmap(schur.times, 1, 1)(values.reshape(-1, r * n_s))
        both = np.eye(len(multipliers)) + matmul(multipliers, responses.reshape(-1, r * n_s).T)
        return ConstraintInertia(responses, solve(both, multipliers).reshape(responses.shape))

    def update(self, x: Unknowns, start, increments, inertia: ConstraintInertia | None):
        """Update of the slow unknowns, residuals of their equations, impulse on them over the step times h.

        Args:
            start, increments: gradient (n_s,), (r, n_s) of h times the action without the slow kinetic energy and the slow
                constraint.
        """
        equations, n, r = self.equations, self.equations.scheme.num_micro, self.equations.scheme.degree
        system, q_s = equations.system, equations.q_s
        times = equations.t + equations.macro_dt * control_nodes(r)
        g, push = jax.linearize(lambda inc: jax.vmap(system.g_slow)(times[1:], q_s + inc), x.slow)
        nodes = jnp.concatenate([q_s[None], q_s + x.slow[:-1]])
        jacobian = jax.vmap(jax.jacrev(system.g_slow, argnums=1))(times[:-1], nodes)
        pull = jnp.sum(x.slow_multiplier[..., None] / n * jacobian, axis=1)
        d = increments + self.kinetic.rows(x.slow, x.fast)[0] / n
        rows = jnp.concatenate([(start - d.sum(0) + equations.micro_dt * equations.p_s)[None], d[:-1]]) - pull
        dx, d_nu = solve_saddle(lambda rows: self._by_masses(rows, inertia), jacobian, push, rows, g)
        return jnp.concatenate([dx.reshape(-1), n * d_nu.reshape(-1)]), (rows, g), start - pull.sum(0)

    def _by_masses(self, rows, inertia: ConstraintInertia | None = None):
        """Slow increments (r, n_s) for given rows (r, n_s)."""
        dx = matmul(self.inverse_form, self.inverse_mass(rows))
        if inertia is None:
            return dx
        mu = jnp.sum(inertia.multipliers * dx, axis=(1, 2))
        return dx - jnp.sum(mu[:, None, None] * inertia.responses, axis=0)
