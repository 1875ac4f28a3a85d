"""`simulate_batch`: runs side by side, with an estimate of their errors on request."""

import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import jax
import numpy as np

from vmri_jax.accuracy.companions import Compared, UncertifiedWarning, finer, run_error
from vmri_jax.mechanics.checks import check_flags
from vmri_jax.mechanics.driving import Events, driven, events
from vmri_jax.mechanics.state import Movable, State
from vmri_jax.running.arguments import Save, Steps
from vmri_jax.running.batch import Batch, batch, shared
from vmri_jax.running.origin import is_repeated
from vmri_jax.running.progress import Working
from vmri_jax.running.run_error import RunError
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver


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
    """Simulate a lane for each set of parameters, start or step size, each as `simulate` would; arrays returned have a leading axis of lanes.

        batch = vm.simulate_batch(car, scheme, params={"omega": omegas}, macro_dt=0.01, t_end=10.0)  # a lane for each omega
        print(batch.lane(3))

    Whatever has no axis of lanes holds for all lanes. Lanes are computed side by side (`jax.vmap`), in chunks that fit into the cache. Unlike
    `simulate`, a failed step never raises: its
    lane is NaN after the step and has its status in ``.result`` and ``.failed_at``; other lanes do not change. A
    `FailedLanesWarning` says how many lanes failed. A lane fails in its first step if its start violates the constraints of its parameters, in
    positions or velocities. Lanes that the first matrix of "auto" does not solve are run again with exact
    matrices, whose program is compiled at the first such lane.

    Args:
        system: a `Problem` or a scene; or a `System`, with states.
        scheme: a scheme or composition.
        states: a `State` whose arrays have an axis of lanes, e.g. ``jax.vmap(make)(q_s, ...)`` or
            ``jax.tree.map(lambda *a: jnp.stack(a), *list_of_states)``; None for positions and velocities of the problem in all lanes.
        macro_dt: macro step H, a number or one per lane.
        num_steps, t_end, save, solver: as in `simulate`; t_end with one step size and one time of the start for all.
        params: some or all of ``system.params``, by name: ``{"springs": {"stiffness": k}}``, or "springs.stiffness". An array of the shape of the
            parameter holds for all lanes; one with an axis of lanes in front of this shape has a value for each lane.
        chunk: lanes that are computed side by side; chosen from the size of the problem if None.
        devices: CPU devices over which chunks are spread, see `vmri_jax.configure`.
        warn: give warnings about lanes; False for a program that looks at the statuses itself.
        error: estimate the error of the positions of each lane as `simulate` does, ``run.error``, a `RunError` whose arrays have the axis of lanes;
            without slow and fast share. It takes runs with half the macro step, by the same program, and further ones in driven systems.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed.
    """
    check_flags(warn=warn, error=error)
    steps = Steps(macro_dt, num_steps, t_end, save)
    with Working("simulate_batch: the starts"):
        lanes = batch(system, scheme, states, steps, params, solver, chunk, devices)
    saved = lanes()
    trajectory = plain = saved.trajectory(lanes.runs)
    if error:
        trajectory = replace(plain, error=_errors(lanes, plain))
    lanes.runs.tell_of_start("simulate_batch", plain.states)
    lanes.runs.warn("simulate_batch", saved.table, plain.states.t)
    for kind, message in _about_lanes(trajectory) if warn else ():
        warnings.warn(f"simulate_batch: {message}", kind, stacklevel=2)
    return trajectory


def _errors(lanes: Batch, plain: Trajectory) -> RunError:
    """The errors of all lanes, from batches of companions; `plain` are the runs, with arrays of NumPy."""

    @cache
    def companions(parts: int, whole: int = 1) -> Trajectory:
        runs = finer(lanes.runs, parts, whole)
        if is_repeated(lanes.runs.macro_dt):  # a step of all lanes stays one array
            runs = replace(runs, macro_dt=shared(runs.macro_dt[0], len(lanes)))
        return replace(lanes, runs=runs)().trajectory(runs)

    def error(i: int) -> RunError:
        run, coarse = lanes.lane(i), plain.lane(i)
        drives = events(run.system, run.state, float(coarse.t[-1])) if is_driven else Events()
        return run_error(Compared.of(run, coarse, drives, lambda *counts: companions(*counts).lane(i)))

    is_driven = driven(lanes.run.system, lanes.run.state)
    return jax.tree.map(lambda *arrays: np.stack(arrays), *map(error, range(len(plain.t))))


def _about_lanes(trajectory: Trajectory) -> Iterator[tuple[type[UserWarning], str]]:
    """Warnings about the lanes that failed, and about those that did not and whose error is not certified: kind, and number with the first lane."""
    failed_at = np.asarray(trajectory.failed_at)
    failed = np.flatnonzero(failed_at >= 0)
    if failed.size:
        first = int(failed[0])
        result = Result(int(trajectory.result[first]))
        yield (
            FailedLanesWarning,
            (
                f"{failed.size} of {failed_at.size} lanes failed and are NaN from there on; .result and .failed_at say "
                f"which. The first is lane {first}, at macro step {failed_at[first]} ({result.name}): {result.message}"
            ),
        )
    error = trajectory.error
    lanes = np.flatnonzero((failed_at < 0) & ~np.asarray(error is None or error.is_certified))
    if lanes.size:
        yield (
            UncertifiedWarning,
            (
                f"the error of {lanes.size} of {failed_at.size} lanes is not certified over the whole run, as run.error.largest says; the first is lane "
                f"{lanes[0]}, certified until t = {error.certified_until[lanes[0]]:.4g}. Take smaller steps, or a scheme of higher order."
            ),
        )
