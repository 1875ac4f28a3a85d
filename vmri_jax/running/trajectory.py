"""`Trajectory`, the result of a run: saved nodes, work of the solver, energy and constraints, and status."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vmri_jax.mechanics.arrays import Numbers, is_concrete, is_known, numbers_of
from vmri_jax.mechanics.checks import check_system
from vmri_jax.mechanics.invariants import energy_parts
from vmri_jax.mechanics.state import Movable, State
from vmri_jax.mechanics.summary import has_values, summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.export import INFO, MICRO, NODES, STATUS, Exports, named_arrays, summary_of
from vmri_jax.running.files import replaced
from vmri_jax.running.micro_nodes import Nodes
from vmri_jax.running.origin import UNKNOWN, Origin, SavedRun, Settings, at_nodes
from vmri_jax.running.quantities import momenta_at
from vmri_jax.running.run_error import RunError
from vmri_jax.steppers.results import Method, Result, Status

FORMAT = "vmri_jax trajectory 3"
NOT_READ = ("drawing", "slow_names", "fast_names")
"""Arrays of a file for other programs."""
ENERGY_TOLERANCE = 1e-9
"""Difference of two energies of the same state, as a part of the sum of the moduli of their terms, up to which it is
round-off. A larger value accepts a run whose parameters differ by little."""
ERROR = tuple(f"error_{name}" for name in RunError._fields)
"""Arrays of the estimated error; absent in runs without one."""


class RunInfo(NamedTuple):
    """Work of the solver from one saved node to the next.

    Attributes:
        method: largest code of the methods of the steps, mostly of the most expensive one, see `Method`.
        iterations: most Newton iterations of a step; 0 for explicit steps.
        residual: largest residual of the momentum equations after a step, relative to the momentum.
    """

    method: Int[Numbers, "k-1"]
    iterations: Int[Numbers, "k-1"]
    residual: Float[Numbers, "k-1"]

    def __repr__(self) -> str:
        arrays = self._asdict()
        return f"RunInfo: {self.in_words()}" if has_values(self) else f"RunInfo({eqx.tree_pformat(arrays, width=1000)})"

    def in_words(self) -> str:
        """The method with the largest code, the most iterations and the largest residual, of concrete arrays."""
        if not np.size(self.method):
            return "no step"
        method, iterations = Method(int(np.max(self.method))), int(np.max(self.iterations))
        residual = np.nanmax(self.residual, initial=0.0)
        return f"{method.name}, at most {iterations} iterations per step, residual at most {residual:.1e}"


class MicroNodes(NamedTuple):
    """Micro nodes of the macro step that ends at each saved node, without the start of the step.

    t: times.
    q_f: fast positions.
    """

    t: Float[Numbers, "k-1 num_micro"]
    q_f: Float[Numbers, "k-1 num_micro n_f"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Exports):
    """Trajectory at the k saved macro nodes, the first one the start; in a batch every array has a leading axis of
    lanes.

    ``len(run)`` is k; ``run[i]`` is the `State` at a node, ``run[-1]`` that at the end; ``run[a:b]`` and ``run[a:b:n]``
    are the `Trajectory` of these nodes. Velocities, multipliers, reaction forces and work are `Quantities` of it. It is
    a pytree of arrays; its origin travels with it through ``jax.tree.map``, ``jax.vmap``, ``jax.jit`` and pickle.

    Positions, velocities and momenta are dictionaries of arrays, ``run.q_f["load"]``, if the problem was given its
    start as dictionaries; `states` always has vectors.

    Attributes:
        states: all saved nodes as a `State` of arrays (k,), (k, n); NaN after a failure.
        energy: Hamiltonian.
        constraint_residual: largest |g| and largest |G v|, including rows that the solver leaves out as implied by
            other rows.
        info: work of the solver since the previous node.
        result: status of the run, the number of a `Result`, which prints as a sentence; after a failure the status of
            the failed step.
        failed_at: number of the macro step that failed; -1 if no step failed.
        micro: the micro nodes of the macro step that ends at each saved node; None without ``Save(micro=True)``.
        error: estimated error of the positions, a `RunError`; None without error=True or an accuracy.
        origin: system, parameters and names.
    """

    states: State
    energy: Float[Numbers, "k"]
    constraint_residual: Float[Numbers, "k 2"]
    info: RunInfo
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]
    micro: MicroNodes | None = None
    error: RunError = None  # pyright: ignore[reportAssignmentType] None in most runs, and users need no check for None
    origin: Origin = UNKNOWN

    def __repr__(self) -> str:
        fields = [*vars(self.states).values(), self.energy, self.constraint_residual, self.result, self.failed_at]
        if not all(map(has_values, (*fields, *self.info))) or not np.size(self.energy) or not np.ndim(self.t):
            return eqx.tree_pformat(self)
        return summary(*summary_of(self))

    @property
    def t(self) -> Any:
        """(k,) times."""
        return self.states.t

    @property
    def q_s(self) -> Any:
        """(k, n_s) slow positions, or by name."""
        return self.origin.shaped("s", self.states.q_s)

    @property
    def q_f(self) -> Any:
        """(k, n_f) fast positions, or by name."""
        return self.origin.shaped("f", self.states.q_f)

    @property
    def p_s(self) -> Any:
        """(k, n_s) slow momenta, or by name."""
        return self.origin.shaped("s", self.states.p_s)

    @property
    def p_f(self) -> Any:
        """(k, n_f) fast momenta, or by name."""
        return self.origin.shaped("f", self.states.p_f)

    @property
    def t_micro(self) -> Any:
        """(k - 1, num_micro) times of the micro nodes; None without ``Save(micro=True)``."""
        return None if self.micro is None else self.micro.t

    @property
    def q_f_micro(self) -> Any:
        """(k - 1, num_micro, n_f) fast positions at the micro nodes, or by name; None without ``Save(micro=True)``."""
        return None if self.micro is None else self.origin.shaped("f", self.micro.q_f)

    @property
    def settings(self) -> Settings:
        """Scheme and steps of a run with an accuracy, for which they were chosen; None of any other run."""
        return self.origin.settings  # pyright: ignore[reportReturnType]

    def of(self, moving: Movable) -> "Trajectory":
        """The same run with its origin: its system, and the names of bodies and constraints.

        Args:
            moving: the Problem, Scene or System that was simulated.

        Raises:
            TypeError: `moving` is none of the three.
            ValueError: its numbers of coordinates, or its energies at the first and the last node, differ from the run.
        """
        run = self._with_origin(moving)
        if is_known((run.energy, run.origin)):
            run._check_energy()
        return run

    def _with_origin(self, moving: Movable) -> "Trajectory":
        """The same states with an origin of as many coordinates, and all lanes of a batch with the same one."""
        origin = replace(Origin.of(moving), settings=self.settings)
        n_s, n_f = self.states.q_s.shape[-1], self.states.q_f.shape[-1]
        try:
            check_system(origin.system(), np.zeros(n_s), np.zeros(n_f))
        except ValueError as error:
            raise Refused(f"of: the run has {n_s} slow and {n_f} fast coordinates. {error}") from None
        return replace(self, origin=origin.repeated(np.shape(self.t)[:-1]))

    def _check_energy(self) -> None:
        """Refuse an origin whose energy at the first or the last node is not the energy of the run: its parameters are
        other ones."""
        axis = np.ndim(self.t) - 1
        states, energy = jax.tree.map(lambda a: np.take(a, (0, -1), axis), (self.states, self.energy))
        parts = at_nodes(energies_at, self.origin, states)
        off = np.abs(parts.sum(axis=-1) - energy) > ENERGY_TOLERANCE * np.abs(parts).sum(axis=-1)
        if off.any():
            ours, theirs = parts.sum(axis=-1)[off][0], energy[off][0]
            raise Refused(
                f"of: the energy of the system is {ours:.9g} where the energy of the run is {theirs:.9g}; give the "
                "system that was simulated, with its parameters."
            )

    def with_arrays(self, **arrays) -> "Trajectory":
        """The same run with other arrays, named as in a file written by `save`:
        ``run.with_arrays(q_f=..., energy=...)``."""
        return from_named_arrays(named_arrays(self) | arrays, self.origin)

    def __len__(self) -> int:
        return np.shape(self.t)[-1]

    @overload
    def __getitem__(self, nodes: int) -> State: ...
    @overload
    def __getitem__(self, nodes: slice) -> "Trajectory": ...
    def __getitem__(self, nodes):
        chosen, lanes = chosen_nodes(self, nodes), (slice(None),) * (np.ndim(self.t) - 1)
        if isinstance(chosen, int):
            return jax.tree.map(lambda a: a[*lanes, chosen], numbers_of(self.states))
        if not is_concrete(self.energy):
            raise Refused("Trajectory: the run is traced by JAX; take slices of its arrays, run.q_s[a:b].")
        arrays = named_arrays(self)
        part = part_of(self, lambda name, rows: np.asarray(arrays[name])[*lanes, rows], chosen, self.micro is not None)
        return part if self.error is None else replace(part, error=self.error.part(nodes))

    @property
    def final_state(self) -> State:
        """`State` at the last saved node (of every run, in a batch)."""
        return self[-1]

    def lane(self, i: int) -> "Trajectory":
        """One run of a batch.

        Args:
            i: number of the lane.

        Raises:
            ValueError: this is no batch.
        """
        if np.ndim(self.t) != 2:
            raise Refused("lane: this is one run, no batch of runs.")
        run = jax.tree.map(lambda a: a[i], numbers_of(self))
        return replace(run, result=status(run.result))

    @property
    def success(self):
        """Whether no step failed (of every run, in a batch)."""
        return self.result <= Result.CONVERGED_AT_ROUNDOFF

    def save(self, path, drawing: dict | None = None) -> None:
        """Write all arrays to a .npz file (no pickled objects); an existing file is replaced after all bytes are on
        disk.

        Names of coordinates are the arrays ``slow_names`` and ``fast_names``; ``settings`` of a run with an accuracy
        are JSON.

        Args:
            path: of the file.
            drawing: plain data of a `vmri_jax.animation.Drawing`, written beside the arrays.

        Raises:
            OSError: the file cannot be written.
        """
        arrays = {name: np.asarray(value) for name, value in named_arrays(self).items()}
        if drawing is not None:
            arrays["drawing"] = np.array(json.dumps(drawing))
        if self.origin.names is not None:
            names = self.names
            arrays |= {"slow_names": np.array(names.slow_coordinates), "fast_names": np.array(names.fast_coordinates)}
            arrays["names"] = np.array(json.dumps(names.to_dict()))
        if self.settings is not None:
            arrays["settings"] = np.array(json.dumps(self.settings.to_dict()))
        with replaced(path) as file:
            np.savez_compressed(file, **arrays, format=np.array(FORMAT))  # pyright: ignore[reportArgumentType]

    @classmethod
    def load(cls, path) -> "Trajectory":
        """Read a trajectory written by `save`, as arrays of NumPy; with ``.of(problem)`` it knows its system again.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is damaged or not a trajectory.
        """
        path = FilePath(path)
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; give the .npz file of a saved trajectory.")
        if path.is_dir():
            raise Refused(f"{path} is a folder; a run written by stream is opened by StoredTrajectory({str(path)!r}).")
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files if name not in NOT_READ}
        except Exception as error:
            raise Refused(f"{path} cannot be read as a .npz file ({error}); it may be damaged.") from error
        known = str(arrays.pop("format", ""))
        if known != FORMAT:
            other = f" It has the format {known!r}, this version of vmri_jax reads {FORMAT!r}." if known else ""
            raise Refused(f"{path} is a .npz file but no trajectory of Trajectory.save of this version.{other}")
        texts = [arrays.pop(name, None) for name in ("names", "settings")]
        needed = {*NODES, *INFO, *STATUS}
        missing = needed - set(arrays)
        if missing or set(arrays) - needed - {*MICRO, *ERROR}:
            raise Refused(f"{path} is a damaged trajectory: it lacks {sorted(missing)}, or has arrays of another kind.")
        try:
            origin = Origin.from_file(*(None if text is None else json.loads(str(text)) for text in texts))
        except (KeyError, TypeError, ValueError) as error:
            raise Refused(f"{path} is a damaged trajectory: no names or settings can be read ({error!r}).") from error
        return from_named_arrays(arrays, origin)


def in_coordinates(run: Trajectory, moving: Movable, q: tuple[Any, Any], v: tuple[Any, Any]) -> Trajectory:
    """The motion of a run in the coordinates of another system, without micro nodes and error.

    Its momenta are ``dT/dv`` of that system: kinetic effects, such as rotors and charges in a magnetic field, add to
    the M v of bodies.

    Args:
        run: the motion.
        moving: the other system.
        q, v: slow and fast positions and velocities in its coordinates, (..., k, n) each.
    """
    bare = replace(run, states=State(run.t, *q, *v), micro=None, error=None)._with_origin(moving)
    p_s, p_f = at_nodes(momenta_at, bare.origin, Nodes(run.t, *q, *v))
    return replace(bare, states=State(run.t, *q, p_s, p_f))


def energies_at(system: System, node: State):
    """The parts of the energy of a state, see `energy_parts`, as a vector."""
    return jnp.stack(list(energy_parts(system, node.q_s, node.q_f, node.p_s, node.p_f).values()))


def status(result) -> Any:
    """A concrete result of one run as a `Status`, which prints as a sentence; any other result unchanged."""
    is_array = isinstance(result, jax.Array | np.ndarray) and result.ndim == 0
    return Status(result) if is_array and is_concrete(result) else result


def from_named_arrays(arrays: dict, origin: Origin = UNKNOWN) -> Trajectory:
    """The inverse of `named_arrays`; arrays of micro nodes and of the error may be absent."""
    states, info = State(*map(arrays.get, NODES[:5])), RunInfo(*map(arrays.get, INFO))
    fields = {name: arrays[name] for name in NODES[5:]} | {"result": status(arrays["result"])}
    micro = MicroNodes(*map(arrays.get, MICRO)) if MICRO[0] in arrays else None
    error: Any = RunError(*map(arrays.get, ERROR)) if ERROR[0] in arrays else None
    return Trajectory(
        states, info=info, failed_at=arrays["failed_at"], micro=micro, error=error, origin=origin, **fields
    )


def chosen_nodes(run: SavedRun, nodes: Any) -> int | tuple[int, int, int]:
    """The number of a node of a run for an index, or the first, the last and the stride of its nodes for a slice."""
    kind, count = type(run).__name__, len(run)
    if isinstance(nodes, int | np.integer):
        if not -count <= nodes < count:
            raise IndexError(f"{kind}: there is no node {nodes}; it has {count} nodes, counted from 0.")
        return int(nodes) % count
    if not isinstance(nodes, slice):
        raise Refused(f"{kind}: the index is {nodes!r}; give the number of a node, or a slice as in run[:100].")
    first, stop, stride = nodes.indices(count)
    if stride < 1 or first >= stop:
        raise Refused(f"{kind}: no nodes {first}:{stop}:{stride}; it has {count}, and they are taken forwards.")
    return first, first + (stop - 1 - first) // stride * stride, stride


def part_of(run: SavedRun, rows: Callable[[str, slice], np.ndarray], nodes: tuple, has_micro: bool) -> Trajectory:
    """The nodes (first, last, stride) of a run, with the largest work of the solver between two of them.

    ``rows(name, slice)`` are some rows of an array; row i of the arrays of intervals belongs to the nodes i and i + 1.
    A failure after the last node is left out.
    """
    first, last, stride = nodes
    arrays = {name: rows(name, slice(first, last + 1, stride)) for name in NODES}
    for name in INFO:
        between, starts = rows(name, slice(first, last)), range(0, last - first, stride)
        arrays[name] = np.maximum.reduceat(between, starts, axis=arrays["t"].ndim - 1) if starts else between
    if has_micro:
        arrays |= {name: rows(name, slice(first + stride - 1, last, stride)) for name in MICRO}
    fails_later = (np.asarray(run.failed_at) >= 0) & ~np.isnan(arrays["energy"]).any(axis=-1)
    arrays["result"] = np.where(fails_later, int(Result.CONVERGED), run.result)
    arrays["failed_at"] = np.where(fails_later, -1, run.failed_at)
    return from_named_arrays(arrays, run.origin)
