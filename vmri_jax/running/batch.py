"""Batches of runs: a lane for each start, step size or parameter set of one system; lanes do not influence each other.

Every array of a batch has the lanes as its first axis. An array that all lanes share is a view without copies, see `shared`: compiled programs
get it once.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from vmri_jax.mechanics.arrays import is_concrete, options_of_runs, real_array, whole_number
from vmri_jax.mechanics.checks import check_params
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.state import Movable, State, initial_state, opened, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.arguments import Steps
from vmri_jax.running.engine import Arrays, Engine
from vmri_jax.running.memory import check_memory
from vmri_jax.running.origin import is_repeated
from vmri_jax.running.progress import Working
from vmri_jax.running.simulation import FALLING_BACK, STEPPING, Simulation, simulation
from vmri_jax.running.trajectory import Trajectory, from_arrays, with_origin
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


@dataclass(frozen=True)
class Batch:
    """Runs side by side, with checked arguments.

    Attributes:
        run: the run of the first lane.
        params: (lanes, ...) leaves of the parameters of all lanes.
        state: (lanes, ...) arrays of the starts.
        macro_dt: (lanes,) macro steps.
        width: lanes that are computed side by side.
        devices: CPU devices that share the lanes.
    """

    run: Simulation
    params: list[Any]
    state: tuple[Any, ...]
    macro_dt: Any
    width: int
    devices: int

    def __call__(self) -> Trajectory:
        """The runs; lanes that the first solver of the plan does not solve are computed again by its fallback."""
        run, lanes = self.run, len(self.macro_dt)
        with Working(f"simulate_batch, {lanes} lanes", running=STEPPING):
            trajectory = self._in_chunks(run.engine)
        unsolved = (np.asarray(trajectory.failed_at) >= 0) & (np.asarray(trajectory.result) != Result.NOT_IMPLIED)
        failed = np.flatnonzero(unsolved)
        if failed.size and run.plan.has_fallback:
            # Failed lanes are padded to a power of two with copies of the last one, so that few programs serve all numbers of failures.
            padded_size = 2 ** int(failed.size - 1).bit_length()
            padded = failed[np.minimum(np.arange(padded_size), failed.size - 1)]
            with Working(f"simulate_batch, {failed.size} of {lanes} lanes: {FALLING_BACK}"):
                again = self._taken(padded)._in_chunks(run.exact_engine)
            trajectory = jax.tree.map(lambda a, b: a.at[failed].set(b[: failed.size]), trajectory, again)
        params = jax.tree.unflatten(jax.tree.structure(run.system.params), self.params)
        return with_origin(trajectory, run.origin.repeated((lanes,), params))

    def lane(self, i: int) -> Simulation:
        """The run of a lane."""
        params = jax.tree.unflatten(jax.tree.structure(self.run.system.params), [a[i] for a in self.params])
        state = State(*(a[i] for a in self.state))
        return replace(self.run, system=self.run.system.with_params(params), state=state, macro_dt=self.macro_dt[i])

    def with_steps(self, run: Simulation) -> "Batch":
        """The batch with the steps of another run of its first lane, in the same ratio for all lanes."""
        same = is_repeated(self.macro_dt)
        macro_dt = (
            shared(run.macro_dt, len(self.macro_dt)) if same else self.macro_dt * (run.macro_dt / self.macro_dt[0])
        )
        return replace(self, run=run, macro_dt=macro_dt)

    def _taken(self, index: np.ndarray) -> "Batch":
        """The lanes with these numbers."""

        def taken(a):
            return shared(a[0], len(index)) if is_repeated(a) else a[index]

        return replace(
            self,
            params=[taken(a) for a in self.params],
            state=tuple(map(taken, self.state)),
            macro_dt=taken(self.macro_dt),
        )

    def _in_chunks(self, engine: Engine) -> Trajectory:
        """All lanes, `width` at a time; the last chunk is padded with copies of its last lane, so that one program computes all chunks."""
        lanes = len(self.macro_dt)
        width = min(self.width, -(-lanes // self.devices) * self.devices)
        of_params, of_steps = tuple(not is_repeated(a) for a in self.params), not is_repeated(self.macro_dt)
        of_state = not all(map(is_repeated, self.state)) or not (any(of_params) or of_steps)
        program = _side_by_side(engine, of_params, of_state, of_steps, self.devices)
        leaves = self.run.arrays.model  # the parameters come last, see `Arrays`
        leaves, pieces = leaves[: len(leaves) - len(self.params)], []
        for start in range(0, lanes, width):
            part = self._taken(np.minimum(np.arange(start, start + width), lanes - 1))
            params = [a if has_lanes else a[0] for a, has_lanes in zip(part.params, of_params, strict=True)]
            state = tuple(a if of_state else a[0] for a in part.state)
            macro_dt = part.macro_dt if of_steps else part.macro_dt[0]
            pieces.append(program(leaves, params, state, macro_dt, self.run.save_every))
        return from_arrays([jnp.asarray(np.concatenate(parts)[:lanes]) for parts in zip(*pieces, strict=True)])


def batch(
    moving: Movable,
    scheme: Scheme | Composition,
    states: State | None,
    steps: Steps,
    params,
    solver: Newton | None,
    chunk: int | None,
    devices: int,
) -> Batch:
    """The `Batch` with these arguments of `simulate_batch`; bad arguments raise."""
    if not is_concrete((states, steps.macro_dt, steps.micro_dt, params)):
        raise ValueError(
            "simulate_batch: arguments are tracers; call it outside of jax.jit, vmap and grad, or take jax.vmap of simulate."
        )
    problem = opened(moving)
    system, start = start_of("simulate_batch", problem, states)
    known = dict(zip(_names(system.params), map(np.shape, jax.tree.leaves(system.params)), strict=True))
    new = {} if params is None else dict(_named(params, known))
    check_params(new)
    sizes = {name: getattr(steps, name) for name in ("macro_dt", "micro_dt") if getattr(steps, name) is not None}
    arrays = {f"params[{name!r}]": (value, known[name]) for name, value in new.items()}
    arrays |= {
        f"states.{name}": (value, np.shape(value)[-1:] if name != "t" else ()) for name, value in vars(start).items()
    }
    arrays |= {name: (real_array(f"simulate_batch: {name}", size), ()) for name, size in sizes.items()}
    arrays = _with_lanes(arrays)
    t, *_ = state = tuple(arrays[f"states.{name}"] for name in vars(start))
    lanes = len(t)
    if steps.t_end is not None and not all(
        is_repeated(arrays[name]) or np.ptp(arrays[name]) == 0 for name in (*sizes, "states.t")
    ):
        raise ValueError(
            "simulate_batch: t_end with steps or start times that differ; give num_steps, the same for all lanes."
        )
    for name in sizes:
        if not (np.all(np.isfinite(arrays[name])) and np.all(arrays[name] > 0)):
            raise ValueError(f"simulate_batch: every {name} must be a positive number, got {sizes[name]}.")
    _check_devices(devices, chunk)
    leaves = [
        arrays[f"params[{name!r}]"] if name in new else shared(leaf, lanes)
        for name, leaf in zip(known, jax.tree.leaves(system.params), strict=True)
    ]
    if states is None and new and not (system.has_constant_mass and not system.is_constrained):
        # momenta M v, and their projection onto constraints, depend on parameters
        all_params = jax.tree.unflatten(jax.tree.structure(system.params), leaves)
        fixed = tuple(getattr(problem, name) for name in ("t", "q_s", "q_f", "v_s", "v_f"))
        states = consistent_states(system, all_params, fixed, problem.project, starts_differ=False)
        state = tuple(map(np.asarray, vars(states).values()))
    first = State(*(a[0] for a in state))
    run = simulation(problem, scheme, first, solver, replace(steps, **{name: arrays[name][0] for name in sizes}))
    run.check("simulate_batch: the positions of the first state", constraints=not new)
    check_memory("simulate_batch", run.state, scheme.num_micro, run.num_saves, steps.save_micro, lanes)
    (dt,) = (arrays[name] for name in sizes)
    macro_dt = shared(run.macro_dt, lanes) if is_repeated(dt) else dt * (1 if "macro_dt" in sizes else scheme.num_micro)
    return Batch(run, leaves, state, macro_dt, (lanes_at_once(run) if chunk is None else chunk) * devices, devices)


def shared(value, lanes: int) -> np.ndarray:
    """(lanes, ...) view of a value that all lanes share, see `is_repeated`."""
    return np.broadcast_to(np.asarray(value), (lanes, *np.shape(value)))


@eqx.filter_jit
def consistent_states(system: System, params, start: tuple, project: bool, starts_differ: bool = True) -> State:
    """Consistent states of all lanes, from starts (t, q_s, q_f, v_s, v_f) and parameters.

    Args:
        params: of all lanes; None for the parameters of the system.
        starts_differ: whether the arrays of the start have an axis of lanes.
    """

    def of_lane(lane_params, lane_start):
        t, q_s, q_f, v_s, v_f = lane_start
        lane_system = system if lane_params is None else system.replace(params=lane_params)
        return initial_state(lane_system, q_s, q_f, v_s, v_f, t, project=project)

    return jax.vmap(of_lane, (None if params is None else 0, 0 if starts_differ else None))(params, start)


def _names(params) -> list[str]:
    """Names of all parameters, with dots in names of nested ones."""
    return [
        jax.tree_util.keystr(path, simple=True, separator=".")
        for path, _ in jax.tree_util.tree_leaves_with_path(params)
    ]


def _named(values, known: Collection[str], path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Name and value of each parameter in a part of the parameters, nested or with dots in its names.

    Raises:
        ValueError: a name that is not known, with the known ones.
    """
    name = ".".join(path)
    if name in known:
        yield name, np.asarray(values)
        return
    entries, _ = jax.tree_util.tree_flatten_with_path(values, is_leaf=lambda node: node is not values)
    if entries[:1] == [((), values)] or (name and not any(other.startswith(f"{name}.") for other in known)):
        raise ValueError(f"simulate_batch: params: {unknown('parameter', name, known)}")
    for (key,), entry in entries:
        yield from _named(entry, known, (*path, jax.tree_util.keystr((key,), simple=True)))


