"""Starts that fit the joints: velocities of all bodies from the rates of a few joints, closed loops from the values of a few."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.constraints import RANK
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.system import System
from vmri_jax.scene.body import GROUND, GROUND_COORDINATES, AnyBody, Bodies
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.freedoms import FREEDOMS
from vmri_jax.scene.effects.joints import Joint, freedom_of
from vmri_jax.scene.rows import ConstraintRows
from vmri_jax.scene.sorting import Sorting

REACHED = 1e-8
"""Part of the rates by which they may be missed."""
PARTS = 20
"""Parts of the way from the start of a joint to its new value, after each of which loops are closed anew: with fewer a loop may fold over
into its other configuration."""
CLOSED = 1e-12
"""Largest value of a row, in parts of its size, with which a loop counts as closed."""
CORRECTIONS = 20
"""Most corrections of Newton's iteration for a part; four are needed where a loop closes."""


def with_rates(
    sorting: Sorting, effects: Sequence[Effect], system: System, wanted: Mapping[str, Any]
) -> tuple[list[AnyBody], dict[tuple[str, int, str], tuple[Any, Any]]]:
    """The bodies with velocities that have these rates in their joints, see `Scene.with_rates`, and the starts of joints that carry some.

    With all constraints and rates as rows ``C v = b``, v is the nearest to the given velocities v_0 in the norm of the
    kinetic energy: with ``M = R R^T``, ``R^T (v - v_0)`` is the shortest solution of ``C R^-T x = b - C v_0``.

    Args:
        sorting: bodies at their places.
        effects: of the scene, joints among them.
        system: of the scene.
        wanted: rates by the name of the joint.
    """
    if not is_concrete((sorting.start, system)):
        raise TypeError(
            "Scene.with_rates: numbers of the scene are traced; find its velocities outside of jit and grad."
        )
    q_s, q_f, v_s, v_f = sorting.start
    q, v, n_s = jnp.concatenate([q_s, q_f]), np.concatenate([v_s, v_f]), q_s.size
    first = {"s": 0, "f": sorting.layout.ends[0]}
    columns = {name: place.start + first[place.part] for name, place in sorting.places.items()}
    bodies, of_bodies = sorting.to_bodies(np.asarray(q))

    def constraints(t, q):
        return system.constraints(t, q[:n_s], q[n_s:])

    def momentum(v):
        return jnp.concatenate(legendre(system, q_s, q_f, v[:n_s], v[n_s:]))

    t = jnp.zeros(())
    rows = [np.asarray(jax.jacfwd(constraints, 1)(t, q))]
    values = [-np.asarray(jax.jacfwd(constraints)(t, q))]
    for joint, freedom, given in _rates(effects, sorting.bodies, wanted):
        along = jax.jacfwd(lambda q, joint=joint, of=freedom: _freedoms(joint, of, sorting.bodies, columns, q))
        rows.append(np.asarray(along(jnp.asarray(bodies))) @ of_bodies)
        values.append(given)
    c, b = np.concatenate(rows), np.concatenate(values)
    root = np.linalg.cholesky(np.asarray(jax.jacfwd(momentum)(jnp.asarray(v))))  # M = R R^T
    size = np.abs([b, c @ v]).max()
    v = v + np.linalg.solve(root.T, np.linalg.lstsq(np.linalg.solve(root, c.T).T, b - c @ v, rcond=None)[0])
    missed = np.abs(c @ v - b).max()
    if missed > REACHED * size:
        raise ValueError(
            f"Scene.with_rates: no velocities have these rates of {', '.join(wanted)} and keep the constraints: they are missed by "
            f"{missed:.3g}. Give fewer rates: those of a joint follow from others, or it cannot move here."
        )
    rates = sorting.to_bodies(np.concatenate(sorting.assembled))[1] @ v
    moved = [body.with_rates(rates[columns[name] : columns[name] + body.size]) for name, body in sorting.bodies.items()]
    if not sorting.layout.freedoms:
        return moved, {}
    at = {key: place.start + (n_s if place.part == "f" else 0) for key, place in sorting.layout.freedoms.items()}
    return moved, {key: (np.asarray(q[i]), v[i]) for key, i in at.items()}


