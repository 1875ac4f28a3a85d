"""How fast bodies would move under each effect alone, and the border between slow and fast.

A potential (L = -V) or kinetic effect gives the force ``f(q, v) = L_q - L_vq v`` at constant velocity; gauge terms drop out.
With the stiffness ``K = -df/dq``, the gyroscopic matrix G, the antisymmetric part of df/dv, and the mass matrix M of its
bodies, the frequency of an element is the largest w at the start with ``det(K - w^2 M) = 0`` or ``det(G - i w M) = 0``.

The rate is that, or ``sqrt(a / L)`` if larger: a an acceleration of bodies at rest, L the size of the scene. The border is
the middle of the widest gap between all rates, on a logarithmic scale.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from vmri_jax.mechanics.arrays import quickly_compiled
from vmri_jax.scene.body import LARGEST_POINT, Bodies, moving
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.terms import EffectTerm

SEPARATION = 3.0
"""Smallest ratio of two neighbouring rates that separates slow from fast; without, one rate is enough for all."""
SPAN = 1e3
"""Largest ratio of time scales that counts: slower effects are slow in any case, and would hide the gap between slow and fast ones."""


class Rates(NamedTuple):
    """Of every element of an effect: the frequency of its linearised motion and the rate of its change, rad/s."""

    frequency: np.ndarray
    rate: np.ndarray


class Linearised(NamedTuple):
    """An element at the start: its columns, its force on bodies at rest, K, G, and d2L/dv2, its part of the mass matrix.

    All are those of the motions that the bodies can make: of a rigid one the velocity of its centre and its spin.
    """

    columns: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    gyroscopic: np.ndarray
    mass: np.ndarray


def measure(bodies: Bodies, effects: Sequence[Effect]) -> dict[str, Rates]:
    """Rates of potentials and kinetic effects by name.

    Args:
        bodies: by name.
        effects: the potentials and kinetic effects.

    Raises:
        ValueError: energies that are not smooth at the start, or a kinetic energy that is not positive there.
    """
    sizes = [body.motions.shape[1] for body in bodies.values()]
    columns = dict(zip(bodies, np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]), strict=True))
    mass = np.asarray(block_diag(*(body.motions.T @ (body.masses[:, None] * body.motions) for body in bodies.values())))
    found = {effect.name: _linearise(effect, bodies, columns) for effect in effects}
    for element in chain(*found.values()):
        mass[np.ix_(element.columns, element.columns)] += element.mass
    positions = _positions(bodies)
    size = max(float(np.ptp(positions, axis=0).max(initial=0.0)), float(np.abs(positions).max()))
    return {effect.name: _rates(effect, bodies, found[effect.name], mass, size or 1.0) for effect in effects}


def border(rates: Sequence[np.ndarray], slow: float = 0.0, fast: float = np.inf) -> float | None:
    """The middle of the widest gap between rates, None where there is none.

    Args:
        rates: of all effects, rad/s.
        slow, fast: the border is above the one and below the other, rates of effects that are declared slow and fast.
    """
    found = np.sort([rate for some in rates for rate in some if rate > 0])
    if not found.size:
        return None
    found = np.maximum(found, found[-1] / SPAN)
    gaps = [(high / low, np.sqrt(high * low)) for low, high in pairwise(found) if slow <= low and high <= fast]
    widest, middle = max(gaps, default=(1.0, 0.0))
    declared = slow > 0 or fast < np.inf
    return float(middle) if widest >= SEPARATION or (declared and widest > 1) else None


def _rates(effect: Effect, bodies, elements: Sequence[Linearised], mass: np.ndarray, size: float) -> Rates:
    known = effect.curvature(bodies)
    curvatures = np.broadcast_to(-np.inf if known is None else known, len(elements))
    frequency, rate = np.zeros(len(elements)), np.zeros(len(elements))
    for i, (names, element) in enumerate(zip(effect.elements(bodies), elements, strict=True)):
        own = mass[np.ix_(element.columns, element.columns)]
        lightest = np.linalg.eigvalsh(own).min()
        if not lightest > 0:
            raise ValueError(
                f"{effect.name}: the kinetic energy of {', '.join(names)} is not positive at the start; change masses or kinetic "
                "effects, or give every body a pace and every potential between fast bodies a rate."
            )
        root = np.linalg.cholesky(own)
        matrix = _scaled(root, (element.stiffness + element.stiffness.T) / 2)
        largest = max(np.linalg.eigvalsh(matrix).max(), curvatures[i] / lightest)
        if largest > 1e-12 * np.abs(matrix).max(initial=0.0):  # else round-off
            frequency[i] = np.sqrt(largest)
        frequency[i] = max(frequency[i], np.linalg.norm(_scaled(root, element.gyroscopic), 2))
        rate[i] = max(frequency[i], np.sqrt(np.abs(np.linalg.solve(own, element.force)).max() / size))
    same: dict[frozenset, list[int]] = {}
    for i, names in enumerate(effect.elements(bodies)):
        same.setdefault(frozenset(names), []).append(i)
    for some in same.values():  # terms of one sum, as of a torsion: they belong together
        frequency[some], rate[some] = frequency[some].max(), rate[some].max()
    return Rates(frequency, rate)


def _scaled(root: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``R^-1 X R^-T``, whose eigenvalues are those of M^-1 X for ``M = R R^T``."""
    return np.linalg.solve(root, np.linalg.solve(root, matrix).T).T


