"""The rate at which each effect alone would move its bodies, and the border between slow and fast rates.

An effect adds L(q, v) to the Lagrangian; of a potential, ``L = -V``. At constant v its force is
``f = dL/dq - d/dt dL/dv = L_q - L_vq v``; a total time derivative in L adds nothing to f. The stiffness is
``K = -df/dq``, the gyroscopic matrix G is the antisymmetric part of df/dv, and M is the mass matrix of the bodies of an
element. The frequency of the element is the largest w at the start with ``det(K - w^2 M) = 0`` or
``det(G - i w M) = 0``.

The rate of the element is the largest of this frequency, ``sqrt(a / L)`` and ``sqrt(alpha)``, with the largest
acceleration a and angular acceleration alpha that it gives to bodies at rest, and the size L of the scene. The border
is the middle of the widest gap between all rates, on a logarithmic scale.
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
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.mechanics.linearisation import mass_orthonormal
from vmri_jax.mechanics.motion import force_of
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import LARGEST_POINT, Bodies, label_of, moving
from vmri_jax.scene.effect import Effect

SEPARATION = 3.0
"""Smallest ratio of neighbouring rates that separates slow from fast: below it micro steps cost more than they save.
With a larger value fewer scenes have fast bodies."""
SPAN = 1e3
"""Rates below the fastest rate over SPAN count as the fastest rate over SPAN. Their effects are slow in any case, and
with a larger value the gap between these effects and all others may be wider than the gap between slow and fast
effects."""
ROUND_OFF = 1e-12
"""An eigenvalue of the stiffness below this fraction of its largest entry is round-off, and the frequency zero. A
larger value hides soft motions of stiff elements."""


class Rates(NamedTuple):
    """Frequencies and rates of all elements of an effect, (n,) rad/s each."""

    frequency: np.ndarray
    rate: np.ndarray


class Linearised(NamedTuple):
    """An element at the start, in the velocities of its bodies: of a rigid body that of its centre and its spin.

    columns: indices of these velocities among the velocities of all bodies.
    force, stiffness, gyroscopic, mass: force on the bodies at rest, K, G, and d2L/dv2, a part of the mass matrix.
    """

    columns: np.ndarray
    force: np.ndarray
    stiffness: np.ndarray
    gyroscopic: np.ndarray
    mass: np.ndarray


def measure(bodies: Bodies, effects: Sequence[Effect]) -> dict[str, Rates]:
    """Rates of potentials and kinetic effects by name; the inertia is the one of `bodies`, where frames have some."""
    sizes = [body.motions.shape[1] for body in bodies.values()]
    columns = dict(zip(bodies, np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]), strict=True))
    # M = A^T diag(m) A with the motions A of each body, plus d2L/dv2 of kinetic effects
    mass = np.asarray(block_diag(*(body.motions.T @ (body.masses[:, None] * body.motions) for body in bodies.values())))
    elements = {
        effect.name: [_linearise(effect, i, bodies, columns) for i in range(len(effect.elements))] for effect in effects
    }
    for element in chain(*elements.values()):
        mass[np.ix_(element.columns, element.columns)] += element.mass
    # the first three coordinates of a rigid body are its centre, all others directors
    centres = [(body.motions, 3 if body.rigid else body.size) for body in bodies.values()]
    motions = block_diag(*(m[:k] for m, k in centres)), block_diag(*(m[k:] for m, k in centres))
    points = positions(bodies)
    size = max(float(np.ptp(points, axis=0).max(initial=0.0)), float(np.abs(points).max()))
    return {effect.name: _rates(effect, elements[effect.name], mass, motions, size or 1.0) for effect in effects}


def border(measured: Mapping[str, Rates], effects: Sequence[Effect]) -> float | None:
    """The border between slow and fast: the middle of the widest gap between rates, rad/s; None if no gap is wide
    enough.

    It is above the largest rate of the effects that are declared slow, and below the smallest one of those declared
    fast.
    """
    of_slow, of_fast = (
        [measured[effect.name].rate for effect in effects if effect.rate == rate and effect.name in measured]
        for rate in ("slow", "fast")
    )
    slow, fast = max(map(np.max, of_slow), default=0.0), min(map(np.min, of_fast), default=np.inf)
    ordered = np.sort([rate for rates in measured.values() for rate in rates.rate if rate > 0])
    if not ordered.size:
        return None
    ordered = np.maximum(ordered, min(ordered[-1], fast) / SPAN)
    gaps = [(high / low, np.sqrt(high * low)) for low, high in pairwise(ordered) if slow <= low and high <= fast]
    widest, middle = max(gaps, default=(1.0, 0.0))
    declared = slow > 0 or fast < np.inf  # then the user says that there are two time scales: any gap will do
    return float(middle) if widest >= SEPARATION or (declared and widest > 1) else None


def _rates(effect: Effect, elements: Sequence[Linearised], mass: np.ndarray, motions: Sequence, size: float) -> Rates:
    """Of the elements of an effect; `motions` are matrices from all velocities to rates of positions, and to rates of
    directors."""
    declared = effect.curvature()
    curvatures = np.broadcast_to(-np.inf if declared is None else declared, len(elements))
    frequency, rate = np.zeros(len(elements)), np.zeros(len(elements))
    for i, (names, element) in enumerate(zip(effect.elements, elements, strict=True)):
        translation, turning = (np.asarray(part)[:, element.columns] for part in motions)
        element_mass = mass[np.ix_(element.columns, element.columns)]
        if not np.linalg.eigvalsh(element_mass).min() > 0:
            raise Refused(
                f"{effect.name}: the kinetic energy of {', '.join(names)} is not positive at the start; change masses "
                "or kinetic effects, or give every body a pace and every potential between fast bodies a rate."
            )
        N = mass_orthonormal(element_mass)
        # w^2: the largest eigenvalue of N^T K N, or the declared curvature k times the largest eigenvalue of A M^-1
        # A^T, where A v are the rates of positions: k / m for a body of mass m
        matrix = N.T @ (element.stiffness + element.stiffness.T) @ N / 2
        largest = max(np.linalg.eigvalsh(matrix).max(), curvatures[i] * np.linalg.norm(translation @ N, 2) ** 2)
        if largest > ROUND_OFF * np.abs(matrix).max(initial=0.0):
            frequency[i] = np.sqrt(largest)
        frequency[i] = max(frequency[i], np.linalg.norm(N.T @ element.gyroscopic @ N, 2))
        acceleration = N @ (N.T @ element.force)
        a, alpha = (np.abs(part @ acceleration).max(initial=0.0) for part in (translation, turning))
        rate[i] = max(frequency[i], np.sqrt(a / size), np.sqrt(alpha))
    # elements between the same bodies are terms of a series, as of a torsion: they get the rate of the fastest
    same_bodies: dict[frozenset, list[int]] = {}
    for i, names in enumerate(effect.elements):
        same_bodies.setdefault(frozenset(names), []).append(i)
    for numbers in same_bodies.values():
        frequency[numbers], rate[numbers] = frequency[numbers].max(), rate[numbers].max()
    return Rates(frequency, rate)


def _linearise(effect: Effect, i: int, bodies: Bodies, columns: Mapping[str, np.ndarray]) -> Linearised:
    """Element i of an effect at the start; `columns` of each body, see `Linearised`."""
    names, (term, params) = moving(effect.elements[i]), effect.element_term(i)
    q, v = (np.concatenate([getattr(bodies[name], of) for name in names]) for of in ("coordinates", "rates"))
    force, *matrices = map(np.asarray, _derivatives(TracedOnce(term), effect.kind == "kinetic", q, v, params))
    motions = block_diag(*(bodies[name].motions for name in names))
    parts = [motions.T @ force, *(motions.T @ matrix @ motions for matrix in matrices)]
    if not all(np.isfinite(part).all() for part in parts):
        raise Refused(
            f"{effect.name}: its energy between {', '.join(map(label_of, effect.elements[i]))} has no finite "
            "derivatives at the start; move these bodies, or smooth the energy."
        )
    return Linearised(np.concatenate([columns[name] for name in names]), *parts)


@partial(quickly_compiled, static_argnames="kinetic")
def _derivatives(function: TracedOnce, kinetic: bool, q, v, params):
    """The force, K, G and d2L/dv2 of an element, whose energy is `function`, in the coordinates of its bodies."""
    # the term of an element takes the coordinates of its bodies as q_s

    def energy(q, v):
        none = jnp.zeros(0)
        return function({"q": (q, none), "v": (v, none)}, params)

    # the derivatives of L = -V(q) by velocities are zero: tracing and compiling them would take time for nothing
    if not kinetic:

        def gradient(q):
            values = jax.grad(energy)(q, v)
            return values, values

        stiffness, values = jax.jacfwd(gradient, has_aux=True)(q)
        zero = jnp.zeros_like(stiffness)
        return -values, stiffness, zero, zero

    force = partial(force_of, energy)
    by_velocities = jax.jacfwd(force, 1)(q, v)
    at_rest = jax.grad(energy)(q, jnp.zeros_like(v))
    gyroscopic = (by_velocities - by_velocities.T) / 2
    return at_rest, -jax.jacfwd(force)(q, v), gyroscopic, jax.hessian(energy, 1)(q, v)


def positions(bodies: Bodies) -> np.ndarray:
    """(n, 3) positions of all points and centres, padded with zeros; without the blocks, or the origin if there are
    only blocks."""
    points = [np.asarray(body.point().position) for body in bodies.values() if not body.block] or [np.zeros(1)]
    return np.stack([np.pad(point, (0, LARGEST_POINT - point.size)) for point in points])
