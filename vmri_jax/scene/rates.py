"""How fast bodies would move under each effect alone, and the border between slow and fast.

A potential (L = -V) or kinetic effect gives the force ``f(q, v) = L_q - L_vq v`` at constant velocity; gauge terms, total
time derivatives in L, drop out of it. With the stiffness ``K = -df/dq`` (V'' of a potential), the gyroscopic matrix G, the
antisymmetric part of df/dv (``L_qv - L_vq``: of a charge in a magnetic field the matrix of Q v x B), and the mass matrix M
of its bodies, the frequency of an element is, at the start, the largest w with ``det(K - w^2 M) = 0`` or ``det(G - i w M) = 0``.

What gives bodies at rest an acceleration a has a rate without any curvature, ``sqrt(a / L)``, L the size of the scene. The
border is the middle of the widest gap between all rates, on a logarithmic scale; where no gap is as wide as SEPARATION, one
rate is enough for all.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.scene.body import LARGEST_POINT, Body
from vmri_jax.scene.effect import Effect

SEPARATION = 3.0
"""Smallest ratio of two neighbouring rates that separates slow from fast."""
SPAN = 1e3
"""Rates slower than the fastest one by more than this count as slower by this: they are slow in any case."""


class Rates(NamedTuple):
    """Of every element of an effect: the frequency of its linearised motion and the rate of its change, rad/s."""

    frequency: np.ndarray
    rate: np.ndarray


class Linearised(NamedTuple):
    """An element at the start: its force on bodies at rest, K, G, and what it adds to the mass matrix, d2L/dv2."""

    force: np.ndarray
    stiffness: np.ndarray
    gyroscopic: np.ndarray
    mass: np.ndarray


def measure(bodies: Mapping[str, Body], effects: Sequence[Effect]) -> dict[str, Rates]:
    """Rates of potentials and kinetic effects by name.

    Raises:
        ValueError: energies that are not smooth at the start, or a kinetic energy that is not positive there.
    """
    found = {effect.name: _linearise(effect, bodies) for effect in effects}
    blocks = {(name, name): np.diag(np.broadcast_to(body.mass, (body.size,))) for name, body in bodies.items()}
    for effect in effects:
        for element, linearised in zip(effect.elements(bodies), found[effect.name], strict=True):
            cuts = np.cumsum([bodies[name].size for name in element])[:-1]
            for a, rows in zip(element, np.split(linearised.mass, cuts), strict=True):
                for b, block in zip(element, np.split(rows, cuts, axis=1), strict=True):
                    blocks[a, b] = blocks.get((a, b), 0.0) + block
    size = max(float(np.ptp(_positions(bodies), axis=0).max(initial=0.0)), float(np.abs(_positions(bodies)).max()))
    return {effect.name: _rates(effect, bodies, found[effect.name], blocks, size or 1.0) for effect in effects}


def border(rates: Sequence[np.ndarray]) -> float | None:
    """The middle of the widest gap between rates, None where there is none."""
    found = np.concatenate([*rates, np.zeros(0)])
    found = np.sort(found[found > 0])
    if not found.size:
        return None
    found = np.maximum(found, found[-1] / SPAN)
    gaps = [(high / low, np.sqrt(high * low)) for low, high in pairwise(found)]
    widest, middle = max(gaps, default=(1.0, 0.0))
    return float(middle) if widest >= SEPARATION else None


def _rates(effect: Effect, bodies, elements: Sequence[Linearised], blocks, size: float) -> Rates:
    known = effect.curvature(bodies)
    frequency, rate = np.zeros(len(elements)), np.zeros(len(elements))
    for i, (names, (force, stiffness, gyroscopic, _)) in enumerate(zip(effect.elements(bodies), elements, strict=True)):
        zeros = {(a, b): np.zeros((bodies[a].size, bodies[b].size)) for a in names for b in names}
        mass = np.block([[blocks.get((a, b), zeros[a, b]) for b in names] for a in names])
        lightest = np.linalg.eigvalsh(mass).min()
        if not lightest > 0:
            raise ValueError(
                f"{effect.name}: the kinetic energy of {', '.join(names)} is not positive at the start; change masses or kinetic "
                "effects, or give every body a pace and every potential between fast bodies a rate."
            )
        root = np.linalg.cholesky(mass)
        matrix = _scaled(root, (stiffness + stiffness.T) / 2)
        largest = np.linalg.eigvalsh(matrix).max()
        if known is not None:
            largest = max(largest, np.broadcast_to(known, len(elements))[i] / lightest)
        largest = max(largest, 0.0) if largest > 1e-12 * np.abs(matrix).max(initial=0.0) else 0.0
        frequency[i] = max(np.sqrt(largest), np.linalg.norm(_scaled(root, gyroscopic), 2))
        rate[i] = max(frequency[i], np.sqrt(np.abs(np.linalg.solve(mass, force)).max() / size))
    return Rates(frequency, rate)


def _scaled(root: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``R^-1 X R^-T``, whose eigenvalues are those of M^-1 X for ``M = R R^T``."""
    return np.linalg.solve(root, np.linalg.solve(root, matrix).T).T


def _linearise(effect: Effect, bodies: Mapping[str, Body]) -> list[Linearised]:
    params, found = effect.parameters(bodies), []
    for i, element in enumerate(effect.elements(bodies)):
        q, v = (tuple(getattr(bodies[name], what) for name in element) for what in ("position", "velocity"))
        chosen = effect.one(params, i, bodies)
        found.append(
            Linearised(*map(np.asarray, _derivatives(effect.function, effect.kind == "kinetic", q, v, chosen)))
        )
        if not all(np.isfinite(part).all() for part in found[-1]):
            raise ValueError(
                f"{effect.name}: its energy between {', '.join(element)} has no finite derivatives at the start; move them, or smooth it."
            )
    return found


@partial(jax.jit, static_argnames=("function", "kinetic"))
def _derivatives(function, kinetic: bool, q, v, params):
    """What `Linearised` holds."""
    (q, unravel), (v, _) = ravel_pytree(q), ravel_pytree(v)

    def lagrangian(q, v):
        return function(unravel(q), unravel(v), params) if kinetic else -function(unravel(q), params)

    def force(q, v):
        momentum = jax.grad(lagrangian, 1)
        return jax.grad(lagrangian)(q, v) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]

    moved = jax.jacfwd(force, 1)(q, v)
    at_rest = jax.grad(lagrangian)(q, jnp.zeros_like(v))
    return at_rest, -jax.jacfwd(force)(q, v), (moved - moved.T) / 2, jax.hessian(lagrangian, 1)(q, v)


def _positions(bodies) -> np.ndarray:
    """Coordinates of all points in one array, blocks left out where there are points; padded with zeros."""
    points = [np.asarray(body.position) for body in bodies.values() if not body.block] or [np.zeros(1)]
    return np.stack([np.pad(point, (0, LARGEST_POINT - point.size)) for point in points])
