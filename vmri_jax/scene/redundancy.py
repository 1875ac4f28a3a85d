"""Redundant constraints: naming the dependent rows, dropping some of them, and checking that the dropped rows follow
from the others.

A row whose gradient depends on the gradients of the other rows at the start need not depend on them elsewhere: examples
are the third distance of three atoms in line, and a linkage that lies flat. The kept rows g_k are independent at the
start, so that ``g_k = 0`` is a smooth surface there. The dropped rows follow from the kept rows, that is are implied by
them, if and only if they vanish on this surface around the start. The check evaluates them at the ends of random
motions along the surface.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import qr

from vmri_jax.mechanics.constraints import RANK, START_TOLERANCE, rank_of
from vmri_jax.mechanics.slopes import ROUNDING
from vmri_jax.mechanics.summary import listed
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import Key
from vmri_jax.scene.body import Bodies
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joint_base import Joint
from vmri_jax.scene.rigid import Rigidity
from vmri_jax.scene.rows import ConstraintRows
from vmri_jax.scene.sorting import HOMES, Sorting, sort
from vmri_jax.scene.trees import Branch

MOTIONS = 3
"""Number of random motions on which dropped rows are evaluated: on a single motion a row may by chance change little.

More take longer.
"""
NEARBY = 0.1
"""Length of a motion, as a fraction of the smallest singular value of the kept rows: this value bounds the region where
they are independent. A row that changes with the second power of the motion changes by some 1e-3; a longer motion may
reach another branch of a mechanism."""
CONTRACTION = 0.1
"""Largest ratio of consecutive corrections of Newton's iteration from the end of a motion back to the surface. With a
larger ratio the iteration may end on another branch."""
SHORTENING = 4.0
"""Factor by which a motion is shortened after corrections that shrink too slowly; a larger factor may skip usable
lengths."""
NUM_LENGTHS = 10
"""Most lengths of a motion that are tried.

