"""Bodies of a tree as functions of few coordinates: what is left of bodies that joints tie.

A body b hangs on a body a, or on the ground, by a joint with one coordinate x, or with none. The joint lies at the points X_a and X_b of
the bodies, and has a triad in each, the rows of F_a and F_b; all are components along the directors, the rows of D. With x = 0 points and
triads coincide, and x turns b about the axis k of the triad or moves it along. With the centres phi,

    D_b = M D_a,   phi_b = phi_a + r D_a,
    M = F_b^T T(x) F_a = N + P cos x + S sin x,   r = X_a - X_b M + (way along k) F_a[k]

So the four rows (r, M) are ``C + P cos x + S sin x + E x``, with constants that are computed once. They are multiplied from the roots
outwards, along all ways to outermost bodies at once (a loop over the depth keeps programs small).

Joints of several coordinates are chains of such with frames between them. Bodies on no joint, the roots, have their centre and directors
among the coordinates themselves.

Source: R. Featherstone, Rigid Body Dynamics Algorithms, Springer (2008), chapter 4.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels import matmul
from vmri_jax.mechanics.rows import Part, Place, Rows, Run

GROUND = -1
"""The number of the body that does not move."""
JOINTS = "kinematics"
"""Where the numbers of joints are in the params of a system."""
MASS = "mass"
"""Where the masses of the coordinates of bodies are in them, "slow" and "fast"."""
Grid = Literal["s", "f", "sf"]
"""The coordinates that a body depends on: slow ones, fast ones, both."""


class Move(NamedTuple):
    """What one coordinate of a joint does with a triad.

    kind: "turn" about a vector of the triad, "slide" along it, or "screw": both.
    axis: number of the vector.
    """

    kind: Literal["turn", "slide", "screw"]
    axis: int


@dataclass(frozen=True)
class Frames:
    """Bodies that depend on coordinates of one kind, and frames between them; compared by value.

    Args:
        grid: the coordinates.
        first: number of the first frame among all of the kinematics.
        roots: what each way starts from: `GROUND` or a number among the roots of the kinematics and then the bodies of `Frames` before
            these. A way leads from there to an outermost body; those that have a part in common repeat it.
        coordinates: of the frames that move; None where none does.
        moving: for each frame the number of its coordinate, -1 where it has none; the first ones of all ways, then the second ones.
        slides: whether a coordinate moves along its axis.
        bodies: numbers of the frames that are bodies.
        directors: which directors each body has.
    """

    grid: Grid
    first: int
    roots: tuple[int, ...]
    coordinates: Rows | None
    moving: tuple[int, ...]
    slides: bool
    bodies: tuple[int, ...]
    directors: tuple[tuple[int, ...], ...]

    @property
    def sizes(self) -> list[int]:
        """Coordinates of each body as a rigid body."""
        return [3 + 3 * len(kept) for kept in self.directors]

    def relative(self, q_s, q_f, joints: dict[str, Any]):
        """(n, 4, 3) the rows (r, M) of every frame in those it hangs on.

        Args:
            q_s, q_f: coordinates.
            joints: the constants C, P, S, E of all frames.
        """
        joints = {name: values[self.first : self.first + len(self.moving)] for name, values in joints.items()}
        rows = joints["constant"]
        if self.coordinates is None:
            return rows
        x = taken(self.coordinates.take(q_s, q_f).reshape(-1), self.moving, np.zeros(()))[:, None, None]
        rows = rows + jnp.cos(x) * joints["cosine"] + jnp.sin(x) * joints["sine"]
        return rows + x * joints["way"] if self.slides else rows

    def in_space(self, rows, roots):
        """(n, 4, 3) origins and directors of all frames.

        Args:
            rows: (n, 4, 3) those of every frame in the one before it.
            roots: (ways, 4, 3) those of what the ways start from.
        """

        def outwards(inner, rows):
            return (outer := after(rows, inner)), outer

        return jax.lax.scan(outwards, roots, rows.reshape(-1, *roots.shape))[1].reshape(rows.shape)


@dataclass(frozen=True)
class Kinematics:
    """The map from coordinates q to those of points and rigid bodies Q; compared by value.

    Q_s is q_s with the centres and directors of the bodies after it that depend on slow coordinates alone; Q_f is q_f with those of bodies
    that depend on fast ones alone, and then with all others.

    Args:
        roots: where the coordinates of bodies that carry others are in q_s and q_f.
        frames: at most one entry for each of these, in this order: bodies of slow coordinates that carry bodies of fast ones, bodies of fast
            coordinates, bodies of both, bodies of slow coordinates that carry no other ones.
        sizes: (n_s, n_f), numbers of coordinates.
        num_fast: number of entries of `frames` that Q_f needs, the first ones.
    """

    roots: tuple[Place, ...]
    frames: tuple[Frames, ...]
    sizes: tuple[int, int]
    num_fast: int

    @property
    def of_slow(self) -> "Kinematics":
        """The map from q_s to Q_s, with q_f as Q_f."""
        return replace(self, frames=tuple(frames for frames in self.frames if frames.grid == "s"))

    @property
    def of_fast(self) -> "Kinematics":
        """The map from q to Q_f; of Q_s there is what carries these bodies."""
        return replace(self, frames=self.frames[: self.num_fast])

    def __call__(self, q_s, q_f, joints: dict[str, Any]) -> tuple[Any, Any]:
        """(Q_s, Q_f).

        Args:
            q_s, q_f: coordinates.
            joints: the constants C, P, S, E (n, 4, 3) of all frames, "constant", "cosine", "sine", "way".
        """
        known = self._roots(q_s, q_f)
        slow, fast = [q_s], [q_f]
        for frames in self.frames:
            roots = jnp.stack([known[root] for root in frames.roots])
            rows = frames.in_space(frames.relative(q_s, q_f, joints), roots)
            known |= {len(known) - 1 + i: rows[k] for i, k in enumerate(frames.bodies)}
            (slow if frames.grid == "s" else fast).append(_coordinates(rows, frames))
        return jnp.concatenate(slow), jnp.concatenate(fast)

    def velocities(self, q_s, q_f, v_s, v_f, joints: dict[str, Any]):
        """Rates of (Q_s, Q_f)."""
        return jax.jvp(lambda q_s, q_f: self(q_s, q_f, joints), (q_s, q_f), (v_s, v_f))[1]

    def momenta(self, q_s, q_f, v_s, v_f, params: dict[str, Any]):
        """Momenta of the bodies, their masses times their velocities."""
        rates = self.velocities(q_s, q_f, v_s, v_f, params[JOINTS])
        return tuple(params[MASS][part] * rate for part, rate in zip(("slow", "fast"), rates, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """As plain data for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Kinematics":
        """The inverse of `to_dict`, also of what JSON makes of it.

        Args:
            data: from `to_dict`.
        """
        frames = []
        for some in data["frames"]:
            rows = some["coordinates"]
            runs = None if rows is None else tuple(Run(*run) for run in rows["runs"])
            found: dict[str, Any] = {name: tuple(some[name]) for name in ("roots", "moving", "bodies")}
            found["coordinates"] = None if rows is None else Rows(**(rows | {"runs": runs}))
            found["directors"] = tuple(map(tuple, some["directors"]))
            frames.append(Frames(**(some | found)))
        roots = tuple(Place(*root) for root in data["roots"])
        return cls(roots, tuple(frames), tuple(data["sizes"]), data["num_fast"])

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """Where the bodies of the frames are in Q_s and Q_f, in their order."""
        ends, found = {"s": self.sizes[0], "f": self.sizes[1]}, []
        for frames in self.frames:
            part: Part = "s" if frames.grid == "s" else "f"
            for size in frames.sizes:
                found.append(Place(part, ends[part], size))
                ends[part] += size
        return tuple(found)

    def _roots(self, q_s, q_f) -> dict[int, Any]:
        """(4, 3) centre and directors of the ground and of the roots by number."""
        found: dict[int, Any] = {GROUND: jnp.asarray(UNMOVED)}
        for number, (part, start, size) in enumerate(self.roots):
            rows = (q_s if part == "s" else q_f)[start : start + size].reshape(-1, 3)
            found[number] = jnp.pad(rows, ((0, 4 - len(rows)), (0, 0)))
        return found