def joint_starts(
    sorting: Sorting, effects: Sequence[Effect], wanted: Mapping[str, Any]
) -> dict[tuple[str, int, str], tuple[Any, Any]]:
    """Values and rates of freedoms by the keys of `Layout.freedoms`, see `Scene.with_joints`.

    Args:
        sorting: bodies at their places.
        effects: of the scene, joints among them.
        wanted: by the name of the joint.
    """
    if not isinstance(wanted, Mapping):
        raise TypeError(
            f'Scene.with_joints: joints is {wanted!r}; give starts by the names of joints, {{"hinge": 0.3}}.'
        )
    joints = {effect.name: effect for effect in effects if isinstance(effect, Joint)}
    found = {}
    for name, given in wanted.items():
        if name not in joints:
            raise ValueError(f"Scene.with_joints: {unknown('joint', name, joints)}")
        joint, count = joints[name], len(joints[name].elements(sorting.bodies))
        for of, start in given.items() if isinstance(given, Mapping) else [("auto", given)]:
            try:
                freedom = freedom_of(joint, of)
            except ValueError as error:
                raise ValueError(f"Scene.with_joints: {error} Give a dictionary of them.") from None
            value, rate = start if isinstance(start, tuple) else (start, 0.0)
            what = f"Scene.with_joints: the start of {name}"
            numbers = [real_array(what, number) for number in (value, rate)]
            for number in numbers:
                if number.shape not in ((), (count,)):
                    more = f", or one for each pair, ({count},)" if count > 1 else ""
                    raise ValueError(
                        f"{what} has shape {number.shape}; give one number, or a pair (value, rate){more}."
                    )
                if is_concrete(number) and not np.isfinite(number).all():
                    raise ValueError(f"{what} is {number}; it must be finite.")
            for i in range(count):
                key = name, i, freedom
                if key not in sorting.layout.freedoms:
                    raise ValueError(
                        f"Scene.with_joints: {joint.label(i, sorting.bodies)} has no coordinate of its own: "
                        + (
                            "it closes a loop; set the other joints of the loop."
                            if sorting.layout.freedoms
                            else 'give the scene coordinates="joint".'
                        )
                    )
                found[key] = tuple(number if number.ndim == 0 else number[i] for number in numbers)
    return with_closed_loops(sorting, found)


def with_closed_loops(
    sorting: Sorting, wanted: dict[tuple[str, int, str], tuple[Any, Any]]
) -> dict[tuple[str, int, str], tuple[Any, Any]]:
    """Starts of freedoms, and with them those of all others that rows of loops and couplings tie to them.

    Newton's iteration on ``g(q) = 0`` moves the freedoms x that are not wanted, ``dx = -(dg/dx)^+ g``, while the wanted ones go to their values
    in parts; then rates of x keep ``dg/dq v = 0``. Rows that bodies with coordinates of their own can keep, such as those behind a ball joint,
    are left to the state at the start.

    Args:
        sorting: bodies at their places, effects at their homes.
        wanted: value and rate by the keys of `Layout.freedoms`.

    Raises:
        ValueError: a loop that does not close.
    """
    rows = ConstraintRows.of(sorting)
    if rows is None or not is_concrete((sorting.start, wanted)):
        return wanted
    n_s = sorting.layout.sizes[0]
    at = {key: place.start + (n_s if place.part == "f" else 0) for key, place in sorting.layout.freedoms.items()}
    held, others = [at[key] for key in wanted], [at[key] for key in at if key not in wanted]
    q, v = (np.concatenate(parts) for parts in (sorting.start[:2], sorting.start[2:]))
    numbers = _of_joints_alone(sorting, rows)
    begin, end = q[held], np.array([float(value) for value, _ in wanted.values()])
    reached, opened = begin, None
    for part in np.linspace(0.0, 1.0, PARTS + 1)[1:]:
        moved = q.copy()
        moved[held] = begin + part * (end - begin)
        opened = _close(rows, numbers, moved, others)
        if opened is None:  # between the start and values that fit each other rows may be open
            q, reached = moved, moved[held]
    if opened is not None:
        row, gap = opened
        named = " and ".join(f"{joint} at {value:.4g}" for (joint, *_), value in zip(wanted, reached, strict=True))
        raise ValueError(
            f"Scene.with_joints: no configuration of the other joints keeps {row}, which stays open by {gap:.3g}. It is kept up to "
            f"{named}; give values within, or fewer of them."
        )
    v[held] = [float(rate) for _, rate in wanted.values()]
    jacobian = rows.at(0.0, q)[1][numbers]
    v[others] -= np.linalg.lstsq(jacobian[:, others], jacobian @ v, rcond=RANK)[0]
    return wanted | {key: (q[i], v[i]) for key, i in at.items() if key not in wanted and jacobian[:, i].any()}


