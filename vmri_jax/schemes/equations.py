"""The equations of one macro step: stationarity of the augmented discrete action in momentum form.

    A = L - sum_j H w_j lambda_j . g(q at node j) - sum_i H w_i nu_i . g_s(S_i)

with L the terms of L_d without kicks, and sums over all control nodes but the last: the constraint force at the last node belongs to the
next step, so that the momenta at the end are off the hidden constraints until they are projected. The equations are

    p_s + D_{S_0} A = 0      D_{S_i} A = 0  (0 < i < r)           g_s(S_i) = 0  (i = 1..r)
    p_f + D_{F_0} A = 0      D_{F_j} A = 0  (all but the last)    g = 0 at every micro control node but the first

Forces add their virtual work ``H sum_i w_i F(t_i, q_i, v_i) . dq_i / dX`` to every D_X A (Lagrange-d'Alembert). Kicks are not part
of these equations: p_s and p_f are the momenta after the kicks at the start of the step (`vmri_jax.steppers.kicked`).

The momentum equations are multiplied by the micro step h, and the multipliers absorb their weights: the unknowns are
``mu_j = h H w_j lambda_j`` and ``H^2 w_i nu_i``, so that for constant masses M_s, M_f the Newton matrix consists of ``k_ij M_f``,
``k_ij M_s / num_micro`` and the constraint Jacobian for every step size, up to ``h^2`` times the curvature of potentials, with
``k_ij = sum_n w_n l_i'(c_n) l_j'(c_n)`` of the rule of T. The w_j are weights on the macro interval: with
n = num_micro, the weight of the constraint rule over n, summed over both intervals at nodes where two intervals meet
(`StepEquations.multiplier_scales`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Number, Numbers
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.path import Nodes, Path, control_nodes, lagrange_basis, velocity_nodes
from vmri_jax.schemes.scheme import Scheme

LEAST_SUM = 0.2
"""Smallest length of a step and the step before together, relative to the step, with which multipliers at their common node count. If a forward and a
backward step of a composition nearly cancel, they are round-off. A larger value loses predictions of multipliers, a smaller one amplifies round-off."""


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
    """The nonlinear equations of one macro step, from positions and momenta after the kicks at its start.

    Arguments of the methods: x, the `Unknowns`; `path`, which is varied; `held`, the same path as a constant, along which forces are
    evaluated.

    before: length of the step before, whose momenta are off the hidden constraints; 0 for momenta on them.
    masses: mass matrix ``d2T/dv2`` (n, n) at the start of the step, of a kinetic energy that is a function; solvers need it.
    """

    system: System
    scheme: Scheme
    t: Number
    q_s: Float[Numbers, "n_s"]
    q_f: Float[Numbers, "n_f"]
    p_s: Float[Numbers, "n_s"]
    p_f: Float[Numbers, "n_f"]
    macro_dt: Number
    before: Number = 0.0
    masses: Float[Numbers, "n n"] | None = None

    @classmethod
    def of(cls, system: System, scheme: Scheme, state: State, macro_dt, before: Number = 0.0) -> "StepEquations":
        """The equations of a step from a state, without `masses`."""
        return cls(system, scheme, state.t, state.q_s, state.q_f, state.p_s, state.p_f, macro_dt, before)

    @property
    def micro_dt(self):
        """Length h of a micro interval."""
        return self.macro_dt / self.scheme.num_micro

    @property
    def force_nodes(self) -> Nodes:
        """Where forces are evaluated."""
        return velocity_nodes(self.scheme.force, self.scheme.num_micro, self.scheme.degree)

    def mass_diagonal(self):
        """Diagonals (n_s,) and (n_f,) of the constant masses, or of `masses`."""
        if isinstance(self.system.kinetic, ConstantMass):
            return self.system.kinetic.diagonal
        assert self.masses is not None
        return tuple(jnp.split(jnp.diagonal(self.masses), [self.q_s.size]))

    def path(self, x: Unknowns) -> Path:
        """The path of the unknowns: fast starts are the running sums of the increments over whole intervals."""
        return Path(self.t, self.macro_dt, self.q_s, x.slow, self.q_f + sum_before(x.fast[:, -1]), x.fast)

    def action(self, path: Path, held: Path, x: Unknowns):
        """Augmented action times h, with the virtual work of forces along `held` on displacements of `path`."""
        energies = lagrangian(self.system, self.scheme).at_nodes_inside(path)
        return self.micro_dt * (energies + self.virtual_work(path, held)) - self.constraint_work(path, x)

    def virtual_work(self, path: Path, held: Path):
        """Lagrange-d'Alembert: ``H sum_i w_i F(t_i, q_i, v_i) . Q_i``, with q_i and v_i on the path `held`, which is not varied, and Q_i on `path`."""
        if self.system.force is None:
            return 0.0
        nodes = self.force_nodes
        f_s, f_f = jax.vmap(self.system.forces)(*nodes.sample(held, ("t", "q_s", "q_f", "v_s", "v_f")).values())
        q_s, q_f = nodes.sample(path, ("q_s", "q_f")).values()
        return self.macro_dt * jnp.sum(nodes.weights * (jnp.sum(f_s * q_s, axis=1) + jnp.sum(f_f * q_f, axis=1)))

    def constraint_work(self, path: Path, x: Unknowns):
        """``sum mu . g + sum nu . g_s / num_micro`` at all control nodes but the last."""
        q_s, q_f = path.control_points()
        g = jax.vmap(self.system.g)(path.control_times()[:-1], q_s[:-1], q_f[:-1])
        g_slow = jax.vmap(self.system.g_slow)(path.slow_control_times()[:-1], path.slow_control_points()[:-1])
        return jnp.sum(x.multiplier.reshape(g.shape) * g) + jnp.sum(x.slow_multiplier * g_slow) / self.scheme.num_micro

    def slots(self, x: Unknowns):
        """``h D_{S_i} A`` (r + 1, n_s) and, per micro interval, ``h D_{F_j} A`` (num_micro, r + 1, n_f)."""
        path = self.path(x)
        d = jax.grad(self.action)(path, path, x)
        # control point X_j = X_0 + Delta_j: D_{X_j} = d/dDelta_j, and D_{X_0} = d/dX_0 at fixed control points = d_start - sum_j d/dDelta_j
        slow = jnp.concatenate([(d.slow_start - d.slow.sum(0))[None], d.slow])
        fast = jnp.concatenate([(d.fast_start - d.fast.sum(1))[:, None], d.fast], axis=1)
        return slow, fast

    def evaluate(self, x: Unknowns):
        """Residual of the equations (times h in the momentum rows), and momenta ``D_last A`` at the end of the step."""
        slow, fast = self.slots(x)
        g, g_slow = self.constraints(x)
        # momentum that arrives at each micro interval, times h: p_f, then D_last of the interval before
        incoming = jnp.concatenate([self.micro_dt * self.p_f[None], fast[:-1, -1]])
        residual = Unknowns(
            slow=slow[:-1].at[0].add(self.micro_dt * self.p_s),
            slow_multiplier=g_slow,
            fast=fast[:, :-1].at[:, 0].add(incoming),
            multiplier=g.reshape(x.multiplier.shape),
        )
        return residual, (slow[-1] / self.micro_dt, fast[-1, -1] / self.micro_dt)

    def constraints(self, x: Unknowns):
        """Values of g (num_micro r, n_g) and of g_s (r, n_gs) at all control nodes but the first."""
        path = self.path(x)
        q_s, q_f = path.control_points()
        g = jax.vmap(self.system.g)(path.control_times()[1:], q_s[1:], q_f[1:])
        return g, jax.vmap(self.system.g_slow)(path.slow_control_times()[1:], path.slow_control_points()[1:])

    def residual(self, x: Unknowns) -> Unknowns:
        """Left-hand sides of the equations at x."""
        return self.evaluate(x)[0]

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

        With the weights w_0..w_r of the constraint rule on its unit interval, and H_before, the factors of g are

            h^2 (w_0 + (H_before / H) w_r)  at the start of the step    h^2 (w_0 + w_r)  where micro intervals meet    h^2 w_j  inside

        and, with the weights of the slow constraint rule, those of g_s are ``H^2 (w_0 + (H_before / H) w_r)`` at S_0 and ``H^2 w_i`` at S_i:
        the constraint force that the step before has left out at the common node belongs to this step.
        """
        scheme, macro_dt = self.scheme, self.macro_dt
        w, w_slow = (jnp.asarray(placed.rule.weights) for placed in (scheme.constraint, scheme.slow_constraint))
        starts, first = np.eye(1, w.size - 1), np.eye(scheme.num_micro, 1)
        shared = w[:-1] + (1 + first * (self.before / macro_dt - 1)) * starts * w[-1]
        slow_shared = w_slow[:-1] + self.before / macro_dt * np.eye(1, w_slow.size - 1)[0] * w_slow[-1]
        return self.micro_dt**2 * shared[..., None], macro_dt**2 * slow_shared[:, None]

    def multipliers(self, x: Unknowns, multiplier, slow_multiplier):
        """The multipliers lambda (num_micro, r, n_g) and (r, n_gs) of the unknowns; those of the step before, where both steps cancel.

        Args:
            x: unknowns.
            multiplier, slow_multiplier: (n_g,) and (n_gs,) multipliers of the step before.
        """
        cancels = jnp.abs(self.macro_dt + self.before) < LEAST_SUM * jnp.abs(self.macro_dt)
        scaled, last = (x.multiplier, x.slow_multiplier), (multiplier, slow_multiplier)
        return tuple(
            jnp.where(cancels, before, mu / jnp.where(cancels, 1.0, scale))
            for mu, scale, before in zip(scaled, self.multiplier_scales(), last, strict=True)
        )


def sum_before(increments):
    """Running sum of increments over the intervals before each one."""
    return jnp.concatenate([jnp.zeros_like(increments[:1]), jnp.cumsum(increments[:-1], axis=0)])


def slow_basis_at_control_nodes(num_micro: int, degree: int) -> np.ndarray:
    """``l_i(theta_{m,j})`` of the slow path at every micro control node, shape (num_micro, r + 1, r + 1)."""
    theta = (np.arange(num_micro)[:, None] + control_nodes(degree)[None]) / num_micro
    return lagrange_basis(degree, theta)
