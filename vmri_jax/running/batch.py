"""Batches of runs: a lane for each start, step size or parameter set of one system; lanes do not influence each other.

Every array of a batch has the lanes as its first axis. An array that all lanes share is a view without copies, see
`shared`: compiled programs get it once.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.custom_batching import sequential_vmap
from jax.sharding import PartitionSpec

from vmri_jax.kernels import LANES_IN_TURN
from vmri_jax.mechanics.arrays import options_of_runs, whole_number
from vmri_jax.mechanics.checks import check_params
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.slots import check_computed, leaves_by_name
from vmri_jax.mechanics.state import Movable, State, initial_state, opened, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import check_step_size, refuse_tracers
from vmri_jax.running.engine import FALLING_BACK, Engine
from vmri_jax.running.origin import is_repeated
from vmri_jax.running.progress import Working
from vmri_jax.running.saved import Saved, check_memory
from vmri_jax.running.simulation import STEPPING, Simulation, simulation
from vmri_jax.schemes.composition import SchemeLike

NUMBERS_PER_CHUNK = 4096
"""Positions at all nodes of a macro step, summed over the lanes of a chunk: 32 kB of float64, the first-level cache of
a core. Chunks with more of them wait for slower memory."""
FEWEST_LANES = 64
"""Fewest lanes of a chunk, even where they exceed `NUMBERS_PER_CHUNK`: with fewer lanes the fixed cost of an operation
outweighs the cache."""
FEWEST_IN_TURN = 16
"""Positions of a lane at all nodes of a micro step from which lanes with constraints are computed one after the other
on a CPU, and compile in half of the time. Vectors over the lanes are faster below: TSP, with 9 coordinates, takes 0.75
of the time; above they are slower, since all lanes wait for the lane with the most passes: SAM, with 18, takes 1.3
times, a satellite of rigid bodies 1.9 times the time."""
MOST_LANES = 1024
"""Most lanes of a chunk; with more, the last chunk of a batch may be mostly padding."""


def computed(runs: Simulation, width: int, devices: int) -> Saved:
    """Runs whose arrays have an axis of lanes, `width` of them side by side, on CPU devices; lanes that are not solved
    are computed again by the fallback."""
    run, lanes = lane(runs, 0), len(runs.macro_dt)
    with Working(f"simulate_batch, {lanes} lanes", running=STEPPING):
        done = _in_chunks(run, runs.leaves, np.arange(lanes), width, devices)
    failed = np.flatnonzero(run.unsolved(done))
    if failed.size:
        # Failed lanes are padded to a power of two with copies of the last one, so that few programs serve all numbers
        # of failures.
        padded = failed[np.minimum(np.arange(2 ** int(failed.size - 1).bit_length()), failed.size - 1)]
        with Working(f"simulate_batch, {failed.size} of {lanes} lanes: {FALLING_BACK}"):
            again = _in_chunks(run.exact, runs.leaves, padded, width, devices)
        for old, new in zip(*map(jax.tree.leaves, (done, again)), strict=True):
            old[failed] = new[: failed.size]
    return done


def lane(runs: Simulation, i: int) -> Simulation:
    """The run of a lane."""
    return jax.tree.map(lambda a: a[i], runs)


def _in_chunks(run: Simulation, leaves: list, lanes: np.ndarray, width: int, devices: int) -> Saved:
    """Some lanes of runs shaped like `run`, `width` at a time; the last chunk is padded with copies of its last lane,
    so that one program computes all chunks."""
    width, chunks = min(width, -(-len(lanes) // devices) * devices), []
    program = _of_lanes(run.engine, tuple(not is_repeated(a) for a in leaves), devices, are_in_turn(run))
    for start in range(0, len(lanes), width):
        chosen = lanes[np.minimum(np.arange(start, start + width), len(lanes) - 1)]
        chunks.append(program([a[0] if is_repeated(a) else a[chosen] for a in leaves], run.save_every))
    rows, status = jax.tree.map(lambda *parts: np.concatenate(parts)[: len(lanes)], *chunks)
    return Saved(run.columns.split(rows[:, : run.num_saves + 1]), *status.T.copy()).marked(run)


def batch(
    moving: Movable,
    scheme: SchemeLike,
    states: State | None,
    macro_dt,
    params,
    solver,
    chunk,
    devices: int,
    **steps: Any,
) -> tuple[Simulation, Callable[[Simulation], Saved]]:
    """The runs with these arguments of `simulate_batch`, and the function that computes them; bad arguments raise."""
    refuse_tracers("simulate_batch", (states, macro_dt, params), ", or take jax.vmap of simulate")
    if not 1 <= devices <= jax.device_count():
        advice = f"call vm.configure(devices={devices}) before JAX starts"
        raise Refused(f"simulate_batch: devices is {devices}, but JAX has {jax.device_count()}; {advice}.")
    if chunk is not None:
        whole_number("simulate_batch: chunk", chunk, otherwise=", or None")
    problem: Any = opened(moving)
    system, start = start_of("simulate_batch", problem, states)
    check_step_size(macro_dt, "simulate_batch", ndim=None)
    params, start, macro_dt = _with_lanes(system.params, params, start, macro_dt)
    if steps["t_end"] is not None and any(np.ptp(array) > 0 for array in (start.t, macro_dt)):
        raise Refused("simulate_batch: t_end with steps or start times that differ; give num_steps instead.")
    differs = not all(map(is_repeated, jax.tree.leaves(params)))
    if states is None and differs and not (system.has_constant_mass and not system.is_constrained):
        # momenta M v, and their projection onto constraints, depend on parameters
        fixed = tuple(getattr(problem, name) for name in ("t", "q_s", "q_f", "v_s", "v_f"))
        start = consistent_states(system, params, fixed, problem.project, starts_differ=False)
    start = State(*map(np.asarray, vars(start).values()))
    first, lanes = jax.tree.map(lambda a: a[0], start), len(macro_dt)
    run = simulation(problem, scheme, first, solver, macro_dt[0], **steps)
    run.save.without_bar("simulate_batch")
    run.check("simulate_batch: the positions of the first state", constraints=not differs)
    check_memory("simulate_batch", run, lanes)
    width = (lanes_at_once(run) if chunk is None else chunk) * devices
    runs = jax.tree.map(lambda a: shared(a, lanes), run)
    runs = replace(runs, macro_dt=macro_dt, state=start, system=runs.system.with_params(params))
    return runs, partial(computed, width=width, devices=devices)


def shared(value, lanes: int) -> np.ndarray:
    """(lanes, ...) view of a value that all lanes share, see `is_repeated`."""
    return np.broadcast_to(np.asarray(value), (lanes, *np.shape(value)))


@eqx.filter_jit
def consistent_states(system: System, params, start: tuple, project: bool, starts_differ: bool = True) -> State:
    """Consistent states of all lanes, from parameters, None for those of the system, and starts
    (t, q_s, q_f, v_s, v_f), which have an axis of lanes if they differ."""

    def of_lane(lane_params, lane_start):
        t, q_s, q_f, v_s, v_f = lane_start
        lane_system = system if lane_params is None else system.replace(params=lane_params)
        return initial_state(lane_system, q_s, q_f, v_s, v_f, t, project=project)

    return jax.vmap(of_lane, (None if params is None else 0, 0 if starts_differ else None))(params, start)


def _named(values, known: Collection[str], path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Name and value of each parameter in a part of the parameters, nested or with dots in its names."""
    name = ".".join(path)
    if name in known:
        yield name, np.asarray(values)
        return
    entries, _ = jax.tree_util.tree_flatten_with_path(values, is_leaf=lambda node: node is not values)
    if entries[:1] == [((), values)] or (name and not any(other.startswith(f"{name}.") for other in known)):
        raise Refused(f"simulate_batch: params: {unknown('parameter', name, known)}")
    for (key,), entry in entries:
        yield from _named(entry, known, (*path, jax.tree_util.keystr((key,), simple=True)))