def _linearise(effect: Effect, bodies: Bodies, columns: Mapping[str, np.ndarray]) -> list[Linearised]:
    params, found = effect.parameters(bodies), []
    for i, element in enumerate(map(moving, effect.elements(bodies))):
        term, own = effect.alone(i, bodies, params)
        q, v = (jnp.concatenate([getattr(bodies[name], what) for name in element]) for what in ("coordinates", "rates"))
        force, *matrices = map(np.asarray, _derivatives(term, effect.kind == "kinetic", q, v, own))
        motions = block_diag(*(bodies[name].motions for name in element))
        parts = motions.T @ force, *(motions.T @ matrix @ motions for matrix in matrices)
        found.append(Linearised(np.concatenate([columns[name] for name in element]), *parts))
        if not all(np.isfinite(part).all() for part in found[-1]):
            raise ValueError(
                f"{effect.name}: its energy between {', '.join(element)} has no finite derivatives at the start; move them, or smooth it."
            )
    return found


@partial(quickly_compiled, static_argnames=("term", "kinetic"))
def _derivatives(term: EffectTerm, kinetic: bool, q, v, params):
    """What `Linearised` holds after the columns, before the motions of bodies are chosen."""
    if not kinetic:  # L = -V(q) has no derivatives by velocities, which would be traced and compiled for nothing

        def gradient(q):
            values = jax.grad(term.value)(q, None, params)
            return values, values

        stiffness, values = jax.jacfwd(gradient, has_aux=True)(q)
        none = jnp.zeros_like(stiffness)
        return -values, stiffness, none, none

    def lagrangian(q, v):
        return term.kinetic(q, None, v, None, params)

    def force(q, v):
        momentum = jax.grad(lagrangian, 1)
        return jax.grad(lagrangian)(q, v) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]

    moved = jax.jacfwd(force, 1)(q, v)
    at_rest = jax.grad(lagrangian)(q, jnp.zeros_like(v))
    return at_rest, -jax.jacfwd(force)(q, v), (moved - moved.T) / 2, jax.hessian(lagrangian, 1)(q, v)


def _positions(bodies) -> np.ndarray:
    """All points and centres in one array, blocks left out where there are points; padded with zeros."""
    points = [np.asarray(body.point().position) for body in bodies.values() if not body.block] or [np.zeros(1)]
    return np.stack([np.pad(point, (0, LARGEST_POINT - point.size)) for point in points])
