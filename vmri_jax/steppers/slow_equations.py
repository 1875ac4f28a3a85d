"""The slow equations of a macro step, linearised by a cheap matrix: masses, tied masses and the slow constraint.

In the first micro interval the constraints give the fast variables the velocity that the slow path asks for, and later ones let
them keep it. So a change dx of the slow increments changes the multipliers of the first interval by ``-S G_s dx``, with
``S = (G K^-1 G^T)^-1`` of that interval and G_s the Jacobian by the slow variables, and the multipliers of other intervals hardly.
That is the inertia of the fast masses that are tied to the slow variables; the rest of their answer is small.

Where nothing is constrained, what masses leave out is the derivative of the slow forces by the slow path: over a long macro
step it is as large as they are, and an update can be solved for with it (`SlowEquations.with_forces`).
"""

from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import BandInverse, FullInverse, inverse, matmul, max_abs, solve
from vmri_jax.schemes.discrete_lagrangian import QuadraticKinetic, lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns, slow_basis_at_control_nodes
from vmri_jax.schemes.path import control_nodes, lagrange_basis, lagrange_derivative
from vmri_jax.schemes.quadrature import gauss
from vmri_jax.steppers.interval import constant_mass, interval_problem, solve_saddle

NODES = 4
"""Gauss nodes of a macro step at which the slow forces are linearised. With more, a solve costs more; with fewer, steps in which slow forces
turn over take more passes."""
ITERATIONS = 6
"""Most iterations of `minimal_residuals`. With more, a solve costs as much as a pass."""
LEFT_OVER = 1e-5
"""Part of an update that `minimal_residuals` may leave. With more, the update costs another pass."""


class ConstraintInertia(NamedTuple):
    """The masses K_s of the slow variables and those tied to them have the inverse ``(1 - U P) K_s^-1``.

    responses: U, slow increments by each multiplier of the first micro interval.
    multipliers: P, those multipliers by the slow increments that K_s alone would give.
    """

    responses: Float[Array, "r*n_g r n_s"]
    multipliers: Float[Array, "r*n_g r n_s"]


class SlowEquations(NamedTuple):
    """inverse_form, inverse_mass: ``K_s^-1 = inverse_form x inverse_mass``, a matrix for the slots and an operator for the coordinates."""

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
        """Update of the slow unknowns, residual of their momentum equations, impulse on them over the step times h.

        With the residual R of the slow momentum equations, the masses K_s and the slow constraint with the Jacobians G_0 at the start of a slot
        and G_1 at its end,

            K_s dx - G_0^T dnu = -R        G_1 dx = -g_s

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
        return jnp.concatenate([dx.reshape(-1), n * d_nu.reshape(-1)]), rows, start - pull.sum(0)

    def with_forces(self, d, x: Unknowns):
        """The update ``(1 + K_s^-1 C)^-1 d`` for an update d by the masses alone, with the derivative C of the slow forces.

            ``(C dx)_i = h H sum_k w_k l_i(c_k) dF_s(sum_j l_j(c_k) dx_j, sum_j l_j'(c_k) dx_j / H)``

        on a few Gauss nodes c_k, ``F_s = F - dV/dq_s`` of all potentials and forces inside the macro interval, with the fast path as it is.

        Args:
            d: (r n_s,) update.
            x: the path.
        """
        equations, H, r, n = self.equations, self.equations.macro_dt, len(x.slow), len(x.fast)
        system, _ = interval_problem(equations.system, equations.scheme)
        rule = gauss(min(n, NODES))
        c, basis, slopes = np.array(rule.nodes), lagrange_basis(r, rule.nodes), lagrange_derivative(r, rule.nodes)
        weights = equations.micro_dt * H * (np.array(rule.weights)[:, None] * basis[:, :-1]).T

        m = (c * n).astype(int)  # the micro intervals that the nodes are in
        moved = [jnp.sum(part, axis=0) for part in jnp.split(x.fast[:, -1], m)[:-1]]
        q_f, v_f = equations.q_f + jnp.stack(list(accumulate(moved))), x.fast[m, -1] / equations.micro_dt

        def sample(increments):
            return matmul(basis[:, 1:], increments), matmul(slopes[:, 1:], increments) / H

        others = [f for name, f in equations.system.potentials if not equations.scheme.rule_of(name).only_kicks]

        def forces(q_s, v_s):
            total = jax.vmap(system.forces)(equations.t + c * H, q_s, q_f, v_s, v_f)[0]
            if system.slow_potential is not None:
                total -= jax.vmap(jax.grad(system.slow_potential), (0, 0, None))(q_s, q_f, system.params)
            for potential in others:
                total -= jax.vmap(jax.grad(potential), (0, 0, None))(q_s, q_f, system.params)
            return total

        q_s, v_s = sample(x.slow)
        path = equations.q_s + q_s, v_s

        def operator(dx):
            return dx + self._by_masses(matmul(weights, jax.jvp(forces, path, sample(dx))[1]))

        return minimal_residuals(operator, d.reshape(x.slow.shape)).reshape(-1)

    def _by_masses(self, rows, inertia: ConstraintInertia | None = None):
        """Slow increments (r, n_s) for given rows (r, n_s)."""
        dx = matmul(self.inverse_form, self.inverse_mass(rows))
        if inertia is None:
            return dx
        mu = jnp.sum(inertia.multipliers * dx, axis=(1, 2))
        return dx - jnp.sum(mu[:, None, None] * inertia.responses, axis=0)


def minimal_residuals(operator, b):
    """x with ``operator(x) = b`` to `LEFT_OVER` of b or after `ITERATIONS`, for an operator close to one.

    By Orthomin(1) (Vinsome 1976; Eisenstat, Elman, Schultz, SIAM J. Numer. Anal. 20, 1983): along the residual, with what
    it has in common with the move before taken out, to where the next residual is least.
    """

    def goes_on(at):
        i, _, rest, *_ = at
        return (i < ITERATIONS) & (max_abs(rest) > LEFT_OVER * max_abs(b))

    def move_on(at):
        i, x, rest, move, change, squared = at
        change_of_rest = operator(rest)
        part = jnp.sum(change_of_rest * change) / squared
        move, change = rest - part * move, change_of_rest - part * change
        squared = jnp.sum(change**2) + jnp.finfo(float).tiny
        part = jnp.sum(rest * change) / squared
        return i + 1, x + part * move, rest - part * change, move, change, squared

    none = jnp.zeros_like(b)
    return jax.lax.while_loop(goes_on, move_on, (0, none, b, none, none, 1.0))[1]
