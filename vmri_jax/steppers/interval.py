"""The structure of a micro interval, and the Newton matrix K of its fast increments.

K (r n_f, r n_f) is the derivative of the fast momentum equations, times h and without constraint forces, by the fast
increments. Its rows i = 0..r-1 and columns j = 1..r are

    K_ij = k_ij M_f - h^2 sum_k w_k l_i(c_k) l_j(c_k) U''(c_k)
           + h^2 sum_k w_k l_i(c_k) (dF/dq l_j(c_k) + dF/dv l_j'(c_k) / h)
    k_ij = sum_n w_n l_i'(c_n) l_j'(c_n)

k_ij has the nodes c_n and weights w_n of T. The terms with U'' are summed over W and all other potentials U with nodes
c_k inside micro intervals. U'' and the derivatives of the forces F, both in fast variables, are evaluated on the
straight path over the first micro interval of a macro step. A `DiagonalMatrix` takes only potentials of q_f alone, and
no forces.

For r = 1, without forces and with W at the midpoint, ``K = -(M_f + h^2 W'' / 4)``: negative definite where the mass
dominates. The entries of K that couple coordinates of a long chain lie in a band, which O(n_f) operations eliminate.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import DIAGONAL_MATRICES, LARGEST_RENEWED, inverse
from vmri_jax.kernels.band import Band, BandInverse, Full, FullInverse, Sparsity, sparsity
from vmri_jax.mechanics.arrays import is_concrete, quickly_compiled
from vmri_jax.mechanics.constraint_pattern import MOST_ROWS_OF_FULL_MATRIX, fast_rows
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.structure import has_constant_hessian, has_diagonal_hessian, is_linear
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.discrete_lagrangian import TermOnNodes, lagrangian
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.interval_nodes import IntervalPath, of_interval
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.schemes.path import control_nodes, lagrange_basis
from vmri_jax.schemes.scheme import Scheme

SMALL = 24
"""Most fast variables for which an interval of high degree is solved with one full matrix. For more variables, matrices
per coordinate, or matrices that are kept over many steps, are cheaper."""
PATHS = 3
"""Random paths on which the entries of K are looked for; fewer of them miss entries that are zero by chance, or in a
part of the positions."""


def implicit_terms(system: System, scheme: Scheme) -> list[TermOnNodes]:
    """The potentials with nodes inside micro intervals, whose gradients depend on the fast unknowns."""
    return [term for term in lagrangian(system, scheme).terms if np.any(term.inside.c > 0)]


class DiagonalMatrix(NamedTuple):
    """``K^-1`` as one matrix (r, r) for every fast coordinate."""

    inverse: Float[Array, "r r n_f"]

    def solve(self, rows):
        """The increments ``K^-1 rows`` (r, n_f) for rows (r, n_f)."""
        return jnp.sum(self.inverse * rows[None], axis=1)


class JoinedMatrix(NamedTuple):
    """``K^-1`` (r n_f, r n_f) for all fast coordinates together, as a full matrix or by a band."""

    inverse: FullInverse | BandInverse

    def solve(self, rows):
        """The increments ``K^-1 rows`` (r, n_f) for rows (r, n_f)."""
        return self.inverse.times(rows.reshape(-1)).reshape(rows.shape)


Matrix = DiagonalMatrix | JoinedMatrix


@dataclass(frozen=True)
class IntervalStructure:
    """The structure of a micro interval.

    is_explicit: whether the fast increments are explicit functions of the multipliers,
        ``x = M_f^-1 (h p_f - G_0^T mu)``.
    is_diagonal: whether K is taken as one matrix per fast coordinate: M_f is diagonal, and inside the interval either
        all potentials are linear in q_f, or there are only V and W, and each function of q_f alone among V and W is a
        sum over the coordinates. K then leaves out forces and potentials that depend on slow variables: this costs
        passes, not accuracy.
    is_constant: whether K is the same for a whole run.
    of_matrix: sparsity of K, where it is not diagonal.
    of_constraints: sparsity of ``G K^-1 G^T``.
    """

    is_explicit: bool
    is_diagonal: bool
    is_constant: bool
    of_matrix: Sparsity
    of_constraints: Sparsity

    @classmethod
    def of(cls, system: System, scheme: Scheme, q_s, q_f) -> "IntervalStructure":
        """The structure for a system, a scheme, and positions of these shapes."""
        terms = implicit_terms(system, scheme)
        of_fast = [term for term in terms if term.arguments == ("q_f",)]
        sums = bool(of_fast) and all(has_diagonal_hessian(term.integrand, q_f) for term in of_fast)
        # further potentials may be stiff: K must contain them
        sums = sums and all(term.name in ("V", "W") for term in terms)
        linear = all(is_linear(partial(term.at, q_s), q_f) for term in terms)
        linear &= scheme.degree == 1 or q_f.size > SMALL  # few variables and a high degree: one full matrix is cheaper
        is_diagonal = DIAGONAL_MATRICES and system.kinetic.fast_mass.is_diagonal and (linear or sums)
        is_explicit = scheme.degree == 1 and not terms and system.force is None
        varies = system.force is not None or (scheme.degree > 1 and system.constraint is not None)
        is_constant = (is_diagonal or not varies) and all(
            has_constant_hessian(term.at, q_s, q_f) for term in (of_fast if is_diagonal else terms)
        )
        of_matrix = Full(scheme.degree * q_f.size)
        if not is_diagonal and q_f.size > MOST_ROWS_OF_FULL_MATRIX:
            of_matrix = _of_matrix(system, scheme, q_s.size, q_f.size)
        full = Full(scheme.degree * system.num_constraints(q_s, q_f)[0])
        of_constraints = fast_rows(system, q_s, q_f, scheme.degree) if is_diagonal else full
        return cls(is_explicit, is_diagonal, is_constant, of_matrix, of_constraints)

    @property
    def is_cheap(self) -> bool:
        """Whether every macro step computes K anew: it is small, or no larger than a few vectors."""
        return self.is_diagonal or isinstance(self.of_matrix, Band) or self.of_matrix.size <= LARGEST_RENEWED

    def no_matrix(self, equations: StepEquations) -> Matrix:
        """K filled with zeros, for its shapes."""
        return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(self.matrix, equations))

    @partial(jax.jit, static_argnums=0)  # traced once for the shapes of `no_matrix` and for the steps
    def matrix(self, equations: StepEquations) -> Matrix:
        """K on the first micro interval of a macro step, on the straight path from its start."""
        velocities = equations.system.kinetic.velocity(equations.p_s, equations.p_f)
        c, lengths = control_nodes(equations.scheme.degree)[1:, None], (equations.macro_dt, equations.micro_dt)
        slow, fast = (length * c * v for length, v in zip(lengths, velocities, strict=True))
        intervals = Intervals(equations)
        path = intervals.path(intervals.start(), intervals.seen.take(slow), fast)
        if self.is_diagonal:
            return _diagonal_matrix(intervals, path)
        times_k = jax.linearize(partial(_rows, intervals, path), fast)[1]
        seeds = self.of_matrix.seeds
        products = jax.vmap(times_k)(seeds.reshape(len(seeds), *fast.shape))
        return JoinedMatrix(self.of_matrix.inverse(products.reshape(seeds.shape), may_depend=False))


def _rows(intervals: Intervals, path: IntervalPath, fast):
    """Fast momentum equations (r, n_f) of the first interval, without constraints and the momentum that arrives, with
    forces along the same path."""
    d = intervals.gradient(0, path._replace(fast=fast))
    return intervals.rows(intervals.with_inertia(d, fast))


def _of_matrix(system: System, scheme: Scheme, n_s: int, n_f: int) -> Sparsity:
    """Sparsity of K: the rows that change with each fast coordinate on random paths.

    An entry that differs from zero elsewhere alone is missed, which costs passes, not accuracy.
    """
    touched, parts = np.zeros((n_f, n_f), bool), (system, scheme)
    for seed in range(PATHS):
        rng = np.random.default_rng(seed)
        numbers = [rng.normal(size=n) for n in (n_s, n_f, n_s, n_f)]
        # random numbers in place of traced ones
        known = jax.tree.map(lambda a, rng=rng: a if is_concrete(a) else rng.uniform(0.5, 1.5, np.shape(a)), parts)
        with jax.ensure_compile_time_eval():
            touched |= np.asarray(_touched(known, numbers, rng.normal(size=(scheme.degree, n_f))))
    return sparsity(touched | touched.T, scheme.degree)


@quickly_compiled
def _touched(parts: tuple[System, Scheme], numbers, fast):
    """(n_f, n_f) whether the rows of each coordinate change with each other one, on the path with these positions and
    increments."""
    system, scheme = parts
    start = State(jnp.zeros(()), *numbers)
    intervals = Intervals(StepEquations.of(system, scheme, start, jnp.asarray(float(scheme.num_micro))))
    arriving = intervals.start()
    path = intervals.path(arriving, arriving.slow, fast)
    times_k = jax.linearize(partial(_rows, intervals, path), fast)[1]

    def column(i):
        # every change counts, however small: K is the exact matrix of linear equations
        return jnp.any(times_k(jnp.zeros_like(fast).at[:, i].set(fast[:, i])) != 0, axis=0)

    return jax.lax.map(column, jnp.arange(fast.shape[1]))


def _diagonal_matrix(intervals: Intervals, path: IntervalPath) -> DiagonalMatrix:
    equations, kinetic = intervals.equations, intervals.kinetic
    # block_ija = k_ij M_a - h^2 sum_k w_k l_i(c_k) l_j(c_k) W''_aa, i = 0..r-1, j = 1..r, coordinate a
    block = kinetic.fast_form[:-1, 1:, None] * kinetic.mass.fast
    for term, nodes in intervals.terms:
        if term.arguments != ("q_f",):
            continue
        (q,) = nodes.sample(path, equations, intervals.seen, 0, ("q_f",))
        # W'' times ones: its diagonal, since W is a sum over coordinates
        curvature = jax.jvp(jax.vmap(jax.grad(term.integrand)), (q,), (jnp.ones_like(q),))[1]
        basis = lagrange_basis(equations.scheme.degree, nodes.c[0])
        weights = term.sign * equations.micro_dt * term.times_step(equations.macro_dt) * of_interval(nodes.weights, 0)
        block += jnp.einsum("k,ki,kj,ka->ija", weights, basis[:, :-1], basis[:, 1:], curvature)
    if len(block) == 1:
        return DiagonalMatrix(1 / block)
    return DiagonalMatrix(jnp.moveaxis(jax.vmap(inverse, in_axes=-1)(block), 0, -1))
