"""Estimated errors of a run at its saved nodes."""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.summary import has_values


class RunError(NamedTuple):
    """Estimated error of a run at its k saved nodes, by Richardson's extrapolation; NaN where it is not certified.

    In a batch every array has a leading axis of lanes, and so have `is_certified` and `largest`.

    Attributes:
        q_s, q_f: (k, n_s), (k, n_f) positions of the run minus positions of the exact motion.
        slow, fast: (k,) largest modulus of the slow and of the fast share of the error over all coordinates. Shares
            have signs and add up to the error, so that each may be larger. NaN unless ``error="shares"`` asked for
            them, or if their companion run failed.
        of: error of the user's function of the run, in its shape; None without a function.
        certified_until: time of the last node whose error is certified.
        growth: factor by which the error grows in the second half of the time up to `certified_until`.
    """

    q_s: Float[Numbers, "k n_s"]
    q_f: Float[Numbers, "k n_f"]
    slow: Float[Numbers, "k"]
    fast: Float[Numbers, "k"]
    of: Any
    certified_until: Float[Numbers, ""]
    growth: Float[Numbers, ""]

    @property
    def positions(self) -> np.ndarray:
        """(k,) largest error of a coordinate at each node."""
        return largest_of(np.concatenate([self.q_s, self.q_f], axis=-1))

    @property
    def is_certified(self) -> Any:
        """Whether the error of every node is certified."""
        return np.isfinite(self.positions).all(axis=-1)

    @property
    def largest(self) -> Any:
        """Largest error of a position over all nodes; infinite where a node is not certified."""
        largest = np.where(self.is_certified, self.positions.max(axis=-1, initial=0.0), np.inf)
        return largest if largest.ndim else float(largest)

    def part(self, nodes: slice) -> "RunError":
        """The error at some of the nodes; the error of the user's function stays whole unless it has a value for each
        node."""
        lanes = (slice(None),) * (np.ndim(self.slow) - 1)
        of = self.of[*lanes, nodes] if np.shape(self.of)[: len(lanes) + 1] == np.shape(self.slow) else self.of
        at_nodes = {name: getattr(self, name)[*lanes, nodes] for name in ("q_s", "q_f", "slow", "fast")}
        return self._replace(of=of, **at_nodes)

    def __repr__(self) -> str:
        return f"RunError: {self.in_words() if has_values(self) else eqx.tree_pformat(self._asdict())}"

    def in_words(self) -> str:
        """The largest error, its shares, and the time up to which it is certified."""
        known = np.isfinite(self.positions)
        if not known.any():
            return "no error is certified"
        total, slow, fast = (np.max(a[known], initial=0.0) for a in (self.positions, self.slow, self.fast))
        shares = "" if np.isnan(slow) else f", slow share {slow:.1e}, fast share {fast:.1e}"
        whole = f"positions are wrong by about {total:.1e}{shares}"
        return whole if np.all(self.is_certified) else f"until t = {float(np.min(self.certified_until)):.4g} {whole}"


def largest_of(values) -> np.ndarray:
    """(..., k) largest modulus over the coordinates of values (..., k, n); NaN where one of them is NaN."""
    return np.abs(values).max(axis=-1, initial=0.0)