def _of_joints_alone(sorting: Sorting, rows: ConstraintRows) -> np.ndarray:
    """Numbers of the rows that no motion of bodies with coordinates of their own changes: those of loops and couplings of joints."""
    n_s, changes = sorting.layout.sizes[0], np.zeros(len(rows.rows), bool)
    for name, place in sorting.layout.own.items():
        if name in sorting.bodies:
            first = place.start + (n_s if place.part == "f" else 0)
            by_motions = rows.jacobian[:, first : first + place.size] @ sorting.bodies[name].motions
            changes |= np.linalg.norm(by_motions, axis=1) > RANK * np.linalg.norm(rows.jacobian, axis=1)
    return np.flatnonzero(~changes)


def _close(rows: ConstraintRows, numbers: np.ndarray, q: np.ndarray, free: Sequence[int]) -> tuple[str, float] | None:
    """Move coordinates of q, in place, until rows are zero; where they do not close, the name and value of the one that is furthest off.

    Args:
        numbers: of the rows.
        free: the coordinates.
    """
    opened = None
    for _ in range(CORRECTIONS):
        values, jacobian = (x[numbers] for x in rows.at(0.0, q))
        sizes = np.abs(values / rows.sizes[numbers])
        if sizes.max(initial=0.0) <= CLOSED:
            return None
        worst = int(np.argmax(sizes))
        opened = rows.rows[numbers[worst]].name, float(abs(values[worst]))
        q[free] -= np.linalg.lstsq(jacobian[:, free], values, rcond=RANK)[0]
    return opened


def _rates(effects: Sequence[Effect], bodies: Bodies, wanted: Mapping[str, Any]):
    """Joints, which freedom of each, and its rates (n,), one for each pair of bodies."""
    if not isinstance(wanted, Mapping):
        raise TypeError(
            f'Scene.with_rates: rates is {wanted!r}; give rates by the names of joints, {{"bearing": 100.0}}.'
        )
    joints = {effect.name: effect for effect in effects if isinstance(effect, Joint)}
    for name, given in wanted.items():
        if name not in joints:
            raise ValueError(f"Scene.with_rates: {unknown('joint', name, joints)}")
        joint = joints[name]
        for of, values in given.items() if isinstance(given, Mapping) else [("auto", given)]:
            try:
                freedom = freedom_of(joint, of)
            except ValueError as error:
                raise ValueError(
                    f'Scene.with_rates: {error} Give {{"turn": ...}} or {{"slide": ...}} of them.'
                ) from None
            what, count = f"Scene.with_rates: the rate of {name}", len(joint.elements(bodies))
            values = real_array(what, values)
            if values.shape not in ((), (count,)):
                raise ValueError(f"{what} has shape {values.shape}; give one number, or one for each pair, ({count},).")
            if not is_concrete(values) or not np.isfinite(values).all():
                raise ValueError(f"{what} is {values}; it must be finite.")
            yield joint, freedom, np.broadcast_to(values, (count,))


def _freedoms(joint: Joint, of: str, bodies: Bodies, columns: Mapping[str, int], q):
    """How far each pair of a joint has turned or moved, (n,), by the coordinates of all bodies."""
    params, found = joint.parameters(bodies), []
    for i, element in enumerate(joint.elements(bodies)):
        _, own = joint.one(i, bodies, params)
        parts = [
            GROUND_COORDINATES if name == GROUND else q[columns[name] : columns[name] + bodies[name].size]
            for name in element
        ]
        found.append(FREEDOMS[of](tuple(map(jnp.asarray, parts)), own))
    return jnp.stack(found)
