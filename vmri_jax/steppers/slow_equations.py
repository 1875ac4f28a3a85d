"""The slow equations of a macro step, linearised by a cheap matrix: masses, tied masses and the slow constraint.

A change dx of the slow increments changes the slow velocity, and constraints make the fast variables follow it. An
impulse of the multipliers of the first micro interval, ``dmu = -S G_1 dx``, gives the fast variables the changed
velocity; in the later intervals they keep it by inertia, and the multipliers hardly change. With the slow masses
``K_s = k_ij M_s / n``, the matrix of the slow equations is therefore

    K_s + G_0^T S G_1        (Woodbury)   (K_s + G_0^T S G_1)^-1 = (1 - U P) K_s^-1
    U = K_s^-1 G_0^T         P = (1 + S G_1 U)^-1 S G_1

S is the inverse of ``G K^-1 G^T`` of the first interval, in the fast variables (`vmri_jax.steppers.micro_intervals`).
With ``G_s = dg/dq_s`` at the start of the macro step, the nodes c_j of the first interval and the basis l_i of the slow
path,

    G_0 = l_i(c_j) G_s  for i, j = 0..r-1, where multipliers act
    G_1 = l_i(c_j) G_s  for i, j = 1..r, where constraints hold

For r = 1 and explicit fast equations (``K = -M_f``) the matrix is ``-(M_s + G_s^T (G_f M_f^-1 G_f^T)^-1 G_s) / n``: the
second term is the inertia of the fast masses that constraints tie to the slow variables.

Without constraints this matrix leaves out the derivative of the slow forces with respect to the slow path. Over a long
macro step that derivative is as large as the masses, and `SlowEquations.with_forces` solves for an update with it.
"""

from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import inverse, matmul, max_abs, solve
from vmri_jax.kernels.band import BandInverse, FullInverse
from vmri_jax.kernels.saddle import regularized
from vmri_jax.schemes.discrete_lagrangian import placed_potentials
from vmri_jax.schemes.equations import Unknowns, slow_basis_at_control_nodes
from vmri_jax.schemes.intervals import Arriving, Intervals
from vmri_jax.schemes.path import control_nodes, lagrange_basis, lagrange_derivative
from vmri_jax.schemes.quadrature import gauss

NODES = 4
"""Gauss nodes per macro step at which the slow forces are linearised. A larger number makes the solve dearer; with a
smaller one, steps in which slow forces change sign take more passes."""
ITERATIONS = 6
"""Most iterations of `minimal_residuals`. With a larger number a solve may cost as much as a pass."""
LEFT_OVER = 1e-5
"""Accepted residual of `minimal_residuals`, relative to the right-hand side.

With a larger value the update costs another pass.
"""


class ConstraintInertia(NamedTuple):
    """The factors U and P of the inverse ``(1 - U P) K_s^-1`` at the top of this module.

    responses: U, slow increments for each multiplier of the first micro interval.
    multipliers: P, multipliers of the first interval for the slow increments ``K_s^-1 rows``.
    """

    responses: Float[Array, "r*n_g r n_s"]
    multipliers: Float[Array, "r*n_g r n_s"]


