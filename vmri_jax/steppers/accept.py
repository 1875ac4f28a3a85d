"""When the corrections of a step are small enough: the test of all solvers, and the meaning of `Solver.tolerance`.

A solver may omit the next correction c of the slow (or of the fast) increments if

    max |c|  <=  tolerance / 10 * max |increments|  +  4 eps max |positions|  +  eps max |all increments|

The slow variables have their increments over the macro step and their positions on the right-hand side, the fast
variables their increments over a micro interval and their positions. A solver may take the largest free motion
``|h M^-1 p|`` for the size of the increments. Maxima compare numbers of one unit: if masses are constant, slow and fast
variables as they are; else numbers times `Weights`.

- The test is of one correction, of the slow variables and of the fast ones in each micro interval. Omitted corrections
  of intervals and of steps add up, and so do the corrections after them: the tenth is a safety factor for that. With
  100 micro steps the error of a macro step may be some times the tolerance of a micro step's increments, far below that
  of its own.
- Positions are known up to their round-off.
- Variables at rest have increments of size zero: the last term allows them the round-off of the other increments.

Solvers compute the next correction from the residual, or extrapolate it from the last two (`expected`). The march
(`vmri_jax.steppers.marched`) also accepts corrections that no longer shrink near round-off, of the positions
(`Accepted.at_floor`) or of the momentum equations (`is_solved`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.arrays import Number, split_at
from vmri_jax.schemes.equations import StepEquations

ROUNDOFF = 4.0
"""Accepted correction in units of ``eps max |positions|``. With a smaller value steps at round-off would not end; with
a larger one the momenta would lose digits."""
ITERATIONS_BEFORE_TIED_ROUNDOFF = 20
"""Iterations after which slow variables are also allowed the round-off of the fast ones, and these the round-off of the
slow ones: constraints carry it from one to the other. With a smaller number slow variables near the origin, whose own
round-off is small, would lose digits."""
FLOOR = 100.0
"""Largest correction, in units of ``eps max |positions|``, that is accepted if corrections no longer shrink: with
nearly dependent constraints they fluctuate at this size. A larger value would cut off steps that converge slowly."""
FLOOR_OF_NEWTON = 1e5
"""`FLOOR` for a pass with exact matrices. Near a regular solution the corrections of such passes shrink down to
round-off times the condition number of the constraint Jacobian, which is large if constraints hardly depend on the fast
variables: up to this size they count as round-off. A larger value would accept singular solutions, near which
corrections also stop shrinking."""
SAFETY = 10.0
"""Tolerance of a run over tolerance of a correction, since errors of steps accumulate. A larger factor costs passes."""
MARGIN = 10.0
"""Safety factor on the contraction ``|d_k| / |d_(k-1)|`` that is expected of the next correction. A larger factor costs
passes; with a smaller one an iteration whose correction is small by chance ends too early."""


class Weights(NamedTuple):
    """Factors that give all variables the same unit: the square roots of their masses, of a kinetic energy that is a
    function.

    Variables with constant masses have no factors, None: with the square roots of masses a light body would be computed
    to fewer digits than a heavy one. They have one unit, of which the library knows nothing.
    """

    slow: Any
    fast: Any

    @classmethod
    def of(cls, equations: StepEquations) -> "Weights":
        """The weights at the start of a step."""
        if equations.masses is None:
            return NO_WEIGHTS
        return cls(*map(jnp.sqrt, equations.mass_diagonal()))

    def of_momenta(self) -> "Weights":
        """The weights of momenta and of the rows of momentum equations."""
        return Weights(*(w if w is None else 1 / w for w in self))

    def largest(self, slow, fast):
        """The largest slow and the largest fast number, (..., n) each, with these weights."""
        return largest(slow, self.slow), largest(fast, self.fast)


NO_WEIGHTS = Weights(None, None)


def largest(numbers, weights=None):
    """The largest absolute value of numbers times weights."""
    return max_abs(numbers if weights is None else numbers * weights)


class Accepted(NamedTuple):
    """Accepted corrections of the increments: a part relative to the motion over the step, and a part for round-off of
    the positions.

    tolerance: `Solver.tolerance` over `SAFETY`.
    slow, fast: accepted round-off. First entry: of these variables, used in the first `ITERATIONS_BEFORE_TIED_ROUNDOFF`
        iterations. Second entry, used later: with the round-off of the variables that constraints tie to them.
    roundoff: `ROUNDOFF` units of round-off of all positions, ``4 eps max |q|``, for `at_floor`.
    constraints: the same with `constraint_length` in place of the positions; zero where a solver does not use
        `at_floor`.
    """

    tolerance: Number
    slow: Float[Array, "2"]
    fast: Float[Array, "2"]
    roundoff: Float[Array, ""]
    constraints: Number = 0.0

    @classmethod
    def of(cls, equations: StepEquations, settings, weights: Weights = NO_WEIGHTS) -> "Accepted":
        """The accepted corrections of a step, from the positions at its start, with the weights of corrections."""
        slow, fast = weights.largest(equations.q_s, equations.q_f)
        either = jnp.maximum(slow, fast)
        # a constraint g(q_s, q_f) carries the round-off of q_f to q_s, and vice versa
        tied = (either, either) if equations.system.constraint is not None else (slow, fast)
        floors = jnp.stack([slow, tied[0]]), jnp.stack([fast, tied[1]]), either
        roundoff = (ROUNDOFF * jnp.finfo(float).eps * floor for floor in floors)
        return cls(settings.tolerance / SAFETY, *roundoff)

    def at_floor(self, size, before, floor=FLOOR):
        """Whether corrections no longer shrink, from `before` to `size`, and are round-off, see `is_roundoff`. With
        `before` zero, in a first pass, round-off is enough.
        """
        return (size > before / 2) & self.is_roundoff(size, floor)

    def with_constraints(self, equations: StepEquations, weights: Weights) -> "Accepted":
        """The same with the round-off of constraints."""
        return self._replace(constraints=ROUNDOFF * jnp.finfo(float).eps * constraint_length(equations, weights))

    def is_roundoff(self, size, floor=FLOOR):
        """Whether a correction is at most `floor` units ``eps max |positions|``, or `FLOOR` units of the round-off of
        constraints."""
        # `roundoff` and `constraints` count ROUNDOFF of these units
        return (size <= floor / ROUNDOFF * self.roundoff) | (size <= FLOOR / ROUNDOFF * self.constraints)

    def ratio(self, changes, motions, iterations):
        """Ratio of the next corrections (slow, fast) to the right-hand sides of the formula at the top of this module,
        the larger of the two.

        Args:
            changes: largest next corrections (slow, fast).
            motions: largest increments (slow, fast).
            iterations: iterations so far.
        """
        numbers = jnp.finfo(float)
        at_rest = numbers.eps * jnp.maximum(*motions) + numbers.tiny
        late = (iterations >= ITERATIONS_BEFORE_TIED_ROUNDOFF) * 1
        # where a correction is larger than the motion, as from rest at the origin, the ratio is 1 / tolerance and does
        # not overflow
        pairs = zip(changes, map(jnp.maximum, motions, changes), (self.slow[late], self.fast[late]), strict=True)
        return jnp.maximum(*(change / (self.tolerance * size + floor + at_rest) for change, size, floor in pairs))


def is_solved(rows, motions):
    """Whether a residual is round-off of the momenta, ``4 eps max sqrt(M) |increments|``. Masses whose condition number
    is large make more of it than round-off of the increments: a chain of 100 bars has corrections ``M^-1 R`` of 1e-11
    of them.

    Args:
        rows: largest residual of the momentum equations, times h, with the weights of momenta.
        motions: largest increments (slow, fast), with `Weights`.
    """
    return rows <= ROUNDOFF * jnp.finfo(float).eps * jnp.maximum(*motions)


def constraint_length(equations: StepEquations, weights: Weights):
    """Largest radius of curvature of the constraints at the start of a step,
    ``max_i |e . grad g_i| / |e^T (hess g_i) e|`` along a direction e.

    A constraint has the round-off of the lengths in it, which may be far larger than the positions: for
    ``g = |q - c| - R`` with q near the origin it moves q by ``eps R``. Straight constraints count as zero. The
    direction e is arbitrary, but the same in all steps.
    """
    system, n_s = equations.system, equations.q_s.size
    if not system.is_constrained:
        return jnp.zeros(())
    q = jnp.concatenate([equations.q_s, equations.q_f])
    e = np.random.default_rng(0).normal(size=q.size)
    e = e / np.linalg.norm(e)
    if weights.slow is not None:
        e = e / jnp.concatenate(weights)

    def along(q):
        return jax.jvp(lambda q: system.constraints(equations.t, *split_at(q, n_s)), (q,), (e,))[1]

    slope, curvature = (jnp.abs(a) for a in jax.jvp(along, (q,), (e,)))
    is_curved = curvature > 0
    return jnp.max(slope / jnp.where(is_curved, curvature, 1.0), where=is_curved, initial=0.0)


def expected(moved, before):
    """The expected next correction ``min(MARGIN moved / before, 1) moved`` after the corrections `before` and then
    `moved`."""
    return jnp.minimum(MARGIN * moved / (before + jnp.finfo(float).tiny), 1.0) * moved
