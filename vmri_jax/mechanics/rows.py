"""Coordinates of some bodies in q_s and q_f, taken out and put back without a gather."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

Part = Literal["s", "f"]


class Place(NamedTuple):
    """Coordinates ``q_part[start : start + size]`` of a body."""

    part: Part
    start: int
    size: int


class Run(NamedTuple):
    """A run of neighbours: `count` bodies that follow one another in q_part, or, if `same`, one body `count` times."""

    part: Part
    start: int
    count: int
    same: bool


@dataclass(frozen=True)
class Entries:
    """Some entries of vectors (n,), as static slices.

    Args:
        runs: first entry of each run of neighbours, and the one after its last.
        size: n.
    """

    runs: tuple[tuple[int, int], ...]
    size: int

    @classmethod
    def of(cls, marked: Sequence[bool]) -> "Entries":
        """The entries with a True in `marked` (n,)."""
        ends = [i for i, (a, b) in enumerate(pairwise([False, *marked, False])) if a != b]
        return cls(tuple(zip(ends[::2], ends[1::2], strict=True)), len(marked))

    @property
    def count(self) -> int:
        """Number of the entries."""
        return sum(stop - start for start, stop in self.runs)

    @property
    def marked(self) -> np.ndarray:
        """(n,) whether an entry is one of them."""
        runs = (range(*run) for run in self.runs)
        return np.isin(np.arange(self.size), [i for run in runs for i in run])

    def take(self, vectors):
        """(..., count) the entries of vectors (..., n)."""
        if self.count == self.size:
            return vectors
        return jnp.concatenate([vectors[..., :0], *(vectors[..., start:stop] for start, stop in self.runs)], axis=-1)

    def put(self, entries, vectors):
        """Vectors (..., n) with these entries replaced by `entries` (..., count)."""
        if self.count == self.size:
            return entries
        pieces, end, taken = [], 0, 0
        for start, stop in self.runs:
            pieces += [vectors[..., end:start], entries[..., taken : taken + stop - start]]
            end, taken = stop, taken + stop - start
        return jnp.concatenate([*pieces, vectors[..., end:]], axis=-1)


@dataclass(frozen=True)
class Rows:
    """Coordinates of some bodies of one size, as static slices; compared by value, as `jax.jit` needs it.

    Of every body with `stride` coordinates the first `size` are taken.
    """

    size: int
    stride: int
    runs: tuple[Run, ...]
    single: bool

    @classmethod
    def of(cls, places: Sequence[Place], size: int | None = None) -> "Rows":
        """The rows at these places.

        Args:
            places: of the bodies; `take` returns a vector (size,) for a single place, else (n, size).
            size: number of coordinates to take of each body; None for all.
        """
        stride, runs = places[0].size, []
        for part, start, _ in places:
            last = runs[-1] if runs else Run(part, start, 0, False)
            follows = not last.same and start == last.start + stride * last.count
            again = last.start == start and (last.same or last.count == 1)
            if last.part == part and last.count and (follows or again):
                runs[-1] = last._replace(count=last.count + 1, same=again)
            else:
                runs.append(Run(part, start, 1, False))
        return cls(size or stride, stride, tuple(runs), len(places) == 1)

    @property
    def places(self) -> list[Place]:
        """Places of the bodies, in the order of the rows."""
        return [
            Place(part, start + (0 if same else i * self.stride), self.stride)
            for part, start, count, same in self.runs
            for i in range(count)
        ]

    def within(self, sizes: tuple[int, int]) -> bool:
        """Whether all rows are among the first (n_s, n_f) coordinates."""
        most = {"s": sizes[0], "f": sizes[1]}
        ends = [(run.part, run.start + self.stride * (1 if run.same else run.count)) for run in self.runs]
        return all(end <= most[part] for part, end in ends)

    def take(self, q_s, q_f):
        """The rows of q_s and q_f, which may also be velocities; for a single place (..., n) arrays."""
        if self.single:
            ((part, start, _, _),) = self.runs
            return (q_s if part == "s" else q_f)[..., start : start + self.size]
        pieces = []
        for part, start, count, same in self.runs:
            q = q_s if part == "s" else q_f
            if same or count == 1:
                piece = q[start : start + self.size]
                pieces.append(jnp.tile(piece, count) if same else piece)
            else:
                whole = q[start : start + self.stride * count].reshape(count, self.stride)
                pieces.append(whole[:, : self.size].reshape(-1))
        return jnp.concatenate(pieces).reshape(-1, self.size)

    def put(self, rows, n_s: int, n_f: int):
        """The transpose of `take`.

        Args:
            rows: one row for each place, or one row for all places.
            n_s, n_f: lengths of q_s and q_f.

        Returns:
            Vectors (n_s,), (n_f,) with the rows added at their places.
        """
        rows, first = jnp.broadcast_to(rows, (sum(run.count for run in self.runs), self.size)), 0
        sums, beyond = {"s": jnp.zeros(n_s), "f": jnp.zeros(n_f)}, self.stride - self.size
        for part, start, count, same in self.runs:
            piece = rows[first : first + count]
            piece = jnp.sum(piece, axis=0) if same else jnp.pad(piece, ((0, 0), (0, beyond))).reshape(-1)
            after = sums[part].shape[0] - start - piece.shape[0]
            sums[part] += jnp.pad(piece, (start, after))
            first += count
        return tuple(sums.values())
