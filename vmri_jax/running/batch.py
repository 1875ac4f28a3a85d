"""Batches of runs: a lane for each start, step size or parameter set of one system; lanes do not influence each other."""

import warnings
from functools import lru_cache

import jax
import numpy as np
from jax.sharding import PartitionSpec

from vmri_jax.mechanics.arrays import is_concrete, options_of_runs, real_array, whole_number
from vmri_jax.mechanics.checks import check_params
from vmri_jax.mechanics.state import Movable, State, opened, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.arguments import Steps
from vmri_jax.running.engine import Arrays, Engine
from vmri_jax.running.memory import check_memory
from vmri_jax.running.progress import Working
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.trajectory import Run, Trajectory, trajectory_of, with_origin
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solvers import Newton

NUMBERS_PER_CHUNK = 4096
"""Positions at all nodes of a macro step, summed over the lanes of a chunk: 32 kB of float64, the first-level cache of a core. Chunks with
more of them wait for slower memory."""
FEWEST_LANES = 64
"""Fewest lanes of a chunk, even where they exceed `NUMBERS_PER_CHUNK`: with fewer lanes the fixed cost of an operation outweighs the cache."""
MOST_LANES = 1024
"""Most lanes of a chunk; with more, the last chunk of a batch may be mostly padding."""


class FailedLanesWarning(UserWarning):
    """Lanes of a batch failed: they are NaN after the failing step; all other lanes are right."""


