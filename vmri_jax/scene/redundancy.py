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


def check_constraints(bodies: Mapping[str, Body], places: Mapping[str, Place], placed: Sequence[Placed]) -> None:
    """Refuse constraints that are redundant, or that the fast bodies cannot keep, naming them.

    Raises:
        ValueError: with the names of the links that are too many.
    """
    held = [part for part in placed if part.effect.kind == "constraint"]
    if not held or not is_concrete(
        [[body.position for body in bodies.values()], *[p.effect.parameters(bodies) for p in held]]
    ):
        return
    rows = {
        home: _rows(bodies, places, [p for p in held if p.home == home]) for home in ("slow_constraint", "constraint")
    }
    names = [name for some in rows.values() for name, _ in some]
    _refuse(names, np.array([row for some in rows.values() for _, row in some]), "leave one of them out")
    fast = [name for name, place in places.items() if place.part == "f"]
    n_f = sum(places[name].size for name in fast)
    if rows["constraint"]:
        names, matrix = zip(*rows["constraint"], strict=True)
        advice = (
            f"they touch fast bodies and are held on the micro grid, where only {', '.join(fast)} can move; leave one out, or make "
            "more of their bodies fast"
        )
        _refuse(list(names), np.array(matrix)[:, -n_f:], advice)


def _rows(bodies, places, held: Sequence[Placed]) -> list[tuple[str, np.ndarray]]:
    """Rows of the constraints' Jacobian, slow coordinates first, each with the name of its element."""
    n_s = sum(place.size for place in places.values() if place.part == "s")
    n = sum(place.size for place in places.values())
    rows = []
    for part in held:
        effect = part.effect
        elements, params = effect.elements(bodies), effect.parameters(bodies)
        for i in part.elements:
            own = effect.one(params, i, bodies)
            jacobian = _jacobian(
                effect.function, effect.timed, tuple(bodies[name].position for name in elements[i]), own
            )
            columns = [
                (n_s if places[name].part == "f" else 0) + places[name].start + k
                for name in elements[i]
                for k in range(places[name].size)
            ]
            label = f"{effect.name} {'-'.join(elements[i])}"
            for j, entries in enumerate(np.asarray(jacobian)):
                row = np.zeros(n)
                row[columns] = entries
                rows.append((label if len(jacobian) == 1 else f"{label} [{j}]", row))
    return rows


@partial(jax.jit, static_argnames=("function", "timed"))
def _jacobian(function, timed: bool, q, params):
    flat, unravel = ravel_pytree(q)
    t = (jnp.zeros(()),) if timed else ()
    return jax.jacfwd(lambda flat: jnp.reshape(function(*t, unravel(flat), params), (-1,)))(flat)


def _refuse(names: list[str], matrix: np.ndarray, advice: str) -> None:
    """Raise if the rows are dependent, naming those that take part."""
    rank, dependent = rank_of(matrix)
    if not dependent:
        return
    involved = [names[row] for row in dependent]
    raise ValueError(
        f"Scene: over-constrained at the start: {', '.join(involved)} are {len(involved)} constraints of rank "
        f"{len(involved) - (len(names) - rank)}; {advice}."
    )
