"""Inverses of ``G M^-1 G^T``, and of the matrix K of a micro interval, as a full or as a band matrix: for a chain of n
bodies a band takes O(n) operations, a full matrix O(n^3).

Two rows of G without a common body have a zero entry in the product, and so have two coordinates without a common
spring in K. The order of Cuthill and McKee brings the other entries close to the diagonal, so that the matrix is block
tridiagonal. Columns without a common row are computed together, as one product with the sum of their unit vectors, a
seed (Curtis, Powell, Reid, J. Inst. Math. Appl. 13, 1974).

Time of a RATTLE step of a hinged chain on one core, full over band: 2.8 with 10 bodies, 6 with 20, 16 with 40.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vmri_jax import kernels
from vmri_jax.kernels.saddle import regularized

LARGEST_HALF_WIDTH = 0.2
"""Largest half width of a band, relative to the number of rows, for which the band is used. With a larger value wide
bands cost more than the full matrix."""


class FullInverse(NamedTuple):
    """An inverse as a matrix (n, n)."""

    matrix: Float[Array, "n n"]

    def times(self, g):
        """The product with g (n,)."""
        return kernels.matvec(self.matrix, g)


@dataclass(frozen=True)
class Full:
    """The sparsity of a matrix (n, n) without known zeros; `size` is n."""

    size: int

    @property
    def seeds(self):
        """(n, n) unit vectors: products of the matrix with them are its columns."""
        return jnp.eye(self.size)

    def inverse(self, products, may_depend: bool = True) -> FullInverse:
        """The inverse of a matrix, from its products (n, n) with the seeds, one product in each row; as of
        `Band.inverse`."""
        return FullInverse(kernels.inverse(regularized(products) if may_depend else products).T)

    def solve(self, products, g):
        """The x (n,) with ``A x = g``, for the matrix A with these products."""
        return kernels.solve(regularized(products.T), g[:, None])[:, 0]


class BandInverse(NamedTuple):
    """Block LU decomposition of a block tridiagonal matrix. Row i has the blocks L_i, D_i, U_i, and
    ``D'_i = D_i - L_i D'_(i-1)^-1 U_(i-1)``.

    diagonal: ``D'_i^-1``.
    upper: ``D'_i^-1 U_i``.
    lower: ``L_i D'_(i-1)^-1``.
    places, back: row at each place of the order (n at a place without a row), and place of each row.
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

        # forward elimination y_i = g_i - L D'^-1 y_(i-1), then back substitution x_i = D'^-1 (y_i - U x_(i+1))
        def down(before, row):
            g, lower = row
            y = g - lower @ before
            return y, y

        def up(after, row):
            y, diagonal, upper = row
            x = diagonal @ y - upper @ after
            return x, x

        y = jax.lax.scan(down, zero, (rows, self.lower))[1]
        x = jax.lax.scan(up, zero, (y, self.diagonal, self.upper), reverse=True)[1]
        return x.reshape(-1)[self.back]


@dataclass(frozen=True)
class Band:
    """The sparsity of a matrix whose entries lie within `width` of the diagonal, with rows and columns in this
    order."""

    order: tuple[int, ...]
    width: int

    @property
    def _blocks(self) -> int:
        return -(-len(self.order) // self.width)

    @property
    def _places(self) -> np.ndarray:
        """(blocks b,) row at each place, n at a place without a row."""
        free = self._blocks * self.width - len(self.order)
        return np.append(np.array(self.order), np.full(free, len(self.order)))

    @property
    def seeds(self):
        """(3 b, n) seeds: one for each place in a block and each of three colours of blocks, the sum of its unit
        vectors in every third block."""
        n = len(self.order)
        place = np.arange(n)
        color = place % self.width + self.width * (place // self.width % 3)
        seeds = np.zeros((3 * self.width, n))
        seeds[color, np.array(self.order)] = 1.0
        return jnp.asarray(seeds)

    def inverse(self, products, may_depend: bool = True) -> BandInverse:
        """The inverse of a matrix, from its products (3 b, n) with the seeds, one product in each row.

        The matrix is `regularized` if its rows may depend on each other, as constraints may.
        """
        b, blocks, places = self.width, self._blocks, self._places
        rows = jnp.pad(products, [(0, 0), (0, 1)])[:, places]
        block = np.arange(blocks)
        # axes: block, colour of the block of columns, row in the block, column in its block
        entries = jnp.transpose(rows.reshape(3, b, blocks, b), (2, 0, 3, 1))
        lower, diagonal, upper = (entries[block, (block + shift) % 3] for shift in (-1, 0, 1))
        is_free = (places == len(self.order)).reshape(blocks, b)  # places without a row get a unit diagonal
        diagonal = (regularized(diagonal) if may_depend else diagonal) + is_free[:, :, None] * np.eye(b)

        def eliminate(before, row):
            inverse_before, upper_before = before
            lower, diagonal, upper = row
            lower = lower @ inverse_before
            inverse = kernels.inverse(diagonal - lower @ upper_before)
            return (inverse, upper), (inverse, inverse @ upper, lower)

        zero = jnp.zeros((b, b))
        ends = (block > 0)[:, None, None], (block < blocks - 1)[:, None, None]
        lower, upper = jnp.where(ends[0], lower, 0.0), jnp.where(ends[1], upper, 0.0)
        diagonal, upper, lower = jax.lax.scan(eliminate, (zero, zero), (lower, diagonal, upper))[1]
        back = np.argsort(np.array(self.order), kind="stable")
        return BandInverse(diagonal, upper, lower, jnp.asarray(places), jnp.asarray(back))

    def solve(self, products, g):
        """The x (n,) with ``A x = g``, for the matrix A with these products."""
        return self.inverse(products).times(g)


Sparsity = Full | Band


def sparsity(pattern: np.ndarray, nodes: int = 1) -> Sparsity:
    """The sparsity of a matrix that is zero outside of a symmetric pattern (n, n): a band if it is narrow, else full.

    Args:
        pattern: True where an entry may differ from zero.
        nodes: r; the matrix (r n, r n) has r x r blocks with this pattern.
    """
    n = len(pattern)
    if n <= 1:
        return Full(n * nodes)

    from scipy.sparse import csr_array  # imported here: the import takes a tenth of a second
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    order = np.asarray(reverse_cuthill_mckee(csr_array(pattern), symmetric_mode=True))
    row, column = np.nonzero(pattern[np.ix_(order, order)])
    width = int(np.max(np.abs(row - column), initial=0))
    order = (order[:, None] + n * np.arange(nodes)).reshape(-1)
    width = nodes * width + nodes - 1
    if width > LARGEST_HALF_WIDTH * len(order):
        return Full(len(order))
    return Band(tuple(order.tolist()), max(width, 1))