class SlowEquations(NamedTuple):
    """The slow equations, with ``K_s^-1`` as the Kronecker product of a matrix for the nodes and an operator for the
    coordinates.

    inverse_form: ``n (k_ij)^-1``, i = 0..r-1, j = 1..r, with the form k of the kinetic energy.
    inverse_mass: ``v -> M_s^-1 v``.
    """

    intervals: Intervals
    inverse_form: Float[Array, "r r"]
    inverse_mass: Callable

    @classmethod
    def of(cls, intervals: Intervals) -> "SlowEquations":
        """The slow equations of a macro step."""
        equations, kinetic = intervals.equations, intervals.kinetic
        inverse_form = equations.scheme.num_micro * inverse(kinetic.slow_form[:-1, 1:])
        return cls(intervals, inverse_form, equations.system.kinetic.slow_mass.inverse().times)

    def constraint_inertia(self, schur: FullInverse | BandInverse) -> ConstraintInertia:
        """U and P from the matrix S (r n_g, r n_g) of the first micro interval, with constraints."""
        equations = self.intervals.equations
        r, n_s = equations.scheme.degree, equations.q_s.shape[0]
        jacobian = jax.jacrev(equations.system.g, argnums=1)(equations.t, equations.q_s, equations.q_f)
        # keeps round-off independent of the expression of the constraint
        jacobian = jax.lax.optimization_barrier(jacobian)
        basis = slow_basis_at_control_nodes(equations.scheme.num_micro, r)[0]
        forces, values = (b[:, None, :, None] * jacobian[:, None, :] for b in (basis[:-1, :-1], basis[1:, 1:]))
        responses = jax.vmap(self._by_masses)(forces.reshape(-1, r, n_s))
        multipliers = jax.vmap(schur.times, 1, 1)(values.reshape(-1, r * n_s))
        # both = 1 + S G_1 U
        both = np.eye(len(multipliers)) + matmul(multipliers, responses.reshape(-1, r * n_s).T)
        return ConstraintInertia(responses, solve(both, multipliers).reshape(responses.shape))

    def update(self, slow, multiplier, arriving: Arriving, inertia: ConstraintInertia):
        """Update of the slow unknowns, residual R of the slow momentum equations, times h, and slow momentum at the end
        of the step.

        A step at rest ends with its first pass: its multipliers are those of this update, whose impulse the momentum
        contains.

        With the masses K_s (and the tied ones), and the Jacobians G_0, G_1 of g_s at the macro control nodes 0..r-1 and
        1..r,

            K_s dx - G_0^T dnu = -R        G_1 dx = -g_s

        Args:
            slow, multiplier: slow unknowns.
            arriving: quantities that the last micro interval hands on.
            inertia: of the tied masses.
        """
        equations = self.intervals.equations
        n, r = equations.scheme.num_micro, equations.scheme.degree
        times = equations.t + equations.macro_dt * control_nodes(r)[:-1]
        g, push = jax.linearize(self.intervals.slow_constraints, slow)
        nodes = jnp.concatenate([equations.q_s[None], equations.q_s + slow[:-1]])
        jacobian = jax.vmap(jax.jacrev(equations.system.g_slow, argnums=1))(times, nodes)

        def impulses(multiplier):
            """``G_0^T nu``; nu is scaled by n = num_micro (`multiplier_scales`)."""
            return jnp.sum(multiplier[..., None] / n * jacobian, axis=1)

        rows, p_s = self.intervals.slow_rows(slow, impulses(multiplier), arriving)
        dx, d_nu = solve_saddle(lambda rows: self._by_masses(rows, inertia), jacobian, push, rows, g)
        p_s -= impulses(n * d_nu).sum(0) / equations.micro_dt
        return (dx.reshape(-1), n * d_nu), rows, p_s

    def with_forces(self, d, x: Unknowns):
        """The update ``(1 + K_s^-1 C)^-1 d`` for an update d by the masses alone, with the derivative C of the slow
        forces,

            (C dx)_i = h H sum_k w_k l_i(c_k) dF_s(sum_j l_j(c_k) dx_j, sum_j l_j'(c_k) dx_j / H)

        on a few Gauss nodes c_k. ``F_s = F - dV/dq_s`` has all potentials and forces with nodes inside the macro
        interval. The fast path is approximated: q_f at the start of the micro interval that contains c_k, and the mean
        velocity over that interval. C only decides on the number of passes.

        Args:
            d: (r n_s,) update by the masses alone.
            x: unknowns, which give the path.
        """
        equations, r, n = self.intervals.equations, len(x.slow), len(x.fast)
        system, H = equations.system, equations.macro_dt
        placed = (part for part in placed_potentials(system, equations.scheme) if "q_s" in part.term.arguments)
        potentials = [part.term for part in placed if not part.rule.only_kicks]
        rule = gauss(min(n, NODES))
        c, basis, slopes = np.array(rule.nodes), lagrange_basis(r, rule.nodes), lagrange_derivative(r, rule.nodes)
        weights = equations.micro_dt * H * (np.array(rule.weights)[:, None] * basis[:, :-1]).T

        m = (c * n).astype(int)  # micro interval of each node c_k
        moved = [jnp.sum(part, axis=0) for part in jnp.split(x.fast[:, -1], m)[:-1]]
        q_f, v_f = equations.q_f + jnp.stack(list(accumulate(moved))), x.fast[m, -1] / equations.micro_dt

        def sample(increments):
            return matmul(basis[:, 1:], increments), matmul(slopes[:, 1:], increments) / H

        def forces(q_s, v_s):
            total = jax.vmap(system.forces)(equations.t + c * H, q_s, q_f, v_s, v_f)[0]
            for term in potentials:
                gradient = jax.grad(lambda q_s, q_f, term=term: term.at((q_s, q_f), system.params))
                total -= jax.vmap(gradient)(q_s, q_f)
            return total

        q_s, v_s = sample(x.slow)
        path = equations.q_s + q_s, v_s

        def operator(dx):
            return dx + self._by_masses(matmul(weights, jax.jvp(forces, path, sample(dx))[1]))

        return minimal_residuals(operator, d.reshape(x.slow.shape)).reshape(-1)

    def _by_masses(self, rows, inertia: ConstraintInertia | None = None):
        """``K_s^-1 rows`` (r, n_s) for rows (r, n_s), or ``(1 - U P) K_s^-1 rows`` with tied masses."""
        dx = matmul(self.inverse_form, self.inverse_mass(rows))
        if inertia is None:
            return dx
        mu = jnp.sum(inertia.multipliers * dx, axis=(1, 2))
        return dx - jnp.sum(mu[:, None, None] * inertia.responses, axis=0)


