"""Constraints that are too many, found and named; those that are left out must follow from the others along the motion.

A row whose gradient depends on those of the other rows at the start need not depend on them elsewhere: the third distance of three
atoms in line, or a linkage that lies flat. The rows g_k that stay are independent at the start, so that ``g_k = 0`` is a smooth
surface there. The others follow from them if and only if they vanish on that surface around the start, which is looked at where
random motions along it lead.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

from vmri_jax.mechanics.constraints import RANK, rank_of
from vmri_jax.scene.effects.joints import Joint
from vmri_jax.scene.rigid import Rigidity
from vmri_jax.scene.rows import HOMES, ConstraintRows
from vmri_jax.scene.sorting import Sorting

NAMED = 8
"""Most rows that a message names."""
MOTIONS = 3
"""Random motions from the start along which dropped rows are looked at: along a single one a row may open by little by chance."""
NEARBY = 0.1
"""Length of a motion as a part of the least singular value of the rows that stay, which bounds where they stay independent.

A row that opens with the second power of the motion opens by some 1e-3. A longer motion may reach another branch of a mechanism.
"""
CONTRACTION = 0.1
"""Largest ratio of two corrections of Newton's iteration back from the end of a motion; a larger one may lead to another branch."""
SHORTER = 4.0
"""Factor by which a motion is shortened where the corrections do not shrink like that; a larger one may skip good lengths."""
SHORTENINGS = 10
"""Most lengths of a motion that are tried: the last one suits a molecule of a millionth of the extent of the scene."""
ITERATIONS = 12
"""Most corrections of Newton's iteration; six reach round-off from nearby."""
REACHED = 1e-12
"""Largest value of the rows that stay, in parts of their sizes, with which they count as kept."""
FOLLOWS = RANK
"""Largest value of a dropped row, in parts of its size, that counts as zero: that of rows which depend on others to RANK, as the choice of dropped rows asks."""
BEND = "Bend what lies in line or flat at the start by a little, leave other rows out of the scene, or hold the shape by other constraints"


class Opening(NamedTuple):
    """How far dropped rows leave zero.

    rows: their numbers, among all rows.
    values: largest values of these, in parts of their sizes.
    motion: how far coordinates were moved, in parts of their scales; 0 of rows that are not kept at the start itself.
    """

    rows: list[int]
    values: list[float]
    motion: float


def check_constraints(sorting: Sorting) -> None:
    """Refuse constraints that are redundant, dropped ones that do not follow from the others, and those that the fast bodies cannot keep.

    Args:
        sorting: bodies at their places, effects at their homes.

    Raises:
        ValueError: with the names of the constraints that are too many.
    """
    rows = ConstraintRows.of(sorting)
    if rows is None:
        return
    opening = find_opening(rows)
    if opening is not None:
        raise ValueError(f'Scene: redundant="drop" would change the motion: {_told(rows, opening)}.')
    macro, micro = (rows.numbers(home) for home in HOMES)
    _refuse(rows, macro + micro, 0, lambda: _cure(sorting))
    if micro:
        _refuse(rows, micro, rows.num_slow, lambda: _advice(sorting, rows, micro))


