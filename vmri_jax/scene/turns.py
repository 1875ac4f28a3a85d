"""Whole turns of the angles of joints: a coordinate counts them, directors do not.

The directors of two bodies give the sine and the cosine of the angle between them. An effect to which turns matter takes such an angle up to
`REACH` alone; along a run turns are counted from one saved node to the next.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import moving
from vmri_jax.scene.effects.freedoms import ANGLES, REACH
from vmri_jax.scene.effects.joint_base import Joint, OfFreedoms, freedom_of
from vmri_jax.scene.sorting import Sorting
from vmri_jax.scene.velocities import steps_of


def along_run(sorting: Sorting, joint: Joint, run: Any, of: str, pair: int) -> np.ndarray:
    """The freedom of a joint along a run, (k,) rad or m, whole turns included; see `Scene.joint_motion`."""
    freedom, elements = freedom_of(joint, of), joint.elements
    pair = range(len(elements))[pair]  # raises IndexError
    if (label := joint.label(pair, freedom)) in run.names.bodies:
        return np.asarray(run.position(label))[..., 0]
    value = partial(joint.value, freedom, pair)
    q = {name: run.position(name) for name in moving(elements[pair])}
    if freedom not in ANGLES:
        return np.asarray(value(q))
    angle, rate = map(np.asarray, jax.jvp(value, (q,), ({name: run.velocity(name) for name in q},)))
    counted, dt, rates = np.unwrap(angle), np.diff(run.t), (rate[..., 1:], rate[..., :-1])
    fastest, excess = np.maximum(*np.abs(rates)), np.abs(np.diff(counted) - dt * np.mean(rates, axis=0))
    # an angle that moves by a quarter of a turn more or less than both rates say is faster in between
    unknown = np.argwhere((fastest * dt >= np.pi) | (excess >= np.pi / 2))
    if unknown.size:
        node = unknown[0, -1]
        raise Refused(
            f"Scene.joint_motion: {joint.label(pair)} may turn by half a turn or more between the saved nodes {node} and "
            f"{node + 1}, and its angle comes from directors, which know no whole turns. Save nodes less than "
            f'{np.pi / 2 / np.nanmax(fastest):.2g} s apart, save=..., or give the scene coordinates="joint".'
        )
    turns = np.round((at_start(sorting, joint, pair, freedom) - angle[..., :1]) / (2 * np.pi))
    return counted + 2 * np.pi * turns


def check_reach(sorting: Sorting) -> None:
    """Refuse limits, neutral angles and starts that effects which count turns cannot take from directors."""
    for effect, i, joint, pair, freedom in _from_directors(sorting):
        for mark in effect.marks:
            value = effect.parameters[mark]
            _require_reach(effect, mark, value[i] if np.ndim(value) else value, joint)
        _require_reach(effect, "the start", at_start(sorting, joint, pair, freedom), joint)


def check_run(sorting: Sorting, run: Any, twin: Sorting) -> None:
    """Refuse a run with angles that effects of the same scene by directors, `twin`, could not take from these."""
    for effect, _, joint, pair, freedom in _from_directors(twin):
        angle = np.nanmax(np.abs(along_run(sorting, joint, run, freedom, pair)))
        _require_reach(effect, "the largest angle of the run", angle, joint)


def _from_directors(sorting: Sorting) -> Iterator[tuple[OfFreedoms, int, Joint, int, str]]:
    """(effect, number of its element, joint, number of its pair, freedom) for all angles that effects which count turns take from directors."""
    joints = {part.effect.name: part.effect for part in sorting.placed if isinstance(part.effect, Joint)}
    for part in sorting.placed:
        effect = part.effect
        if not (isinstance(effect, OfFreedoms) and effect.counts_turns):
            continue
        for i in part.elements:
            for name, pair, freedom in effect.freedoms_of(i):
                if freedom in ANGLES and (name, pair, freedom) not in sorting.layout.freedoms:
                    yield effect, i, joints[name], pair, freedom


def _require_reach(effect: OfFreedoms, quantity: str, value: Any, joint: Joint) -> None:
    """Refuse an angle of `REACH` or more."""
    expected = (
        f"the angle of {joint.name} comes from directors, which know no whole turns, and has to stay within {REACH:.4g} rad: give the scene "
        'coordinates="joint", or where all joints of a loop have such effects leave one of these out'
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