def solve_saddle(solve_k, jacobian, push, rows, g):
    """(dx, dmu) with ``K dx - G_0^T dmu = -rows`` and ``G_1 dx = -g``, by the Schur complement ``G_1 K^-1 G_0^T``.

    Args:
        solve_k: K^-1, (r, n) rows to (r, n) increments.
        jacobian: (r, n_g, n) G_0, at the control nodes 0..r-1, where the multipliers act.
        push: G_1 as a function, changes (r, n) of the control points 1..r to changes (r, n_g) of the constraints.
        rows, g: (r, n) and (r, n_g).
    """
    r, n_g = g.shape
    if n_g == 0:
        return -solve_k(rows), g
    # Columns of G_0^T and -rows, then K^-1 and G_1 of them: one map for all, since each use of a function is compiled
    # anew. vmap stacks columns in rows, so that `schur` is the transposed complement.
    columns = np.eye(r)[:, None, :, None] * jacobian[:, :, None, :]  # (node, constraint, row, coordinate)
    columns = jnp.concatenate([columns.reshape(r * n_g, r, -1), -rows[None]])
    response = jax.vmap(solve_k)(columns)
    pushed = jax.vmap(push)(response).reshape(-1, r * n_g)
    response, dx, schur, g_of_dx = response[:-1], response[-1], regularized(pushed[:-1]), pushed[-1]
    dmu = -solve(schur.T, (g.reshape(-1) + g_of_dx)[:, None])
    return dx + jnp.sum(dmu[..., None] * response, axis=0), dmu.reshape(r, n_g)


def minimal_residuals(operator, b):
    """x with ``A x = b`` for an operator A that is one plus a smooth part, to `LEFT_OVER` of b or after `ITERATIONS`.

    Where the iteration stalls, the x that it has reached only makes the passes of the solver more numerous.

    Orthomin(1) (Vinsome 1976; Eisenstat, Elman, Schultz, SIAM J. Numer. Anal. 20, 1983), with residual r and direction
    p:

        p <- r - beta p,         beta  = (A r . A p) / (A p . A p)
        x <- x + alpha p,        alpha = (r . A p) / (A p . A p)
        r <- r - alpha A p
    """

    def goes_on(carry):
        i, _, r, *_ = carry
        return (i < ITERATIONS) & (max_abs(r) > LEFT_OVER * max_abs(b))

    def iterate(carry):
        i, x, r, p, A_p, squared = carry
        A_r = operator(r)
        beta = jnp.sum(A_r * A_p) / squared
        p, A_p = r - beta * p, A_r - beta * A_p
        squared = jnp.sum(A_p**2) + jnp.finfo(float).tiny
        alpha = jnp.sum(r * A_p) / squared
        return i + 1, x + alpha * p, r - alpha * A_p, p, A_p, squared

    zero = jnp.zeros_like(b)
    return jax.lax.while_loop(goes_on, iterate, (0, zero, b, zero, zero, 1.0))[1]
