"""The march as a solver: passes until the corrections are small enough, see `vmri_jax.steppers.march`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import CONTRACTION, max_abs
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.accept import FLOOR_OF_NEWTON, Accepted, expected
from vmri_jax.steppers.continuation import solve_in_parts, with_dependent_constraints
from vmri_jax.steppers.march import (
    MarchEquations,
    Matrices,
    Passed,
    Worst,
    exact_pass,
    further_pass,
    inverse_with_multipliers,
)
from vmri_jax.steppers.newton import null_space
from vmri_jax.steppers.predictors import PolynomialPredictor
from vmri_jax.steppers.results import RUNNING, Method, Result
from vmri_jax.steppers.solved import Solution, Solver, ended, largest_constraint, status_of
from vmri_jax.steppers.solvers import Newton

PLAIN_PASSES = 30
"""Most passes of an attempt at the whole step, before parts of it are tried. Newton's method needs at most 15 from a good guess, and half of
the passes are exact ones. With more, runs that fail take longer; with fewer, parts are tried where they are not needed."""
INVERSES: dict[str, Callable] = {
    "arrowhead": inverse_with_multipliers,
    "null_space": null_space.inverse_without_multipliers,
}
"""How the matrices of micro intervals and of the slow equations are inverted."""


class MarchMemory(NamedTuple):
    """What a macro step hands to the next one.

    slow: the past of the slow unknowns, step by step.
    fast: unknowns of the last micro interval.
    matrices: of the last exact pass.
    rate: by which passes with them made the corrections smaller, the last time; infinite where there are no matrices.
    """

    slow: PolynomialPredictor
    fast: Float[Array, "k"]
    matrices: Matrices
    rate: Float[Array, ""]


class Progress(NamedTuple):
    """Where the iteration is.

    passed: the last pass.
    matrices: of the last exact pass.
    size: its largest correction, of slow and fast increments.
    rate: expected ratio of the next correction to this one with the matrices that are kept.
    curvature: kappa in ``|d_next| = kappa |d|^2`` for passes after an exact one with the correction d.
    exact_size: size of the last exact pass.
    still_moves: largest correction of fast increments that is expected of another pass.
    passes, result: how many passes there were, and `Result`.
    """

    passed: Passed
    matrices: Matrices
    size: Float[Array, ""]
    rate: Float[Array, ""]
    curvature: Float[Array, ""]
    exact_size: Float[Array, ""]
    still_moves: Float[Array, ""]
    passes: Int[Array, ""]
    result: Int[Array, ""]


@dataclass(frozen=True)
class Marched(Solver):
    """Passes until one more would change neither the slow increments nor those of the micro intervals.

    linear_solver: "arrowhead", elimination with multipliers, or "null_space", without them.
    sizes: (n_s, n_gs, n_f, n_g) and the degree, which are told where multipliers are eliminated.
    """

    newton: Newton
    linear_solver: str
    sizes: tuple[int, int, int, int, int] | None = None

    def remembers(self, equations: StepEquations, guess: Unknowns) -> MarchMemory:
        march = self._march(equations)
        z, x = march.rows(guess)
        return MarchMemory(PolynomialPredictor.constant(z), x[0], march.no_matrices(), jnp.asarray(jnp.inf))

    def solve(self, equations: StepEquations, guess: Unknowns, memory: MarchMemory) -> tuple[Solution, MarchMemory]:
        march = self._march(equations)
        z, x = march.rows(guess)
        zero, infinite = jnp.zeros(()), jnp.asarray(jnp.inf)
        start = Progress(
            passed=Passed(z, x, z, x, march.start(), equations.p_s, Worst.none()),
            matrices=memory.matrices,
            size=infinite,
            rate=memory.rate,
            curvature=zero,
            exact_size=infinite,
            still_moves=zero,
            passes=jnp.asarray(0),
            result=jnp.asarray(RUNNING),
        )
        if self.newton.fixed_iterations is not None:
            done = self._iterate(march, guess, start, memory, None)
            return self._solution(march, done, ended(done.result), done.passes), self._learned(march, memory, done)

        def part(equations, guess, limit, is_first):
            done = self._iterate(self._march(equations), guess, start, memory, limit, is_first)
            return done, march.by_name(done.passed.z, done.passed.x), done.result, done.passes

        parts = solve_in_parts(equations, guess, start, part, self.newton.max_iterations, PLAIN_PASSES)
        done = parts.solution
        return self._solution(march, done, parts.result, parts.iterations), self._learned(march, memory, done)

    def _march(self, equations: StepEquations) -> MarchEquations:
        return MarchEquations(equations, INVERSES[self.linear_solver])

    def _iterate(
        self, march: MarchEquations, guess: Unknowns, start: Progress, memory: MarchMemory, limit, is_first: Any = True
    ) -> Progress:
        """Passes, at most `limit`: of the first attempt from what the steps before lead to, of others from the guess."""
        accepted, fixed = Accepted.of(march.equations, self.newton), self.newton.fixed_iterations
        z, x = march.rows(guess)
        z = jnp.where(is_first, memory.slow.next(march.num_slow), z)
        at = start._replace(
            passed=start.passed._replace(z=z, x=x, dz=jnp.zeros_like(z), dx=jnp.zeros_like(x)),
            rate=jnp.where(is_first, memory.rate, jnp.inf),
        )

        def judged(now: Passed, before: Progress) -> Progress:
            slow, fast = max_abs(now.dz[: march.num_slow]), now.worst.moved
            still_moves = jnp.where(before.passes > 0, expected(fast, before.passed.worst.moved), fast)
            motions = max_abs(now.z[: march.num_slow]), max_abs(now.x[:, : march.num_fast])
            passes, size = before.passes + 1, jnp.maximum(slow, fast)
            over = accepted.over((slow, still_moves), motions, passes)
            at_floor = accepted.at_floor(size, before.size)
            result = jnp.where(over <= 1, Result.CONVERGED, jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, RUNNING))
            if limit is not None:
                failed = jnp.where(size > before.size, Result.DIVERGED, Result.STAGNATED)
                result = jnp.where((passes >= limit) & (result == RUNNING), failed, result)
            # the prediction was poor: the next attempt starts from straight motion
            lost = is_first & (size > before.size)
            result = jnp.where(lost & (result == RUNNING), Result.DIVERGED, result)
            broken = jnp.where(now.worst.is_singular, Result.SINGULAR, Result.NON_FINITE)
            result = jnp.where(jnp.isfinite(over), result, broken)
            return before._replace(passed=now, size=size, still_moves=still_moves, passes=passes, result=result)

        def unknowns(at: Progress) -> tuple:
            passed = at.passed
            return passed.z + passed.dz, passed.x + passed.dx, memory.fast, is_first & (at.passes == 0)

        def exact(at: Progress) -> Progress:
            matrices, now = exact_pass(march, *unknowns(at))
            after = judged(now, at)
            at_floor = (after.result == RUNNING) & accepted.at_floor(after.size, at.size, FLOOR_OF_NEWTON)
            result = jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, after.result)
            rate = after.curvature * after.size
            return after._replace(matrices=matrices, rate=rate, exact_size=after.size, result=result)

        def further(at: Progress) -> Progress:
            now = judged(further_pass(march, at.matrices, *unknowns(at)), at)
            rate = jnp.where(at.passes > 0, now.size / at.size, at.rate)
            return now._replace(rate=rate, curvature=jnp.maximum(at.curvature, rate / at.exact_size))

        def passes(at: Progress) -> Progress:
            """Passes with the matrices that are kept, and exact ones where they are not enough.

            Both are loops: in a batch, a branch of `jax.lax.cond` would be computed in every turn, whether or not a lane takes it.
            """
            at = jax.lax.while_loop(lambda at: (at.result == RUNNING) & (at.rate <= CONTRACTION), further, at)
            return jax.lax.while_loop(lambda at: (at.result == RUNNING) & ~(at.rate <= CONTRACTION), exact, at)

        return self.newton.iterate(passes if fixed is None else exact, at)

    def _solution(self, march: MarchEquations, done: Progress, result, passes) -> Solution:
        equations, passed = march.equations, done.passed
        x = march.by_name(passed.z, passed.x)
        end = passed.end.position, passed.p_s, passed.end.rest[: march.n_f] / equations.micro_dt
        shrinks = done.still_moves / jnp.maximum(passed.worst.moved, jnp.finfo(float).tiny)
        rows, g = passed.worst.rows * jnp.minimum(shrinks, 1.0), largest_constraint(equations, x)
        method = Method[self.linear_solver.upper()]
        status = status_of(equations, result, method, passes, rows, g, self.newton.tolerance)
        return Solution(x, end, with_dependent_constraints(equations, status))

    def _learned(self, march: MarchEquations, memory: MarchMemory, done: Progress) -> MarchMemory:
        passed = done.passed
        return MarchMemory(memory.slow.add(passed.z, march.num_slow), passed.x[-1], done.matrices, done.rate)

    def describe(self) -> list[str]:
        head = f"march over the micro intervals with exact matrices, {self.linear_solver.replace('_', ' ')}"
        if self.linear_solver != "null_space" or self.sizes is None:
            return [head]
        *counts, r = self.sizes
        parts = zip(("slow variables", "each micro interval"), counts[::2], counts[1::2], strict=True)
        few = [f"  unknowns of {what}: {r * (n - g)}, with multipliers {r * (n + g)}" for what, n, g in parts if g]
        return [head, *few]
