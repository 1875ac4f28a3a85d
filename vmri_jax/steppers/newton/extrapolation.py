"""Extrapolation of the unknowns: the slow ones from step to step, the fast ones from micro interval to micro interval."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.cpu import ordered

ORDER = 10
"""Highest order of the polynomials."""
INFINITE = int(np.float64(np.inf).view(np.int64))
"""From here on `ordered` numbers are those of a step that failed."""
FADING = 1 << 50
"""`ordered` numbers are nearly logarithms: this makes a miss smaller by a sixth with every step."""
PLACES = 16
"""A power of two, more than there are orders."""


class Differences(NamedTuple):
    """values (ORDER + 2, n): backward differences ``d_0 = x_n``, ``d_(j+1) = d_j(x_n) - d_j(x_(n-1))``.

    The polynomial of order k through the last k + 1 values goes on with ``d_0 + ... + d_k``, and d_(k+1) is by how much that
    of the step before missed x_n. Few or rough steps ask for a low order, smooth ones for a high one.

    past (ORDER + 1,): the worst misses before those, `ordered` and fading: one lucky step is not to decide.
    """

    values: Any
    past: Any

    @classmethod
    def constant(cls, x) -> "Differences":
        """A past in which nothing changed."""
        return cls(jnp.zeros((ORDER + 2, x.size)).at[0].set(x), jnp.zeros(ORDER + 1, int))

    def next(self, measured: int):
        """Where the values go on, by the order that has missed the first `measured` entries least."""
        with_order = (self._missed(measured) & -PLACES) + jnp.arange(ORDER + 1)  # the last places hold the order
        best = jnp.min(with_order) & (PLACES - 1)
        taken = jnp.arange(ORDER + 2) <= best
        return jnp.sum(jnp.where(taken[:, None], self.values, 0.0), axis=0)

    def add(self, x, measured: int) -> "Differences":
        """With one more step."""
        rows = [x]
        for before in self.values[:-1]:
            rows.append(rows[-1] - before)
        missed = self._missed(measured)
        return Differences(jnp.stack(rows), jnp.where(missed < INFINITE, missed - FADING, 0))

    def _missed(self, measured: int):
        """(ORDER + 1,) by how much each order has missed, `ordered`."""
        return jnp.maximum(jnp.max(ordered(self.values[1:, :measured]), axis=1, initial=0), self.past)


class Line(NamedTuple):
    """Values of the micro intervals one after the other, extrapolated by the line through the last two.

    A kick at the macro nodes, or half of their constraint force, lets the first value of every macro step stand out from
    its neighbours.

    last (2, ...): of the last two intervals, the last one first, without what stands out.
    jump (...): by how much the first one of a macro step stands out; None if it does not.
    """

    last: Any
    jump: Any

    @classmethod
    def zero(cls, shape: tuple[int, ...], stands_out: bool) -> "Line":
        """The start of a run."""
        return cls(jnp.zeros((2, *shape)), jnp.zeros(shape) if stands_out else None)

    def next(self, m):
        """The value that is expected in interval m of a macro step."""
        value = 2 * self.last[0] - self.last[1]
        return value if self.jump is None else value + jnp.where(m == 0, self.jump, 0.0)

    def add(self, m, value) -> "Line":
        """With the value of interval m."""
        if self.jump is not None:
            value = value - jnp.where(m == 0, self.jump, 0.0)
        return self._replace(last=jnp.stack([value, self.last[0]]))

    def after_step(self, values) -> "Line":
        """With the values (num_micro, ...) of a macro step, and the jump at its start."""
        line, n = self, len(values)
        if self.jump is not None:
            line = self._replace(jump=values[0] - (self.last[0] + values[1]) / 2)
        for m in range(max(n - 2, 0), n):
            line = line.add(m, values[m])
        return line

    def after(self, other: "Line") -> "Line":
        """Going on where another line ended."""
        return self._replace(last=other.last)