The last of ten suits a molecule of a millionth of the extent of the scene.
"""
BEND = (
    "Bend bodies that lie in line or flat at the start by a little, leave other rows out of the scene, or hold the "
    "shape by other constraints"
)
"""Advice for rows that depend on others at the start alone."""


def sort_with_loops(
    bodies: Bodies,
    effects: Sequence[Effect],
    branches: Sequence[Branch],
    joint_starts: Mapping[Key, tuple[Any, Any]],
    redundant: str,
) -> Sorting:
    """The sorting of a scene, where bodies that are tied to fast bodies are fast; with `redundant` as of `Scene`."""
    tied: dict[str, str] = {}
    while True:
        sorting = replace(sort(bodies, effects, branches, tied), joint_starts=joint_starts)
        sorting = without_redundant(sorting) if redundant == "drop" else sorting
        more = tied_to_fast(sorting)
        if not more:
            return sorting
        tied |= more


def check_constraints(sorting: Sorting, moved: bool) -> None:
    """Refuse constraints that the start violates, unless the scene moves the bodies onto them, redundant ones, dropped
    rows that do not follow from the others, and constraints that the fast bodies cannot satisfy."""
    rows = ConstraintRows.of(sorting)
    if rows is None:
        return
    violations = np.abs(rows.evaluate(0.0, sorting.assembled)[0])
    # far from the origin positions are rounded by more than a part of the extent of the scene
    reach = np.abs(rows.jacobian).sum(axis=1) * np.abs(sorting.of_bodies("coordinates")).max()
    violated = np.flatnonzero(violations > START_TOLERANCE * rows.sizes + ROUNDING * np.finfo(float).eps * reach)
    if violated.size and not moved:
        raise Refused(
            f"Scene: the positions at the start violate {rows.rows[violated[0]].name} by "
            f"{violations[violated[0]]:.3g}; move the bodies, change numbers of this constraint, or let the scene move "
            "the bodies, project=True."
        )
    if opening := _opening_in_words(rows):
        raise Refused(f'Scene: redundant="drop" would change the motion: {opening}.')
    macro, micro = (rows.numbers(home) for home in HOMES)
    _refuse(rows, macro + micro, 0, lambda: _cure(sorting))
    if micro:
        _refuse(rows, micro, sorting.layout.sizes[0], lambda: _advice(rows, micro))


def without_redundant(sorting: Sorting) -> Sorting:
    """The sorting without as many rows of constraints as depend on others at the start.

    A QR decomposition with pivoting chooses the kept rows, scaled by the masses and to length one. All rows of
    `Rigidity` are kept.
    """
    rows = ConstraintRows.of(sorting)
    if rows is None:
        return sorting
    scaled = rows.by_masses
    lengths = np.linalg.norm(scaled, axis=1, keepdims=True)
    scaled /= np.where(lengths > 0, lengths, 1.0)
    # remove the span of the rigidity rows from the other rows, then rank these: the last ones in the order of pivots
    # depend on the first
    rigid = np.array([isinstance(row.effect, Rigidity) for row in rows.rows])
    basis = np.linalg.qr(scaled[rigid].T)[0]
    candidates = np.flatnonzero(~rigid)
    remainder = scaled[candidates] - scaled[candidates] @ basis @ basis.T
    triangle, order = qr(remainder.T, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    rank = np.count_nonzero(np.abs(np.diagonal(triangle)) > RANK)
    placed = list(sorting.placed)
    for i in sorted(candidates[order[rank:]].tolist()):
        row, part = rows.rows[i], placed[rows.rows[i].part]
        placed[row.part] = part._replace(dropped=(*part.dropped, row.number), sizes=(*part.sizes, float(rows.sizes[i])))
    return replace(sorting, placed=tuple(placed))


def find_opening(rows: ConstraintRows) -> tuple[dict[int, float], float]:
    """The dropped rows that do not follow from the kept rows g_k: their largest values over their sizes by number, {}
    if all follow; and the length of the motion to them relative to the scales of coordinates, 0 if they are violated at
    the start itself.

    In coordinates over their scales, motions z along the surface solve ``dg_k(q_0) z = 0``. Newton's iteration leads
    from ``q_0 + s z`` back onto ``g_k = 0``, where the dropped rows are evaluated.
    """
    kept, dropped = rows.numbers(), [i for i, row in enumerate(rows.rows) if not row.kept]
    if not dropped:
        return {}, 0.0
    unit = (rows.jacobian * rows.scales / rows.sizes[:, None])[kept]
    basis, triangle = np.linalg.qr(unit.T)
    step = NEARBY * float(np.linalg.svd(triangle, compute_uv=False).min(initial=1.0))
    everywhere = np.arange(rows.sorting.positions.size)
    q, values, is_reached = rows.onto(kept, rows.sorting.positions, everywhere)
    if not is_reached:
        return {}, 0.0  # positions far off the constraints: the initial state refuses them with a message of its own
    worst, length = np.abs(values[dropped]), 0.0
    if worst.max() <= RANK:  # the accuracy to which the choice of dropped rows finds them dependent
        random, timed = np.random.default_rng(0), any(row.effect.timed for row in rows.rows)
        for _ in range(MOTIONS):
            time, motion = random.normal() * timed, random.normal(size=rows.sorting.positions.size)
            motion -= basis @ (basis.T @ motion)
            for _ in range(NUM_LENGTHS):
                start = q + rows.scales * step * motion
                _, values, is_reached = rows.onto(kept, start, everywhere, step * time, CONTRACTION)
                if is_reached:
                    worst, length = np.maximum(worst, np.abs(values[dropped])), max(length, step)
                    break
                step /= SHORTENING
    return {i: value for i, value in zip(dropped, worst.tolist(), strict=True) if value > RANK}, length


def _cure(sorting: Sorting) -> str:
    """Advice about rows that depend on others: to leave one out, unless this would change the motion."""
    rows = ConstraintRows.of(without_redundant(sorting))
    if rows is None or not (opening := _opening_in_words(rows)):
        return f'{_joined_twice(sorting)}leave one of them out, or let the scene choose, redundant="drop"'
    return f"leaving one out would change the motion: {opening}"


def _joined_twice(sorting: Sorting) -> str:
    """The joints between the same two bodies, for a message: a joint that carries a body has no rows, which the message
    could name."""
    joints = {branch.joint.name: branch.joint for branch in sorting.branches}
    joints |= {part.effect.name: part.effect for part in sorting.placed if isinstance(part.effect, Joint)}
    labels: dict[frozenset[str], list[str]] = {}
    for joint in joints.values():
        for i, pair in enumerate(joint.elements):
            labels.setdefault(frozenset(pair), []).append(joint.label(i))
    twice = [
        f"{' and '.join(sorted(pair))} by {' and '.join(names)}" for pair, names in labels.items() if len(names) > 1
    ]
    return f"joints join the same bodies: {listed(twice)}; " if twice else ""


def _opening_in_words(rows: ConstraintRows) -> str:
    """That dropped rows do not vanish where the others do, and advice; "" if all follow."""
    values, motion = find_opening(rows)
    if not values:
        return ""
    names = [rows.rows[i].name for i in values]
    errors = listed([f"{rows.rows[i].name} by {value:.1e}" for i, value in values.items()])
    if not motion:
        return (
            f"{listed(names)} contradicts the other constraints. Where they hold, its violation relative to its size "
            f"is not zero: {errors}. Correct its numbers, or leave it out"
        )
    return (
        f"{listed(names)} depends on the other constraints at the start alone. Nearby, where coordinates have moved by "
        f"some {motion:.1g} of the extent of the scene and the other constraints hold, its violation relative to its "
        f"size is not zero: {errors}. {BEND}"
    )


def tied_to_fast(sorting: Sorting) -> dict[str, str]:
    """The bodies with the pace "auto" that are slow, and without which the fast bodies cannot satisfy constraints on
    the micro grid; with reasons."""
    rows = ConstraintRows.of(sorting)
    micro = rows.numbers("constraint") if rows else []
    if rows is None or not micro:
        return {}
    touched, ties = _beyond_fast(rows, micro)
    reason = f"tied by {listed(ties)} to fast bodies, which cannot move without it"
    return {name: reason for name in touched if sorting.bodies[name].pace == "auto"}


def _beyond_fast(rows: ConstraintRows, micro: list[int]) -> tuple[list[str], list[str]]:
    """The slow bodies whose motion changes the rows on the micro grid that the fast bodies cannot satisfy, and the
    effects of these rows."""
    sorting, jacobian = rows.sorting, rows.by_masses[micro]
    num_slow, carried = sorting.layout.sizes[0], _carried(sorting)
    _, dependent = rank_of(jacobian[:, num_slow:])
    involved, touched = jacobian[dependent], []
    involved = involved / np.linalg.norm(involved, axis=1, keepdims=True)
    for name, place in sorting.layout.coordinates.items():
        columns = involved[:, sorting.layout.numbers[name]]
        changes = columns if name in carried else columns @ sorting.bodies[name].motions
        if place.part == "s" and np.any(np.abs(changes) > RANK):
            touched.append(carried.get(name, name))
    return sorted(set(touched)), list(dict.fromkeys(rows.rows[micro[i]].effect.name for i in dependent))


def _carried(sorting: Sorting) -> dict[str, str]:
    """By the name of each coordinate of a joint, the body that the joint carries."""
    return {label: branch.child for branch in sorting.branches for label in branch.labels}


def _advice(rows: ConstraintRows, micro: list[int]) -> str:
    """Advice about constraints on the micro grid that the fast bodies cannot satisfy."""
    sorting, carried = rows.sorting, _carried(rows.sorting)
    fast = [carried.get(name, name) for name, place in sorting.layout.coordinates.items() if place.part == "f"]
    touched, _ = _beyond_fast(rows, micro)
    make_fast = f"make {' or '.join(touched)} fast too" if touched else "make more of their bodies fast"
    return (
        f"they touch fast bodies and are held on the micro grid, where only {', '.join(dict.fromkeys(fast))} can move; "
        "leave one out, or "
        f'{make_fast}, pace="fast"'
    )


def _refuse(rows: ConstraintRows, numbers: list[int], first: int, advice: Callable[[], str]) -> None:
    """Raise ValueError with the names of the dependent rows, if there are some in the coordinates from `first` on."""
    names, jacobian = [rows.rows[i].name for i in numbers], rows.by_masses[numbers][:, first:]
    _, involved = rank_of(jacobian)
    if not involved:
        return
    all_named = [names[i] for i in involved]
    # the user did not write the rows of rigidity, so they are named only if no others are involved
    named = [name for name in all_named if not name.startswith(Rigidity.default_name + " ")] or all_named
    among = "among " if len(named) < len(involved) else ""
    raise Refused(
        f"Scene: over-constrained at the start: {listed(named)} are {among}{len(involved)} constraints of "
        f"rank {rank_of(jacobian[involved])[0]}; {advice()}."
    )
