"""Constraints that are too many, found at the start and named."""

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.constraints import rank_of
from vmri_jax.scene.body import Body
from vmri_jax.scene.layout import Place
from vmri_jax.scene.sorting import Placed

HOMES = ("slow_constraint", "constraint")


def check_constraints(bodies: Mapping[str, Body], places: Mapping[str, Place], placed: Sequence[Placed]) -> None:
    """Refuse constraints that are redundant, or that the fast bodies cannot keep, naming them.

    Raises:
        ValueError: with the names of the constraints that are too many.
    """
    held = [part for part in placed if part.home in HOMES]
    positions = [body.position for body in bodies.values()]
    if not held or not is_concrete((positions, [part.effect.parameters(bodies) for part in held])):
        return
    macro, micro = ([row for p in held if p.home == home for row in _rows(bodies, places, p)] for home in HOMES)
    _refuse(macro + micro, 0, "leave one of them out")
    fast = [name for name, place in places.items() if place.part == "f"]
    if micro:
        n_s = sum(place.size for place in places.values() if place.part == "s")
        advice = (
            f"they touch fast bodies and are held on the micro grid, where only {', '.join(fast)} can move; leave one out, or make "
            "more of their bodies fast"
        )
        _refuse(micro, n_s, advice)


def _rows(bodies, places, part: Placed) -> list[tuple[str, np.ndarray]]:
    """Rows of the Jacobian of some constraints, slow coordinates first, each with the name of its element."""
    n_s = sum(place.size for place in places.values() if place.part == "s")
    n = sum(place.size for place in places.values())
    effect, rows = part.effect, []
    elements, params = effect.elements(bodies), effect.parameters(bodies)
    for i in part.elements:
        starts = [places[name].start + (n_s if places[name].part == "f" else 0) for name in elements[i]]
        q = tuple(bodies[name].position for name in elements[i])
        columns = np.concatenate([start + np.arange(x.size) for start, x in zip(starts, q, strict=True)])
        jacobian = np.asarray(_jacobian(effect.function, effect.timed, q, effect.one(params, i, bodies)))
        label = f"{effect.name} {'-'.join(elements[i])}"
        for j, entries in enumerate(jacobian):
            row = np.zeros(n)
            row[columns] = entries
            rows.append((label if len(jacobian) == 1 else f"{label} [{j}]", row))
    return rows


@partial(jax.jit, static_argnames=("function", "timed"))
def _jacobian(function, timed: bool, q, params):
    flat, unravel = ravel_pytree(q)
    t = (jnp.zeros(()),) if timed else ()
    return jax.jacfwd(lambda flat: jnp.reshape(function(*t, unravel(flat), params), (-1,)))(flat)


def _refuse(rows: Sequence[tuple[str, np.ndarray]], first: int, advice: str) -> None:
    """Raise if named rows, from a column on, are dependent, naming those that take part."""
    names, jacobian = [name for name, _ in rows], np.array([row[first:] for _, row in rows])
    involved = rank_of(jacobian).dependent
    if involved:
        raise ValueError(
            f"Scene: over-constrained at the start: {', '.join(names[i] for i in involved)} are {len(involved)} constraints of rank "
            f"{rank_of(jacobian[involved]).rank}; {advice}."
        )
