"""Inverses of ``G M^-1 G^T``, full or as a band: of a chain of n bodies the band takes O(n) operations, the full one O(n^3).

Rows of G that share no body leave zeros. In a good order those that are not zero lie close to the diagonal, and the matrix is
block tridiagonal. Columns that have no row in common are computed together, as one product with the sum of their unit vectors
(Curtis, Powell, Reid, J. Inst. Math. Appl. 13, 1974); the order is that of Cuthill and McKee.

Time of a RATTLE step of a hinged chain on one core, full over band: 2.8 with 10 bodies, 6 with 20, 16 with 40.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import chosen
from vmri_jax.kernels.saddle import regularized

PART = 0.2
"""A band is taken where its half width is at most this part of the size."""


class FullInverse(NamedTuple):
    """The inverse (n, n) itself."""

    matrix: Float[Array, "n n"]

    def times(self, g):
        """The product with g (n,)."""
        return chosen.matvec(self.matrix, g)


@dataclass(frozen=True)
class Full:
    """Nothing is known about zeros.

    size: n.
    """

    size: int

    @property
    def seeds(self):
        """(n, n) unit vectors: products with them are the columns."""
        return jnp.eye(self.size)

    def inverse(self, products) -> FullInverse:
        """Of the matrix with these products (n, n) with the seeds, one in each row."""
        return FullInverse(chosen.inverse(regularized(products)).T)

    def solve(self, products, g):
        """The x (n,) that the matrix with these products takes to g."""
        return chosen.solve(regularized(products.T), g[:, None])[:, 0]


class BandInverse(NamedTuple):
    """Block LU decomposition, blocks D, U to the right and L to the left of it, D' what elimination leaves of D.

    diagonal: ``D'^-1``.
    upper: ``D'^-1 U``.
    lower: ``L D'^-1`` with the D' of the block before.
    places, back: order of the rows, and where each row is in it.
    """

    diagonal: Float[Array, "blocks b b"]
    upper: Float[Array, "blocks b b"]
    lower: Float[Array, "blocks b b"]
    places: Int[Array, "blocks*b"]
    back: Int[Array, "n"]

    def times(self, g):
        """The product with g (n,)."""
        rows = jnp.append(g, 0.0)[self.places].reshape(self.diagonal.shape[:2])
        zero = jnp.zeros_like(rows[0])

        def down(before, at):
            g, lower = at
            y = g - lower @ before
            return y, y

        def up(after, at):
            y, diagonal, upper = at
            x = diagonal @ y - upper @ after
            return x, x

        y = jax.lax.scan(down, zero, (rows, self.lower))[1]
        x = jax.lax.scan(up, zero, (y, self.diagonal, self.upper), reverse=True)[1]
        return x.reshape(-1)[self.back]


@dataclass(frozen=True)
class Band:
    """All entries lie within `width` of the diagonal, when rows and columns are taken in this order."""

    order: tuple[int, ...]
    width: int

    @property
    def _blocks(self) -> int:
        return -(-len(self.order) // self.width)

    @property
    def _places(self) -> np.ndarray:
        """(blocks b,) row at each place, n where there is none."""
        free = self._blocks * self.width - len(self.order)
        return np.append(np.array(self.order), np.full(free, len(self.order)))

    @property
    def seeds(self):
        """(3 b, n): one for every place in a block of every third block."""
        n = len(self.order)
        place = np.arange(n)
        color = place % self.width + self.width * (place // self.width % 3)
        seeds = np.zeros((3 * self.width, n))
        seeds[color, np.array(self.order)] = 1.0
        return jnp.asarray(seeds)

    def inverse(self, products) -> BandInverse:
        """Of the matrix with these products (3 b, n) with the seeds, one in each row."""
        b, blocks, places = self.width, self._blocks, self._places
        rows = jnp.pad(products, [(0, 0), (0, 1)])[:, places]
        block = np.arange(blocks)
        of = jnp.transpose(rows.reshape(3, b, blocks, b), (2, 0, 3, 1))  # block, third, row in it, column in it
        lower, diagonal, upper = (of[block, (block + shift) % 3] for shift in (-1, 0, 1))
        none = (places == len(self.order)).reshape(blocks, b)
        diagonal = regularized(diagonal) + none[:, :, None] * np.eye(b)

        def eliminate(before, at):
            inverse_before, upper_before = before
            lower, diagonal, upper = at
            lower = lower @ inverse_before
            inverse = chosen.inverse(diagonal - lower @ upper_before)
            return (inverse, upper), (inverse, inverse @ upper, lower)

        zero = jnp.zeros((b, b))
        ends = (block > 0)[:, None, None], (block < blocks - 1)[:, None, None]
        lower, upper = jnp.where(ends[0], lower, 0.0), jnp.where(ends[1], upper, 0.0)
        diagonal, upper, lower = jax.lax.scan(eliminate, (zero, zero), (lower, diagonal, upper))[1]
        back = np.argsort(np.array(self.order), kind="stable")
        return BandInverse(diagonal, upper, lower, jnp.asarray(places), jnp.asarray(back))

    def solve(self, products, g):
        """The x (n,) that the matrix with these products takes to g."""
        return self.inverse(products).times(g)


Sparsity = Full | Band


def sparsity(pattern: np.ndarray, nodes: int = 1) -> Sparsity:
    """How to invert a matrix that is zero outside of a symmetric pattern (n, n).

    Args:
        pattern: True where an entry may differ from zero.
        nodes: r; the matrix consists of r x r blocks with this pattern.
    """
    n = len(pattern)
    if n <= 1:
        return Full(n * nodes)

    from scipy.sparse import csr_array  # here: its import takes a tenth of a second
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    order = np.asarray(reverse_cuthill_mckee(csr_array(pattern), symmetric_mode=True))
    at = np.nonzero(pattern[np.ix_(order, order)])
    width = int(np.max(np.abs(at[0] - at[1]), initial=0))
    order = (order[:, None] + n * np.arange(nodes)).reshape(-1)
    width = nodes * width + nodes - 1
    if width > PART * len(order):
        return Full(len(order))
    return Band(tuple(order.tolist()), max(width, 1))