def simulate_batch(
    system: Movable,
    scheme: Scheme | Composition,
    states: State,
    *,
    macro_dt=None,
    micro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save_every: int = 1,
    save_micro: bool = False,
    params=None,
    solver: Newton | None = None,
    chunk: int | None = None,
    devices: int = 1,
    warn: bool = True,
) -> Trajectory:
    """Simulate a batch of states, each lane as `simulate` would; the arrays returned have a leading batch axis.

    Lanes are computed side by side (`jax.vmap`), in chunks that fit into the cache. Unlike `simulate`, a failed step never raises: its
    lane is NaN after the step and has its status in ``.result`` and ``.failed_at``; other lanes do not change. A
    `FailedLanesWarning` says how many lanes failed. Lanes that the first solver of `Auto` does not solve are run again with `Arrowhead`,
    whose program is compiled at the first such lane.

    Args:
        system: a `System`, `Problem` or scene.
        scheme: a scheme or composition.
        states: a `State` whose arrays have a leading batch axis, e.g. ``jax.vmap(make)(q_s, ...)`` or
            ``jax.tree.map(lambda *a: jnp.stack(a), *list_of_states)``.
        macro_dt, micro_dt: step size, a number or one per lane; exactly one of them.
        num_steps, t_end, save_every, save_micro, solver: as in `simulate`; t_end with one step size for all.
        params: a pytree like ``system.params`` with a leading batch axis, if parameters differ between lanes.
        chunk: lanes that are computed side by side; chosen from the size of the problem if None.
        devices: CPU devices over which chunks are spread, see `vmri_jax.configure`.
        warn: give a `FailedLanesWarning` where lanes failed; False for a program that looks at the statuses itself.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed.
    """
    if not is_concrete((states, macro_dt, micro_dt, params)):
        raise ValueError(
            "simulate_batch: arguments are tracers; call it outside of jax.jit, vmap and grad, or take jax.vmap of simulate."
        )
    lanes = _check_states(states)
    first = jax.tree.map(lambda a: np.asarray(a)[0], states)
    problem = opened(system)
    system, _ = start_of("simulate_batch", problem, first)
    if params is not None:
        _check_params(system, params, lanes)
    if t_end is not None and any(np.ndim(step) for step in (macro_dt, micro_dt) if step is not None):
        raise ValueError(
            "simulate_batch: t_end with a step size for each lane; give num_steps, the same for all lanes."
        )
    steps = Steps(_first(macro_dt), _first(micro_dt), num_steps, t_end, save_every, save_micro)
    run = simulation(problem, scheme, first, solver, steps)
    name, dt = ("macro_dt", macro_dt) if micro_dt is None else ("micro_dt", micro_dt)
    dt = np.asarray(real_array(f"simulate_batch: {name}", dt))
    if dt.shape not in ((), (lanes,)):
        raise ValueError(
            f"simulate_batch: {name} has shape {dt.shape}; give a number, or one for each of the {lanes} lanes."
        )
    if not (np.all(np.isfinite(dt)) and np.all(dt > 0)):
        raise ValueError(f"simulate_batch: every {name} must be a positive number, got {dt}.")
    _check_devices(devices, chunk)
    run.check("simulate_batch: the positions of the first state", constraints=params is None)
    check_memory("simulate_batch", run.state, scheme.num_micro, run.num_saves, save_micro, lanes)
    width = (lanes_at_once(run) if chunk is None else chunk) * devices
    batch = {
        "params": None if params is None else [np.asarray(leaf) for leaf in jax.tree.leaves(params)],
        "state": tuple(np.asarray(a, dtype=float) for a in vars(states).values()),
        "macro_dt": None if dt.ndim == 0 else dt * (scheme.num_micro if micro_dt is not None else 1),
    }
    with Working("simulate_batch: compiled if it is the first of its kind, then stepped"):
        done, table = _in_chunks(run, run.engine, batch, width, devices)
    unsolved = (done.failed_at >= 0) & (done.result != Result.NOT_IMPLIED)
    failed = np.flatnonzero(unsolved)
    if failed.size and run.plan.has_fallback:
        # Failed lanes are padded to a power of two with copies of the last one, so that few programs serve all numbers of failures.
        padded_size = 2 ** int(failed.size - 1).bit_length()
        padded = failed[np.minimum(np.arange(padded_size), failed.size - 1)]
        with Working(
            f"simulate_batch: {failed.size} of {lanes} lanes, which the first solver does not solve, with solvers.Arrowhead"
        ):
            again = _in_chunks(run, run.exact_engine, jax.tree.map(lambda a: a[padded], batch), width, devices)
        for old, new in zip(jax.tree.leaves((done, table)), jax.tree.leaves(again), strict=True):
            old[failed] = new[: failed.size]
    if warn:
        _warn_of_failures(done)
    macro_steps = run.macro_dt if batch["macro_dt"] is None else batch["macro_dt"]
    run.warn("simulate_batch", table, done.states.t, macro_steps)
    return with_origin(jax.device_put(trajectory_of(done, table)), run.origin.repeated((lanes,), params))


def _warn_of_failures(run: Run) -> None:
    """Warn about failed lanes, with the failing step and the status of the first one."""
    failed_at = run.failed_at
    failed = np.flatnonzero(failed_at >= 0)
    if failed.size:
        first = int(failed[0])
        result = Result(int(run.result[first]))
        warnings.warn(
            f"simulate_batch: {failed.size} of {failed_at.size} lanes failed and are NaN from there on; .result and .failed_at say "
            f"which. The first is lane {first}, at macro step {failed_at[first]} ({result.name}): {result.message}",
            FailedLanesWarning,
            stacklevel=3,
        )


def _first(dt):
    """The step size of the first lane."""
    if dt is None or not np.size(real_array("simulate_batch: the step size", dt)):
        return dt
    return np.ravel(dt)[0]


def _check_params(system: System, params, lanes: int) -> None:
    """Refuse parameters of another structure than ``system.params``, or without a batch axis."""
    check_params(params)
    expected, structure = jax.tree.structure(system.params), jax.tree.structure(params)
    if expected != structure:
        raise ValueError(
            f"simulate_batch: params is {structure}; give the pytree of system.params, {expected}, with a batch axis."
        )
    wanted = [(lanes, *np.shape(leaf)) for leaf in jax.tree.leaves(system.params)]
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(params)]
    if shapes != wanted:
        raise ValueError(
            f"simulate_batch: the arrays of params have shapes {shapes}; give one per lane of each parameter, {wanted}."
        )


