"""The exception of a failed run, with its probable cause: the body that moves most in the step, a force that jumps,
swapped rates."""

from typing import Any, NamedTuple

import jax
import numpy as np

from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.jumps import in_words, jump_ahead
from vmri_jax.mechanics.linearisation import linearise
from vmri_jax.mechanics.names import AXES, Names
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.running.origin import SavedRun
from vmri_jax.steppers.results import Result, SimulationError

LARGE_TURN = 0.5
"""Radians that a rigid body may turn in a step. Beyond one radian the constraint forces at the start of a step, which
hold the directors, cannot make them unit vectors again at its end; with a larger value a step near that limit is no
longer blamed."""
LARGE_MOVE = 0.25
"""Distance that a point or a coordinate may move in a step, as a part of the extent of all positions; with a larger
value a step that throws a point through other points is no longer blamed."""
RUN_AWAY = 20.0
"""Multiple of `LARGE_TURN` or `LARGE_MOVE` above which a motion is the result of an instability, not its cause; with a
larger value the advice computes steps from positions that have already exploded."""


class Move(NamedTuple):
    """How far a body, or a coordinate without a body, moves in a step, in a micro step if it is fast (`micro`).

    amount: radians for a turn; for a move the distance as a part of the extent of all positions.
    turns: whether this is the turn of a rigid body; else it is a move.
    """

    name: str
    micro: bool
    amount: float
    turns: bool

    @property
    def size(self) -> float:
        """The amount divided by its limit."""
        return self.amount / (LARGE_TURN if self.turns else LARGE_MOVE)

    def sentence(self, macro_dt: float) -> str:
        """The motion in a macro step H in words, with advice on the step."""
        step = "micro step" if self.micro else "macro step"
        moves = f"turns {self.amount:.2g} rad" if self.turns else f"moves {self.amount:.1%} of the extent of the system"
        if self.size < 1:
            return (
                f"By the velocities before the failed step, {self.name} {moves} in a {step}, which is little; its "
                "forces may be too large for the step."
            )
        if self.size > RUN_AWAY:
            return (
                f"{self.name} ran away before the failure: the run was unstable, its steps too large for a vibration. "
                "Look at the energy of earlier nodes."
            )
        else_fast = ", or more micro steps" if self.micro else ", or make it fast, so that micro steps follow it"
        return (
            f"{self.name} {moves} in a {step}, which is too much for one step: take macro_dt below "
            f"{macro_dt / self.size:.2g}{else_fast}."
        )


def largest_motion(system: System, state: State, names: Names | None, macro_dt: float, num_micro: int) -> Move | None:
    """The motion of largest `Move.size` in the macro step H from a state; None where there are no coordinates or no
    finite numbers.

    A rigid body turns by ``h |omega|`` with ``2 |omega|^2 = sum_i |dd_i/dt|^2`` over its three directors d_i.
    """
    q, h = {"s": np.asarray(state.q_s), "f": np.asarray(state.q_f)}, {"s": macro_dt, "f": macro_dt / num_micro}
    v_s, v_f = jax.jit(velocity)(system, state.q_s, state.q_f, state.p_s, state.p_f)
    moves = {"s": h["s"] * np.asarray(v_s), "f": h["f"] * np.asarray(v_f)}
    known = (names or Names()).of_coordinates(q["s"].size, q["f"].size)
    labels = {"s": known.slow_coordinates, "f": known.fast_coordinates}
    positions = np.concatenate([q[part][known.positions(part)] for part in ("s", "f")])
    extent = float(np.ptp(positions)) if positions.size > 1 else 0.0
    motions = []
    for name, place in known.bodies.items():
        move, micro = moves[place.part][place.start : place.start + place.size], place.part == "f"
        if name in known.rigid:
            # The centre of mass comes first, then the directors: h^2 |dd_i/dt|^2 of each.
            squares = np.sum(move[len(AXES) :].reshape(-1, len(AXES)) ** 2, axis=1)
            has_all_directors = len(squares) == len(AXES)  # a body of fewer directors turns by its fastest director
            turn = np.sqrt(squares.sum() / 2 if has_all_directors else squares.max(initial=0.0))
            motions.append(Move(name, micro, float(turn), True))
            move = move[: len(AXES)]
        if name in known.numbered:  # coordinates without bodies: name the one that moves most
            fastest = int(np.abs(move).argmax())
            name, move = labels[place.part][place.start + fastest], move[fastest]
        if extent > 0:
            motions.append(Move(name, micro, float(np.linalg.norm(move) / extent), False))
    return max((motion for motion in motions if np.isfinite(motion.amount)), key=lambda m: m.size, default=None)


def simulation_error(run: Any, trajectory: SavedRun) -> SimulationError:
    """The `SimulationError` of a `Simulation`, whose trajectory is in memory or in a store, with the largest motion
    before the failing step."""
    failed_at, dt = int(trajectory.failed_at), float(run.macro_dt)
    interval, step = divmod(failed_at, run.save_every)
    part, moved, jump = trajectory[interval : interval + 2], "", ""  # from the node before the failure
    if trajectory.origin.simulated is not None:
        system, before = trajectory.origin.system(), part[0]
        motion = largest_motion(system, before, part.names, dt, run.scheme.num_micro)
        moved = "" if motion is None else motion.sentence(dt)
        jump = in_words(jump_ahead(system, before, (step + 2) * dt), part.names)  # in the failing step or in the next
    t, work = float(part.t[0] + step * run.macro_dt), (int(part.info.iterations[0]), float(part.info.residual[0]))
    error = SimulationError(Result(int(trajectory.result)), failed_at, t, *work, trajectory, moved=moved)
    return error.advised(dt, _swapped(trajectory[:1]), jump)


def _swapped(start: SavedRun) -> str:
    """The advice of `Linearisation.swapped` at the start of a run; empty if its labels are right or its system is not
    known."""
    if not start.states.q_s.shape[-1] or not start.states.q_f.shape[-1]:
        return ""  # nothing to swap: the linearisation would take seconds to compile
    try:
        advice = linearise(start.origin.system(), start[0], start.names).swapped()
    except (ValueError, TypeError, IndexError):  # no expansion at the start: the error of the run says more about it
        return ""
    return advice[0] if advice else ""
