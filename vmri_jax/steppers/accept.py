"""When the corrections of a step are small enough: one test for all solvers, with one meaning of `Newton.tolerance`.

The next correction c of the slow (or of the fast) increments need not be made if

    max |c|  <=  tolerance / 10 * max |increments|  +  4 eps max |positions|  +  eps max |all increments|

each with its own increments and positions: those of the slow variables over the macro step, those of the fast ones over a micro
interval. The error of a step is the sum of the corrections that were not made, and the errors of all steps add up: hence the tenth.
Positions cannot be known better than their round-off. The last term is for variables at rest, whose increments have no size of
their own.

Solvers know the next correction from the residual, or expect it from how the last ones shrank (`expected`). Corrections that have stopped
shrinking near round-off are accepted, too (`Accepted.at_floor`).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics.arrays import Number
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.schemes.equations import StepEquations

ROUNDOFF = 4.0
"""Units of round-off of the positions below which a correction is accepted. With fewer, steps at round-off would not end; with more,
the momenta would lose digits."""
PATIENCE = 20
"""Iterations after which the round-off of tied variables is accepted too: constraints hand it from slow to fast variables and back. With
fewer, slow variables at the origin would be solved to fewer digits."""
FLOOR = 100.0
"""Units of round-off of the positions below which corrections that no longer shrink are accepted. Nearly dependent constraints
let corrections wander there; with more, steps that converge slowly would be cut off."""
FLOOR_OF_NEWTON = 1e5
"""The same for a pass with exact matrices. Near a regular solution its correction shrinks, unless the residual is nothing but round-off
of the constraints, which rows that hardly depend on the fast variables magnify. With more, singular solutions are taken for regular ones."""
SAFETY = 10.0
"""Factor between the tolerance of a run and that of a correction, since errors of steps add up. A larger one costs passes."""
MARGIN = 10.0
"""Factor on the contraction of the last two corrections that is expected of the next one. A larger one costs passes; with a smaller one an
iteration that shrinks by luck ends too early."""


class Accepted(NamedTuple):
    """Changes of the increments that are accepted: relative to the motion over the step, and round-off of the positions.

    tolerance: of Newton, over `SAFETY`, since what is left of every step adds up.
    slow, fast: round-off, (2,): of these variables alone, and with that of variables that constraints tie to them. At the origin
        they have none of their own.
    stopped: round-off of positions at which corrections may stop shrinking. Coordinates of a kinetic energy that is a function may be
        angles: where bodies are is known to no more digits than with angles of one radian, also at angles near zero.
    """

    tolerance: Number
    slow: Float[Array, "2"]
    fast: Float[Array, "2"]
    stopped: Float[Array, ""]

    @classmethod
    def of(cls, equations: StepEquations, newton) -> "Accepted":
        """For a step from its positions."""
        slow, fast = max_abs(equations.q_s), max_abs(equations.q_f)
        to_slow = to_fast = 0.0
        largest = jnp.maximum(slow, fast)
        largest = largest if equations.system.has_constant_mass else jnp.maximum(largest, 1.0)
        if equations.system.constraint is not None and equations.q_s.size and equations.q_f.size:
            to_slow = to_fast = 1.0
            masses = equations.system.kinetic
            if isinstance(masses, ConstantMass):
                m_s, m_f = (mass.times(jnp.ones(mass.size)) for mass in (masses.slow_mass, masses.fast_mass))
                to_slow, to_fast = (jnp.minimum(1.0, jnp.max(a) / jnp.min(b)) for a, b in ((m_f, m_s), (m_s, m_f)))
        floors = (
            jnp.stack([slow, jnp.maximum(slow, to_slow * fast)]),
            jnp.stack([fast, jnp.maximum(fast, to_fast * slow)]),
        )
        roundoff = (ROUNDOFF * jnp.finfo(float).eps * floor for floor in (*floors, largest))
        return cls(newton.tolerance / SAFETY, *roundoff)

    def sizes(self, motions, iterations) -> tuple[Any, Any]:
        """The changes (slow, fast) that are accepted with these motions after this number of iterations."""
        numbers = jnp.finfo(float)
        rest = numbers.eps * jnp.maximum(*motions) + numbers.tiny  # variables at rest have no size of their own
        late = (iterations >= PATIENCE) * 1
        floors = self.slow[late], self.fast[late]
        slow, fast = (self.tolerance * size + floor + rest for size, floor in zip(motions, floors, strict=True))
        return slow, fast

    def at_floor(self, size, before, floor=FLOOR):
        """Whether corrections have stopped shrinking at or below `floor` units of round-off of the positions."""
        return (size > before / 2) & self.is_roundoff(size, floor)

    def is_roundoff(self, size, floor=FLOOR):
        """Whether a correction is at most `floor` units of round-off of the positions."""
        return size <= floor / ROUNDOFF * self.stopped

    def over(self, changes, motions, iterations):
        """Changes (slow, fast) over what is accepted of them, see `sizes`; the larger of the two."""
        return jnp.maximum(*(c / size for c, size in zip(changes, self.sizes(motions, iterations), strict=True)))


def expected(moved, before):
    """The correction ``min(MARGIN moved / before, 1) moved`` that is expected after the corrections `before` and `moved`."""
    return jnp.minimum(MARGIN * moved / (before + jnp.finfo(float).tiny), 1.0) * moved
