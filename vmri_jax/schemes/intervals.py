"""The equations of a macro step, cut into its micro intervals.

Interval m starts with the fast position F_0 and the momentum p at the end of the interval before. Its part of the
augmented action is

    A_m(S, F) = sum over terms, over their nodes i in this interval:  H w_i term(q(theta_i), qdot(theta_i))
                - sum_j mu_j . g(q at its control node j) / h        (0 <= j < r)

with S_0..S_r the slow control points of the macro step, F_0..F_r the fast ones of this interval. A node where two
intervals meet belongs to the later one. The equations, all times h, are

    p + D_{F_0} A_m = 0      D_{F_j} A_m = 0  (0 < j < r)      g = 0 at its control nodes 1..r

for the fast increments and the scaled multipliers mu. It hands on ``F_r`` and ``D_{F_r} A_m``, and pushes the slow
control points by ``D_{S_i} A_m``. The sum of these impulses over the intervals enters the slow equations:

    p_s + D_{S_0} A = 0      D_{S_i} A = 0  (0 < i < r)        g_s = 0 at S_1..S_r

Terms of slow variables alone, such as `System.slow_kinetic`, belong to no interval: they enter the slow equations once.

These are the equations of `vmri_jax.schemes.equations`, in the order in which a march over the intervals meets them.
All solvers and all derivatives of steps have them from here; `vmri_jax.textbook` has those of the whole step, to
compare with.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.kernels import matmul, matvec
from vmri_jax.mechanics.rows import Entries
from vmri_jax.mechanics.structure import entries_seen
from vmri_jax.schemes.discrete_lagrangian import TermOnNodes, lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns, slow_basis_at_control_nodes
from vmri_jax.schemes.interval_nodes import IntervalNodes, IntervalPath, of_interval, with_unseen
from vmri_jax.schemes.path import control_nodes, lagrange_basis, lagrange_derivative, velocity_nodes


class Arriving(NamedTuple):
    """The quantities that the intervals before hand on.

    q_f, p_f: fast position, and fast momentum times h, whose product with ``M_f^-1`` is a displacement.
    start, slow: gradients of their actions (times h) by the start and by the increments of the slow path.
    """

    q_f: Float[Array, "n_f"]
    p_f: Float[Array, "n_f"]
    start: Float[Array, "n_v"]
    slow: Float[Array, "r n_v"]


class IntervalUnknowns(NamedTuple):
    """Unknowns of a micro interval, and with the same shapes its residual: fast equations at nodes 0..r-1, g at nodes
    1..r."""

    fast: Float[Array, "r n_f"]
    multiplier: Float[Array, "r n_g"]


class Intervals:
    """The equations of the micro intervals of a macro step, and the slow ones.

    The terms on the micro grid may depend on only some of the slow variables. In a satellite with vibrating panels they
    depend on the position of the hub that carries the panels, and not on the angles of its wheels. The intervals then
    take and hand on quantities of these "seen" slow variables only, so that their cost does not grow with the number of
    the others.

    Attributes:
        seen: the slow variables on which terms on the micro grid depend; all of them with forces, which may act on any
            variable.
    """

    def __init__(self, equations: StepEquations):
        self.equations = equations
        of_step = lagrangian(equations.system, equations.scheme)
        self.kinetic, inner = of_step.kinetic, [term for term in of_step.terms if len(term.inside.c)]
        sees_fast = {"q_f", "v_f"}.intersection
        self._slow_terms = [term for term in inner if not sees_fast(term.arguments)]
        of_fast = (term for term in inner if sees_fast(term.arguments))
        self.terms = [(term, nodes) for term in of_fast for nodes in IntervalNodes.of(term.inside)]
        n, r, has_force = equations.scheme.num_micro, equations.scheme.degree, equations.system.force is not None
        self._force_nodes = IntervalNodes.of(velocity_nodes(equations.scheme.force, n, r)) if has_force else []
        self.seen = self._seen()
        self._slow_basis = slow_basis_at_control_nodes(n, r)[..., 1:]  # at the control nodes, by slow increments

    def by_masses(self) -> "Intervals":
        """The equations with ``v^T M v / 2`` in place of kinetic energies T that are functions, with the masses M at
        the start of the step: their derivatives contain none of T.

        The intervals have the masses of the variables that they see, and the slow equations all others.
        """
        masses, n_s = self.equations.masses, self.equations.q_s.size
        assert masses is not None
        is_seen = jnp.array(self.seen.marked, dtype=bool)
        of_slow = jnp.where(is_seen[:, None] & is_seen, 0.0, masses[:n_s, :n_s])

        def with_masses(term: TermOnNodes) -> TermOnNodes:
            if "v_s" not in term.arguments:
                return term
            number, form = (2, _quadratic_form(masses)) if "v_f" in term.arguments else (1, _quadratic_form(of_slow))
            return replace(term, integrand=lambda *arguments: form(jnp.concatenate(arguments[-number:])))

        by_masses = copy(self)
        by_masses.terms = [(with_masses(term), nodes) for term, nodes in self.terms]
        by_masses._slow_terms = [with_masses(term) for term in self._slow_terms]
        return by_masses

    def _seen(self) -> Entries:
        """The slow variables whose positions or velocities the functions on the micro grid can depend on."""
        equations, system = self.equations, self.equations.system
        n_s = equations.q_s.size

        def values(slow):
            """Values of all these functions, for slow positions and velocities in one vector (2 n_s,)."""
            values_of = {"q_s": slow[:n_s], "v_s": slow[n_s:], "q_f": equations.q_f, "v_f": equations.q_f}
            integrands = [term.integrand(*(values_of[name] for name in term.arguments)) for term, _ in self.terms]
            return integrands, system.g(equations.t, values_of["q_s"], values_of["q_f"])

        if self._force_nodes:
            return Entries((True,) * n_s)
        marked = entries_seen(values, jnp.concatenate([equations.q_s, equations.q_s]))
        return Entries(tuple((marked[:n_s] | marked[n_s:]).tolist()))

    def start(self) -> Arriving:
        """The quantities that arrive at the first interval."""
        equations = self.equations
        zero = jnp.zeros(self.seen.count), jnp.zeros((equations.scheme.degree, self.seen.count))
        return Arriving(equations.q_f, equations.micro_dt * equations.p_f, *zero)

    def path(self, arriving: Arriving, slow, fast) -> IntervalPath:
        """The path of fast increments (r, n_f), and of the slow increments (r, n_v) that are seen."""
        return IntervalPath(self.seen.take(self.equations.q_s), slow, arriving.q_f, fast)

    def gradient(self, m, path: IntervalPath) -> IntervalPath:
        """The gradient of ``h A_m`` by the path, without constraints and without the kinetic energy of constant
        masses."""
        return jax.grad(self._action)(path, path, m)

    def constraint_impulses(self, m, path: IntervalPath) -> Callable[..., IntervalPath]:
        """The map from multipliers mu (r, n_g) to the gradient of ``sum_j mu_j . g`` by the path, ``G_0^T mu``."""
        pull = jax.vjp(partial(self.constraints, m=m, nodes=slice(0, -1)), path)[1]
        return lambda mu: pull(mu)[0]

    def rows(self, d: IntervalPath, p_f: Any = 0.0):
        """The momentum equations ``p + D_{F_0}``, then ``D_{F_j}``, 0 < j < r, (r, n_f) of a function with the gradient
        d."""
        return jnp.concatenate([(p_f + d.fast_start - d.fast.sum(0))[None], d.fast[:-1]])

    def with_inertia(self, d: IntervalPath, fast) -> IntervalPath:
        """The gradient d with that of the kinetic energy of constant masses, for fast increments (r, n_f)."""
        return d if self.kinetic is None else d._replace(fast=d.fast + self.kinetic.fast_rows(fast))

    def handed_on(self, arriving: Arriving, d: IntervalPath, last) -> Arriving:
        """The quantities that an interval hands on, from the gradient d of ``h A_m`` without the inertia of constant
        masses.

        The momentum is ``h p + h D_{F_0} A_m + ... + h D_{F_r} A_m``, the start momentum plus all impulses. At a root
        that is h D_{F_r} A_m; but an error e of the increments, below the round-off of the positions, would change that
        by M e, and does not change the impulses of the inertia.

        Args:
            last: (n_f,) fast increment from the start of the interval to its end.
        """
        return Arriving(
            arriving.q_f + last, arriving.p_f + d.fast_start, arriving.start + d.slow_start, arriving.slow + d.slow
        )

    def evaluate(self, m, x: IntervalUnknowns, arriving: Arriving, slow) -> tuple[IntervalUnknowns, Arriving]:
        """Residual of interval m, and the quantities that it hands on.

        Args:
            arriving: from the intervals before.
            slow: (r, n_v) increments of the slow path that are seen.
        """
        path = self.path(arriving, slow, x.fast)
        d = jax.tree.map(jnp.subtract, self.gradient(m, path), self.constraint_impulses(m, path)(x.multiplier))
        rows = self.rows(self.with_inertia(d, x.fast), arriving.p_f)
        residual = IntervalUnknowns(rows, self.constraints(path, m, slice(1, None)))
        return residual, self.handed_on(arriving, d, x.fast[-1])

    def residual(self, x: Unknowns) -> tuple[Unknowns, tuple[Any, Any, Any]]:
        """Residual of all equations of the step, and fast position, slow and fast momentum at its end, from the momenta
        at its start and all impulses."""

        def interval(arriving, of_interval):
            m, *unknowns = of_interval
            residual, on = self.evaluate(m, IntervalUnknowns(*unknowns), arriving, self.seen.take(x.slow))
            return on, residual

        intervals = jnp.arange(len(x.fast)), x.fast, x.multiplier
        end, (fast, g) = jax.lax.scan(interval, self.start(), intervals)
        slow, p_s = self.slow_rows(x.slow, self.slow_impulses(x.slow, x.slow_multiplier), end)
        # intervals hand on the momentum at the start plus all impulses: D_{F_r} A plus their rows, which are zero at
        # the solution alone
        fast = fast.at[1:, 0].add(-fast[:-1].sum(axis=1))
        end = end.q_f, p_s, end.p_f / self.equations.micro_dt
        return Unknowns(slow, self.slow_constraints(x.slow), fast, g), end

    def impulses(self, m, x: IntervalUnknowns, arriving: Arriving, slow, multiplier) -> Arriving:
        """Change of the quantities that interval m hands on if `multiplier` is added to its multipliers."""
        d = self.constraint_impulses(m, self.path(arriving, slow, x.fast))(-multiplier)
        return Arriving(jnp.zeros_like(arriving.q_f), d.fast_start, d.slow_start, d.slow)

    def _action(self, path: IntervalPath, held: IntervalPath, m):
        """``h A_m`` without constraints and without the kinetic energy of constant masses, with the work of forces
        along `held` on displacements of `path`."""
        total = jnp.zeros(())
        for term, nodes in self.terms:
            total += nodes.evaluated(m, partial(self._of_term, term, nodes, m), path)
        for nodes in self._force_nodes:
            total += nodes.evaluated(m, partial(self._virtual_work, nodes, m), path, held)
        return self.equations.micro_dt * total

    def _of_term(self, term: TermOnNodes, nodes: IntervalNodes, m, path: IntervalPath):
        equations = self.equations
        values = jax.vmap(term.integrand)(*nodes.sample(path, equations, self.seen, m, term.arguments))
        return term.sign * term.times_step(equations.macro_dt) * jnp.sum(of_interval(nodes.weights, m) * values)

    def _slow_action(self, slow_start, slow):
        """h times the action of the terms of slow variables alone, ``h H sum_i w_i T_s(S(c_i H), S'(c_i H))``."""
        equations, total = self.equations, jnp.zeros(())
        for term in self._slow_terms:
            nodes, bases = term.inside, (lagrange_basis, lagrange_derivative)
            moved, slopes = (matmul(basis(nodes.degree, nodes.theta)[:, 1:], slow) for basis in bases)
            path = {"q_s": slow_start + moved, "v_s": slopes / equations.macro_dt}
            values = jax.vmap(term.integrand)(*(path[name] for name in term.arguments))
            total += term.sign * term.times_step(equations.macro_dt) * jnp.sum(nodes.weights * values)
        return equations.micro_dt * total

    def _virtual_work(self, nodes: IntervalNodes, m, path: IntervalPath, held: IntervalPath):
        """``H sum_i w_i F(t_i, q_i, v_i) . q_i``."""
        equations = self.equations
        at_nodes = nodes.sample(held, equations, self.seen, m, ("t", "q_s", "q_f", "v_s", "v_f"))
        f_s, f_f = jax.vmap(equations.system.forces)(*at_nodes)
        q_s, q_f = nodes.sample(path, equations, self.seen, m, ("q_s", "q_f"))
        work = jnp.sum(f_s * q_s, axis=1) + jnp.sum(f_f * q_f, axis=1)
        return equations.macro_dt * jnp.sum(of_interval(nodes.weights, m) * work)

    def constraints(self, path: IntervalPath, m, nodes: slice):
        """(r, n_g) values of g at control nodes of interval m."""
        equations = self.equations
        c = control_nodes(equations.scheme.degree)[nodes]
        times = equations.t + equations.micro_dt * (m + c)
        q_s = path.slow_start + matmul(of_interval(self._slow_basis, m)[nodes], path.slow)
        q_s = with_unseen(q_s, "q_s", equations, self.seen)
        q_f = jnp.concatenate([path.fast_start[None], path.fast_start + path.fast])[nodes]
        return jax.vmap(equations.system.g)(times, q_s, q_f)

    def slow_rows(self, slow, impulses, arriving: Arriving):
        """Rows (r, n_s) of the slow momentum equations, and the slow momentum at the end of the step.

        The end momentum is computed as the start momentum plus all impulses, ``p_s + D_{S_0} A + ... + D_{S_r} A``.
        Potentials that are invariant under translations of the slow variables have impulses of sum zero, so that
        momentum is conserved to round-off.

        Args:
            slow: (r, n_s) increments.
            impulses: (r, n_s) of the slow constraint, see `slow_impulses`.
            arriving: quantities that the last micro interval hands on.
        """
        equations = self.equations
        start, d = (
            self.seen.put(a, jnp.zeros((*a.shape[:-1], equations.q_s.size))) for a in (arriving.start, arriving.slow)
        )
        if self.kinetic is not None:
            d += self.kinetic.slow_rows(slow) / equations.scheme.num_micro
        if self._slow_terms:
            by_start, by_slow = jax.grad(self._slow_action, argnums=(0, 1))(equations.q_s, slow)
            start, d = start + by_start, d + by_slow
        # h (p_s + D_{S_0} A), h D_{S_i} A, 0 < i < r
        rows = jnp.concatenate([(equations.micro_dt * equations.p_s + start - d.sum(0))[None], d[:-1]]) - impulses
        return rows, equations.p_s + (start - impulses.sum(0)) / equations.micro_dt

    def slow_constraints(self, slow):
        """(r, n_gs) values of the slow constraint at S_1..S_r, for increments (r, n_s)."""
        equations = self.equations
        times = equations.t + equations.macro_dt * control_nodes(equations.scheme.degree)[1:]
        return jax.vmap(equations.system.g_slow)(times, equations.q_s + slow)

    def slow_impulses(self, slow, multiplier):
        """(r, n_s) impulses ``G_s^T nu``, times h, of the slow constraint at S_0..S_{r-1}, for increments (r, n_s) and
        scaled multipliers (r, n_gs)."""
        equations = self.equations
        times = equations.t + equations.macro_dt * control_nodes(equations.scheme.degree)[:-1]
        nodes = jnp.concatenate([equations.q_s[None], equations.q_s + slow[:-1]])
        pull = jax.vjp(partial(jax.vmap(equations.system.g_slow), times), nodes)[1]
        return pull(multiplier / equations.scheme.num_micro)[0]


def _quadratic_form(matrix) -> Callable:
    """``v -> v^T M v / 2`` of a symmetric matrix M, with the derivative M v: JAX would take the sum with the transposed
    product."""

    @jax.custom_jvp
    def energy(v):
        return v @ matvec(matrix, v) / 2

    @energy.defjvp
    def _(v, dv):
        row = matvec(matrix, *v)
        return v[0] @ row / 2, row @ dv[0]

    return energy
