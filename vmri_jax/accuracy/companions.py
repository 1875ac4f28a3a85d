"""The error of a run from a companion run, its slow and fast shares from a second one.

A run with macro steps H and micro steps h = H / N has, with a scheme of order p, the error

    x_{H,h}(t) - x(t) = S(t) H^p + F(t) h^p + ...

The slow share ``S H^p`` vanishes with H at fixed h, the fast share ``F h^p`` with h at fixed H. With
``r = 2^p / (2^p - 1)`` (Richardson's extrapolation), from companion runs from the same start,

    half the macro step:        S H^p + F h^p = r (x_{H,h} - x_{H/2,h/2})
    twice the micro steps:              F h^p = r (x_{H,h} - x_{H,h/2})

The first companion halves H and h: it is the program of the run with other numbers. The second one is another program,
and is run where the shares are asked for.

A jump of a force can act at the same node in steps of H and of H / 2, too early or too late in both. In systems that
are driven in time, and where an estimate is small beyond belief, a third companion takes about 1.6 times the steps,
with few nodes in common with the run, and a fourth one 2.6 times where forces jump, with the order p = 1. At common
nodes the largest estimate counts, and between them where the first one disagrees. Steps with fewer than
`NODES_OF_EVENT` nodes in an event of `vmri_jax.mechanics.driving` are not certified from this event on.

This is an estimate, not a bound. If the error falls with an order q below p, as for vibrations that the steps do not
resolve, the true error is ``(1 - 2^-p) / (1 - 2^-q)`` times the estimate: 1.5 times for p = 2 and q = 1. Above order 2
an error also has mixed terms ``H^a h^b``, which count in part to both shares. The error of a node is *certified* if the
estimates at this node and at all nodes before it are small against the extent of the motion.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from vmri_jax.accuracy.families import Family
from vmri_jax.mechanics.arrays import of_one_type
from vmri_jax.mechanics.driving import Events
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.arguments import Save
from vmri_jax.running.observables import LostEnergyWarning, SingularCoordinatesWarning, concerns
from vmri_jax.running.run_error import RunError, largest_of
from vmri_jax.running.saved import Saved
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike, stage_lengths, stage_scheme
from vmri_jax.steppers.results import Result

LARGEST_CERTIFIED = 0.1
"""Largest certified error, as a part of the extent of the motion; from the first node with a larger one, no error is
certified. Above it the leading term of the error no longer dominates, so that a larger value certifies meaningless
numbers."""
CHAOTIC_GROWTH = 32.0
"""Growth of the error in the second half of a time, above which the motion may be chaotic: it is if the difference of
two runs with smaller steps grows as much. Errors of regular motions grow like t or t^2, by 2 or 4, errors of chaotic
motions like exp(L t). A larger value overlooks chaos that begins late."""

DOUBTED = 1e-5
"""Error, as a part of the accuracy that is asked for, below which an estimate is not believed without a third
companion: a run at rest has no error until its force begins. A larger value takes one more run where a scheme is
exact."""
LENGTH_TOLERANCE = 0.01
"""Relative error of the lengths of events, so that steps chosen for an event see it; a larger value certifies steps
with fewer nodes."""
NODES_OF_EVENT = 4
"""Least nodes of forces, or of moving constraints, in an event. With fewer nodes the errors of a run and its companions
say nothing about each other; with more of them driven systems take more steps than their accuracy needs."""
MOST_STEPS = 2**22
"""Macro steps of the longest run that a search takes, an hour with a millisecond for each step. With a larger value
searches for an accuracy out of reach, and for events too short for any run, take hours; with a smaller one short pulses
are refused that a run could see."""
FURTHER_PARTS = (1.6, 2.6)
"""Steps of further companions over the steps of the run, near multiples of the golden ratio: hardly any of their nodes
is near a node of the run. Forces that jump take both, other driven systems the first one. More companions take
longer."""
FEWEST_DIVIDED = 20
"""Least number of macro steps between nodes that a further companion has in common with the run. With a smaller number
a jump may act at the same node in all runs, so that none tells the error; with a larger one fewer nodes are
compared."""
AGREEMENT = 2.0
"""Estimate of a further companion over the largest one since the last common node, up to which both agree. A larger
value leaves errors of a jump too small between common nodes; a smaller one gives nodes the errors of others."""


class UncertifiedWarning(UserWarning):
    """The error of a run is not certified over all of its length."""


@dataclass(frozen=True)
class Trial:
    """A run, or a lane of a batch, beside its companion with half the macro step.

    errors: (k, n_s + n_f) of the positions; NaN after a failure of the run or of this companion, infinite if a further
        companion fails.
    drives: events that the steps have to see.
    family: the family that a search took the scheme from; None of other runs.
    """

    run: Simulation
    saved: Saved
    halved: Trajectory
    errors: np.ndarray
    drives: Events
    family: Family = None  # pyright: ignore[reportAssignmentType] (every trial of a search has one)

    @classmethod
    def of(
        cls,
        run: Simulation,
        saved: Saved,
        drives: Events,
        companion_of: Callable[..., Trajectory],
        accuracy: float = 0.0,
        family: Any = None,
    ) -> "Trial":
        """A run with its errors, from the companion ``companion_of(2)``, and from further ones,
        ``companion_of(parts, whole)``, if the system is driven or its errors are below `DOUBTED` of the accuracy."""
        trial = cls(run, saved, companion_of(2), np.zeros(0), drives, family)
        has_failed = max(int(saved.failed_at), int(trial.halved.failed_at)) >= 0
        is_believed = not drives.names and np.abs(trial.first).max(initial=0.0) > DOUBTED * accuracy
        is_enough = has_failed or is_believed
        return replace(trial, errors=trial.first if is_enough else _with_further_companions(trial, companion_of))

    @cached_property
    def trajectory(self) -> Trajectory:
        """The trajectory of the run."""
        return self.saved.trajectory(self.run)

    @property
    def order(self) -> int:
        """The order of the error: of the scheme, or 1 where forces jump."""
        return 1 if self.drives.jump else self.run.order

    @cached_property
    def first(self) -> np.ndarray:
        """(k, n_s + n_f) errors of the positions from the first companion alone."""
        return ratio(self.order) * (positions(self.trajectory) - positions(self.halved))

    def shares(self, twice: Trajectory) -> tuple[np.ndarray, np.ndarray]:
        """Slow and fast shares (k, n_s + n_f) of `first`, from a run with twice the micro steps."""
        fast = ratio(self.order) * (positions(self.trajectory) - positions(twice))
        return self.first - fast, fast

    @cached_property
    def concerns(self) -> list[LostEnergyWarning]:
        """What is wrong with its motion."""
        run = self.run
        return concerns(self.saved.nodes.table, self.trajectory.t, run.system, run.macro_dt, run.save_every)

    @cached_property
    def error(self) -> float:
        """The largest error; infinite unless all errors are certified."""
        return run_error(self).largest

    def steps_for(self, error: float, order: float | None = None) -> int:
        """Macro steps for this error, ``n (e / error)^(1 / p)``, with the order of the scheme if None is given."""
        return max(1, int(np.ceil(self.run.num_steps * (self.error / error) ** (1 / (order or self.run.order)))))


def told_error(trial: Trial, of: Callable | None = None, shares: bool = False) -> Any:
    """The `RunError` of a run without a failed step, None if its companion fails; warns if the error is not certified
    over the whole run."""
    halved, error = trial.halved, None
    if int(halved.failed_at) >= 0:
        failed = float(halved.t[0]) + int(halved.failed_at) * float(trial.run.macro_dt) / 2
        reason = f"the error is not known; the same run with half the macro step failed at t = {failed:.4g}."
    else:
        error = run_error(trial, of, shares)
        reason = "" if error.is_certified else _uncertified(error, trial)
    if reason:
        warn_user(f"simulate: {reason}", UncertifiedWarning)
    return error


def run_error(trial: Trial, of: Callable | None = None, shares: bool = False) -> RunError:
    """The error of a run, NaN where it is not certified."""
    run, trajectory, total = trial.run, trial.trajectory, trial.errors
    slow = fast = np.full_like(total, np.nan)
    if shares:
        twice = run.scheme.with_num_micro(2 * stage_scheme(run.scheme).num_micro)
        slow, fast = trial.shares(companion(replace(run, scheme=of_one_type(twice)), 1))
    certified, growth = certified_nodes(trajectory, total)
    certified[1:] &= np.asarray(trajectory.t)[1:] <= first_unseen(run, trial.drives)
    until = np.asarray(trajectory.t)[certified][-1]
    total, slow, fast = (np.where(certified[:, None], a, np.nan) for a in (total, slow, fast))
    of_error = None if of is None else _of_error(of, trial, certified)
    q_s, q_f = np.split(total, [trajectory.states.q_s.shape[-1]], axis=1)
    shares_at_nodes = largest_of(slow), largest_of(fast)
    return RunError(q_s, q_f, *shares_at_nodes, of_error, np.asarray(until), np.asarray(growth))


def ratio(order: int, parts: float = 2) -> float:
    """``r = k^p / (k^p - 1)`` of a scheme of order p and a companion with k times the steps."""
    return 1.0 / (1.0 - parts**-order)


def _with_further_companions(trial: Trial, companion_of: Callable[..., Trajectory]) -> np.ndarray:
    """The errors of the first companion, raised to the errors from further companions; infinite if one of
    these fails."""
    run, errors = trial.run, np.array(trial.first)
    # From a compared node to the next, `stride` saved nodes later: `whole` steps of the run, `parts` of the companion.
    least = range(math.ceil(FEWEST_DIVIDED / run.save_every), run.num_saves)
    stride = next((s for s in least if run.num_saves % s == 0), run.num_saves)
    whole = stride * run.save_every
    between = errors[1:].reshape(-1, stride, errors.shape[1])  # a view: compared nodes are the last of each interval
    for factor in FURTHER_PARTS if trial.drives.jump else FURTHER_PARTS[:1]:
        parts = next(k for k in range(max(round(factor * whole), 3), 10 * whole + 4) if math.gcd(k, whole) == 1)
        further = companion_of(parts, whole)
        if int(further.failed_at) >= 0:
            return np.full_like(errors, np.inf)
        difference = positions(trial.trajectory)[::stride] - positions(further)
        other = ratio(trial.order, parts / whole) * difference[1:, None]
        disagrees = np.abs(other) > AGREEMENT * np.abs(between).max(axis=1, keepdims=True)
        is_compared = np.arange(stride)[:, None] == stride - 1
        between[:] = np.where(disagrees | is_compared & (np.abs(other) > np.abs(between)), other, between)
    return errors


def node_distance(scheme: SchemeLike, drives: Events) -> float:
    """Largest distance in time of the nodes at which a scheme sees the terms that depend on time, in units of the macro
    step."""
    stage = stage_scheme(scheme)
    longest = float(np.abs(stage_lengths(scheme)).max())
    return longest * max(getattr(stage, name).largest_gap(stage.num_micro) for name in drives.names)


def fewest_steps(scheme: SchemeLike, drives: Events, length: float) -> int:
    """Fewest macro steps with `NODES_OF_EVENT` nodes in the shortest event; refuses more than `MOST_STEPS`."""
    if not drives.lengths.size:
        return 1
    fewest = int(np.ceil(NODES_OF_EVENT * node_distance(scheme, drives) * length / drives.shortest))
    if fewest > MOST_STEPS:
        raise Refused(
            f"t_end is {length:.4g} after the start, and near t = {drives.times[drives.lengths.argmin()]:.4g} "
            f"{' and '.join(drives.names)} of the system changes and changes back within {drives.shortest:.2g}: a run "
            f"that sees this takes {fewest:.1e} macro steps, and no run of more than {MOST_STEPS} is chosen. Give a "
            "force that changes more slowly, or simulate in parts, with steps of your own near this time."
        )
    return fewest


def first_unseen(run: Simulation, drives: Events) -> float:
    """Time of the first event with fewer than `NODES_OF_EVENT` nodes of the run, not before its start; infinite without
    such an event."""
    if not drives.names:
        return np.inf
    least = NODES_OF_EVENT * node_distance(run.scheme, drives) * float(run.macro_dt)
    starts = (drives.times - drives.lengths)[drives.lengths < least * (1 - LENGTH_TOLERANCE)]
    return max(float(starts.min(initial=np.inf)), float(run.state.t))


def _of_error(of: Callable, trial: Trial, certified: np.ndarray) -> np.ndarray:
    """Error of a function of the run, raised like the largest error of a position by further companions; NaN at nodes
    that are not certified, and without a value for each node unless all nodes are certified."""
    values, halved_values = (np.asarray(of(run)) for run in (trial.trajectory, trial.halved))
    estimate, largest = (np.abs(a).max(initial=0.0) for a in (trial.first, trial.errors))
    raised = largest / estimate if estimate > 0 and largest < np.inf else (np.nan if largest > 0 else 1.0)
    error = raised * ratio(trial.order) * (values - halved_values)
    has_node_values = error.shape[:1] == certified.shape
    shown = certified.reshape(-1, *(1,) * (error.ndim - 1)) if has_node_values else certified.all()
    return np.where(shown, error, np.nan)


def certified_nodes(trajectory: Trajectory, error: np.ndarray) -> tuple[np.ndarray, float]:
    """(k,) whether the error (k, n_s + n_f) of each node is certified, and its growth in the second half of the
    certified time."""
    t, extent = np.asarray(trajectory.t), extent_of(trajectory)
    envelope = np.maximum.accumulate(largest_of(error))
    certified = envelope <= LARGEST_CERTIFIED * extent if extent > 0 else np.isfinite(envelope)
    certified[0] = True
    last = np.flatnonzero(certified)[-1]
    half = np.searchsorted(t, (t[0] + t[last]) / 2)
    return certified, float(envelope[last] / envelope[half]) if envelope[half] > 0 else 1.0


def extent_of(trajectory: Trajectory) -> float:
    """Largest difference between the largest and the smallest value of a coordinate in a run, up to a failure."""
    q = positions(trajectory)
    q = q[np.isfinite(q).all(axis=1)]
    return float(np.ptp(q, axis=0).max(initial=0.0)) if len(q) else 0.0


def check_function_of_run(of: Callable | None, run: Simulation) -> None:
    """Refuse a function whose error is to be estimated and that returns no numbers; it is called with a run that rests
    at the start."""
    if of is None:
        return
    value = of(resting(run))
    if np.asarray(value).dtype.kind not in "fiu":
        raise Refused(f"simulate: the function error returned {value!r} for a run; it must return numbers.")
    if not np.array_equal(value, of(resting(run)), equal_nan=True):
        raise Refused("simulate: the function error returns other numbers for the same run; it must be pure.")


def resting(run: Simulation) -> Trajectory:
    """A trajectory at the times of a run that stays at the start, without micro nodes: an argument to try functions of
    runs on."""
    run = replace(run, save=Save())
    _, *phase = vars(run.state).values()
    row = np.concatenate([*phase, np.zeros(run.width - sum(map(len, phase)))])
    nodes = run.columns.split(np.tile(row, (run.num_saves + 1, 1)))
    return Saved(nodes, np.asarray(int(Result.CONVERGED)), np.asarray(-1)).trajectory(run)


def companion(run: Simulation, parts: int, whole: int = 1) -> Trajectory:
    """The run with every `whole` macro steps divided into equal parts, at the nodes of the run or every `whole` steps;
    it may fail."""
    divided = finer(run, parts, whole)
    return divided.in_pieces().trajectory(divided)


def finer(run: Simulation, parts: int, whole: int = 1) -> Simulation:
    """The run that makes a `companion`."""
    return replace(
        run,
        macro_dt=run.macro_dt / (parts / whole),
        num_steps=run.num_steps // whole * parts,
        save_every=max(run.save_every // whole, 1) * parts,
        save=Save(),
    )


def positions(trajectory: Trajectory) -> np.ndarray:
    """(k, n_s + n_f) positions, slow first."""
    return np.concatenate([trajectory.states.q_s, trajectory.states.q_f], axis=1)


def _is_chaotic(error: RunError, trial: Trial) -> bool:
    """Whether small differences grow like exp(L t) by the motion itself, and not by large steps: between two runs with
    a half and a quarter of the macro step. Driven motions, which may be pumped, are left out."""
    trajectory = trial.trajectory
    if not (float(error.growth) > CHAOTIC_GROWTH and trajectory.keeps_energy) or trial.concerns:
        return False
    quartered = companion(trial.run, 4)
    envelope = np.maximum.accumulate(largest_of(positions(trial.halved) - positions(quartered)))
    t = np.asarray(trajectory.t)
    half, last = np.searchsorted(t, [(t[0] + error.certified_until) / 2, error.certified_until])
    return bool(envelope[last] > CHAOTIC_GROWTH * envelope[half])  # False for NaN, where a companion failed


def _uncertified(error: RunError, trial: Trial) -> str:
    """The reason why an error is not certified, and advice."""
    trajectory, drives, macro_dt = trial.trajectory, trial.drives, float(trial.run.macro_dt)
    unseen = first_unseen(trial.run, drives)
    if unseen <= trajectory.t[-1]:
        step = drives.shortest / (NODES_OF_EVENT * node_distance(trial.run.scheme, drives))
        return (
            f"from t = {unseen:.4g} on no error is certified: {' and '.join(drives.names)} of the system changes and "
            f"changes back within {drives.shortest:.2g}, which steps of {macro_dt:.4g} see too seldom or not at all; "
            f"take macro_dt = {step:.2g} or less, or accuracy="
        )
    t, energy = float(error.certified_until), np.asarray(trajectory.energy)
    change = np.abs(energy - energy[0]).max()
    kept = f" The energy has changed by at most {change:.1e}." if trajectory.keeps_energy else ""
    if _is_chaotic(error, trial):
        return (
            f"the motion is chaotic, small errors have grown {float(error.growth):.0f} times in the second half of the "
            f"time until t = {t:.4g}: from there on an error of positions means nothing.{kept}"
        )
    reasons = [f" {concern}" for concern in trial.concerns if isinstance(concern, SingularCoordinatesWarning)]
    advice = "".join(reasons) or " Take smaller steps, or a scheme of higher order."
    return (
        f"from t = {t:.4g} on positions are wrong by more than {LARGEST_CERTIFIED:.0%} of the extent of the motion, "
        f"and no error is certified.{advice}{kept}"
    )