def without_redundant(sorting: Sorting) -> Sorting:
    """The same with as many rows of its constraints left out as depend on others at the start.

    Those that stay are chosen by a QR decomposition with pivoting of the rows, scaled by the masses and to length one. What
    keeps bodies rigid stays.

    Args:
        sorting: bodies at their places, effects at their homes.
    """
    rows = ConstraintRows.of(sorting)
    if rows is None:
        return sorting
    scaled = rows.jacobian / np.sqrt(rows.masses)
    lengths = np.linalg.norm(scaled, axis=1, keepdims=True)
    scaled /= np.where(lengths > 0, lengths, 1.0)
    of_bodies = np.array([isinstance(row.effect, Rigidity) for row in rows.rows])
    rigid = np.linalg.qr(scaled[of_bodies].T)[0]
    others = np.flatnonzero(~of_bodies)
    free = scaled[others] - scaled[others] @ rigid @ rigid.T
    triangle, order = qr(free.T, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    rank = np.count_nonzero(np.abs(np.diagonal(triangle)) > RANK)
    placed = list(sorting.placed)
    for i in sorted(others[order[rank:]].tolist()):
        row, part = rows.rows[i], placed[rows.rows[i].part]
        placed[row.part] = part._replace(dropped=(*part.dropped, row.number), sizes=(*part.sizes, float(rows.sizes[i])))
    return replace(sorting, placed=tuple(placed))


def dropped_rows(sorting: Sorting) -> list[str]:
    """Names of the rows that were left out.

    Args:
        sorting: from `without_redundant`.
    """
    rows = ConstraintRows.of(sorting)
    return [] if rows is None else [row.name for row in rows.rows if not row.kept]


def find_opening(rows: ConstraintRows) -> Opening | None:
    """The dropped rows that do not follow from those that stay, and by how much they leave zero; None if all follow.

    In coordinates x over their scales, ``dg_k(x_0) z = 0`` are motions z along the rows g_k that stay, and Newton's iteration leads
    from ``x_0 + s z`` back onto ``g_k = 0``.

    Args:
        rows: some of them dropped.
    """
    kept, dropped = rows.numbers(), [i for i, row in enumerate(rows.rows) if not row.kept]
    if not dropped:
        return None
    unit = (rows.jacobian * rows.scales / rows.sizes[:, None])[kept]
    basis, triangle = np.linalg.qr(unit.T)
    step = NEARBY * float(np.linalg.svd(triangle, compute_uv=False).min(initial=1.0))
    start = _where_kept(rows, kept, 0.0, np.zeros(rows.start.size), np.inf)
    if start is None:
        return None  # positions off the constraints, which the making of the state refuses
    worst, length = np.abs(start.values[dropped]), 0.0
    if worst.max() <= FOLLOWS:
        random = np.random.default_rng(0)
        for _ in range(MOTIONS):
            time, motion = random.normal() * rows.timed, random.normal(size=rows.start.size)
            motion -= basis @ (basis.T @ motion)
            for _ in range(SHORTENINGS):
                end = _where_kept(rows, kept, step * time, start.x + step * motion, CONTRACTION)
                if end is not None:
                    worst, length = np.maximum(worst, np.abs(end.values[dropped])), max(length, step)
                    break
                step /= SHORTER
    opened = np.flatnonzero(worst > FOLLOWS)
    if not opened.size:
        return None
    return Opening([dropped[i] for i in opened], worst[opened].tolist(), length)


class _Place(NamedTuple):
    """Positions x, in parts of their scales from the start, and the values of all rows there, in parts of their sizes."""

    x: np.ndarray
    values: np.ndarray


def _where_kept(rows: ConstraintRows, kept: list[int], t: float, x: np.ndarray, contraction: float) -> _Place | None:
    """Where Newton's iteration from x reaches the rows that stay; None if its corrections do not shrink by this factor each."""
    before = np.inf
    for _ in range(ITERATIONS):
        values, jacobian = rows.at(t, rows.start + rows.scales * x)
        values = values / rows.sizes
        if np.abs(values[kept]).max(initial=0.0) <= REACHED:
            return _Place(x, values)
        scaled = jacobian[kept] * rows.scales / rows.sizes[kept, None]
        correction = np.linalg.lstsq(scaled, values[kept], rcond=None)[0]
        size = np.linalg.norm(correction)
        if not size <= contraction * before:
            return None
        x, before = x - correction, size
    return None


def _cure(sorting: Sorting) -> str:
    """What to do about rows that depend on others: leave them out, unless they do not follow from these."""
    rows = ConstraintRows.of(without_redundant(sorting))
    opening = None if rows is None else find_opening(rows)
    if rows is None or opening is None:
        return f'{_joined_twice(sorting)}leave one of them out, or let the scene choose, redundant="drop"'
    return f"nor can any be left out: {_told(rows, opening)}"


def _joined_twice(sorting: Sorting) -> str:
    """Which joints are between the same two bodies: in joint coordinates the one that carries a body has no rows that could be named."""
    joints = {branch.joint.name: branch.joint for branch in sorting.branches}
    joints |= {part.effect.name: part.effect for part in sorting.placed if isinstance(part.effect, Joint)}
    labels: dict[frozenset[str], list[str]] = {}
    for joint in joints.values():
        for i, pair in enumerate(joint.elements(sorting.bodies)):
            labels.setdefault(frozenset(pair), []).append(joint.label(i, sorting.bodies))
    twice = [
        f"{' and '.join(sorted(pair))} by {' and '.join(names)}" for pair, names in labels.items() if len(names) > 1
    ]
    return f"joints join the same bodies: {_listed(twice)}; " if twice else ""


def _told(rows: ConstraintRows, opening: Opening) -> str:
    """That dropped rows do not vanish where the others do, and what to do."""
    names = rows.names(opening.rows)
    off = _listed([f"{name} by {value:.1e}" for name, value in zip(names, opening.values, strict=True)])
    if not opening.motion:
        return (
            f"{_listed(names)} contradicts the other constraints. Where these are kept, it is off by parts of its size: {off}. "
            "Correct its numbers, or leave it out"
        )
    return (
        f"{_listed(names)} depends on the other constraints at the start alone. Nearby, where coordinates have moved by some "
        f"{opening.motion:.1g} of the extent of the scene and the other constraints are kept, it is off by parts of its size: {off}. {BEND}"
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


def _advice(sorting: Sorting, rows: ConstraintRows, micro: list[int]) -> str:
    """What to do about constraints that the fast bodies cannot keep."""
    fast = [name for name, place in sorting.layout.own.items() if place.part == "f"]
    jacobian = rows.jacobian[micro]
    involved = jacobian[rank_of(jacobian[:, rows.num_slow :]).dependent]
    touched = {
        name
        for name, place in sorting.layout.own.items()
        if place.part == "s" and involved[:, place.start : place.start + place.size].any()
    }
    more = f"make {' or '.join(sorted(touched))} fast too" if touched else "make more of their bodies fast"
    return (
        f"they touch fast bodies and are held on the micro grid, where only {', '.join(fast)} can move; leave one out, or {more}, "
        'pace="fast"'
    )


def _refuse(rows: ConstraintRows, numbers: list[int], first: int, advice: Callable[[], str]) -> None:
    """Raise if rows, from a column on, are dependent, naming those that take part."""
    names, jacobian = rows.names(numbers), rows.jacobian[numbers][:, first:]
    involved = rank_of(jacobian).dependent
    if involved:
        of_effects = [names[i] for i in involved if not names[i].startswith(Rigidity.default_name + " ")] or [
            names[i] for i in involved
        ]
        raise ValueError(
            f"Scene: over-constrained at the start: {_listed(of_effects)} are {'among ' * (len(of_effects) < len(involved))}{len(involved)} constraints of "
            f"rank {rank_of(jacobian[involved]).rank}; {advice()}."
        )
