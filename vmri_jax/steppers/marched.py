"""The march as a solver: passes until the corrections are small enough, see `vmri_jax.steppers.march`."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import CONTRACTION
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.accept import FLOOR_OF_NEWTON, NO_WEIGHTS, Accepted, Weights, expected, is_solved
from vmri_jax.steppers.continuation import solve_in_parts, with_dependent_constraints
from vmri_jax.steppers.march import MarchEquations, Matrices, Passed, Worst, kept_pass, linearised_pass
from vmri_jax.steppers.null_space import inverse_with_multipliers, inverse_without_multipliers
from vmri_jax.steppers.predictors import PolynomialPredictor
from vmri_jax.steppers.results import RUNNING, Method, Result
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import Solver, iterated, only_if

PLAIN_PASSES = 30
"""Most passes of an attempt at the whole step, before parts of the step are tried. Newton's method needs at most 15
exact passes from a good guess, and about half of the passes are exact. A larger number makes failing runs slower; a
smaller one tries parts without need."""


class MarchMemory(NamedTuple):
    """Memory that a macro step hands to the next one.

    path: predictor of the slow unknowns z, or of the unknowns x of a single interval without slow unknowns.
    fast: unknowns of the last micro interval.
    matrices: the last ones.
    rate: ratio of the last two corrections with these matrices, of the masses the largest ratio; infinite if there are
        none. Corrections at round-off do not count.
    """

    path: PolynomialPredictor
    fast: Float[Array, "k"]
    matrices: Matrices
    rate: Float[Array, ""]


class Progress(NamedTuple):
    """State of the iteration.

    passed: the last pass.
    matrices: the last ones.
    size: largest correction ``|d|`` of slow and fast increments in the last pass.
    rate: expected ratio ``|d_next| / |d|`` with the kept matrices.
    curvature: kappa, with ``|d_next| = kappa |d_new| |d|`` for passes that keep exact matrices: the simplified Newton
        iteration converges linearly, at a rate that is proportional to the correction d_new of the first pass with
        them.
    new_size: ``|d_new|``; infinite before there are new matrices.
    still_moves: correction of the fast increments that the next pass is expected to make.
    passes, result: number of passes, and `Result` or RUNNING.
    """

    passed: Passed
    matrices: Matrices
    size: Float[Array, ""]
    rate: Float[Array, ""]
    curvature: Float[Array, ""]
    new_size: Float[Array, ""]
    still_moves: Float[Array, ""]
    passes: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Marched(StepSolver):
    """Passes until the next one would change neither the slow nor the fast increments.

    settings: of the iteration; its matrix is "exact", "masses", or "null_space", which is exact and eliminates without
        multipliers.
    sizes: (n_s, n_gs, n_f, n_g) and the degree r, for `describe` of the null space method.

    There are new matrices where the old ones contract too slowly: exact ones in every pass, those of the masses before
    the first pass of an attempt.
    """

    settings: Solver
    sizes: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)

    def init(self, equations: StepEquations) -> MarchMemory:
        march = self._march(equations, NO_WEIGHTS)
        matrices = march.no_matrices()
        slow, fast = len(matrices.slow), matrices.inverse.shape[-1]
        path = PolynomialPredictor.empty(slow if march.has_slow_path else fast)
        return MarchMemory(path, jnp.zeros(fast), matrices, jnp.asarray(jnp.inf))

    def solve(self, equations: StepEquations, guess: Unknowns, memory: MarchMemory) -> tuple[Solution, MarchMemory]:
        weights = Weights.of(equations)
        march = self._march(equations, weights)
        accepted = Accepted.of(equations, self.settings, weights).with_constraints(equations, weights)
        z, x = march.flat(guess)
        zero, infinite = jnp.zeros(()), jnp.asarray(jnp.inf)
        start = Progress(
            passed=Passed(z, x, z, x, march.start(), equations.p_s, Worst.none()),
            matrices=memory.matrices,
            size=infinite,
            rate=memory.rate,
            curvature=zero,
            new_size=infinite,
            still_moves=zero,
            passes=jnp.asarray(0),
            result=jnp.asarray(RUNNING),
        )

        def part(equations, guess, limit, is_first):
            of_part = self._march(equations, weights)
            done = self._iterate(of_part, accepted, guess, start, memory, limit, is_first)
            return done, march.by_name(done.passed.z, done.passed.x), done.result, done.passes

        parts = solve_in_parts(equations, guess, start, part, self.settings.max_iterations, PLAIN_PASSES)
        done = parts.solution
        passed = done.passed
        path = memory.path.add(*march.predicted(passed.z, passed.x))
        learned = MarchMemory(path, passed.x[-1], done.matrices, done.rate)
        return self._solution(march, done, parts.result, parts.iterations), learned

    @property
    def is_exact(self) -> bool:
        return self.settings.matrix != "masses"

    def _pass(self, march: MarchEquations, renews, last: Progress, start) -> tuple[Matrices, Passed]:
        """A pass from `start`, the unknowns as in `linearised_pass`, with new matrices if `renews`, else with the last
        ones."""
        if not self.is_exact:
            return last.matrices, kept_pass(march, last.matrices, *start)
        matrices, now = only_if(renews, lambda _: linearised_pass(march, *start)[:2], (last.matrices, last.passed))
        return matrices, only_if(~renews, lambda _: kept_pass(march, matrices, *start), now)

    def _prepared(self, march: MarchEquations, progress: Progress, last, from_last) -> Progress:
        """The start of an attempt, with new matrices of the masses: outside of the loop of passes, which XLA compiles
        as a whole."""
        if self.is_exact:
            return progress
        z, x = progress.passed.z, progress.passed.x
        renews = ~(progress.rate <= CONTRACTION)

        def by_masses(_):
            return linearised_pass(march.by_masses(), z, x, last, from_last, corrects=False)[0]

        matrices = only_if(renews, by_masses, progress.matrices)
        return progress._replace(matrices=matrices, rate=jnp.where(renews, 0.0, progress.rate))

    def _march(self, equations: StepEquations, weights: Weights) -> MarchEquations:
        is_null_space = self.settings.matrix == "null_space"
        inverted = inverse_without_multipliers if is_null_space else inverse_with_multipliers
        return MarchEquations(equations, inverted, weights)

    def _iterate(
        self,
        march: MarchEquations,
        accepted: Accepted,
        guess: Unknowns,
        start: Progress,
        memory: MarchMemory,
        limit,
        is_first,
    ) -> Progress:
        """At most `limit` passes.

        The first attempt starts from the predicted unknowns, later attempts from the guess.
        """
        z, x = march.flat(guess)
        unknowns, measured = march.predicted(z, x)
        unknowns = jnp.where(is_first, memory.path.next(measured, unknowns), unknowns)
        z, x = (unknowns, x) if march.has_slow_path else (z, unknowns[None])
        is_predicted = is_first & ~memory.path.is_empty & march.has_slow_path
        progress = start._replace(
            passed=start.passed._replace(z=z, x=x, dz=jnp.zeros_like(z), dx=jnp.zeros_like(x)),
            rate=jnp.where(is_first, memory.rate, jnp.inf),
        )

        def is_roundoff(now: Passed):
            """Whether the residual is round-off of the momenta; masses in one unit alone can tell."""
            if march.weights is NO_WEIGHTS:
                return False
            return is_solved(now.worst.rows, (march.slow_size(now.z), march.fast_size(now.x)))

        def judged(now: Passed, before: Progress) -> Progress:
            slow, fast = march.slow_size(now.dz), now.worst.moved
            # dz is the next slow correction itself; the next fast one is expected from the last two, or without a pair
            # from the last one
            still_moves = jnp.where(before.passes > 0, expected(fast, before.passed.worst.moved), fast)
            motions = march.slow_size(now.z), march.fast_size(now.x)
            passes, size = before.passes + 1, jnp.maximum(slow, fast)
            ratio = accepted.ratio((slow, still_moves), motions, passes)
            # a first correction that is round-off: the prediction was exact, and matrices that contract leave less than
            # the floor of the next
            at_floor = accepted.at_floor(size, jnp.where(before.passes > 0, before.size, 0.0))
            at_floor |= (size > before.size / 2) & is_roundoff(now)
            result = jnp.where(ratio <= 1, Result.CONVERGED, jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, RUNNING))
            failed = jnp.where(size > before.size, Result.DIVERGED, Result.STAGNATED)
            result = jnp.where((passes >= limit) & (result == RUNNING), failed, result)
            # a correction that grows in the first attempt: the prediction was poor, and the next attempt starts from
            # straight motion
            lost = is_first & (size > before.size)
            result = jnp.where(lost & (result == RUNNING), Result.DIVERGED, result)
            broken = jnp.where(now.worst.is_singular, Result.SINGULAR, Result.NON_FINITE)
            result = jnp.where(jnp.isfinite(ratio), result, broken)
            return before._replace(passed=now, size=size, still_moves=still_moves, passes=passes, result=result)

        def step(last: Progress) -> Progress:
            # every interval of the very first pass starts from the corrected unknowns of the interval before
            from_last = is_predicted & (last.passes == 0)
            start = last.passed.z + last.passed.dz, last.passed.x + last.passed.dx, memory.fast, from_last
            renews = ~(last.rate <= CONTRACTION) & self.is_exact
            matrices, now = self._pass(march, renews, last, start)
            after = judged(now, last)
            at_floor = renews & accepted.at_floor(after.size, last.size, FLOOR_OF_NEWTON)
            result = jnp.where(at_floor & (after.result == RUNNING), Result.CONVERGED_AT_ROUNDOFF, after.result)
            # corrections at round-off do not tell how fast the iteration contracts
            is_noise = accepted.is_roundoff(last.size) | is_roundoff(now)
            ratio = jnp.where((last.passes > 0) & ~is_noise, after.size / last.size, last.rate)
            curvature = jnp.maximum(last.curvature, jnp.where(renews, 0.0, ratio / last.new_size))
            kept = ratio if self.is_exact else jnp.maximum(ratio, last.rate)
            rate = jnp.where(renews, curvature * after.size, kept)  # kappa |d_new|
            new_size = jnp.where(renews, after.size, last.new_size)
            return after._replace(matrices=matrices, rate=rate, curvature=curvature, new_size=new_size, result=result)

        return iterated(step, self._prepared(march, progress, memory.fast, is_predicted))

    def _solution(self, march: MarchEquations, done: Progress, result, passes) -> Solution:
        equations, passed = march.equations, done.passed
        x = march.by_name(passed.z, passed.x)
        end = passed.end.position, passed.p_s, passed.end.gradients[: march.n_f] / equations.micro_dt
        # The residual after the last correction is not evaluated. Estimate: it has shrunk like the fast corrections,
        # |R| = |R before the correction| min(1, expected correction / last correction).
        shrinks = done.still_moves / jnp.maximum(passed.worst.moved, jnp.finfo(float).tiny)
        rows = passed.worst.rows * jnp.minimum(shrinks, 1.0)
        method = Method[self.settings.matrix.upper()]
        status = status_of(equations, result, method, passes, rows=rows, end=end, weights=march.weights)
        if self.is_exact:  # else the fallback names the cause
            status = with_dependent_constraints(equations, status)
        return Solution(x, end, status)

    def describe(self) -> list[str]:
        if not self.is_exact:
            return ["masses: micro intervals in order with matrices of the masses at the start of the step"]
        if self.settings.matrix == "exact":
            return ["exact: micro intervals in order with exact matrices"]
        head = "null_space: micro intervals in order with exact matrices, without multipliers"
        *counts, r = self.sizes
        parts = zip(("slow variables", "each micro interval"), counts[::2], counts[1::2], strict=True)
        unknowns = [f"  unknowns of {part}: {r * (n - g)}, with multipliers {r * (n + g)}" for part, n, g in parts if g]
        return [head, *unknowns]