def _check_states(states) -> int:
    """The number of lanes."""
    if not isinstance(states, State):
        raise TypeError(
            f"simulate_batch: states is {type(states).__name__}; give a State whose arrays have a batch axis."
        )
    shapes = {name: np.shape(value) for name, value in vars(states).items()}
    lanes = shapes["q_s"][:1]
    if any(len(s) != (1 if name == "t" else 2) or s[:1] != lanes for name, s in shapes.items()) or lanes == (0,):
        raise ValueError(
            f"simulate_batch: the arrays of states have shapes {shapes}; give t (batch,) and all others (batch, n)."
        )
    return lanes[0]


def _check_devices(devices, chunk) -> None:
    if not 1 <= devices <= jax.device_count():
        raise ValueError(
            f"simulate_batch: devices is {devices}, but JAX has {jax.device_count()}; call vm.configure(devices={devices}) "
            "before JAX starts."
        )
    if chunk is not None:
        whole_number("simulate_batch: chunk", chunk, otherwise=", or None")


def lanes_at_once(run: Simulation) -> int:
    """Lanes of a chunk where the user gives none: the largest power of two that fits into the cache, between the two limits."""
    nodes = run.scheme.num_micro * stage_scheme(run.scheme).degree
    numbers_per_lane = nodes * (run.state.q_s.size + run.state.q_f.size)
    return 2 ** int(np.log2(np.clip(NUMBERS_PER_CHUNK / numbers_per_lane, FEWEST_LANES, MOST_LANES)))


def _in_chunks(run: Simulation, engine: Engine, batch: dict, width: int, devices: int) -> tuple[Run, np.ndarray]:
    """All lanes, as of `Simulation.observed`, `width` at a time; the last chunk is padded with copies of its last lane, so that one program computes all chunks."""
    lanes = len(batch["state"][0])
    width = min(width, -(-lanes // devices) * devices)
    program = _side_by_side(engine, batch["params"] is not None, batch["macro_dt"] is not None, devices)
    pieces = []
    for start in range(0, lanes, width):
        index = np.minimum(np.arange(start, start + width), lanes - 1)
        piece = jax.tree.map(lambda a, index=index: a[index], batch)
        macro_dt = run.macro_dt if piece["macro_dt"] is None else piece["macro_dt"]
        num_params = 0 if piece["params"] is None else len(piece["params"])
        leaves = run.arrays.model  # the parameters come last, see `Arrays`
        shared = leaves[: len(leaves) - num_params]
        pieces.append(program(shared, piece["params"] or [], piece["state"], macro_dt, run.save_every))
    whole = [np.concatenate(parts)[:lanes] for parts in zip(*pieces, strict=True)]
    return run.observed(Run.of(whole), run.arrays.model, params=batch["params"])


@lru_cache(maxsize=32)
def _side_by_side(engine: Engine, varies_params: bool, varies_steps: bool, devices: int):
    """``program(leaves, params, state, macro_dt, save_every)``: a run of `engine` for each lane, with or without parameters and steps of its own."""

    def lane(leaves, params, state, macro_dt, save_every):
        return jax.tree.leaves(engine.run(Arrays(leaves + params, state, macro_dt), save_every))

    has_lanes = (False, varies_params, True, varies_steps, False)
    program = jax.vmap(lane, [0 if has_axis else None for has_axis in has_lanes])
    if devices > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()[:devices]), ("lanes",))
        spread = PartitionSpec("lanes")
        specs = tuple(spread if has_axis else PartitionSpec() for has_axis in has_lanes)
        program = jax.shard_map(program, mesh=mesh, in_specs=specs, out_specs=spread, check_vma=False)
    return jax.jit(program, compiler_options=options_of_runs())
