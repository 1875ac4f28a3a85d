"""Freedoms of joints by name: velocities of all bodies from the rates of a few joints, closed loops from the values of
a few joints, and whole turns.

A coordinate of a joint counts whole turns, directors do not: those of two bodies give the sine and the cosine of the
angle between them. An effect to which turns matter takes such an angle up to `REACH` alone; along a run turns are
counted from one saved node to the next.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.constraints import RANK, configuration
from vmri_jax.mechanics.projection import mass_and_momentum
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import Key
from vmri_jax.scene.body import AnyBody, moving
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joint_base import ANGLES, REACH, Joint, OfFreedoms, for_pairs, freedom_of, joint_named
from vmri_jax.scene.rows import ConstraintRows
from vmri_jax.scene.sorting import Sorting
from vmri_jax.scene.trees import Branch

RATE_ERROR = 1e-8
"""Largest error of rates, relative to the largest rate, that counts as round-off.

A larger value accepts rates that contradict each other.
"""
STEPS = 20
"""Steps from the start of a joint to its new value, at least; loops are closed after each. With fewer steps a loop may
fold over into its other configuration; more take longer."""
LONGEST_STEP = 0.35
"""Longest of these steps of an angle, rad: other joints of the loop count their turns from step to step.

A longer step may lose a turn.
"""


def with_rates(
    sorting: Sorting, effects: Sequence[Effect], system: System, rates: Mapping[str, Any]
) -> tuple[list[AnyBody], dict[Key, tuple[Any, Any]]]:
    """The bodies with velocities that give joints these rates, see `Scene.with_rates`, and (value, rate) of all joint
    coordinates.

    The constraints and the rates are rows ``C v = b``. Of all solutions, v is the nearest to the present velocities v_0
    in the norm of the kinetic energy: with ``M = R R^T``, ``x = R^T (v - v_0)`` is the shortest solution of
    ``C R^-T x = b - C v_0``.
    """
    if not is_concrete((sorting.start, system, rates)):
        raise Refused(
            "Scene.with_rates: jax.jit, grad or vmap traces numbers of the scene or rates; call with_rates outside of "
            "these."
        )
    start, columns = tuple(map(np.asarray, sorting.start)), sorting.layout.columns
    q, v = np.concatenate(start[:2]), np.concatenate(start[2:])
    bodies, of_bodies = sorting.to_bodies(q)
    # rows dg/dq v = -dg/dt of the constraints, then dx/dq v = x' of the freedoms x whose rates the user gives
    constraints = configuration(system, np.zeros(()), *start[:2])
    rows, values = [constraints.jacobian], [-constraints.rates]
    for joint, freedom, number in _by_freedom("Scene.with_rates", effects, rates):
        pairs, about = range(len(joint.elements)), f"Scene.with_rates: the rate of {joint.name}"
        numbers = for_pairs(about, number, len(pairs), "one number")

        # dx/dQ of the coordinates Q of bodies: the rates of x along unit vectors
        along = {name: np.eye(bodies.size)[:, columns[name]] for name in moving(chain(*joint.elements))}
        there = {name: np.broadcast_to(bodies[columns[name]], unit.shape) for name, unit in along.items()}
        rows.append(np.stack([joint.value_and_rate(freedom, i, there, along)[1] for i in pairs]) @ of_bodies)
        values.append(np.broadcast_to(numbers, (len(pairs),)))
    c, b = np.concatenate(rows), np.concatenate(values)
    root = np.linalg.cholesky(mass_and_momentum(system, *start)[0])  # M = R R^T
    # rows of C R^-T and b in units of their lengths: all have the unit of R^T v, whose squared length is twice the
    # kinetic energy
    c_by_root = np.linalg.solve(root, c.T).T
    lengths = np.linalg.norm(c_by_root, axis=1)
    lengths[lengths == 0] = 1.0
    c, b, c_by_root = c / lengths[:, None], b / lengths, c_by_root / lengths[:, None]
    size = np.abs([b, c @ v]).max()
    v = v + np.linalg.solve(root.T, np.linalg.lstsq(c_by_root, b - c @ v, rcond=None)[0])
    errors = np.abs(c @ v - b)
    if errors.max() > RATE_ERROR * size:
        raise Refused(
            f"Scene.with_rates: no velocities have these rates of {', '.join(rates)} and keep the constraints: the "
            f"nearest ones differ by {(errors * lengths).max():.3g}. Give fewer rates: the rate of a joint follows "
            "from those of others, or the joint cannot move here."
        )
    # the velocities of bodies belong to their positions as the user gave them, where joint coordinates are zero
    body_rates = sorting.to_bodies(sorting.assembled)[1] @ v
    moved = [body.with_rates(body_rates[columns[name]]) for name, body in sorting.bodies.items()]
    # where no joint starts at a value of its own, the velocities of the bodies say all
    keys, numbers = sorting.layout.freedoms if sorting.joint_starts else (), sorting.layout.numbers
    return moved, {key: (q[i], v[i]) for key in keys for i in numbers[key]}


def check_replaced(
    name: str, changes: Mapping[str, Any], branches: Sequence[Branch], starts: Mapping[Key, tuple[Any, Any]]
) -> None:
    """Refuse other velocities of a body for which a rate in `joint_starts` stands."""
    rated = [b.joint.name for b in branches if b.child == name and starts.keys() & set(b.keys)]
    if rated and changes.keys() & {"velocity", "spin"}:
        raise Refused(
            f"Scene.replace: {name}: {' and '.join(changes)} would change nothing, because with_joints or with_rates "
            f"has set the rate of {rated[0]}, which carries {name}. Give that rate to them, or call them after "
            "replace."
        )


def joint_starts(sorting: Sorting, effects: Sequence[Effect], starts: Mapping[str, Any]) -> dict[Key, tuple[Any, Any]]:
    """Values and rates of freedoms by the keys of `Layout.freedoms`: the present ones, and `starts` as of
    `Scene.with_joints`."""
    by_key = {}
    for joint, freedom, start in _by_freedom("Scene.with_joints", effects, starts):
        name, count = joint.name, len(joint.elements)
        value, rate = start if isinstance(start, tuple) else (start, 0.0)
        about = f"Scene.with_joints: the start of {name}"
        numbers = [for_pairs(about, number, count, "one number, or a pair (value, rate)") for number in (value, rate)]
        for i in range(count):
            key = name, i, freedom
            if key not in sorting.layout.freedoms:
                raise Refused(
                    f"Scene.with_joints: {joint.label(i)} has no coordinate of its own: it closes a loop, where you "
                    "may set the other joints, or its bodies have directors: then give the scene"
                    ' coordinates="joint".'
                )
            by_key[key] = tuple(number if number.ndim == 0 else number[i] for number in numbers)
    return {**sorting.joint_starts, **with_closed_loops(sorting, by_key)}


def with_closed_loops(sorting: Sorting, starts: dict[Key, tuple[Any, Any]]) -> dict[Key, tuple[Any, Any]]:
    """The starts of the named joint coordinates and of all other joint coordinates that loops and couplings tie to
    them.

    The named coordinates go to their values in steps. In each step Newton's iteration on ``g(q) = 0`` moves the other
    joint coordinates x, ``dx = -(dg/dx)^+ g``. At the end the rates of x solve ``dg/dq v = 0``. Rows that bodies with
    directors can satisfy, such as the rows of a ball joint, are left to the projection of the initial state.
    """
    rows = ConstraintRows.of(sorting)
    if rows is None or not is_concrete((sorting.start, starts)):
        return starts
    all_numbers = sorting.layout.numbers
    columns = {key: int(all_numbers[key][0]) for key in sorting.layout.freedoms}
    held, free = [columns[key] for key in starts], [columns[key] for key in columns if key not in starts]
    q, v = (np.concatenate(parts) for parts in (sorting.start[:2], sorting.start[2:]))
    numbers = _of_joints_alone(sorting, rows)
    begin, end = q[held], np.array([float(value) for value, _ in starts.values()])
    reached, values, is_closed = begin, np.empty(0), True
    for fraction in np.linspace(0.0, 1.0, steps_of(starts, end - begin) + 1)[1:]:
        moved = q.copy()
        moved[held] = begin + fraction * (end - begin)
        moved, values, is_closed = rows.onto(numbers, moved, free)
        # a loop with several named joints may be open on the way and close again at the end: go on from the last closed
        # position
        if is_closed:
            q, reached = moved, moved[held]
    if not is_closed:
        worst = numbers[np.argmax(np.abs(values[numbers]))]
        row, size = rows.rows[worst].name, abs(values[worst]) * rows.sizes[worst]
        named = " and ".join(f"{joint} at {value:.4g}" for (joint, *_), value in zip(starts, reached, strict=True))
        raise Refused(
            f"Scene.with_joints: no configuration of the other joints keeps {row}, which stays open by {size:.3g}. It "
            f"is kept up to {named}; give values up to there, or values of fewer joints."
        )
    v[held] = [float(rate) for _, rate in starts.values()]
    jacobian = rows.evaluate(0.0, q)[1][numbers]
    scaled, scales = jacobian / rows.sizes[numbers, None], rows.scales[free]
    v[free] -= scales * np.linalg.lstsq(scaled[:, free] * scales, scaled @ v, rcond=RANK)[0]
    return starts | {key: (q[i], v[i]) for key, i in columns.items() if key not in starts and jacobian[:, i].any()}


def steps_of(keys: Iterable[Key], changes: Iterable[float]) -> int:
    """Number of steps in which freedoms change by these values."""
    angles = [abs(change) for (*_, freedom), change in zip(keys, changes, strict=True) if freedom in ANGLES]
    return max(STEPS, int(np.ceil(max(angles, default=0.0) / LONGEST_STEP)))


def _of_joints_alone(sorting: Sorting, rows: ConstraintRows) -> np.ndarray:
    """Numbers of the rows that depend on joint coordinates alone: no motion of a body with directors or of a point
    changes them."""
    changes, numbers = np.zeros(len(rows.rows), bool), sorting.layout.numbers
    for name in sorting.layout.coordinates:
        if name in sorting.bodies:
            by_motions = rows.jacobian[:, numbers[name]] @ sorting.bodies[name].motions
            changes |= np.linalg.norm(by_motions, axis=1) > RANK * np.linalg.norm(rows.jacobian, axis=1)
    return np.flatnonzero(~changes)


def _by_freedom(method: str, effects: Sequence[Effect], numbers: Mapping[str, Any]) -> Iterator[tuple[Joint, str, Any]]:
    """(joint, freedom, numbers) from a mapping by names of joints, whose values may be mappings by freedoms; `method`
    begins messages."""
    if not isinstance(numbers, Mapping):
        raise Refused(f'{method}: got {numbers!r}; give numbers by the names of joints, {{"hinge": 0.3}}.')
    for name, of_joint in numbers.items():
        joint = joint_named(method, name, effects)
        for freedom, of_freedom in of_joint.items() if isinstance(of_joint, Mapping) else [("auto", of_joint)]:
            try:
                known = freedom_of(joint, freedom)
            except ValueError as error:
                raise Refused(f'{method}: {error} Give a dictionary, {{"turn": ..., "slide": ...}}.') from None
            yield joint, known, of_freedom


def along_run(sorting: Sorting, joint: Joint, run: Any, of: str, pair: int) -> np.ndarray:
    """The freedom of a joint along a run, (k,) rad or m, whole turns included; see `Scene.joint_motion`."""
    freedom, elements = freedom_of(joint, of), joint.elements
    pair = range(len(elements))[pair]  # raises IndexError
    if (label := joint.label(pair, freedom)) in run.names.bodies:
        return np.asarray(run.position(label))[..., 0]
    q = {name: run.position(name) for name in moving(elements[pair])}
    if freedom not in ANGLES:
        return np.asarray(joint.value(freedom, pair, q))
    angle, rate = joint.value_and_rate(freedom, pair, q, {name: run.velocity(name) for name in q})
    counted, dt, rates = np.unwrap(angle), np.diff(run.t), (rate[..., 1:], rate[..., :-1])
    fastest, excess = np.maximum(*np.abs(rates)), np.abs(np.diff(counted) - dt * np.mean(rates, axis=0))
    # an angle that moves by a quarter of a turn more or less than both rates say is faster in between
    unknown = np.argwhere((fastest * dt >= np.pi) | (excess >= np.pi / 2))
    if unknown.size:
        node = unknown[0, -1]
        raise Refused(
            f"Scene.joint_motion: {joint.label(pair)} may turn by half a turn or more between the saved nodes {node} "
            "and "
            f"{node + 1}, and its angle comes from directors, which know no whole turns. Save nodes less than "
            f'{np.pi / 2 / np.nanmax(fastest):.2g} s apart, save=..., or give the scene coordinates="joint".'
        )
    turns = np.round((at_start(sorting, joint, pair, freedom) - angle[..., :1]) / (2 * np.pi))
    return counted + 2 * np.pi * turns


def check_reach(sorting: Sorting) -> None:
    """Refuse limits, neutral angles and starts that effects which count turns cannot take from directors."""
    for effect, i, joint, freedom in _from_directors(sorting):
        for mark in effect.marks:
            value = effect.parameters[mark]
            _require_reach(effect, mark, value[i] if np.ndim(value) else value, joint)
        _require_reach(effect, "the start", at_start(sorting, joint, i, freedom), joint)


def check_run(sorting: Sorting, run: Any, twin: Sorting) -> None:
    """Refuse a run with angles that effects of the same scene by directors, `twin`, could not take from these."""
    for effect, i, joint, freedom in _from_directors(twin):
        angle = np.nanmax(np.abs(along_run(sorting, joint, run, freedom, i)))
        _require_reach(effect, "the largest angle of the run", angle, joint)


def _from_directors(sorting: Sorting) -> Iterator[tuple[OfFreedoms, int, Joint, str]]:
    """(effect, number of its element and of the pair of the joint, joint, freedom) for all angles that effects which
    count turns take from directors."""
    for part in sorting.placed:
        effect = part.effect
        if isinstance(effect, OfFreedoms) and effect.counts_turns:
            for i in part.elements:
                for joint, freedom in effect.joint_freedoms:
                    if freedom in ANGLES and (joint.name, i, freedom) not in sorting.layout.freedoms:
                        yield effect, i, joint, freedom


def _require_reach(effect: OfFreedoms, quantity: str, value: Any, joint: Joint) -> None:
    """Refuse an angle of `REACH` or more."""
    expected = (
        f"the angle of {joint.name} comes from directors, which know no whole turns, and has to stay within"
        f' {REACH:.4g} rad: give the scene coordinates="joint", or where all joints of a loop have such effects leave'
        " one of these out"
    )
    effect.require(abs(value) < REACH, quantity, value, expected)


def at_start(sorting: Sorting, joint: Joint, pair: int, freedom: str) -> Any:
    """The angle of a joint without a coordinate at the start, rad; it is zero at the positions in `bodies`.

    From there turns are counted along the straight line to the start in joint coordinates.
    """
    starts, begin = sorting.joint_starts, sorting.assembled if is_concrete(sorting.positions) else None
    if not starts or begin is None:
        return 0.0
    way = sorting.positions - begin
    names, columns, angles = moving(joint.elements[pair]), sorting.layout.columns, []
    for fraction in np.linspace(0.0, 1.0, 1 + steps_of(starts, (value for value, _ in starts.values()))):
        bodies = sorting.to_bodies(begin + fraction * way)[0]
        coordinates = {name: bodies[columns[name]] for name in names}
        angles.append(joint.value(freedom, pair, coordinates))
    return float(np.unwrap(angles)[-1])