UNMOVED = np.concatenate([np.zeros((1, 3)), np.eye(3)])
"""(4, 3) centre and directors of what has not moved."""


def after(rows, others):
    """The rows (r, M) of frames in bodies whose own rows are (s, D): ``(s + r D, M D)``.

    Args:
        rows, others: (n, 4, 3).
    """
    return matmul(rows, others[:, 1:]) + jnp.pad(others[:, :1], ((0, 0), (0, 3), (0, 0)))


def taken(rows, numbers: Sequence[int], otherwise: Any = None):
    """Some entries of (n, ...), by slices.

    Args:
        numbers: of the entries.
        otherwise: what stands where a number is -1.
    """
    if list(numbers) == list(range(len(rows))):
        return rows
    pieces, first = [], 0
    for last in range(1, len(numbers) + 1):
        step = 0 if numbers[first] < 0 else 1
        if last == len(numbers) or numbers[last] != numbers[last - 1] + step:
            low, count = int(numbers[first]), last - first
            pieces.append(jnp.broadcast_to(otherwise, (count, *rows.shape[1:])) if low < 0 else rows[low : low + count])
            first = last
    return jnp.concatenate(pieces)


def _coordinates(rows, frames: Frames):
    """Coordinates of the bodies among frames, one after the other."""
    if any(len(kept) < 3 for kept in frames.directors):
        pieces = [rows[i, [0, *(k + 1 for k in kept)]] for i, kept in zip(frames.bodies, frames.directors, strict=True)]
        return jnp.concatenate(pieces).reshape(-1)
    return taken(rows, frames.bodies).reshape(-1)
