"""Constraints that are too many, found at the start and named."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.constraints import RANK, rank_of
from vmri_jax.scene.body import moving
from vmri_jax.scene.labels import label
from vmri_jax.scene.rigid import Rigidity
from vmri_jax.scene.sorting import Placed, Sorting
from vmri_jax.scene.terms import EffectTerm

HOMES = ("slow_constraint", "constraint")
NAMED = 8
"""Most rows that a message names."""


def check_constraints(sorting: Sorting) -> None:
    """Refuse constraints that are redundant, or that the fast bodies cannot keep, naming them.

    Args:
        sorting: bodies at their places, effects at their homes.

    Raises:
        ValueError: with the names of the constraints that are too many.
    """
    held = _held(sorting)
    if not held:
        return
    n_s = _slow_size(sorting)
    macro, micro = ([row for p in held if p.home == home for row in kept_rows(sorting, p)] for home in HOMES)
    _refuse(macro + micro, 0, 'leave one of them out, or let the scene choose, redundant="drop"')
    if micro:
        _refuse(micro, n_s, _advice(sorting, micro, n_s))


def without_redundant(sorting: Sorting) -> Sorting:
    """The same with as many rows of its constraints left out as depend on others.

    Those that stay are chosen by a QR decomposition with pivoting of the rows, scaled by the masses and to length one. What
    keeps bodies rigid stays.

    Args:
        sorting: bodies at their places, effects at their homes.
    """
    held = _held(sorting)
    found = [(part, kept_rows(sorting, part)) for part in held]
    rows = [row for _, own in found for row in own]
    if not rows:
        return sorting
    counts = {part: len(own) for part, own in found}
    own = np.repeat([isinstance(part.effect, Rigidity) for part in held], list(counts.values()))
    mass = np.concatenate(_of_all(sorting, "masses"))
    scaled = np.array([row for _, row in rows]) / np.sqrt(mass)
    scaled /= np.linalg.norm(scaled, axis=1, keepdims=True)
    rigid = np.linalg.qr(scaled[own].T)[0]
    others = np.flatnonzero(~own)
    free = scaled[others] - scaled[others] @ rigid @ rigid.T
    triangle, order = qr(free.T, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    rank = np.count_nonzero(np.abs(np.diagonal(triangle)) > RANK)
    dropped = set(others[order[rank:]].tolist())
    placed, at = [], 0
    for part in sorting.placed:
        if part in held:
            count = counts[part]
            part = part._replace(dropped=tuple(k for k in range(count) if at + k in dropped))
            at += count
        placed.append(part)
    return replace(sorting, placed=tuple(placed))


def dropped_rows(sorting: Sorting) -> list[str]:
    """Names of the rows that were left out.

    Args:
        sorting: from `without_redundant`.
    """
    return [_all_rows(sorting, part)[k][0] for part in sorting.placed for k in part.dropped]


def _held(sorting: Sorting) -> list[Placed]:
    """The constraints, none where their numbers are traced."""
    held = [part for part in sorting.placed if part.home in HOMES]
    numbers = (
        [body.coordinates for body in sorting.bodies.values()],
        [p.effect.parameters(sorting.bodies) for p in held],
    )
    return held if is_concrete(numbers) else []


def _slow_size(sorting: Sorting) -> int:
    return sum(place.size for place in sorting.places.values() if place.part == "s")


def _of_all(sorting: Sorting, what: str) -> list[np.ndarray]:
    """Numbers of all bodies, slow ones first."""
    names = sorted(sorting.bodies, key=lambda name: sorting.places[name].part == "f")
    return [np.asarray(getattr(sorting.bodies[name], what)) for name in names]


def _advice(sorting: Sorting, micro, n_s: int) -> str:
    """What to do about constraints that the fast bodies cannot keep."""
    fast = [name for name, place in sorting.places.items() if place.part == "f"]
    involved = rank_of(np.array([row[n_s:] for _, row in micro])).dependent
    touched = {
        name
        for name, place in sorting.places.items()
        if place.part == "s" and any(micro[i][1][place.start : place.start + place.size].any() for i in involved)
    }
    more = f"make {' or '.join(sorted(touched))} fast too" if touched else "make more of their bodies fast"
    return (
        f"they touch fast bodies and are held on the micro grid, where only {', '.join(fast)} can move; leave one out, or {more}, "
        'pace="fast"'
    )


def kept_rows(sorting: Sorting, part: Placed) -> list[tuple[str, np.ndarray]]:
    """Those of `_all_rows` that are not left out."""
    return [row for k, row in enumerate(_all_rows(sorting, part)) if k not in part.dropped]


def _all_rows(sorting: Sorting, part: Placed) -> list[tuple[str, np.ndarray]]:
    """Rows of the Jacobian of some constraints in the order of their terms, slow coordinates first, each with its name."""
    bodies, effect, rows, n_s = sorting.bodies, part.effect, [], _slow_size(sorting)
    columns = {name: p.start + np.arange(p.size) + (n_s if p.part == "f" else 0) for name, p in sorting.places.items()}
    elements, params = effect.elements(bodies), effect.parameters(bodies)
    for i in chain(*effect.by_size(part.elements, bodies)):
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
        own = [names[i] for i in involved if not names[i].startswith(Rigidity.default_name + " ")] or [
            names[i] for i in involved
        ]
        shown = ", ".join(own[:NAMED]) + (f" and {len(own) - NAMED} more" if len(own) > NAMED else "")
        raise ValueError(
            f"Scene: over-constrained at the start: {shown} are {'among ' * (len(own) < len(involved))}{len(involved)} constraints of rank "
            f"{rank_of(jacobian[involved]).rank}; {advice}."
        )
