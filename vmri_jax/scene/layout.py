"""Where the coordinates of bodies lie in q_s and q_f, and how they are taken out without a gather."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp

from vmri_jax.mechanics.names import Part, Place
from vmri_jax.scene.body import Bodies


class Pace(NamedTuple):
    """Whether a body is slow or fast, and why."""

    value: Literal["slow", "fast"]
    reason: str


def layout(bodies: Bodies, paces: Mapping[str, Pace]) -> dict[str, Place]:
    """The place of every body: slow ones in order in q_s, fast ones in order in q_f.

    Args:
        bodies, paces: by name.
    """
    ends: dict[Part, int] = {"s": 0, "f": 0}
    places = {}
    for name, body in bodies.items():
        part: Part = "f" if paces[name].value == "fast" else "s"
        places[name] = Place(part, ends[part], body.size)
        ends[part] += body.size
    return places


def join(bodies: Bodies, places: Mapping[str, Place], part: Part, what: str):
    """One vector of all slow or of all fast bodies.

    Args:
        bodies, places: by name.
        part: "s" for slow ones, "f" for fast ones.
        what: "coordinates", "rates" or "masses".
    """
    pieces = [jnp.asarray(getattr(body, what)) for name, body in bodies.items() if places[name].part == part]
    return jnp.concatenate(pieces) if pieces else jnp.zeros(0)


class Run(NamedTuple):
    """`count` bodies that follow one another in q_part, or (`same`) one body `count` times."""

    part: Part
    start: int
    count: int
    same: bool


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
            places: a single one gives a vector (size,), more give (n, size).
            size: so many coordinates of each; None for all.
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

    def take(self, q_s, q_f):
        """The rows of these vectors, positions or velocities."""
        pieces = []
        for part, start, count, same in self.runs:
            q = q_s if part == "s" else q_f
            if same or count == 1:
                piece = q[start : start + self.size]
                pieces.append(jnp.tile(piece, count) if same else piece)
            else:
                piece = q[start : start + self.stride * count]
                pieces.append(self._first(piece, count))
        flat = jnp.concatenate(pieces)
        return flat if self.single else flat.reshape(-1, self.size)

    def put(self, rows, n_s: int, n_f: int):
        """The transpose of `take`.

        Args:
            rows: one for each place, or one for all.
            n_s, n_f: lengths of q_s and q_f.

        Returns:
            Vectors (n_s,), (n_f,) with the rows added at their places.
        """
        rows, at = jnp.broadcast_to(rows, (sum(run.count for run in self.runs), self.size)), 0
        sums = {"s": jnp.zeros(n_s), "f": jnp.zeros(n_f)}
        for part, start, count, same in self.runs:
            piece = rows[at : at + count]
            piece = jnp.sum(piece, axis=0) if same else self._whole(piece).reshape(-1)
            after = sums[part].shape[0] - start - piece.shape[0]
            sums[part] += jnp.pad(piece, (start, after))
            at += count
        return tuple(sums.values())

    def _first(self, piece, count: int):
        """The first coordinates of bodies that follow one another, flat."""
        return piece if self.size == self.stride else piece.reshape(count, self.stride)[:, : self.size].reshape(-1)

    def _whole(self, rows):
        """(n, stride) with zeros for the coordinates that are not taken."""
        return rows if self.size == self.stride else jnp.pad(rows, ((0, 0), (0, self.stride - self.size)))