def _with_lanes(all_params, params, start: State, macro_dt) -> tuple[Any, State, np.ndarray]:
    """Parameters (of the system, some replaced by the user's), starts and macro steps, the lanes as their first axis.

    Refuses arrays of other shapes, axes of different lengths, and arguments without any axis of lanes.
    """
    values, structure = leaves_by_name(all_params)
    new = {} if params is None else dict(_named(params, values))
    check_params(new)
    arrays = {f"params[{name!r}]": (new.get(name, value), np.shape(value)) for name, value in values.items()}
    for name, value in vars(start).items():
        arrays[f"states.{name}"] = value, np.shape(value)[-1:] if name != "t" else ()
    arrays["macro_dt"] = np.asarray(macro_dt, dtype=float), ()
    lengths = {name: len(value) for name, (value, shape) in arrays.items() if np.ndim(value) > len(shape)}
    for name, (value, shape) in arrays.items():
        if np.shape(value)[name in lengths :] != shape:
            with_lanes = f"give {shape} for all lanes, or an axis of lanes in front of it"
            raise Refused(f"simulate_batch: {name} has shape {np.shape(value)}; {with_lanes}.")
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        listed = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        listed = listed or "no argument has an axis of lanes"
        raise Refused(f"simulate_batch: {listed}; give params, states or steps with one value for each lane.")
    (lanes,) = set(lengths.values())
    whole = [np.asarray(a) if name in lengths else shared(a, lanes) for name, (a, _) in arrays.items()]
    *of_params, t, q_s, q_f, p_s, p_f, steps = whole
    if all(map(is_repeated, whole)):  # the user gave such views, and `jax.vmap` wants an axis
        t = np.array(t)
    new_params = jax.tree.unflatten(structure, of_params)
    check_computed(all_params, new_params)
    return new_params, State(t, q_s, q_f, p_s, p_f), steps


