"""Nested march: the slow path outside, the micro intervals in order inside, each solving only its own small system.

A pass takes the slow path as known. It marches over the micro intervals; each corrects its fast increments and
multipliers once, by a Newton step on its exact residual, and adds its impulse to the slow equations. Then the slow
increments and slow multipliers are corrected from what is left of their equations. The matrices are cheap ones:

* micro interval: ``[K, -G^T; G, 0]``, with ``K = -(M + h^2 W'' / 4)`` for the implicit midpoint rule, from the start of the macro step, or of
  one before it while that costs no passes. Where the fast equations are explicit K is ``-M``, and only the multipliers are solved for.
  ``G K^-1 G^T`` is that of the first pass;
* slow equations: masses, with those that constraints tie to the slow ones, and the slow constraint (`SlowEquations`). Where nothing is
  constrained, the derivative of the slow forces is added where updates by the masses alone would cost a pass.

The slow unknowns start from the polynomial through those of the steps before (`PolynomialPredictor`); the fast increments from
straight motion, and the multipliers from those of the interval before. The residual is exact, so all of this decides only how many
passes there are: two where the slow motion is smooth. A pass costs one gradient of each term at each of its nodes; nothing is stored but
the path and those small matrices.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import LARGEST_RENEWED, LINEARISES_FORCES, max_abs
from vmri_jax.schemes.equations import StepEquations, Unknowns, multiplier_scales
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.accept import Accepted, expected
from vmri_jax.steppers.interval import Interval, Matrix, constant_mass
from vmri_jax.steppers.micro_intervals import FastUnknowns, MicroSweep, SweepTotals
from vmri_jax.steppers.predictors import PolynomialPredictor
from vmri_jax.steppers.results import Method
from vmri_jax.steppers.slow_equations import ConstraintInertia, SlowEquations
from vmri_jax.steppers.solved import Solution, Solver, largest_constraint, status_of
from vmri_jax.steppers.solvers import Newton

EXTRA_PASSES = 1
"""A step that needs more passes than this above the fewest with its matrix K renews K. With more, steps with an old K take more passes; with
none, K is computed for every fluctuation of the passes."""
UNKNOWN = 10**6
"""Fewest passes with a matrix that no step has used: more than any step takes."""


class NestedState(NamedTuple):
    """What a macro step hands to the next one.

    matrix: K of the micro intervals.
    slow: slow increments and slow multipliers of the last steps.
    multiplier: multipliers lambda of the last micro interval.
    slow_model_error: ``|next update| / |update|`` of the slow unknowns by the masses alone; once the derivative of the slow forces has been
        taken, ``|update with it - update by the masses| / |update with it|``.
    fewest_passes: of a step with this matrix, UNKNOWN before one.
    last_passes: of the last step.
    """

    matrix: Matrix
    slow: PolynomialPredictor
    multiplier: Float[Array, "r n_g"]
    slow_model_error: Float[Array, ""]
    fewest_passes: Int[Array, ""]
    last_passes: Int[Array, ""]


class Pass(NamedTuple):
    """Unknowns of a pass, what it left, and how the iteration stands.

    d: the next update of the slow unknowns, with which their equations, linearised, are zero.
    inertia: masses that constraints tie to the slow variables, from the first pass.
    impulse: on the slow variables over the step, times h.
    rows: largest row of the momentum equations, times h.
    """

    slow: Float[Array, "r n_s"]
    slow_multiplier: Float[Array, "r n_gs"]
    fast: FastUnknowns
    totals: SweepTotals
    d: Float[Array, "r*(n_s+n_gs)"]
    inertia: ConstraintInertia | None
    slow_model_error: Float[Array, ""]
    impulse: Float[Array, "n_s"]
    rows: Float[Array, ""]
    passes: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Nested(Solver):
    """Passes until one more would change neither the slow increments nor those of the micro intervals.

    The next change of the slow increments is known from the residual, that of the fast ones from how their corrections shrink, as in
    stiff solvers (Hairer, Wanner, *Solving Ordinary Differential Equations II*, IV.8). Accepted are changes of
    ``newton.tolerance`` relative to the motion over the macro step and over a micro interval, and round-off of the positions.
    """

    newton: Newton
    interval: Interval

    def init(self, equations: StepEquations, velocity) -> NestedState:
        r, (n_g, n_gs) = equations.scheme.degree, equations.system.num_constraints(equations.q_s, equations.q_f)
        matrix = self.interval.matrix if self.interval.is_constant else self.interval.no_matrix
        increments = control_nodes(r)[1:, None] * (equations.macro_dt * velocity[0])
        slow = PolynomialPredictor.constant(jnp.concatenate([increments.reshape(-1), jnp.zeros(r * n_gs)]))
        fewest, last = jnp.asarray(0), jnp.asarray(2 * EXTRA_PASSES)  # with these the first step computes the matrix
        return NestedState(matrix(equations), slow, jnp.zeros((r, n_g)), jnp.ones(()), fewest, last)

    def renew(self, equations: StepEquations, memory: NestedState) -> NestedState:
        """With a new matrix K, unless it is constant.

        A large one is kept for as long as it costs no passes; a number of passes that is fixed needs a new one.
        """
        if self.interval.is_constant:
            return memory
        if self.interval.is_diagonal or len(memory.matrix.inverse) <= LARGEST_RENEWED or self.newton.fixed_iterations:
            return memory._replace(matrix=self.interval.matrix(equations))
        stale = memory.last_passes > memory.fewest_passes + EXTRA_PASSES
        matrix = jax.lax.cond(stale, lambda: self.interval.matrix(equations), lambda: memory.matrix)
        return memory._replace(matrix=matrix, fewest_passes=jnp.where(stale, UNKNOWN, memory.fewest_passes))

    def solve(self, equations: StepEquations, guess: Unknowns, memory: NestedState) -> tuple[Solution, NestedState]:
        scheme, newton = equations.scheme, self.newton
        scale, _ = multiplier_scales(scheme, equations.macro_dt)
        sweep = MicroSweep(equations, self.interval.is_explicit, memory.matrix, scale, self.interval.sparsity)
        passes = _Passes(equations, memory, sweep, newton)
        done = newton.iterate(passes.next, passes.first(), done=1)

        x = Unknowns(done.slow, done.slow_multiplier, done.fast.increments, done.fast.multiplier)
        per_h = 1 / equations.micro_dt
        end = done.totals.q_f, equations.p_s + per_h * done.impulse, per_h * done.totals.p_f
        g = largest_constraint(equations, x)
        status = status_of(equations, done.result, Method.NESTED, done.passes, done.rows, g, newton.tolerance)

        learned = NestedState(
            memory.matrix,
            memory.slow.add(_joined(done), done.slow.size),
            (done.fast.multiplier / scale)[-1],
            done.slow_model_error,
            jnp.minimum(memory.fewest_passes, done.passes),
            done.passes,
        )
        return Solution(x, end, status), learned

    def continued(self, memory: NestedState, last: NestedState) -> NestedState:
        return memory._replace(multiplier=last.multiplier)

    def describe(self) -> list[str]:
        inside = "the multipliers alone" if self.interval.is_explicit else "fast increments and multipliers"
        return [
            "nested march: the slow path outside, micro intervals in order inside",
            f"  each interval solves for {inside}, with a matrix {self._matrix_in_words()}",
        ]

    def _matrix_in_words(self) -> str:
        kind = "per coordinate" if self.interval.is_diagonal else "of its fast variables"
        return f"{kind}, {'computed once' if self.interval.is_constant else 'renewed with the macro steps'}"


class _Passes:
    """The iteration over passes of one macro step."""

    def __init__(self, equations: StepEquations, memory: NestedState, sweep: MicroSweep, newton: Newton):
        self.equations, self.memory, self.sweep, self.newton = equations, memory, sweep, newton
        self.slow_equations = SlowEquations.of(equations)
        self.accepted = Accepted.of(equations, newton)
        self.mass = constant_mass(equations.system)
        self.r, self.n_s = equations.scheme.degree, equations.q_s.size

    def first(self) -> Pass:
        """From the predicted unknowns."""
        z = self.memory.slow.next(self.r * self.n_s)
        fast, totals = self.sweep.first_pass(self._apart(z)[0], self.memory.multiplier)
        inertia = self.slow_equations.constraint_inertia(jax.tree.map(lambda a: a[0], fast.schur_inverse))
        return self._judged(z, fast, totals, inertia, self.memory.slow_model_error, totals.moved, 1)

    def next(self, last: Pass) -> Pass:
        """With slow unknowns corrected by what the last pass left."""
        if self.equations.system.is_constrained or not (self.n_s and LINEARISES_FORCES):
            return self._moved_by(last.d, last)
        # After the update d by the masses alone the next one is slow_model_error |d|. It must be accepted, or d is solved for with the
        # derivative of the slow forces. After the first pass it is the one after next: the fast unknowns take three passes anyway.
        error = last.slow_model_error
        still_missing = jnp.where(last.passes == 1, error**2, error)
        is_hard = still_missing * self.accepted.over((max_abs(last.d), 0.0), (max_abs(last.slow), 0.0), last.passes) > 1
        wanted = jnp.where(is_hard, last.d, 0.0)  # lanes of a batch that are not hard take no part
        x = Unknowns(last.slow, last.slow_multiplier, last.fast.increments, last.fast.multiplier)
        d = jax.lax.cond(is_hard, lambda: self.slow_equations.with_forces(wanted, x), lambda: last.d)
        now = self._moved_by(d, last)
        missing, update = jnp.where(is_hard, jnp.stack([d - last.d, d]), jnp.stack([now.d, last.d]))
        return now._replace(slow_model_error=max_abs(missing) / (max_abs(update) + jnp.finfo(float).tiny))

    def _moved_by(self, d, last: Pass) -> Pass:
        z = _joined(last) + d
        fast, totals = self.sweep.next_pass(self._apart(z)[0], last.fast)
        still_moves = expected(totals.moved, last.totals.moved)
        return self._judged(z, fast, totals, last.inertia, last.slow_model_error, still_moves, last.passes + 1)

    def _judged(
        self, z, fast: FastUnknowns, totals: SweepTotals, inertia: ConstraintInertia | None, error, still_moves, passes
    ) -> Pass:
        """A pass with slow unknowns z, the next update of these, and whether what is still to come is accepted."""
        equations, inverse_fast = self.equations, self.mass.fast_mass.inverse().times
        slow, slow_multiplier = self._apart(z)
        x = Unknowns(slow, slow_multiplier, fast.increments, fast.multiplier)
        d, rows, impulse = self.slow_equations.update(x, totals.d_start, totals.d_increments, inertia)
        arrives, leaves = inverse_fast(equations.micro_dt * equations.p_f), inverse_fast(totals.p_f)
        motion = jnp.maximum(max_abs(arrives), max_abs(leaves))
        changes = max_abs(d[: self.r * self.n_s]), still_moves
        result = self.newton.status(self.accepted.over(changes, (max_abs(slow), motion), passes), passes)
        rows = jnp.maximum(max_abs(rows), max_abs(self.mass.fast) * still_moves)
        passes = jnp.asarray(passes)
        return Pass(slow, slow_multiplier, fast, totals, d, inertia, error, impulse, rows, passes, result)

    def _apart(self, z):
        """Slow increments (r, n_s) and slow multipliers (r, n_gs)."""
        size = self.r * self.n_s
        return z[:size].reshape(self.r, self.n_s), z[size:].reshape(self.r, -1)


def _joined(at: Pass):
    """Slow increments and slow multipliers in a row."""
    return jnp.concatenate([at.slow.reshape(-1), at.slow_multiplier.reshape(-1)])
