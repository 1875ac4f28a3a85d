"""Bodies of a tree as functions of joint coordinates.

A joint with one coordinate x, or with none, connects a body b to a body a or to the ground. The joint lies at the points X_a and X_b of the
bodies, and has a triad of unit vectors in each body, the rows of F_a and F_b. Points and triads are given by components along the directors
of their body, the rows of D. At x = 0 both points and triads coincide; x turns b about the vector k of the triad, or moves b along it. With
the centres phi, and the rotation T(x) by x about the vector k,

    D_b = M D_a,   phi_b = phi_a + r D_a,
    M = F_b^T T(x) F_a,   r = X_a - X_b M + (distance along k) F_a[k]

So the four rows (r, M) are ``C + P cos x + S sin x + E x``, with constants C, P, S, E that are computed once. The rows are multiplied from
the roots outwards, along the paths to all outermost bodies at once; a loop over the depth keeps programs small.

A joint of several coordinates is a chain of such joints with frames between them. Bodies without a joint, the roots, have their centres and
directors among the coordinates.

Source: R. Featherstone, Rigid Body Dynamics Algorithms, Springer (2008), chapter 4.
"""

from dataclasses import dataclass, replace
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
"""Key of the joint constants in the params of a system."""
MASS = "mass"
"""Key of the masses of body coordinates in the params of a system; its entries are "slow" and "fast"."""
Grid = Literal["s", "f", "sf"]
"""The coordinates that a body depends on: slow ones, fast ones, both."""


class Move(NamedTuple):
    """The motion of a triad with one coordinate of a joint.

    kind: "turn" about a vector of the triad, "slide" along it, or "screw": both.
    axis: number of the vector.
    """

    kind: Literal["turn", "slide", "screw"]
    axis: int


@dataclass(frozen=True)
class Frames:
    """Bodies that depend on coordinates of one kind, and frames between them; compared by value.

    Args:
        grid: kind of the coordinates.
        first: number of the first of these frames among all frames of the kinematics.
        roots: start of each path to an outermost body: `GROUND`, or a number among the roots of the kinematics followed by the bodies of
            earlier `Frames`. Paths with a common part repeat its frames.
        coordinates: rows of the moving frames; None if no frame moves.
        moving: number of the coordinate of each frame, -1 for a fixed frame; the first frames of all paths, then the second ones, and so on.
        slides: whether some frame moves along its axis.
        bodies: numbers of the frames that are bodies.
        directors: numbers of the directors of each body.
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
        """Number of coordinates of each body: centre and directors."""
        return [3 + 3 * len(kept) for kept in self.directors]

    def relative(self, q_s, q_f, joints: dict[str, Any]):
        """(n, 4, 3) the rows (r, M) of every frame, relative to the frame before it on its path.

        Args:
            joints: the constants C, P, S, E of all frames.
        """
        joints = {name: values[self.first : self.first + len(self.moving)] for name, values in joints.items()}
        rows = joints["constant"]
        if self.coordinates is None:
            return rows
        # the last number, -1, is the coordinate of fixed frames
        x = jnp.append(self.coordinates.take(q_s, q_f), 0.0)
        x = x[np.array(self.moving)][:, None, None]
        rows = rows + jnp.cos(x) * joints["cosine"] + jnp.sin(x) * joints["sine"]
        return rows + x * joints["way"] if self.slides else rows

    def in_space(self, rows, roots):
        """(n, 4, 3) origins and directors of all frames.

        Args:
            rows: (n, 4, 3) rows (r, M) of every frame, relative to the frame before it.
            roots: (paths, 4, 3) origins and directors of the starts of the paths.
        """

        def outwards(inner, rows):
            return (outer := after(rows, inner)), outer

        return jax.lax.scan(outwards, roots, rows.reshape(-1, *roots.shape))[1].reshape(rows.shape)


@dataclass(frozen=True)
class Kinematics:
    """The map from coordinates q to those of points and rigid bodies Q; compared by value.

    Q_s is q_s followed by centres and directors of the bodies that depend on slow coordinates alone; Q_f is q_f followed by the bodies that
    depend on fast coordinates alone, then by all other bodies.

    Args:
        roots: places of the coordinates of root bodies in q_s and q_f.
        frames: at most four entries, in this order: bodies that depend on q_s and carry bodies that depend on q_f, bodies that depend on q_f,
            bodies that depend on both, bodies that depend on q_s and carry no body that depends on q_f.
        sizes: (n_s, n_f), numbers of coordinates.
        num_fast: number of the first entries of `frames` that Q_f needs.
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
        """The map from q to Q_f; its Q_s has only the bodies that carry bodies of Q_f."""
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
        """Momenta of the bodies: masses times velocities."""
        rates = self.velocities(q_s, q_f, v_s, v_f, params[JOINTS])
        return tuple(params[MASS][part] * rate for part, rate in zip(("slow", "fast"), rates, strict=True))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Kinematics":
        """The inverse of `dataclasses.asdict`, also after a round trip through JSON."""
        frames = []
        for entry in data["frames"]:
            rows = entry["coordinates"]
            runs = None if rows is None else tuple(Run(*run) for run in rows["runs"])
            fields: dict[str, Any] = {name: tuple(entry[name]) for name in ("roots", "moving", "bodies")}
            fields["coordinates"] = None if rows is None else Rows(**(rows | {"runs": runs}))
            fields["directors"] = tuple(map(tuple, entry["directors"]))
            frames.append(Frames(**(entry | fields)))
        roots = tuple(Place(*root) for root in data["roots"])
        return cls(roots, tuple(frames), tuple(data["sizes"]), data["num_fast"])

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """Places of the bodies in Q_s and Q_f, in the order of the frames."""
        ends, places = {"s": self.sizes[0], "f": self.sizes[1]}, []
        for frames in self.frames:
            part: Part = "s" if frames.grid == "s" else "f"
            for size in frames.sizes:
                places.append(Place(part, ends[part], size))
                ends[part] += size
        return tuple(places)

    def _roots(self, q_s, q_f) -> dict[int, Any]:
        """Centre and directors (4, 3) of the ground and of the roots, by number."""
        known: dict[int, Any] = {GROUND: jnp.asarray(UNMOVED)}
        for number, (part, start, size) in enumerate(self.roots):
            rows = (q_s if part == "s" else q_f)[start : start + size].reshape(-1, 3)
            known[number] = jnp.pad(rows, ((0, 4 - len(rows)), (0, 0)))
        return known


UNMOVED = np.concatenate([np.zeros((1, 3)), np.eye(3)])
"""(4, 3) centre and directors of the ground."""


def after(rows, bodies):
    """Origins and directors of frames with the relative rows (r, M), in bodies with the rows (s, D): ``(s + r D, M D)``.

    Args:
        rows: (n, 4, 3) of the frames.
        bodies: (n, 4, 3).
    """
    return matmul(rows, bodies[:, 1:]) + jnp.pad(bodies[:, :1], ((0, 0), (0, 3), (0, 0)))


def _coordinates(rows, frames: Frames):
    """Coordinates of the frames that are bodies, one body after the other."""
    if any(len(kept) < 3 for kept in frames.directors):
        pieces = [rows[i, [0, *(k + 1 for k in kept)]] for i, kept in zip(frames.bodies, frames.directors, strict=True)]
        return jnp.concatenate(pieces).reshape(-1)
    return rows[np.array(frames.bodies)].reshape(-1)
