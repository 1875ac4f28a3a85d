"""Derivatives of bodies on joints in closed form against derivatives by JAX, through all motions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax.mechanics import kinematics
from vmri_jax.mechanics.kinematics import Carried, Kinematics, Link, _placed, placed
from vmri_jax.mechanics.rows import Place

LINKS, BODIES = 6, 5


def random_tree(seed: int):
    """A tree on a free root and the ground, whose links turn, slide or screw; x; axes, points and places at x = 0."""
    random = np.random.default_rng(seed)
    parents = [int(random.integers(-1, i)) for i in range(LINKS)]
    links = tuple(Link(Place("f", i, 1), parent) for i, parent in enumerate(parents))
    bodies = tuple(Carried("f", int(i % 2) - 1, int(link)) for i, link in enumerate(random.integers(-1, LINKS, BODIES)))
    tree = Kinematics((Place("s", 0, 12),), links, bodies, (12, LINKS))
    axis, point = random.normal(size=(2, LINKS, 3))
    turns, ways = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.3, 0.0, 1.0, 0.0])
    zero = np.concatenate([random.normal(size=(BODIES, 1, 3)), np.linalg.qr(random.normal(size=(BODIES, 3, 3)))[0]], 1)
    return tree, random.normal(size=LINKS), (axis, point, zero), (turns, ways), random.normal(size=(5, BODIES, 4, 3))


def energy(of_tree, kinds, weights, x, v, joints):
    """Weighted squares of the rates of frames, and weighted frames, by ``of_tree(x, T, S, Z)`` -> frames and twists."""
    (axis, point, zero), (turns, ways) = joints, kinds
    axis = axis / jnp.linalg.norm(axis, axis=1, keepdims=True)
    arms = jnp.concatenate([-point[:, None], jnp.broadcast_to(jnp.eye(3), (LINKS, 3, 3))], axis=1)
    turn, slide = turns[:, None, None] * jnp.cross(axis[:, None], arms), ways[:, None, None] * axis[:, None]
    turn, slide, zero = (jnp.pad(x, ((0, 0), (0, 4 - x.shape[1]), (1, 0))) for x in (turn, slide, zero))
    zero += np.diag([1.0, 0, 0, 0])
    frames, rates = (rows[..., 1:] for rows in jax.jvp(lambda x: of_tree(x, turn, slide, zero)[0], (x,), (v,)))
    return jnp.sum(weights[0] ** 2 * rates**2) / 2 + jnp.sum(weights[1] * frames)


@pytest.mark.parametrize(("seed", "largest"), [(0, LINKS), (1, 0)])
def test_derivatives_in_closed_form_are_those_of_the_motions(seed, largest, monkeypatch):
    """With sums over links by a matrix, and as of long chains."""
    monkeypatch.setattr(kinematics, "LARGEST_MATRIX", largest)
    tree, x, joints, kinds, weights = random_tree(seed)
    v = weights[2].ravel()[:LINKS]

    @jax.jit
    def both(x, v, joints):
        values = []
        for function in (placed, _placed):
            of_tree = partial(energy, partial(function, tree), kinds, weights)
            by_all = jax.grad(of_tree, (0, 1, 2))
            tangents = jax.tree.map(lambda a: jnp.cos(jnp.arange(a.size)).reshape(a.shape), (x, v, joints))
            values.append((*jax.jvp(by_all, (x, v, joints), tangents), jax.jacfwd(jax.grad(of_tree, 1))(x, v, joints)))
        return values

    mine, theirs = both(x, v, joints)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11 * max(1.0, float(jnp.abs(b).max())))
