"""The equations of one macro step: stationarity of the augmented discrete action in momentum form.

    A = L - sum_j H w_j lambda_j . g(q at node j) - sum_i H w_i nu_i . g_s(S_i)

with L the terms of L_d without kicks, and sums over all control nodes but the last: the constraint force at the last
node belongs to the next step, so that the momenta at the end are off the hidden constraints until they are projected.
The equations are

    p_s + D_{S_0} A = 0      D_{S_i} A = 0  (0 < i < r)           g_s(S_i) = 0  (i = 1..r)
    p_f + D_{F_0} A = 0      D_{F_j} A = 0  (all but the last)    g = 0 at every micro control node but the first

Forces add their virtual work ``H sum_i w_i F(t_i, q_i, v_i) . dq_i / dX`` to every D_X A (Lagrange-d'Alembert). Kicks
are not part of these equations: p_s and p_f are the momenta after the kicks at the start of the step
(`vmri_jax.steppers.kicked`).

The momentum equations are multiplied by the micro step h, and the multipliers absorb their weights: the unknowns are
``mu_j = h H w_j lambda_j`` and ``H^2 w_i nu_i``, so that for constant masses M_s, M_f the Newton matrix consists of
``k_ij M_f``, ``k_ij M_s / num_micro`` and the constraint Jacobian for every step size, up to ``h^2`` times the
curvature of potentials, with ``k_ij = sum_n w_n l_i'(c_n) l_j'(c_n)`` of the rule of T. The w_j are weights on the
macro interval: with n = num_micro, the weight of the constraint rule over n, summed over both intervals at nodes where
two intervals meet (`StepEquations.multiplier_scales`).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Number, Numbers, split_at
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.path import control_nodes, lagrange_basis
from vmri_jax.schemes.scheme import Scheme

LEAST_SUM = 0.2
"""Smallest length of a step and the step before together, relative to the step, with which multipliers at their common
node count. If a forward and a backward step of a composition nearly cancel, they are round-off. A larger value loses
predictions of multipliers, a smaller one amplifies round-off."""


class Unknowns(NamedTuple):
    """Unknowns of a macro step; the residual has the same fields and shapes.

    | field | unknown | residual |
    |---|---|---|
    | slow | increments of S_1..S_r | slow equations at S_0..S_{r-1} |
    | slow_multiplier | scaled, at S_0..S_{r-1} | g_s at S_1..S_r |
    | fast | increments in each micro interval | fast equations at its nodes 0..r-1 |
    | multiplier | scaled, at its nodes 0..r-1 | g at its nodes 1..r |
    """

    slow: Float[Numbers, "r n_s"]
    slow_multiplier: Float[Numbers, "r n_gs"]
    fast: Float[Numbers, "num_micro r n_f"]
    multiplier: Float[Numbers, "num_micro r n_g"]


class StepEquations(eqx.Module):
    """The data of the nonlinear equations of one macro step, from positions and momenta after the kicks at its start.

    `vmri_jax.schemes.intervals.Intervals` evaluates them.

    last_dt: length of the step before, whose momenta are off the hidden constraints; 0 for momenta on them.
    masses: mass matrix ``d2T/dv2`` (n, n) at the start of the step, of a kinetic energy that is a function; solvers
        need it.
    """

    system: System
    scheme: Scheme
    t: Number
    q_s: Float[Numbers, "n_s"]
    q_f: Float[Numbers, "n_f"]
    p_s: Float[Numbers, "n_s"]
    p_f: Float[Numbers, "n_f"]
    macro_dt: Number
    last_dt: Number = 0.0
    masses: Float[Numbers, "n n"] | None = None

    @classmethod
    def of(cls, system: System, scheme: Scheme, state: State, macro_dt, last_dt: Number = 0.0) -> "StepEquations":
        """The equations of a step from a state, without `masses`."""
        return cls(system, scheme, state.t, state.q_s, state.q_f, state.p_s, state.p_f, macro_dt, last_dt)

    @property
    def micro_dt(self):
        """Length h of a micro interval."""
        return self.macro_dt / self.scheme.num_micro

    def mass_diagonal(self):
        """Diagonals (n_s,) and (n_f,) of the constant masses, or of `masses`."""
        if self.system.has_constant_mass:
            return self.system.kinetic.diagonal
        assert self.masses is not None
        return split_at(jnp.diagonal(self.masses), self.q_s.size)

    def guess(self, v_s, v_f, multiplier, slow_multiplier) -> Unknowns:
        """Straight motion at these velocities, with these (physical) multipliers at all nodes."""
        n, c = self.scheme.num_micro, control_nodes(self.scheme.degree)[1:, None]
        scale, slow_scale = self.multiplier_scales()
        return Unknowns(
            slow=c * (self.macro_dt * v_s),
            slow_multiplier=slow_scale * slow_multiplier,
            fast=jnp.broadcast_to(c * (self.micro_dt * v_f), (n, len(c), v_f.shape[0])),
            multiplier=scale * multiplier,
        )

    def multiplier_scales(self):
        """The factors of the multipliers in the unknowns: ``mu / lambda`` (num_micro, r, 1) of g, and (r, 1) of g_s.

        With the weights w_0..w_r of the constraint rule on its unit interval, and H_last, the factors of g are

            h^2 (w_0 + (H_last / H) w_r)  at the start of the step
            h^2 (w_0 + w_r)               where micro intervals meet
            h^2 w_j                       inside

        and, with the weights of the slow constraint rule, the factors of g_s are ``H^2 (w_0 + (H_last / H) w_r)`` at
        S_0 and ``H^2 w_i`` at S_i: the constraint force that the step before has left out at the common node belongs to
        this step.
        """
        scheme, macro_dt = self.scheme, self.macro_dt
        w, w_slow = (jnp.asarray(placed.rule.weights) for placed in (scheme.constraint, scheme.slow_constraint))
        starts, first = np.eye(1, w.size - 1), np.eye(scheme.num_micro, 1)
        shared = w[:-1] + (1 + first * (self.last_dt / macro_dt - 1)) * starts * w[-1]
        slow_shared = w_slow[:-1] + self.last_dt / macro_dt * np.eye(1, w_slow.size - 1)[0] * w_slow[-1]
        return self.micro_dt**2 * shared[..., None], macro_dt**2 * slow_shared[:, None]

    def multipliers(self, x: Unknowns, multiplier, slow_multiplier):
        """The multipliers lambda (num_micro, r, n_g) and (r, n_gs) of the unknowns; those of the step before, where
        both steps cancel.

        Args:
            x: unknowns.
            multiplier, slow_multiplier: (n_g,) and (n_gs,) multipliers of the step before.
        """
        cancels = jnp.abs(self.macro_dt + self.last_dt) < LEAST_SUM * jnp.abs(self.macro_dt)
        scaled = x.multiplier, x.slow_multiplier
        return tuple(
            jnp.where(cancels, last, mu / jnp.where(cancels, 1.0, scale))
            for mu, scale, last in zip(scaled, self.multiplier_scales(), (multiplier, slow_multiplier), strict=True)
        )


def slow_basis_at_control_nodes(num_micro: int, degree: int) -> np.ndarray:
    """``l_i(theta_{m,j})`` of the slow path at every micro control node, shape (num_micro, r + 1, r + 1)."""
    theta = (np.arange(num_micro)[:, None] + control_nodes(degree)[None]) / num_micro
    return lagrange_basis(degree, theta)
