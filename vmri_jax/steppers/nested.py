"""Nested iteration: an outer iteration on the slow path, and within it the micro intervals in order, each with a small
system of its own.

A pass holds the slow path fixed. It visits the micro intervals in order; each corrects its fast increments and
multipliers once, by a Newton step on its exact residual, and adds its impulse to the slow equations. Then the pass
corrects the slow increments and slow multipliers by the residual of the slow equations. All equations are those of the
march (`vmri_jax.schemes.intervals`); all matrices are cheap approximations:

* micro interval: ``[K, -G_0^T; G_1, 0]`` with K of `vmri_jax.steppers.interval`, e.g. ``-(M_f + h^2 W'' / 4)`` for the
  implicit midpoint rule, on the straight path over the first interval of the macro step, or of an earlier step while
  that costs at most `EXTRA_PASSES`. Where the fast equations are explicit, ``K = -M_f`` and only the multipliers are
  unknown. ``G_1 K^-1 G_0^T`` is computed in the first pass and kept;
* slow equations: the slow masses, the fast masses that constraints tie to them, and the slow constraint
  (`SlowEquations`). Without constraints, the derivative of the slow forces is added where updates by the masses alone
  would cost a pass.

The slow unknowns start from a polynomial through the last steps (`PolynomialPredictor`), the fast increments from
straight motion, the multipliers from the interval before. The residual is exact, so that these approximations change
only the number of passes: mostly two or three where the slow motion is smooth. A pass costs one gradient of each term
at each of its nodes; memory holds the path and the small matrices.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import LINEARISES_FORCES, max_abs
from vmri_jax.mechanics.arrays import split_at
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.intervals import Arriving, Intervals
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.accept import Accepted, expected
from vmri_jax.steppers.interval import IntervalStructure, Matrix
from vmri_jax.steppers.micro_intervals import FastUnknowns, MicroSweep
from vmri_jax.steppers.predictors import PolynomialPredictor
from vmri_jax.steppers.results import RUNNING, Method
from vmri_jax.steppers.slow_equations import ConstraintInertia, SlowEquations
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import Solver, iterated, only_if

EXTRA_PASSES = 1
"""Passes above the fewest with a matrix K that the solver tolerates; it renews K after a step with more. A larger
number lets steps with an old K take more passes; with zero, every fluctuation of the number of passes renews K."""
PASSES_OF_UNUSED_MATRIX = 10**6
"""Initial value of the least number of passes with a new matrix: larger than the number of any step."""


class NestedMemory(NamedTuple):
    """Memory that a macro step hands to the next one.

    matrix: K of the micro intervals.
    slow: predictor of slow increments and slow multipliers.
    multiplier: multipliers lambda of the last micro interval.
    slow_model_error: relative error of the slow update d by the masses alone: ``|next update| / |d|`` after a pass that
        moved by d, and ``|d_F - d| / |d_F|`` after a pass that moved by the update d_F with the derivative of the slow
        forces.
    fewest_passes: least number of passes of a step with this matrix.
    last_passes: number of passes of the last step.
    """

    matrix: Matrix
    slow: PolynomialPredictor
    multiplier: Float[Array, "r n_g"]
    slow_model_error: Float[Array, ""]
    fewest_passes: Int[Array, ""]
    last_passes: Int[Array, ""]


class Pass(NamedTuple):
    """Unknowns after a pass, the quantities that its last interval hands on, and the state of the iteration.

    moved: largest correction of a fast increment.
    d: the next update of the slow increments, by the linearised slow equations; their update of the multipliers is in
        `slow_multiplier` already.
    inertia: masses that constraints tie to the slow variables, from the first pass.
    p_s: slow momentum at the end of the step.
    rows: estimated residual of the momentum equations, times h: ``max(|R_s|, max M_f |c|)`` with the expected fast
        correction c. M_f stands for K here: for stiff W at the midpoint, |K c| is larger by the factor
        ``1 + h^2 W'' / (4 M_f)``.
    """

    slow: Float[Array, "r n_s"]
    slow_multiplier: Float[Array, "r n_gs"]
    fast: FastUnknowns
    end: Arriving
    moved: Float[Array, ""]
    d: Float[Array, "r*n_s"]
    inertia: ConstraintInertia
    slow_model_error: Float[Array, ""]
    p_s: Float[Array, "n_s"]
    rows: Float[Array, ""]
    passes: Int[Array, ""]
    result: Int[Array, ""]

    @property
    def unknowns(self) -> Unknowns:
        """The unknowns of the step."""
        return Unknowns(self.slow, self.slow_multiplier, self.fast.increments, self.fast.multiplier)


@dataclass(frozen=True)
class Nested(StepSolver):
    """Passes until the next one would change neither the slow nor the fast increments (`Accepted`).

    The next slow correction follows from the residual of the slow equations, the next fast one is extrapolated from the
    last two, as in stiff solvers (Hairer, Wanner, *Solving Ordinary Differential Equations II*, IV.8).
    """

    settings: Solver
    interval: IntervalStructure

    def init(self, equations: StepEquations) -> NestedMemory:
        r, (n_g, n_gs) = equations.scheme.degree, equations.system.num_constraints(equations.q_s, equations.q_f)
        matrix = self.interval.matrix if self.interval.is_constant else self.interval.no_matrix
        slow = PolynomialPredictor.empty(r * (equations.q_s.size + n_gs))
        # with these numbers the first step renews the matrix
        fewest, last = jnp.asarray(0), jnp.asarray(2 * EXTRA_PASSES)
        return NestedMemory(matrix(equations), slow, jnp.zeros((r, n_g)), jnp.ones(()), fewest, last)

    def renew(self, equations: StepEquations, memory: NestedMemory) -> NestedMemory:
        """The memory with a new matrix K, unless K is constant.

        A large K is kept while it costs at most `EXTRA_PASSES` passes.
        """
        if self.interval.is_constant:
            return memory
        if self.interval.is_cheap:
            return memory._replace(matrix=self.interval.matrix(equations))
        stale = memory.last_passes > memory.fewest_passes + EXTRA_PASSES
        matrix = jax.lax.cond(stale, lambda: self.interval.matrix(equations), lambda: memory.matrix)
        return memory._replace(
            matrix=matrix, fewest_passes=jnp.where(stale, PASSES_OF_UNUSED_MATRIX, memory.fewest_passes)
        )

    def solve(self, equations: StepEquations, guess: Unknowns, memory: NestedMemory) -> tuple[Solution, NestedMemory]:
        scale, _ = equations.multiplier_scales()
        sweep = MicroSweep(Intervals(equations), self.interval, memory.matrix, scale, memory.multiplier)
        passes = _Passes(memory, sweep, self.settings)
        done = iterated(passes.next, passes.start())

        x = done.unknowns
        end = done.end.q_f, done.p_s, done.end.p_f / equations.micro_dt
        status = status_of(equations, done.result, Method.MASSES, done.passes, rows=done.rows, end=end)

        learned = NestedMemory(
            memory.matrix,
            memory.slow.add(jnp.append(done.slow, done.slow_multiplier), done.slow.size),
            equations.multipliers(x, memory.multiplier[-1], x.slow_multiplier[-1])[0][-1],
            done.slow_model_error,
            jnp.minimum(memory.fewest_passes, done.passes),
            done.passes,
        )
        return Solution(x, end, status), learned

    def continued(self, memory: NestedMemory, last: NestedMemory) -> NestedMemory:
        return memory._replace(multiplier=last.multiplier)

    def describe(self) -> list[str]:
        inside = "the multipliers alone" if self.interval.is_explicit else "fast increments and multipliers"
        kind = "per coordinate" if self.interval.is_diagonal else "of its fast variables"
        renewed = "computed once" if self.interval.is_constant else "renewed with the macro steps"
        return [
            "masses: passes over the slow path, with the micro intervals in order inside",
            f"  each interval solves for {inside}, with a matrix {kind}, {renewed}",
        ]


class _Passes:
    """The iteration over passes of one macro step."""

    def __init__(self, memory: NestedMemory, sweep: MicroSweep, settings: Solver):
        self.memory, self.sweep, self.settings = memory, sweep, settings
        self.equations = equations = sweep.intervals.equations
        self.slow_equations = SlowEquations.of(sweep.intervals)
        self.accepted = Accepted.of(equations, settings)
        self.mass = equations.system.kinetic
        self.r, self.n_s = equations.scheme.degree, equations.q_s.size
        self.num_multipliers = equations.system.num_constraints(equations.q_s, equations.q_f)[1]

    def start(self) -> Pass:
        """The unknowns before the first pass: slow ones as predicted; in the first step, whose momenta are on the
        hidden constraints, from straight motion."""
        increment = self.equations.macro_dt * self.mass.slow_mass.inverse().times(self.equations.p_s)
        straight = (control_nodes(self.r)[1:, None] * increment).reshape(-1)
        predicted = self.memory.slow.next(straight.size, jnp.pad(straight, (0, self.r * self.num_multipliers)))
        slow, multiplier = split_at(predicted, straight.size)
        z = slow.reshape(self.r, self.n_s), multiplier.reshape(self.r, self.num_multipliers)
        fast, zero = self.sweep.blank(), jnp.zeros(())
        inertia = ConstraintInertia(*2 * [jnp.zeros((self.memory.multiplier.size, self.r, self.n_s))])  # none yet
        none, error = jnp.zeros(self.r * self.n_s), self.memory.slow_model_error
        numbers = zero, jnp.asarray(0), jnp.asarray(RUNNING)
        return Pass(*z, fast, self.sweep.intervals.start(), zero, none, inertia, error, self.equations.p_s, *numbers)

    def next(self, last: Pass) -> Pass:
        """The next pass, with corrected slow unknowns."""
        if self.equations.system.is_constrained or not (self.n_s and LINEARISES_FORCES):
            return self._moved_by(last.d, last)
        # With eps = slow_model_error, the update d by the masses alone leaves a next update eps |d|. If a next update
        # of this size would not be accepted, this pass solves for d with the derivative of the slow forces. After pass
        # 1, passes 2 and 3 each make a slow update at no cost, since the fast unknowns mostly need pass 3: the test
        # takes eps^2 |d|, the update after these two.
        error = last.slow_model_error
        still_missing = jnp.where(last.passes == 1, error**2, error)
        is_hard = (
            still_missing * self.accepted.ratio((max_abs(last.d), 0.0), (max_abs(last.slow), 0.0), last.passes) > 1
        )
        wanted = jnp.where(is_hard, last.d, 0.0)  # in lanes of a batch without a hard step the loop ends at once
        d = only_if(is_hard, lambda _: self.slow_equations.with_forces(wanted, last.unknowns), last.d)
        now = self._moved_by(d, last)
        missing, update = jnp.where(is_hard, jnp.stack([d - last.d, d]), jnp.stack([now.d, last.d]))
        error = max_abs(missing) / (max_abs(update) + jnp.finfo(float).tiny)
        return now._replace(slow_model_error=jnp.where(last.passes > 0, error, last.slow_model_error))

    def _moved_by(self, d, last: Pass) -> Pass:
        """The pass after the update d, with its own next update, and with the `Result` of the iteration so far."""
        equations, is_first = self.equations, last.passes == 0
        slow, slow_multiplier = last.slow + d.reshape(last.slow.shape), last.slow_multiplier
        fast, end, moved = self.sweep.corrected(slow, last.fast, is_first)
        inertia = last.inertia
        if inertia.responses.size:
            of_first = jax.tree.map(lambda a: a[0], fast.schur_inverse)
            inertia = only_if(is_first, lambda _: self.slow_equations.constraint_inertia(of_first), inertia)
        update, rows, p_s = self.slow_equations.update(slow, slow_multiplier, end, inertia)
        next_d, d_multiplier = update
        inverse_fast = self.mass.fast_mass.inverse().times
        arrives, leaves = inverse_fast(equations.micro_dt * equations.p_f), inverse_fast(end.p_f)
        # size of the fast motion: largest |h M_f^-1 p_f| at both ends of the macro step
        motion, still_moves = jnp.maximum(max_abs(arrives), max_abs(leaves)), expected(moved, last.moved)
        passes = last.passes + 1
        ratio = self.accepted.ratio((max_abs(next_d), still_moves), (max_abs(slow), motion), passes)
        rows = jnp.maximum(max_abs(rows), max_abs(self.mass.fast) * still_moves)
        return last._replace(
            slow=slow,
            slow_multiplier=slow_multiplier + d_multiplier,
            fast=fast,
            end=end,
            moved=moved,
            d=next_d,
            inertia=inertia,
            p_s=p_s,
            rows=rows,
            passes=passes,
            result=self.settings.status(ratio, passes),
        )
