"""One micro interval as a problem of its own, and the Newton matrix its fast increments are corrected with."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import DIAGONAL_MATRICES, Full, Sparsity, inverse, matvec, regularized, solve
from vmri_jax.mechanics.constraint_pattern import fast_rows
from vmri_jax.mechanics.masses import ConstantMass, Diagonal
from vmri_jax.mechanics.structure import has_constant_hessian, has_diagonal_hessian, is_linear
from vmri_jax.mechanics.system import System, label
from vmri_jax.schemes.discrete_lagrangian import QuadraticKinetic, Term, lagrangian
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.path import Path, control_nodes, lagrange_basis
from vmri_jax.schemes.quadrature import micro, midpoint
from vmri_jax.schemes.scheme import Scheme

SMALL = 16
"""Fast variables up to which an interval of high degree is solved with one matrix for all of them. For more, matrices that are taken apart
or kept are cheaper."""


def weighted_sum(weights, increments):
    """``sum_i weights_i increments_i`` over the last axis of weights and the first of increments."""
    return jnp.sum(weights[..., None] * increments, axis=-2)


def constant_mass(system: System) -> ConstantMass:
    """The masses of a system that can be cut."""
    assert isinstance(system.kinetic, ConstantMass)
    return system.kinetic


def interval_problem(system: System, scheme: Scheme) -> tuple[System, Scheme]:
    """System and scheme of one micro interval: without the kicks at nodes that only some intervals have, and the slow constraint."""
    changes: dict[str, Any] = {"slow_constraint": None}
    rules: dict[str, Any] = {"slow": scheme.slow, "fast": scheme.fast, "force": scheme.force}
    for name, placed in rules.items():
        if not placed.is_local:
            rules[name] = micro(midpoint)
            changes |= {} if name == "force" else {f"{name}_potential": None}
    if system.potentials:
        local = [(label(name), function, scheme.rule_of(name)) for name, function in system.potentials]
        local = [potential for potential in local if potential[2].is_local]
        changes["potentials"] = {name: function for name, function, _ in local}
        rules["potentials"] = {name: placed for name, _, placed in local}
    local = Scheme(1, scheme.degree, kinetic=scheme.kinetic, constraint=scheme.constraint, **rules)
    return system.replace(**changes), local


def implicit_terms(system: System, scheme: Scheme) -> list[Term]:
    """The potentials that the fast unknowns of a micro interval enter."""
    terms = lagrangian(*interval_problem(system, scheme)).terms
    return [term for term in terms if isinstance(term, Term) and term.inside.groups]


def _of_fast(term: Term, q_s, q_f):
    """The integrand of a term at slow positions that are known."""
    return term.integrand(*({"q_s": q_s, "q_f": q_f}[name] for name in term.arguments))


class DiagonalMatrix(NamedTuple):
    """K of a micro interval for every coordinate alone.

    inverse: of the rows of slots 0..r-1.
    last: the row of slot r, which is the momentum handed on.
    """

    inverse: Float[Array, "r r n_f"]
    last: Float[Array, "r n_f"]

    def solve(self, rows):
        """The increments (r, n_f) for given rows (r, n_f)."""
        return jnp.sum(self.inverse * rows[None], axis=1)

    def outgoing(self, increments):
        """Change (n_f,) of the last slot with the increments."""
        return jnp.sum(self.last * increments, axis=0)


class FullMatrix(NamedTuple):
    """K of a micro interval, as in `DiagonalMatrix` with the increments in a row."""

    inverse: Float[Array, "r*n_f r*n_f"]
    last: Float[Array, "n_f r*n_f"]

    def solve(self, rows):
        """The increments (r, n_f) for given rows (r, n_f)."""
        return matvec(self.inverse, rows.reshape(-1)).reshape(rows.shape)

    def outgoing(self, increments):
        """Change (n_f,) of the last slot with the increments."""
        return matvec(self.last, increments.reshape(-1))


Matrix = DiagonalMatrix | FullMatrix


@dataclass(frozen=True)
class Interval:
    """What one micro interval is like, decided from structure.

    is_explicit: its fast increment is the momentum that arrives plus the constraint force.
    is_diagonal: its matrix K, the derivative of its fast equations (r n_f rows, times h) by its increments without constraints,
        negative definite where the mass dominates, is taken for every fast coordinate alone: fast equations are explicit, or W is a
        sum over the coordinates. V is then left out: it is the soft potential, and h^2 times its curvature is small beside the
        mass.
    is_constant: K is the same for a whole run.
    sparsity: of ``G K^-1 G^T``.
    """

    is_explicit: bool
    is_diagonal: bool
    is_constant: bool
    sparsity: Sparsity

    @classmethod
    def of(cls, system: System, scheme: Scheme, q_s, q_f) -> "Interval":
        """For positions of these shapes."""
        terms = implicit_terms(system, scheme)
        of_fast = [term for term in terms if term.arguments == ("q_f",)]
        sums = bool(of_fast) and all(has_diagonal_hessian(term.integrand, q_f) for term in of_fast)
        sums = sums and all(term.name in ("V", "W") for term in terms)  # further potentials may be stiff: K sees them
        straight = all(is_linear(partial(_of_fast, term, q_s), q_f) for term in terms)
        straight &= scheme.degree == 1 or q_f.size > SMALL  # few of high degree are taken together
        is_diagonal = DIAGONAL_MATRICES and isinstance(constant_mass(system).fast_mass, Diagonal) and (straight or sums)
        is_constant = True
        if is_diagonal:
            terms = of_fast
        elif system.force is not None or (scheme.degree > 1 and system.constraint is not None):
            is_constant = False
        q = {"q_s": q_s, "q_f": q_f}
        is_constant = is_constant and all(
            has_constant_hessian(term.integrand, *(q[a] for a in term.arguments)) for term in terms
        )
        is_explicit = scheme.degree == 1 and not implicit_terms(system, scheme) and system.force is None
        full = Full(scheme.degree * system.num_constraints(q_s, q_f)[0])
        sparsity = fast_rows(system, q_s, q_f, scheme.degree) if is_diagonal else full
        return cls(is_explicit, is_diagonal, is_constant, sparsity)

    def no_matrix(self, equations: StepEquations) -> Matrix:
        """The shapes of K, all zero."""
        r, n_f = equations.scheme.degree, equations.q_f.shape[0]
        if self.is_diagonal:
            return DiagonalMatrix(jnp.zeros((r, r, n_f)), jnp.zeros((r, n_f)))
        return FullMatrix(jnp.zeros((r * n_f, r * n_f)), jnp.zeros((n_f, r * n_f)))

    def matrix(self, equations: StepEquations) -> Matrix:
        """K on the first micro interval of a macro step, on the straight path from its start."""
        system, scheme = interval_problem(equations.system, equations.scheme)
        start = equations.q_s, equations.q_f, equations.p_s, equations.p_f
        local = StepEquations(system, scheme, equations.t, *start, equations.micro_dt)
        velocities = constant_mass(system).velocity(equations.p_s, equations.p_f)
        slow, fast = (local.macro_dt * control_nodes(scheme.degree)[1:, None] * v for v in velocities)
        path = local.path_of(slow, fast[None])
        return _diagonal_matrix(local, path) if self.is_diagonal else _full_matrix(local, path)


def _full_matrix(local: StepEquations, path: Path) -> FullMatrix:
    kinetic = lagrangian(local.system, local.scheme).kinetic
    _, r, n_f = path.fast.shape

    def slots(increments):
        at = replace(path, fast=increments[None])
        d = jax.grad(local.without_kinetic)(at, at)
        d_fast = d.fast[0] + kinetic.rows(path.slow, increments)[1]
        return jnp.concatenate([d.fast_start - d_fast.sum(0), d_fast])

    block = jax.jacfwd(slots)(path.fast[0])
    return FullMatrix(inverse(block[:-1].reshape(r * n_f, r * n_f)), block[-1].reshape(n_f, r * n_f))


def _diagonal_matrix(local: StepEquations, path: Path) -> DiagonalMatrix:
    _, r, n_f = path.fast.shape
    block = jnp.zeros((r + 1, r, n_f))
    for term in lagrangian(local.system, local.scheme).terms:
        if isinstance(term, QuadraticKinetic):
            block += term.fast_form[:, 1:, None] * term.mass.fast
        elif term.inside.groups and term.arguments == ("q_f",):
            q = term.inside.sample(path, ("q_f",))["q_f"]
            gradient = jax.vmap(jax.grad(term.integrand))
            curvature = jax.jvp(gradient, (q,), (jnp.ones_like(q),))[1]  # the diagonal of each Hessian
            basis = lagrange_basis(r, np.array([group.c for group in term.inside.groups]))
            weights = term.sign * local.macro_dt**2 * term.inside.weights
            block += jnp.einsum("k,ki,kj,ka->ija", weights, basis, basis[:, 1:], curvature)
    if r == 1:
        return DiagonalMatrix(1 / block[:1], block[-1])
    return DiagonalMatrix(jnp.moveaxis(jax.vmap(inverse, in_axes=-1)(block[:-1]), 0, -1), block[-1])


def solve_saddle(solve_k, jacobian, push, rows, g):
    """(dx, dmu) with ``K dx - G_0^T dmu = -rows`` and ``G_1 dx = -g``, by the Schur complement ``G_1 K^-1 G_0^T``.

    Args:
        solve_k: K^-1, (r, n) rows to (r, n) increments.
        jacobian: (r, n_g, n) G_0, at the control nodes 0..r-1, where the multipliers act.
        push: G_1 as a function, changes (r, n) of the control points 1..r to changes (r, n_g) of the constraints.
        rows, g: (r, n) and (r, n_g).
    """
    r, n_g = g.shape
    dx = -solve_k(rows)
    if n_g == 0:
        return dx, g
    columns = np.eye(r)[:, None, :, None] * jacobian[:, :, None, :]  # (node, constraint, row, coordinate)
    response = jax.vmap(solve_k)(columns.reshape(r * n_g, r, -1))
    schur = regularized(jax.vmap(push)(response).reshape(r * n_g, r * n_g))
    dmu = -solve(schur.T, (g + push(dx)).reshape(r * n_g, 1))
    return dx + jnp.sum(dmu[..., None] * response, axis=0), dmu.reshape(r, n_g)
