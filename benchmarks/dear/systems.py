"""Molecules with all pairs, and a network with its student: each with one dear force, and with that force split over
two rates."""

from functools import partial
from itertools import combinations, pairwise

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm

BOND, STIFFNESS = 0.8, 5e4
"""Length of a bond and its stiffness with unit masses: frequency 316, about 30 times the frequency of neighbours in the
lattice, as of nitrogen."""
SPACING, SPEED = 1.9, 0.5
"""Distance of the molecules of the lattice, in diameters of an atom, and the size of their random velocities."""
WIDTHS = {"student": (16,), "teacher": (300, 300)}
"""Hidden layers of the networks: 1e5 weights of the teacher."""
MIDDLE = "middle"
"""Name of the potential between the two grids, where there are three rates."""


# --- molecules -------------------------------------------------------------------------------------------------------
def lennard_jones(pairs, q_s, q_f, params):
    """``sum 4 (r^-12 - r^-6)`` over pairs of atoms."""
    q = q_f.reshape(-1, 3)
    d = q[pairs[:, 0]] - q[pairs[:, 1]]
    inverse = 1 / jnp.sum(d * d, axis=1) ** 3
    return 4 * jnp.sum(inverse * (inverse - 1))


def bonds(q_f, params):
    """``k / 2 sum (|q_2i - q_2i+1| - l)^2``."""
    q = q_f.reshape(-1, 2, 3)
    return STIFFNESS / 2 * jnp.sum((jnp.linalg.norm(q[:, 0] - q[:, 1], axis=1) - BOND) ** 2)


def molecules(n: int, three_rates: bool = False) -> vm.Problem:
    """Diatomic molecules on a lattice, turned and kicked at random.

    Args:
        n: number of molecules.
        three_rates: whether the pairs of neighbours in the lattice are a potential of their own, `MIDDLE`.
    """
    random = np.random.default_rng(0)
    side = int(np.ceil(n ** (1 / 3)))
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)[:n]
    axes = random.normal(size=(n, 3))
    axes *= BOND / 2 / np.linalg.norm(axes, axis=1)[:, None]
    q = np.stack([SPACING * cells - axes, SPACING * cells + axes], axis=1).reshape(-1)
    pairs = np.array([(i, j) for i, j in combinations(range(2 * n), 2) if i // 2 != j // 2])
    masses, velocity = vm.ConstantMass([], np.ones(6 * n)), SPEED * random.normal(size=6 * n)
    if not three_rates:
        return vm.Problem(vm.System(masses, partial(lennard_jones, pairs), bonds), [], q, [], velocity)
    near = np.abs(cells[pairs[:, 0] // 2] - cells[pairs[:, 1] // 2]).max(axis=1) <= 1
    neighbours, others = (partial(lennard_jones, part) for part in (pairs[near], pairs[~near]))
    system = vm.System(masses, others, bonds, potentials={MIDDLE: neighbours})
    return vm.Problem(system, [], q, [], velocity)


# --- a teacher and its student ---------------------------------------------------------------------------------------
def network(weights, q):
    """A potential: tanh layers, and a sum with the last weights."""
    for matrix, bias in weights:
        q = jnp.tanh(matrix @ q + bias)
    return jnp.sum(q) / jnp.sqrt(q.size)


def difference(q_s, q_f, params):
    """What the teacher knows beyond the student, a tenth of the student's potential."""
    return 0.1 * network(params["teacher"], q_f)


def student(q_s, q_f, params):
    """The potential of the student."""
    return network(params["student"], q_f)


def springs(q_f, params):
    """Stiff springs along the chain."""
    stretch = jnp.diff(q_f.reshape(-1, 3), axis=0)
    return STIFFNESS / 2 * jnp.sum((jnp.linalg.norm(stretch, axis=1) - 1.0) ** 2)


def springs_and_student(q_f, params):
    """Both on one grid."""
    return springs(q_f, params) + network(params["student"], q_f)


def teacher(three_rates: bool = False, count: int = 6) -> vm.Problem:
    """A chain of `count` points in the potential of the teacher.

    Args:
        three_rates: whether the student is a potential of its own, `MIDDLE`.
        count: points of the chain.
    """
    random = np.random.default_rng(1)

    def weights(widths):
        sizes = [3 * count, *widths]
        return [
            (jnp.asarray(random.normal(size=(b, a)) / np.sqrt(a)), jnp.asarray(random.normal(size=b)))
            for a, b in pairwise(sizes)
        ]

    params = {name: weights(widths) for name, widths in WIDTHS.items()}
    q = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).reshape(-1)
    fast, potentials = (springs, {MIDDLE: student}) if three_rates else (springs_and_student, None)
    masses = vm.ConstantMass([], np.ones(3 * count))
    system = vm.System(masses, difference, fast, params=params, potentials=potentials)
    return vm.Problem(system, [], q, [], SPEED * random.normal(size=3 * count))
