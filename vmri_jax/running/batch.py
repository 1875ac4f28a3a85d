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
import numpy as np
from jax.sharding import PartitionSpec

from vmri_jax.mechanics.arrays import is_concrete, options_of_runs, real_array, whole_number
from vmri_jax.mechanics.checks import check_params
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.state import Movable, State, initial_state, opened, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Steps, check_step_size
from vmri_jax.running.engine import NUM_STATE, Engine
from vmri_jax.running.fallback import FALLING_BACK
from vmri_jax.running.origin import Origin, is_repeated
from vmri_jax.running.progress import Working
from vmri_jax.running.saved import check_memory
from vmri_jax.running.simulation import STEPPING, Simulation, simulation
from vmri_jax.running.trajectory import Piece
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme

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
        leaves: (lanes, ...) the leaves of the motions of all lanes.
        width: lanes that are computed side by side.
        devices: CPU devices that share the lanes.
    """

    run: Simulation
    leaves: list
    width: int
    devices: int

    def __call__(self) -> Piece:
        """The runs and their observables, see `Simulation.observed`; lanes that are not solved are computed again by the fallback."""
        run, lanes = self.run, len(self.leaves[0])
        with Working(f"simulate_batch, {lanes} lanes", running=STEPPING):
            done = self._in_chunks()
        failed = np.flatnonzero(run.unsolved(done[0]))
        if failed.size:
            # Failed lanes are padded to a power of two with copies of the last one, so that few programs serve all numbers of failures.
            padded_size = 2 ** int(failed.size - 1).bit_length()
            padded = failed[np.minimum(np.arange(padded_size), failed.size - 1)]
            with Working(f"simulate_batch, {failed.size} of {lanes} lanes: {FALLING_BACK}"):
                again = replace(self, run=run.exact, leaves=_taken(self.leaves, padded))._in_chunks()
            for old, new in zip(jax.tree.leaves(done), jax.tree.leaves(again), strict=True):
                old[failed] = new[: failed.size]
        return done

    @property
    def origin(self) -> Origin:
        """The origin of its trajectories."""
        structure, count = self.run._system
        return Origin(self.run.names, jax.tree.unflatten(structure, self.leaves[len(self.leaves) - count :]))

    def lane(self, i: int) -> Simulation:
        """The run of a lane."""
        return replace(self.run, **self.run.engine.motion([a[i] for a in self.leaves])._asdict())

    def with_steps(self, run: Simulation) -> "Batch":
        """The batch with the steps of another run of its first lane, in the same ratio for all lanes."""
        macro_dt, *others = self.leaves
        all_alike = shared(run.macro_dt, len(macro_dt))
        macro_dt = all_alike if is_repeated(macro_dt) else macro_dt * (run.macro_dt / macro_dt[0])
        return replace(self, run=run, leaves=[macro_dt, *others])

    def _in_chunks(self) -> Piece:
        """All lanes, `width` at a time; the last chunk is padded with copies of its last lane, so that one program computes all chunks."""
        lanes = len(self.leaves[0])
        width = min(self.width, -(-lanes // self.devices) * self.devices)
        program = _side_by_side(self.run.engine, tuple(not is_repeated(a) for a in self.leaves), self.devices)
        pieces = []
        for start in range(0, lanes, width):
            part = _taken(self.leaves, np.minimum(np.arange(start, start + width), lanes - 1))
            part = [a[0] if is_repeated(a) else a for a in part]
            pieces.append(program(part, self.run.save_every))
        saved, result, failed_at = jax.tree.map(lambda *parts: np.concatenate(parts)[:lanes], *pieces)
        run = self.run.unpacked(saved, self.leaves, result, failed_at, self.run.save_every)
        return self.run.observed(run, self.leaves)


def batch(
    moving: Movable,
    scheme: Scheme | Composition,
    states: State | None,
    steps: Steps,
    params,
    solver,
    chunk,
    devices: int,
) -> Batch:
    """The `Batch` with these arguments of `simulate_batch`; bad arguments raise."""
    if not is_concrete((states, steps.macro_dt, params)):
        raise Refused(
            "simulate_batch: arguments are tracers; call it outside of jax.jit, vmap and grad, or take jax.vmap of simulate."
        )
    _check_devices(devices, chunk)
    problem: Any = opened(moving)
    system, start = start_of("simulate_batch", problem, states)
    if steps.macro_dt is None:
        check_step_size(None)
    params, start, macro_dt = _with_lanes(system.params, params, start, steps.macro_dt)
    if not (np.all(np.isfinite(macro_dt)) and np.all(macro_dt > 0)):
        raise Refused(f"simulate_batch: every macro_dt must be a positive number, got {macro_dt}.")
    if steps.t_end is not None and any(np.ptp(array) > 0 for array in (start.t, macro_dt)):
        raise Refused(
            "simulate_batch: t_end with steps or start times that differ; give num_steps, the same for all lanes."
        )
    differs = not all(map(is_repeated, params))
    if states is None and differs and not (system.has_constant_mass and not system.is_constrained):
        # momenta M v, and their projection onto constraints, depend on parameters
        of_lanes = jax.tree.unflatten(jax.tree.structure(system.params), params)
        fixed = tuple(getattr(problem, name) for name in ("t", "q_s", "q_f", "v_s", "v_f"))
        start = consistent_states(system, of_lanes, fixed, problem.project, starts_differ=False)
    state = tuple(map(np.asarray, vars(start).values()))
    first, steps = State(*(a[0] for a in state)), replace(steps, macro_dt=macro_dt[0])
    run, lanes = simulation(problem, scheme, first, solver, steps), len(state[0])
    run.save.without_bar("simulate_batch")
    run.check("simulate_batch: the positions of the first state", constraints=not differs)
    check_memory("simulate_batch", run, lanes)
    model = run.leaves[NUM_STATE:]  # the parameters come last, see `Motion`
    model = [shared(leaf, lanes) for leaf in model[: len(model) - len(params)]] + params
    width = (lanes_at_once(run) if chunk is None else chunk) * devices
    return Batch(run, [macro_dt, *state, *model], width, devices)


def _taken(leaves: list, index: np.ndarray) -> list:
    """The lanes with these numbers."""
    return [shared(a[0], len(index)) if is_repeated(a) else a[index] for a in leaves]


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
        raise Refused(f"simulate_batch: params: {unknown('parameter', name, known)}")
    for (key,), entry in entries:
        yield from _named(entry, known, (*path, jax.tree_util.keystr((key,), simple=True)))


def _with_lanes(all_params, params, start: State, macro_dt) -> tuple[list, State, np.ndarray]:
    """Parameters, starts and macro steps of all lanes, with the lanes as their first axis.

    Args:
        all_params: of the system.
        params: of the user, some of them with an axis of lanes.

    Raises:
        ValueError: arrays of other shapes, axes of different lengths, or no axis of lanes at all.
    """
    values = dict(zip(_names(all_params), jax.tree.leaves(all_params), strict=True))
    new = {} if params is None else dict(_named(params, values))
    check_params(new)
    arrays = {f"params[{name!r}]": (new.get(name, value), np.shape(value)) for name, value in values.items()}
    arrays |= {
        f"states.{name}": (value, np.shape(value)[-1:] if name != "t" else ()) for name, value in vars(start).items()
    }
    arrays["macro_dt"] = real_array("simulate_batch: macro_dt", macro_dt), ()
    lengths = {}
    for name, (value, shape) in arrays.items():
        if np.ndim(value) > len(shape) and np.shape(value)[1:] == shape:
            lengths[name] = len(value)
        elif np.shape(value) != shape:
            raise Refused(
                f"simulate_batch: {name} has shape {np.shape(value)}; give {shape} for all lanes, or an axis of lanes in front of it."
            )
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        listed = (
            ", ".join(f"{name} has {length}" for name, length in lengths.items()) or "no argument has an axis of lanes"
        )
        raise Refused(
            f"simulate_batch: {listed}; give params, states or steps with one value for each lane, all of the same number."
        )
    (lanes,) = set(lengths.values())
    whole = {
        name: np.asarray(value) if name in lengths else shared(value, lanes) for name, (value, _) in arrays.items()
    }
    if all(map(is_repeated, whole.values())):  # the user gave such views, and `jax.vmap` wants an axis
        whole["states.t"] = np.array(whole["states.t"])
    starts = (whole[f"states.{name}"] for name in vars(start))
    return [whole[f"params[{name!r}]"] for name in values], State(*starts), whole["macro_dt"]


def _check_devices(devices, chunk) -> None:
    if not 1 <= devices <= jax.device_count():
        raise Refused(
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
def _side_by_side(engine: Engine, differs: tuple[bool, ...], devices: int):
    """``program(leaves, save_every)``: `Engine.run` for each lane; `differs` says which of the leaves have an axis of lanes."""
    program = jax.vmap(engine.run, ([0 if differ else None for differ in differs], None))
    if devices > 1:
        mesh = jax.sharding.Mesh(np.array(jax.devices()[:devices]), ("lanes",))
        spread = PartitionSpec("lanes")
        in_specs = [spread if differ else PartitionSpec() for differ in differs], PartitionSpec()
        program = jax.shard_map(program, mesh=mesh, in_specs=in_specs, out_specs=spread, check_vma=False)
    return jax.jit(program, compiler_options=options_of_runs())
