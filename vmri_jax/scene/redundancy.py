"""Constraints that are too many, found at the start and named."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.constraints import rank_of
from vmri_jax.scene.body import moving
from vmri_jax.scene.labels import label
from vmri_jax.scene.sorting import Placed, Sorting
from vmri_jax.scene.terms import EffectTerm

HOMES = ("slow_constraint", "constraint")


def check_constraints(sorting: Sorting) -> None:
    """Refuse constraints that are redundant, or that the fast bodies cannot keep, naming them.

    Args:
        sorting: bodies at their places, effects at their homes.

    Raises:
        ValueError: with the names of the constraints that are too many.
    """
    held = [part for part in sorting.placed if part.home in HOMES]
    positions = [body.coordinates for body in sorting.bodies.values()]
    if not held or not is_concrete((positions, [part.effect.parameters(sorting.bodies) for part in held])):
        return
    n_s = sum(place.size for place in sorting.places.values() if place.part == "s")
    macro, micro = ([row for p in held if p.home == home for row in _rows(sorting, p, n_s)] for home in HOMES)
    _refuse(macro + micro, 0, "leave one of them out")
    if micro:
        fast = [name for name, place in sorting.places.items() if place.part == "f"]
        advice = (
            f"they touch fast bodies and are held on the micro grid, where only {', '.join(fast)} can move; leave one out, or make "
            "more of their bodies fast"
        )
        _refuse(micro, n_s, advice)


def _rows(sorting: Sorting, part: Placed, n_s: int) -> list[tuple[str, np.ndarray]]:
    """Rows of the Jacobian of some constraints, slow coordinates first, each with the name of its element."""
    bodies, effect, rows = sorting.bodies, part.effect, []
    columns = {name: p.start + np.arange(p.size) + (n_s if p.part == "f" else 0) for name, p in sorting.places.items()}
    elements, params = effect.elements(bodies), effect.parameters(bodies)
    for i in part.elements:
        term, own = effect.alone(i, bodies, params)
        names = moving(elements[i])
        jacobian = np.asarray(_jacobian(term, jnp.concatenate([bodies[name].coordinates for name in names]), own))
        what = label(effect, elements[i])
        for j, entries in enumerate(jacobian):
            row = np.zeros(sum(body.size for body in bodies.values()))
            row[np.concatenate([columns[name] for name in names])] = entries
            rows.append((what if len(jacobian) == 1 else f"{what} [{j}]", row))
    return rows


@partial(jax.jit, static_argnames="term")
def _jacobian(term: EffectTerm, q, params):
    return jax.jacfwd(lambda q: jnp.reshape(term.value(q, None, params, jnp.zeros(())), (-1,)))(q)


def _refuse(rows: Sequence[tuple[str, np.ndarray]], first: int, advice: str) -> None:
    """Raise if named rows, from a column on, are dependent, naming those that take part."""
    names, jacobian = [name for name, _ in rows], np.array([row[first:] for _, row in rows])
    involved = rank_of(jacobian).dependent
    if involved:
        raise ValueError(
            f"Scene: over-constrained at the start: {', '.join(names[i] for i in involved)} are {len(involved)} constraints of rank "
            f"{rank_of(jacobian[involved]).rank}; {advice}."
        )
