"""Where the coordinates of bodies lie in q_s and q_f, and how they are taken out without a gather."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp

from vmri_jax.scene.body import Body

Part = Literal["s", "f"]


class Place(NamedTuple):
    """Coordinates ``q_part[start : start + size]`` of a body."""

    part: Part
    start: int
    size: int


def layout(bodies: Mapping[str, Body], paces: Mapping[str, str]) -> dict[str, Place]:
    """The place of every body: slow ones in order in q_s, fast ones in order in q_f."""
    ends: dict[Part, int] = {"s": 0, "f": 0}
    places = {}
    for name, body in bodies.items():
        part: Part = "f" if paces[name] == "fast" else "s"
        places[name] = Place(part, ends[part], body.size)
        ends[part] += body.size
    return places


def join(bodies: Mapping[str, Body], places: Mapping[str, Place], part: Part, what: str):
    """One vector of all slow or of all fast bodies: their "position", "velocity" or "mass"."""
    members = [body for name, body in bodies.items() if places[name].part == part]
    pieces = [jnp.broadcast_to(getattr(body, what), (body.size,)) for body in members]
    return jnp.concatenate(pieces) if pieces else jnp.zeros(0)


class Run(NamedTuple):
    """`count` bodies that follow one another in q_part, or (`same`) one body `count` times."""

    part: Part
    start: int
    count: int
    same: bool


@dataclass(frozen=True)
class Rows:
    """Coordinates of some bodies of one size, as static slices; compared by value, as `jax.jit` needs it."""

    size: int
    runs: tuple[Run, ...]
    single: bool

    @classmethod
    def of(cls, places: Sequence[Place]) -> "Rows":
        """The rows at these places; a single place gives a vector (size,), more give (n, size)."""
        size, runs = places[0].size, []
        for part, start, _ in places:
            last = runs[-1] if runs else None
            if last and last.part == part and (last.count == 1 or last.same) and start == last.start:
                runs[-1] = last._replace(count=last.count + 1, same=True)
            elif last and last.part == part and not last.same and start == last.start + size * last.count:
                runs[-1] = last._replace(count=last.count + 1)
            else:
                runs.append(Run(part, start, 1, False))
        return cls(size, tuple(runs), len(places) == 1)

    @property
    def shape(self) -> tuple[int, ...]:
        """(size,) of a single place, (n, size) of more."""
        return (self.size,) if self.single else (sum(run.count for run in self.runs), self.size)

    def take(self, q_s, q_f):
        """The rows of these vectors, positions or velocities."""
        pieces = [self._take(run, q_s if run.part == "s" else q_f) for run in self.runs]
        flat = pieces[0] if len(pieces) == 1 else jnp.concatenate(pieces)
        return flat if self.single else flat.reshape(-1, self.size)

    def _take(self, run: Run, q):
        stop = run.start + self.size * (1 if run.same else run.count)
        piece = q if run.start == 0 and stop == q.shape[0] else q[run.start : stop]
        return jnp.tile(piece, run.count) if run.same else piece

    def put(self, rows, n_s: int, n_f: int):
        """The transpose of `take`: vectors (n_s,), (n_f,) with these rows added at their places, None where there are none."""
        rows, at = jnp.reshape(rows, (-1, self.size)), 0
        sums: dict[Part, list] = {"s": [], "f": []}
        for run in self.runs:
            piece = rows[at : at + run.count]
            piece = jnp.sum(piece, axis=0) if run.same else piece.reshape(-1)
            after = (n_s if run.part == "s" else n_f) - run.start - piece.shape[0]
            sums[run.part].append(jnp.pad(piece, (run.start, after)) if run.start or after else piece)
            at += run.count
        return tuple(sum(parts[1:], parts[0]) if parts else None for parts in sums.values())
