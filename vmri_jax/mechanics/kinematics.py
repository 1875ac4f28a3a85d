"""Bodies of trees as functions of joint coordinates.

A body hangs on the root of its tree, or on the ground, by a chain of links, each with a coordinate x that turns all
bodies behind the link about an axis, moves them along the axis, or both. At x = 0 all bodies have known places. Motions
are matrices (4, 4), ``(1, r; 0, M)`` with a vector r and a matrix M in the axes of the root: they act on rows (1, y),
and a point y goes to ``r + y M``. Rates of motions are twists ``(0, m; 0, K)``: the point y has the velocity
``m + y K = m + k x y``.

    E_i = exp(x_i Y_i) E_parent      exp(x Y) = 1 + sin x T + (1 - cos x) T T + x S      Y = T + S, turn T and slide S
    A_b = Z_b E_b                    origin and axes of body b, of Z_b at x = 0, moved by the last link of b
    (phi_b, D_b) = A_b (phi, D)      in space, by centre phi and directors D of the root, which need not be orthonormal

A coordinate x_i moves all bodies behind it by the twist ``J_i = E_i^-1 Y_i E_i``. So positions and twists have
derivatives in closed form,

    dA_b = A_b W_b      dJ_i = J_i W_i - W_i J_i      W = sum of J_j dx_j over the links j before

W_i without link i itself. `placed` gives these derivatives to JAX: velocities, kinetic energies, forces and all their
derivatives consist of sums over trees and of products of matrices, and never differentiate the chains of motions.

A joint of several coordinates is a chain of links. Bodies without a joint, the roots, have their centres and directors
among the coordinates.

Source: F. C. Park, J. E. Bobrow, S. R. Ploen, A Lie group formulation of robot dynamics, Int. J. Robot. Res. 14 (1995).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from vmri_jax.kernels import matmul
from vmri_jax.mechanics.arrays import is_concrete, library
from vmri_jax.mechanics.rows import Part, Place, Rows
from vmri_jax.mechanics.slots import Computed

GROUND = -1
"""The number of the root that does not move."""
JOINTS = Computed("kinematics")
"""Key of the joint constants in the params of a system."""
MASS = Computed("mass")
"""Key of the masses of body coordinates in the params of a system; its entries are "slow" and "fast"."""
SIZE = 12
"""Number of coordinates of a body on a joint: centre and directors."""
LARGEST_MATRIX = 16
"""Most links whose sums are products with a matrix: their time grows with the square of the number of links. A smaller
number makes the programs of small trees larger."""
UNMOVED = np.eye(4)[:, 1:]
"""(4, 3) centre and directors of the ground."""


class Link(NamedTuple):
    """A coordinate of a joint.

    place: of the coordinate in q_s or q_f.
    parent: number of the link before it on the way from the root; -1 for the first one.
    turns: whether it turns bodies; else it moves them along its axis alone.
    """

    place: Place
    parent: int
    turns: bool = True


class Carried(NamedTuple):
    """A body on joints.

    part: "f" if the body depends on fast coordinates, else "s".
    root: number of the root of its tree, or `GROUND`.
    link: number of the last link on the way to the body; -1 if it does not move against the root.
    """

    part: Part
    root: int
    link: int


@dataclass(frozen=True)
class Kinematics:
    """The map from coordinates q to those of points and rigid bodies Q; compared by value.

    Q_s is q_s followed by centres and directors of the bodies that depend on slow coordinates alone; Q_f is q_f
    followed by centres and directors of all other bodies.

    Args:
        roots: places of the coordinates of root bodies in q_s and q_f.
        links: slow links that carry no fast body, then slow links that do, then links that carry fast bodies alone.
        bodies: the slow ones first.
        sizes: (n_s, n_f), numbers of coordinates.
        first: numbers of the first link and of the first body in the joint constants.
    """

    roots: tuple[Place, ...]
    links: tuple[Link, ...]
    bodies: tuple[Carried, ...]
    sizes: tuple[int, int]
    first: tuple[int, int] = (0, 0)

    def of(self, start: int, stop: int) -> "Kinematics":
        """The map with the bodies ``bodies[start:stop]`` alone, and the links that move them."""
        bodies, moving = self.bodies[start:stop], np.flatnonzero(self.before[start:stop].any(axis=0))
        first = int(moving.min(initial=len(self.links)))
        links = self.links[first : int(moving.max(initial=-1)) + 1]
        return replace(
            self,
            links=tuple(link._replace(parent=max(link.parent - first, -1)) for link in links),
            bodies=tuple(body._replace(link=max(body.link - first, -1)) for body in bodies),
            first=(self.first[0] + first, self.first[1] + start),
        )

    def __call__(self, q_s, q_f, joints: dict[str, Any]) -> tuple[Any, Any]:
        """(Q_s, Q_f).

        Args:
            q_s, q_f: coordinates.
            joints: the constants in the axes of the roots: "turn" T and "slide" S (n, 4, 4) of all links, "zero" Z
                (n, 4, 4) of all bodies.
        """
        if not self.bodies:
            return q_s, q_f
        frames, _ = self._against_roots(q_s, q_f, joints)
        slow, roots = sum(body.part == "s" for body in self.bodies), [body.root for body in self.bodies]
        frames = product(frames, self._roots(q_s, q_f, roots)) if set(roots) != {GROUND} else frames[:, :, 1:]
        parts = (q_s, frames[:slow].reshape(-1)), (q_f, frames[slow:].reshape(-1))
        q_slow, q_fast = (library(part).concatenate(part) for part in parts)
        return q_slow, q_fast

    def _against_roots(self, q_s, q_f, joints: dict[str, Any]):
        """A (bodies, 4, 4) and J (links, 4, 4), in the axes of the roots."""
        link, body = self.first
        turn, slide = (joints[name][link : link + len(self.links)] for name in ("turn", "slide"))
        zero = joints["zero"][body : body + len(self.bodies)]
        x = Rows.of([link.place for link in self.links]).take(q_s, q_f).reshape(-1) if self.links else np.zeros(0)
        if any(link.turns for link in self.links):
            return (_placed if is_concrete((x, joints)) else placed)(self, x, turn, slide, zero)
        # shifts alone add up, which JAX differentiates as well: A_b = Z_b + sum of x_i S_i over the links before b, J_i
        # = S_i
        return zero + self.summed(x[:, None, None] * slide)[0], slide

    def _motions(self, q_s, q_f, joints: dict[str, Any]):
        """A (bodies, 4, 4), and K (n, 4, 3) of all coordinates.

        A body b on joints has the rates ``A_b sum_i K_i v_i`` over the coordinates i on the way to it. A link has
        ``K_i = J_i D``, a coordinate of a root a unit row.
        """
        frames, twists = self._against_roots(q_s, q_f, joints)
        links, roots, *_ = self._tables
        twists = twists[:, :, 1:]
        if set(self._owners) - {GROUND}:
            twists = product(twists, self._roots(q_s, q_f, self._owners)[:, 1:])
        columns = (product(links, twists.reshape(-1, SIZE)) if self.links else 0.0) + roots
        return frames, columns.reshape(-1, 4, 3)

    def with_jacobian(self, q_s, q_f, joints: dict[str, Any]):
        """Q = (Q_s, Q_f) as one vector, and its Jacobian dQ/dq; of NumPy unless a number is traced."""
        bodies = self(q_s, q_f, joints)
        xp, n, (n_s, _) = library(q_s, q_f, joints), sum(self.sizes), self.sizes
        frames, columns = self._motions(q_s, q_f, joints)
        # A_b K_i if b is behind i, else zero
        of_bodies = product(frames[:, None], columns[None]) * self._tables[2].T[:, :, None, None]
        rows = xp.moveaxis(of_bodies, 1, -1).reshape(-1, n)
        end = bodies[0].size - n_s
        return xp.concatenate(bodies), xp.concatenate([np.eye(n)[:n_s], rows[:end], np.eye(n)[n_s:], rows[end:]])

    def mass_matrix(self, q_s, q_f, joints: dict[str, Any], masses: Sequence[Any]):
        """``(dQ/dq)^T m dQ/dq`` (n, n), in which the bodies behind a coordinate move as one, composite body.

        With the masses ``G_j = sum_b A_b^T m_b A_b`` of the bodies b behind a coordinate j, and K of `_motions`,

            M_ij = M_ji = tr(K_i^T G_j K_j)    for i on the way to j.

        Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), 6.2.

        Args:
            q_s, q_f, joints: as of a call.
            masses: m of Q_s and of Q_f; those of a body on joints are equal along each of its directors.
        """
        n = sum(self.sizes)
        own, of_bodies = zip(*(jnp.split(m, [size]) for m, size in zip(masses, self.sizes, strict=True)), strict=True)
        of_coordinates = jnp.diag(jnp.concatenate(own))
        if not self.bodies:
            return of_coordinates
        frames, columns = self._motions(q_s, q_f, joints)
        *_, behind, on_way = self._tables
        of_rows = jnp.concatenate(of_bodies).reshape(-1, 4, 3)[:, :, :1]
        of_frames = matmul(jnp.swapaxes(frames, 1, 2), of_rows * frames).reshape(-1, 16)
        composite = matmul(behind, of_frames).reshape(n, 4, 4)
        momenta = matmul(composite, columns).reshape(n, SIZE)
        half = matmul(columns.reshape(n, SIZE), momenta.T) * on_way
        return half + half.T + of_coordinates

    def velocities(self, q_s, q_f, v_s, v_f, joints: dict[str, Any]):
        """Rates of (Q_s, Q_f)."""
        return jax.jvp(lambda q_s, q_f: self(q_s, q_f, joints), (q_s, q_f), (v_s, v_f))[1]

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Kinematics":
        """The inverse of `dataclasses.asdict`, also after a round trip through JSON."""
        return cls(
            tuple(Place(*root) for root in data["roots"]),
            tuple(Link(Place(*place), *others) for place, *others in data["links"]),
            tuple(Carried(*body) for body in data["bodies"]),
            tuple(data["sizes"]),
            tuple(data["first"]),
        )

    @cached_property
    def lasts(self) -> np.ndarray:
        """(bodies + links,) number of the last link before each body and before each link; -1 for none."""
        return np.array([*(body.link for body in self.bodies), *(link.parent for link in self.links)], int)

    @cached_property
    def before(self) -> np.ndarray:
        """(bodies + links, links) 1 for the links between the root and each body, and between the root and each link.

        No link is before itself.
        """
        before = np.zeros((len(self.lasts), len(self.links)))
        for row, last in zip(before, self.lasts, strict=True):
            while last >= 0:
                row[last], last = 1.0, self.links[last].parent
        return before

    @property
    def is_deep(self) -> bool:
        """Whether a link hangs on another one."""
        return any(link.parent >= 0 for link in self.links)

    def jumps(self) -> Iterator[np.ndarray]:
        """Numbers of the links 1, 2, 4, ... links before each link, -1 for none, as long as there are some."""
        parents = np.array([link.parent for link in self.links], int)
        while (parents >= 0).any():
            yield parents
            parents = np.append(parents, -1)[parents]

    def summed(self, of_links):
        """Sums of (n, 4, 4) of the links before each body (bodies, 4, 4), and of the links before each link (n, 4, 4).

        By a product with the matrix `before`, whose program is small; beyond `LARGEST_MATRIX` links over 1, 2, 4, ...
        links at once, so that the time grows nearly in proportion to the number of links.
        """
        rows = of_links.reshape(-1, 16)
        if len(self.links) <= LARGEST_MATRIX:
            # without deep links the lower part is zero
            sums = product(self.before if self.is_deep else self.before[: len(self.bodies)], rows)
        else:
            for parents in self.jumps():
                rows = rows + _taken(rows, parents)
            sums = _taken(rows, self.lasts)
        return library(sums).split(sums.reshape(-1, 4, 4), [len(self.bodies)])

    def _roots(self, q_s, q_f, numbers: Sequence[int]):
        """(k, 4, 3) centre and directors of roots by their numbers (k,); (1, 4, 3) if all are the same."""
        roots = [(q_s if part == "s" else q_f)[start : start + size] for part, start, size in self.roots]
        if len(set(numbers)) == 1:
            return roots[numbers[0]].reshape(1, 4, 3)
        chosen, roots = np.array(numbers)[:, None] == [*range(len(roots)), GROUND], [*roots, UNMOVED.ravel()]
        return product(chosen.astype(float), library(roots).stack(roots)).reshape(-1, 4, 3)

    @cached_property
    def _owners(self) -> list[int]:
        """Numbers of the roots of the links."""
        behind = self.before[: len(self.bodies)]
        return [self.bodies[int(column.argmax())].root if column.any() else GROUND for column in behind.T]

    @cached_property
    def _tables(self) -> tuple[np.ndarray, ...]:
        """Over the n coordinates: the matrix (n, links) that puts the rows K_i of links at their places, and the rows
        (n, SIZE) of roots; (n, bodies) 1 for the bodies behind a coordinate; (n, n) 1 for each coordinate on the way to
        another one, 1/2 for two that move the same bodies."""
        n = sum(self.sizes)
        links, roots, behind = (np.zeros((n, k)) for k in (len(self.links), SIZE, len(self.bodies)))
        for i, link in enumerate(self.links):
            number = link.place.numbers(self.sizes[0])
            links[number, i], behind[number] = 1.0, self.before[: len(self.bodies), i]
        for k, root in enumerate(self.roots):
            numbers = root.numbers(self.sizes[0])
            roots[numbers], behind[numbers] = np.eye(SIZE), [body.root == k for body in self.bodies]
        # i is on the way to j if all bodies behind j are behind i
        on_way = behind @ behind.T == behind.sum(axis=1)
        return links, roots, behind, on_way / (1.0 + on_way.T)


def _placed(tree: Kinematics, x, turn, slide, zero):
    """A (bodies, 4, 4) and J (links, 4, 4).

    Args:
        x: (n,) coordinates of the links.
        turn, slide, zero: T (n, 4, 4), S (n, 4, 4), and Z (bodies, 4, 4).
    """
    xp = library(x, turn, slide, zero)
    sine, versine, way = (values[:, None, None] for values in (xp.sin(x), 1 - xp.cos(x), x))
    motions = np.eye(4) + sine * turn + versine * product(turn, turn) + way * slide
    for parents in tree.jumps():
        motions = product(motions, _with_unmoved(motions)[parents])  # after k turns, motions of the last 2^k links
    twists = turn + slide
    if tree.is_deep:  # else E_i = exp(x_i Y_i), which leaves its own Y_i as it is
        # E^-1 = (1, -r M^T; 0, M^T)
        twists = product(twists, motions)
        turning = product(xp.swapaxes(motions[:, 1:, 1:], 1, 2), twists[:, 1:])
        twists = xp.concatenate([twists[:, :1] - product(motions[:, :1, 1:], turning), turning], axis=1)
    return product(zero, _with_unmoved(motions)[tree.lasts[: len(tree.bodies)]]), twists


placed = jax.custom_jvp(_placed, nondiff_argnums=(0,))
"""`_placed` with derivatives in closed form."""


@partial(placed.defjvp, symbolic_zeros=True)
def _change(tree: Kinematics, arguments, tangents):
    (x, *constants), (dx, *changes) = arguments, tangents
    frames, twists = placed(tree, *arguments)
    d_frames, d_twists = jnp.zeros_like(frames), jnp.zeros_like(twists)
    if not isinstance(dx, SymbolicZero):
        of_bodies, of_links = tree.summed(dx[:, None, None] * twists)
        d_frames = matmul(frames, of_bodies)
        if tree.is_deep:
            d_twists = matmul(twists, of_links) - matmul(of_links, twists)
    if not all(isinstance(change, SymbolicZero) for change in changes):
        changes = [
            jnp.zeros_like(c) if isinstance(change, SymbolicZero) else change
            for c, change in zip(constants, changes, strict=True)
        ]
        by_constants = jax.jvp(partial(_placed, tree, x), constants, changes)[1]
        d_frames, d_twists = d_frames + by_constants[0], d_twists + by_constants[1]
    return (frames, twists), (d_frames, d_twists)


def _taken(rows, numbers):
    """Rows (n, k) by their numbers, zeros for -1, by static slices: derivatives in reverse mode are no scatters."""
    follows = [b - a == (a >= 0) for a, b in pairwise(numbers)]
    ends = [0, *(i for i, goes_on in enumerate(follows, 1) if not goes_on), len(numbers)]
    pieces = [
        rows[numbers[i] : numbers[i] + j - i] if numbers[i] >= 0 else np.zeros((j - i, rows.shape[1]))
        for i, j in pairwise(ends)
    ]
    return library(pieces).concatenate(pieces)


def product(a, b):
    """``a @ b``, of NumPy unless an entry is traced."""
    return a @ b if is_concrete((a, b)) else matmul(a, b)


def _with_unmoved(motions):
    """Motions (n, 4, 4), and the motion of nothing as the last one, number -1."""
    return library(motions).concatenate([motions, np.eye(4)[None]])