def lanes_at_once(run: Simulation) -> int:
    """Lanes of a chunk where the user gives none: the largest power of two that fits into the cache, between the two
    limits."""
    numbers_per_lane = run.scheme.num_micro * positions_of_micro_step(run)
    return 2 ** int(np.log2(np.clip(NUMBERS_PER_CHUNK / numbers_per_lane, FEWEST_LANES, MOST_LANES)))


def positions_of_micro_step(run: Simulation) -> int:
    """Positions at all nodes of a micro step."""
    return run.scheme.degree * (run.state.q_s.size + run.state.q_f.size)


def are_in_turn(run: Simulation) -> bool:
    """Whether lanes are computed one after the other, by the measurements at `FEWEST_IN_TURN`."""
    is_large = run.system.is_constrained and positions_of_micro_step(run) >= FEWEST_IN_TURN
    return LANES_IN_TURN and jax.default_backend() == "cpu" and (is_large or not run.system.has_constant_mass)


@lru_cache(maxsize=32)
def _of_lanes(engine: Engine, differs: tuple[bool, ...], devices: int, in_turn: bool):
    """``program(leaves, save_every)``: `Engine.steps` for each lane, one after the other or all at once; `differs` says
    which of the leaves have an axis of lanes."""
    steps = sequential_vmap(engine.steps) if in_turn else engine.steps
    program = jax.vmap(steps, ([0 if differ else None for differ in differs], None))
    if devices > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()[:devices]), ("lanes",))
        spread = PartitionSpec("lanes")
        in_specs = [spread if differ else PartitionSpec() for differ in differs], PartitionSpec()
        program = jax.shard_map(program, mesh=mesh, in_specs=in_specs, out_specs=spread, check_vma=False)
    return jax.jit(program, compiler_options=options_of_runs())