def _with_lanes(arrays: dict[str, tuple[Any, tuple[int, ...]]]) -> dict[str, np.ndarray]:
    """Arrays (lanes, *shape), of arrays with or without an axis of lanes and the shape without it, by name.

    Raises:
        ValueError: arrays of other shapes, axes of different lengths, or no axis of lanes at all.
    """
    values = {name: np.asarray(value) for name, (value, _) in arrays.items()}
    for name, (_, shape) in arrays.items():
        if values[name].shape != shape and values[name].shape[1:] != shape:
            raise ValueError(
                f"simulate_batch: {name} has shape {values[name].shape}; give {shape} for all lanes, or an axis of lanes in front of it."
            )
    lengths = {name: len(value) for name, value in values.items() if value.ndim > len(arrays[name][1])}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        listed = (
            ", ".join(f"{name} has {length}" for name, length in lengths.items()) or "no argument has an axis of lanes"
        )
        raise ValueError(
            f"simulate_batch: {listed}; give params, states or steps with one value for each lane, all of the same number."
        )
    (lanes,) = set(lengths.values())
    return {name: value if name in lengths else shared(value, lanes) for name, value in values.items()}


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


@lru_cache(maxsize=32)
def _side_by_side(engine: Engine, of_params: tuple[bool, ...], of_state: bool, of_steps: bool, devices: int):
    """``program(leaves, params, state, macro_dt, save_every)``: a run of `engine` for each lane; flags say which arguments have an axis of lanes."""

    def lane(leaves, params, state, macro_dt, save_every):
        return jax.tree.leaves(engine.trajectory(Arrays(leaves + params, state, macro_dt), save_every))

    def for_each(lanes, whole):
        """`lanes` for arguments with an axis of lanes, `whole` for all others."""
        params = [lanes if has_axis else whole for has_axis in of_params]
        return whole, params, lanes if of_state else whole, lanes if of_steps else whole, whole

    program = jax.vmap(lane, for_each(0, None))
    if devices > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()[:devices]), ("lanes",))
        spread = PartitionSpec("lanes")
        in_specs = for_each(spread, PartitionSpec())
        program = jax.shard_map(program, mesh=mesh, in_specs=in_specs, out_specs=spread, check_vma=False)
    return jax.jit(program, compiler_options=options_of_runs())
