"""The same problems in the words of the peers: particles, springs and rods; accelerations without multipliers.

Expressions are of single numbers, which may be arrays of JAX or symbols of heyoka.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

import vmri_jax as vm


@dataclass(frozen=True)
class Particles:
    """Particles in space under gravity along -z, joined by springs and rigid rods.

    masses: one per particle.
    springs: ``(i, j, k, l)``, potentials ``k/2 (|q_j - q_i| - l)^2``.
    rods: ``(i, j, l)``, constraints ``|q_j - q_i| = l``; i = -1 is the origin.
    """

    masses: tuple[float, ...]
    springs: tuple[tuple[int, int, float, float], ...]
    rods: tuple[tuple[int, int, float], ...]
    gravity: float

    @staticmethod
    def of(problem: vm.Problem) -> "Particles":
        """A `triple_spherical_pendulum` or a `simple_atomic_model`."""
        p = {name: np.asarray(value).tolist() for name, value in problem.system.params.items()}
        k, length = p["stiffness"], p.get("length")
        if length is None:
            springs, rods = [(1, 2, k, p["lengths"][2])], [(-1, 0, p["lengths"][0]), (0, 1, p["lengths"][1])]
        else:
            springs = [(0, 1, k[0], length), (1, 2, k[1], length)]
            springs += [(i, j, k[2], length) for i, j in ((2, 3), (3, 4), (4, 2))]
            rods = [(-1, 0, length), (1, 3, length), (1, 4, length), (2, 5, length)]
        return Particles(tuple(p["masses"]), tuple(springs), tuple(rods), p["gravity"])

    def energy(self, q, v) -> float:
        """Kinetic and potential energy; positions and velocities (3 n,)."""
        q, v, m = np.reshape(q, (-1, 3)), np.reshape(v, (-1, 3)), np.array(self.masses)
        springs = sum(k / 2 * (np.linalg.norm(q[j] - q[i]) - length) ** 2 for i, j, k, length in self.springs)
        return float(m @ (v**2).sum(axis=1) / 2 + springs + self.gravity * m @ q[:, 2])

    def forces(self, q: Sequence, sqrt) -> list:
        """Forces of springs and gravity, 3 per particle, as expressions of the 3 n positions."""
        force: list[Any] = [0.0, 0.0, 0.0] * len(self.masses)
        for i, m in enumerate(self.masses):
            force[3 * i + 2] = -m * self.gravity
        for i, j, k, length in self.springs:
            d = _between(q, i, j)
            pull = k - k * length / sqrt(dot(d, d))  # k (|d| - l) / |d|
            for axis in range(3):
                force[3 * i + axis] += pull * d[axis]
                force[3 * j + axis] -= pull * d[axis]
        return force

    def rod_matrix(self, d: Sequence[Sequence], e: Sequence[Sequence]) -> list[list]:
        """``G(d) M^-1 G(e)^T`` for rows of G that are the rods d and e; None where two rods share no particle."""
        entries: list[list[Any]] = [[None] * len(self.rods) for _ in self.rods]
        for a, (i, j, _) in enumerate(self.rods):
            for b, (k, n, _) in enumerate(self.rods):
                shared = [
                    ((j, i).index(x) * 2 - 1) * ((n, k).index(x) * 2 - 1) / self.masses[x]
                    for x in {i, j} & {k, n} - {-1}
                ]
                if shared:
                    entries[a][b] = sum(shared) * dot(d[a], e[b])
        return entries

    def rods_of(self, q: Sequence) -> list[list]:
        """The rods as vectors."""
        return [_between(q, i, j) for i, j, _ in self.rods]

    def accelerations(self, q: Sequence, v: Sequence, sqrt) -> list:
        """``M^-1 (F + G^T mu)``, the multipliers mu such that the rods keep their length at acceleration level.

        With rods d and the differences w of the velocities of their ends: ``d . d'' + w . w = 0``.
        """
        free = [f / self.masses[i // 3] for i, f in enumerate(self.forces(q, sqrt))]
        rods, rates, relative = self.rods_of(q), self.rods_of(v), self.rods_of(free)
        right = [-dot(w, w) - dot(d, a) for d, w, a in zip(rods, rates, relative, strict=True)]
        mu = solve(self.rod_matrix(rods, rods), right)
        return self.pulled(free, rods, mu)

    def pulled(self, a: Sequence, rods: Sequence[Sequence], mu: Sequence) -> list:
        """``a + M^-1 G^T mu``."""
        a = list(a)
        for (i, j, _), d, x in zip(self.rods, rods, mu, strict=True):
            for axis in range(3):
                if i >= 0:
                    a[3 * i + axis] -= x * d[axis] / self.masses[i]
                a[3 * j + axis] += x * d[axis] / self.masses[j]
        return a


def solve(matrix: Sequence[Sequence], right: Sequence) -> list:
    """Gaussian elimination without pivoting, of numbers or symbols; None is a zero that costs nothing."""
    a, x, n = [list(row) for row in matrix], list(right), len(right)
    for k in range(n):
        for i in range(k + 1, n):
            if a[i][k] is None:
                continue
            factor = a[i][k] / a[k][k]
            for j in range(k + 1, n):
                if a[k][j] is not None:
                    a[i][j] = -factor * a[k][j] if a[i][j] is None else a[i][j] - factor * a[k][j]
            x[i] = x[i] - factor * x[k]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            if a[i][j] is not None:
                x[i] = x[i] - a[i][j] * x[j]
        x[i] = x[i] / a[i][i]
    return x


def chain_gaps(q: Sequence) -> list:
    """Lengths of the soft springs of a Fermi-Pasta-Ulam chain between walls at 0, up to sqrt(2)."""
    n = len(q) // 2
    s, f = q[:n], q[n:]
    return [s[0] - f[0], *(s[i + 1] - f[i + 1] - s[i] - f[i] for i in range(n - 1)), -(s[-1] + f[-1])]


def chain_accelerations(q: Sequence, omega: float) -> list:
    """Of a Fermi-Pasta-Ulam chain, ``-dV/ds`` and ``-dV/df - omega^2 f``, over single numbers."""
    cubes = [d * d * d for d in chain_gaps(q)]
    f = q[len(q) // 2 :]
    slow = [right - left for left, right in pairwise(cubes)]
    fast = [left + right - omega**2 * x for (left, right), x in zip(pairwise(cubes), f, strict=True)]
    return slow + fast


def to_masses(q):
    """Places of the masses of a chain, left and right end of every stiff spring: ``(s -+ f) / sqrt(2)``."""
    s, f = np.split(np.asarray(q), 2)
    return np.stack([s - f, s + f], axis=1).reshape(-1) / np.sqrt(2)


def from_masses(x):
    """The inverse of `to_masses`."""
    left, right = np.reshape(x, (-1, 2)).T
    return np.concatenate([left + right, right - left]) / np.sqrt(2)


def _between(q: Sequence, i: int, j: int) -> list:
    """``q_j - q_i``; i = -1 is the origin."""
    return [q[3 * j + axis] if i < 0 else q[3 * j + axis] - q[3 * i + axis] for axis in range(3)]


def dot(a: Sequence, b: Sequence):
    """Of two vectors in space."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
