"""Search for discontinuous forces, such as dry friction: a step across a jump has no solution, or one that no iteration
reaches.

The search evaluates the forces ``F + dL/dq`` along two lines from a state, straight ahead and to the reversed
velocities:

    t + s,  q + s v,  v + s a,    0 <= s <= duration          t,  q,  v - s v,    0 <= s <= 2

It divides the piece of a line with the largest change of a force repeatedly: the change of a smooth force shrinks with
the piece, the change of a discontinuous force does not.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import quickly_compiled, split_at
from vmri_jax.mechanics.invariants import lagrangian
from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System

PIECES = 65
"""Pieces of a division.

Odd, since a force such as v / |v| is not finite at the middle of the second line, where v = 0.
"""
ROUNDS = 3
"""Divisions. A change within 65^-3 of a line is a jump; with more divisions, steep smooth forces are not reported."""
LEAST_KEPT_CHANGE = 0.5
"""Least change over the last piece of a jump, relative to the change over the first piece.

A larger value misses jumps of forces that also vary.
"""
LEAST_CONTRAST = 10.0
"""Least ratio of a jump to all other changes in the last division.

A smaller value reports round-off, whose changes are alike.
"""
ROUND_OFF = 1e-6
"""Least jump relative to the force.

A smaller value reports round-off of the positions; a larger one misses small friction forces.
"""
MOST_COORDINATES = 8
"""Number of forces that the search follows, those with the most uneven changes. A larger number takes longer."""
ZERO_VELOCITY = 1e-4
"""Velocity at a jump, relative to the largest one on the line, that counts as zero.

A larger value blames friction for other jumps.
"""


class Jump(NamedTuple):
    """A discontinuity of a force.

    coordinate: number of the coordinate of the force, slow coordinates first.
    before, behind: the force on both sides of the jump, in the direction of the motion.
    reverses: whether the velocity of the coordinate passes zero there.
    """

    coordinate: int
    before: float
    behind: float
    reverses: bool


def jump_ahead(system: System, state: State, duration: float) -> Jump | None:
    """A discontinuity of a force ahead of a state; None if the search finds none.

    Args:
        system: its potentials, kinetic energy and forces.
        state: where the lines start.
        duration: length of the line straight ahead, and the time in which a velocity may reach zero.
    """
    now = _motion(system, state)
    v, a = (np.append(*x) for x in ((now.v_s, now.v_f), (now.a_s, now.a_f)))
    every = np.ones(len(v), dtype=bool)
    reached = np.abs(v) <= np.abs(a) * duration
    for (dt, dq, dv), end, may_jump in (((1.0, v, a), duration, every), ((0.0, 0 * v, -v), 2.0, reached)):
        jump = _jump_on_line(system, state, (dt, dq, dv), end, may_jump)
        if jump is not None:
            return jump
    return None


def in_words(jump: Jump | None, names: Names) -> str:
    """A sentence on the force that jumps, and on a smooth replacement; empty without a jump."""
    if jump is None:
        return ""
    label = [*names.slow_coordinates, *names.fast_coordinates][jump.coordinate]
    sides = f"The likely cause: the force on {label} jumps from {jump.before:.4g} to {jump.behind:.4g} just ahead"
    if jump.reverses:
        return (
            f"{sides}, where the velocity of {label} passes zero, as dry friction does. A step across a jump has no "
            "solution that the iteration could reach, and sticking is out of scope. Take f tanh(v / eps) instead of "
            "f sign(v), with eps well below the velocities of interest and a step below 2 m eps / f: what sticks "
            "then creeps, slower than eps."
        )
    return (
        f"{sides}. A step across a jump has no solution that the iteration could reach. Take a smooth function instead "
        "of sign, where, abs or round in forces and potentials, tanh(x / eps) for sign(x), and a step that resolves "
        "eps."
    )


def _jump_on_line(system: System, state: State, line: tuple, end: float, may_jump: np.ndarray) -> Jump | None:
    """The first discontinuity on a line, given by its rates of t, q and v, among the forces on coordinates that
    `may_jump` marks."""
    s = np.linspace(0.0, end, PIECES + 1)
    forces, velocities = jax.device_get(_on_line(system, state, line, s))
    changes = _changes(forces)
    uneven = np.where(may_jump, changes.max(axis=0), 0.0) / np.maximum(changes.mean(axis=0), np.finfo(float).tiny)
    for i in np.argsort(-uneven)[:MOST_COORDINATES]:
        first, part, values, speeds = changes[:, i].max(), s, forces, velocities
        if not (may_jump[i] and first > 0):
            continue
        for _ in range(ROUNDS - 1):
            k = int(_changes(values)[:, i].argmax())
            part = np.linspace(part[k], part[k + 1], PIECES + 1)
            values, speeds = jax.device_get(_on_line(system, state, line, part))
        last = _changes(values)[:, i]
        k = int(last.argmax())
        size = np.abs(values[k : k + 2, i]).max()
        if last[k] > max(LEAST_KEPT_CHANGE * first, LEAST_CONTRAST * np.delete(last, k).max(), ROUND_OFF * size):
            reverses = abs(speeds[k, i]) <= ZERO_VELOCITY * abs(velocities[:, i]).max()
            return Jump(int(i), float(values[k, i]), float(values[k + 1, i]), bool(reverses))
    return None


def _changes(forces: np.ndarray) -> np.ndarray:
    """(pieces, n) change of each force over each piece; zero next to values that are not finite."""
    with np.errstate(invalid="ignore", over="ignore"):  # of infinities
        changes = np.abs(np.diff(forces, axis=0))
    return np.where(np.isfinite(changes), changes, 0.0)


_motion = quickly_compiled(motion)


@quickly_compiled
def _on_line(system, state, line, s):
    """Forces and velocities (k, n) on a line."""
    now, (dt, dq, dv) = motion(system, state), line
    q, v, n_s = jnp.append(state.q_s, state.q_f), jnp.append(now.v_s, now.v_f), state.q_s.size

    def force(s):
        here, velocity = q + s * dq, v + s * dv
        outside = system.forces(state.t + s * dt, *split_at(here, n_s), *split_at(velocity, n_s))
        return jax.grad(partial(lagrangian, system, n_s))(here, velocity) + jnp.concatenate(outside), velocity

    return jax.vmap(force)(s)
