"""Coordinates of some bodies in q_s and q_f, taken out without a gather."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library, split_at

Part = Literal["s", "f"]


class Place(NamedTuple):
    """Coordinates ``q_part[start : start + size]`` of a body."""

    part: Part
    start: int
    size: int

    @property
    def order(self) -> tuple[bool, int]:
        """Sort key of places: the order of the coordinates in (q_s, q_f)."""
        return self.part == "f", self.start

    def numbers(self, num_slow: int) -> np.ndarray:
        """(size,) numbers of the coordinates in (q_s, q_f), taken as one vector whose first `num_slow` entries are
        q_s."""
        return self.start + (num_slow if self.part == "f" else 0) + np.arange(self.size)


class Run(NamedTuple):
    """A run of neighbours: `count` bodies that follow one another in q_part, or, if `same`, one body `count` times."""

    part: Part
    start: int
    count: int
    same: bool


@dataclass(frozen=True)
class Entries:
    """The entries of vectors (n,) with a True in `marked` (n,), as static slices."""

    marked: tuple[bool, ...]

    @property
    def count(self) -> int:
        """Number of the entries."""
        return sum(self.marked)

    @property
    def ends(self) -> list[int]:
        """The first entry of each run of neighbours, and the one after its last, in turn."""
        return [i for i, (a, b) in enumerate(pairwise([False, *self.marked, False])) if a != b]

    def take(self, vectors):
        """(..., k) the k entries of vectors (..., n)."""
        if all(self.marked):
            return vectors
        taken = split_at(vectors, *self.ends)[1::2]
        return jnp.concatenate([np.zeros((*vectors.shape[:-1], 0)), *taken], axis=-1)

    def put(self, entries, vectors):
        """Vectors (..., n) with these entries replaced by `entries` (..., k)."""
        if all(self.marked):
            return entries
        kept, new = split_at(vectors, *self.ends)[::2], split_at(entries, *np.cumsum(np.diff(self.ends)[::2]))
        return jnp.concatenate([*chain(*zip(kept, new, strict=True))], axis=-1)


@dataclass(frozen=True)
class Rows:
    """Coordinates of some bodies of one size, as static slices; compared by value, as `jax.jit` needs it.

    Of every body with `stride` coordinates the first `size` are taken.
    """

    size: int
    stride: int
    runs: tuple[Run, ...]

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
        return cls(size or stride, stride, tuple(runs))

    @property
    def places(self) -> list[Place]:
        """Places of the bodies, in the order of the rows."""
        return [
            Place(part, start + (0 if same else i * self.stride), self.stride)
            for part, start, count, same in self.runs
            for i in range(count)
        ]

    def take(self, q_s, q_f):
        """The rows of q_s and q_f, which may also be velocities; for a single place (..., n) arrays."""
        if self.runs[0].count == len(self.runs) == 1:
            ((part, start, _, _),) = self.runs
            return (q_s if part == "s" else q_f)[..., start : start + self.size]
        pieces = []
        for part, start, count, same in self.runs:
            q = q_s if part == "s" else q_f
            if same or count == 1:
                piece = q[start : start + self.size]
                pieces.append(library(piece).tile(piece, count) if same else piece)
            else:
                whole = q[start : start + self.stride * count].reshape(count, self.stride)
                pieces.append(whole[:, : self.size].reshape(-1))
        return library(pieces).concatenate(pieces).reshape(-1, self.size)
