"""`simulate`: a run with given steps, or with steps chosen for an accuracy, with an estimate of its error on request;
and `simulate_batch`: runs side by side."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import numpy as np

from vmri_jax.accuracy.companions import (
    Trial,
    UncertifiedWarning,
    check_function_of_run,
    companion,
    finer,
    run_error,
    told_error,
)
from vmri_jax.accuracy.families import for_system, of_scheme, two_families
from vmri_jax.accuracy.search import MOST_COORDINATES, Search
from vmri_jax.mechanics.arrays import is_known
from vmri_jax.mechanics.checks import check_flags, check_system, check_type
from vmri_jax.mechanics.driving import Events, driven, events
from vmri_jax.mechanics.state import Movable, State
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.arguments import Save, refuse_tracers
from vmri_jax.running.batch import batch, lane, shared
from vmri_jax.running.origin import is_repeated
from vmri_jax.running.progress import Working, progress_to
from vmri_jax.running.run_error import RunError
from vmri_jax.running.saved import Saved, check_memory
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver


class AccuracyNotReached(UserWarning):
    """The error of a run exceeds its accuracy, or is not certified."""


def simulate(
    system: Movable,
    scheme: SchemeLike | None = None,
    state: State | None = None,
    *,
    macro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save: int | Save = 1,
    solver: Solver | None = None,
    accuracy: float | None = None,
    error: bool | str | Callable[[Trajectory], Any] = False,
) -> Trajectory:
    """Simulate `num_steps` macro steps, or up to `t_end`, and save every `save`-th macro node.

        run = vm.simulate(problem, vm.fully_implicit(10), macro_dt=0.01, t_end=10.0)
        run = vm.simulate(problem, accuracy=1e-5, t_end=10.0)

    With an accuracy, trial runs choose the steps, and the scheme if none is given, see `vmri_jax.accuracy.search`;
    ``run.settings`` has the choice, ``run.error`` the error of the run. Resonant steps are avoided in systems of up to
    60 coordinates.

    Outside of transformations, `simulate` compiles once per structure of system and scheme: macro steps, parameters,
    rule weights, starts, numbers of steps and of saved nodes vary without another compilation; num_micro and
    ``Save.micro`` are part of the structure. It works under ``jax.vmap`` over state, params and macro_dt, and under
    ``jax.grad`` and ``jax.jacfwd``, where the numbers of steps and of saved nodes are part of the structure, too. There
    a failed step does not raise: the status is in the trajectory. Names work inside of the transformed function:
    ``run.position("load")``. Under ``jax.vmap`` the matrix "auto" computes its fallback for every lane: take
    `simulate_batch`, or ``solver=vm.plan(system, scheme, state).first``.

    A run whose system keeps its energy warns with `LostEnergyWarning` if the energy changes by more than half of the
    largest kinetic energy, and a run across a pole of its coordinates with `SingularCoordinatesWarning`;
    ``run.concerns()`` has these sentences, also after a run in a transformation.

    Args:
        system: a `Problem` or a scene; or a `System`, with a state.
        scheme: a scheme or composition; None, with an accuracy, to have it chosen.
        state: start, from `initial_state` or an earlier run; None for the start of the problem.
        macro_dt: macro step H, num_micro times the micro step.
        num_steps, t_end: number of macro steps, or the time of the end; exactly one of them.
        save: every how many macro steps a node is saved, which divides num_steps; or a `Save`, for saved intervals by
            number, micro nodes, derivatives in little memory, and a bar. With an accuracy only the number of saved
            intervals is the user's: one per macro step, at most 1000, unless ``save=vm.Save(number=200)`` says how
            many, for a smooth curve.
        solver: for implicit equations; None for ``Solver()``.
        accuracy: largest error of a position at a saved node, in the unit of the positions; replaces the step size, and
            needs `t_end`.
        error: True to estimate the error of the positions, ``run.error``, a `RunError`, by a run of the same program
            with half the macro step; or a function of a run (without micro nodes) whose error is estimated, too,
            ``run.error.of``. It returns numbers, such as ``lambda run: run.position("load")``. "shares" for the slow
            and the fast share of the error as well, by a run with twice the micro steps, which is another program. A
            failed run has no error.

    Returns:
        The `Trajectory`, with ``num_steps / save + 1`` saved nodes. Times are ``t_0 + k macro_dt``, computed from
        the step number k, never accumulated.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed; an accuracy larger than the motion, after the
            first trial runs.
        SimulationError: a step failed; its `trajectory` is NaN from the failure on.
        Interrupted: Ctrl-C while a bar is shown; it carries the trajectory computed so far.
    """
    of = error if callable(error) else None
    if not (of or isinstance(error, bool) or error == "shares"):
        raise Refused(f"simulate: error is {error!r}; it must be True or False, 'shares', or a function of a run.")
    if accuracy is not None:
        t_end, saved = _end(macro_dt, num_steps, t_end, save), Save.of(save)
        with progress_to("simulate", saved.progress) as tell:
            how = {"state": state, "solver": solver, "num_saves": saved.number, "of": of, "progress": tell}
            search = Search(system, t_end, **how)
            best = _with_accuracy(search, scheme, accuracy)
        trajectory = best.run.finished("simulate", best.saved)
        origin = replace(trajectory.origin, settings=search.settings(best))
        return replace(trajectory, origin=origin, error=told_error(best, of, error == "shares"))
    if scheme is None:
        raise Refused("simulate: scheme is None without an accuracy; give one of them, e.g. accuracy=1e-5.")
    run = simulation(system, scheme, state, solver, macro_dt, num_steps, t_end, save)
    if not is_known(run.leaves):
        if error:
            refuse_tracers("simulate: an error", run.leaves)
        check_system(run.system, run.state.q_s, run.state.q_f)
        return run.traced()
    if state is not None:  # the start of a problem is checked when it is made
        run.check()
    check_memory("simulate", run)
    check_function_of_run(of, run)
    saved = run.in_pieces()
    trajectory = run.finished("simulate", saved)
    if not error:
        return trajectory
    drives = events(run.system, run.state, float(trajectory.t[-1]))
    trial = Trial.of(run, saved, drives, partial(companion, run))
    return replace(trajectory, error=told_error(trial, of, error == "shares"))


def _with_accuracy(search: Search, scheme: SchemeLike | None, accuracy: float) -> Trial:
    """The trial whose largest estimated error of a position is at most `accuracy`, with a scheme of the user or with
    one of the usual menu."""
    check_type("simulate: scheme", scheme, SchemeLike | None, "a Scheme, e.g. fully_implicit(num_micro=10), or None")
    search.check(accuracy)
    if scheme is None:
        size = search.start.q_s.size + search.start.q_f.size
        menu = two_families(search.system, size, search.digits(accuracy), MOST_COORDINATES)
        menu = for_system(menu, search.system, search.has_two_rates)
    else:
        menu = [of_scheme(scheme)]
    (best,) = search.cheapest(menu, accuracy)
    search.warn_of_events("simulate", best.run.scheme)
    if not best.error <= accuracy:
        uncertified = "no error is certified over its length"
        reached_error = f"its error is {best.error:.1e}" if np.isfinite(best.error) else uncertified
        warn_user(
            f"simulate: accuracy {accuracy:g} is not reached with {best.run.num_steps} macro steps, {reached_error}; "
            "give a shorter t_end, a larger accuracy, or another scheme.",
            AccuracyNotReached,
        )
    return best


def _end(macro_dt, num_steps, t_end, save) -> float:
    """`t_end` of a run with an accuracy; refuses arguments of step size and saving, which the accuracy determines."""
    refused = [name for name, value in (("macro_dt", macro_dt), ("num_steps", num_steps)) if value is not None]
    saved = Save.of(save)
    if replace(saved, every=None if saved.every == 1 else saved.every, number=None, progress=False) != Save():
        refused.append(f"save={save!r}")
    if refused:
        chosen = "an accuracy, which chooses steps and saved nodes, but for Save(number=)"
        raise Refused(f"simulate: got {' and '.join(refused)} with {chosen}; leave them out, or the accuracy.")
    if t_end is None:
        raise Refused("simulate: an accuracy needs t_end, the time until which it is to be kept.")
    return t_end


class FailedLanesWarning(UserWarning):
    """Lanes of a batch failed: they are NaN after the failing step; all other lanes are right."""


def simulate_batch(
    system: Movable,
    scheme: SchemeLike,
    states: State | None = None,
    *,
    macro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save: int | Save = 1,
    params=None,
    solver: Solver | None = None,
    chunk: int | None = None,
    devices: int = 1,
    warn: bool = True,
    error: bool = False,
) -> Trajectory:
    """Simulate a lane for each set of parameters, start or step size, each as `simulate` would; arrays returned have a
    leading axis of lanes.

        batch = vm.simulate_batch(car, scheme, params={"omega": omegas}, macro_dt=0.01, t_end=10.0)
        print(batch.lane(3))  # of omegas[3]

    Whatever has no axis of lanes holds for all lanes. Lanes of small systems are computed side by side (`jax.vmap`), in
    chunks that fit into the cache, lanes of larger ones one after the other (`vmri_jax.running.batch`). Unlike
    `simulate`, a failed step never raises: its lane is NaN after the step and has its status in ``.result`` and
    ``.failed_at``; other lanes do not change. A `FailedLanesWarning` says how many lanes failed. A lane
    fails in its first step if its start violates the constraints of its parameters, in positions or velocities. Lanes
    that the first matrix of "auto" does not solve are run again with exact matrices, whose program is compiled at the
    first such lane.

    Args:
        system: a `Problem` or a scene; or a `System`, with states.
        scheme: a scheme or composition.
        states: a `State` whose arrays have an axis of lanes, e.g. ``jax.vmap(make)(q_s, ...)`` or
            ``jax.tree.map(lambda *a: jnp.stack(a), *list_of_states)``; None for positions and velocities of the problem
            in all lanes.
        macro_dt: macro step H, a number or one per lane.
        num_steps, t_end, save, solver: as in `simulate`; t_end with one step size and one time of the start for all.
        params: some or all of ``system.params``, by name: ``{"springs": {"stiffness": k}}``, or "springs.stiffness". An
            array of the shape of the parameter holds for all lanes; one with an axis of lanes in front of this shape
            has a value for each lane.
        chunk: lanes that are computed side by side; chosen from the size of the problem if None.
        devices: CPU devices over which chunks are spread, see `vmri_jax.configure`.
        warn: give warnings about lanes; False for a program that looks at the statuses itself.
        error: estimate the error of the positions of each lane as `simulate` does, ``run.error``, a `RunError` whose
            arrays have the axis of lanes; without slow and fast share. It takes runs with half the macro step, by the
            same program, and further ones in driven systems.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed.
    """
    check_flags(warn=warn, error=error)
    steps = {"num_steps": num_steps, "t_end": t_end, "save": save}
    with Working("simulate_batch: the starts"):
        runs, computed = batch(system, scheme, states, macro_dt, params, solver, chunk, devices, **steps)
    saved = computed(runs)
    trajectory = runs.finished("simulate_batch", saved, throw=False)
    if error:
        trajectory = replace(trajectory, error=_errors(runs, computed, saved))
    for warning in _about_lanes(trajectory) if warn else ():
        warn_user(warning)
    return trajectory


def _errors(runs: Simulation, computed: Callable[[Simulation], Saved], saved: Saved) -> RunError:
    """The errors of all lanes, from batches of companions."""

    @cache
    def companions(parts: int, whole: int = 1) -> Trajectory:
        divided = finer(runs, parts, whole)
        if is_repeated(runs.macro_dt):  # a step of all lanes stays one array
            divided = replace(divided, macro_dt=shared(divided.macro_dt[0], len(runs.macro_dt)))
        return computed(divided).trajectory(divided)

    def error(i: int) -> RunError:
        run, of_lane = lane(runs, i), jax.tree.map(lambda a: a[i], saved)
        t_end = float(run.state.t + run.num_steps * run.macro_dt)
        drives = events(run.system, run.state, t_end) if is_driven else Events()
        return run_error(Trial.of(run, of_lane, drives, lambda *counts: companions(*counts).lane(i)))

    is_driven = driven(lane(runs, 0).system, lane(runs, 0).state)
    return jax.tree.map(lambda *arrays: np.stack(arrays), *map(error, range(len(runs.macro_dt))))


def _about_lanes(trajectory: Trajectory) -> Iterator[UserWarning]:
    """Warnings about the lanes that failed, and about those that did not and whose error is not certified, with their
    number and the first of them."""
    failed_at = np.asarray(trajectory.failed_at)
    failed = np.flatnonzero(failed_at >= 0)
    if failed.size:
        first = int(failed[0])
        result = Result(int(trajectory.result[first]))
        yield FailedLanesWarning(
            f"simulate_batch: {failed.size} of {failed_at.size} lanes failed and are NaN from there on; .result and "
            f".failed_at say which. The first is lane {first}, at macro step {failed_at[first]} ({result.name}): "
            f"{result.message}"
        )
    error = trajectory.error
    lanes = np.flatnonzero((failed_at < 0) & ~np.asarray(error is None or error.is_certified))
    if lanes.size:
        yield UncertifiedWarning(
            f"simulate_batch: the error of {lanes.size} of {failed_at.size} lanes is not certified over the whole run, "
            f"as run.error.largest says; the first is lane {lanes[0]}, certified until t = "
            f"{error.certified_until[lanes[0]]:.4g}. Take smaller steps, or a scheme of higher order."
        )
