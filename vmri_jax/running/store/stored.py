"""`StoredTrajectory`: reads the status of a store and any part of its trajectory; `Record`, the note of a chunk, with
which a run goes on."""

import io
import zipfile
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple, overload

import jax
import numpy as np

from vmri_jax.mechanics.state import Movable, State
from vmri_jax.mechanics.summary import summary
from vmri_jax.refusals import Refused
from vmri_jax.running.engine import Cursor
from vmri_jax.running.export import NODES, named_coordinates
from vmri_jax.running.origin import UNKNOWN, Origin
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.store import layout
from vmri_jax.running.store.layout import chunk_file, read_attributes
from vmri_jax.running.trajectory import Trajectory, chosen_nodes, part_of
from vmri_jax.steppers.results import Result

OF_ONE_NODE = {"names": slice(1), "keeps_energy": slice(1), "final_state": slice(-1, None)}
"""Properties of a run that its first or its last node has."""


class Record(NamedTuple):
    """A `Cursor` after the committed saved intervals: their number, its counts, whether the fallback goes on from
    there, leaves of state and memory."""

    saved: int = 0
    result: int = int(Result.CONVERGED)
    failed_at: int = -1
    step: int = 0
    fell_back: bool = False
    leaves: list[np.ndarray] = []  # noqa: RUF012 (never changed)

    @classmethod
    def of(cls, cursor: Cursor, saved: int, fell_back: bool) -> "Record":
        """The record of a cursor."""
        leaves = list(map(np.asarray, jax.tree.leaves((cursor.state, cursor.memory))))
        return cls(saved, int(cursor.result), int(cursor.failed_at), int(cursor.step), fell_back, leaves)

    @classmethod
    def last_of(cls, path: Path) -> "Record":
        """The record of the last committed chunk of a store; a ValueError if it is damaged."""
        numbers = layout.committed(path)
        if not numbers:
            return cls()
        try:
            with np.load(io.BytesIO(layout.note(path, numbers[-1])), allow_pickle=False) as data:
                *counts, fell_back = data["counts"].tolist()
                leaves = [data[f"leaf_{k}"] for k in range(len(data.files) - 1)]
                return cls._make((*counts, bool(fell_back), leaves))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise Refused(f"{path}: the checkpoint is damaged ({error}); the run cannot go on.") from error

    def packed(self) -> bytes:
        """The bytes of an .npz file."""
        out, leaves = io.BytesIO(), {f"leaf_{k}": leaf for k, leaf in enumerate(self.leaves)}
        np.savez(out, counts=np.array(self[:-1], dtype=np.int64), **leaves)  # pyright: ignore[reportArgumentType]
        return out.getvalue()

    def cursor(self, run: Simulation) -> tuple[Cursor, Simulation]:
        """The cursor, and the run that goes on from it, `run` or its fallback; a ValueError if the arrays do not fit
        the memory of its stepper."""
        if not self.leaves:
            return Cursor.at_start(run.state), run
        run = run.exact if self.fell_back else run
        expected, structure = jax.tree.flatten((run.state, run.blank_memory))
        if [(leaf.shape, leaf.dtype) for leaf in self.leaves] != [(leaf.shape, leaf.dtype) for leaf in expected]:
            raise Refused("the checkpoint was made by a version of vmri_jax whose steps remember something else")
        state, memory = jax.tree.unflatten(structure, jax.device_put(list(self.leaves)))
        return Cursor(state, memory, *map(np.asarray, (self.step, self.result, self.failed_at))), run


class StoredTrajectory:
    """A trajectory on disk, written by `stream`; it reads only the nodes that are requested.

    ``len(stored)`` is the number of saved nodes, including the start (0 before the first chunk is complete);
    ``stored[i]`` is the `State` at a node, ``stored[a:b]`` and ``stored[a:b:n]`` are a `Trajectory` of these nodes,
    ``stored.load()`` is the `Trajectory` of all nodes. It has all fields, properties and methods of a `Trajectory`,
    which read all nodes. Length and status are from the moment when the store was opened: open it again to follow a
    running simulation. `xarray.open_zarr` reads its folder, too.

    Args:
        path: folder of the store.

    Attributes:
        num_steps: macro steps of the complete run.
        save_every: macro steps from one saved node to the next.
        chunk: saved intervals that are written together.
        step: macro steps on disk.
        result: status of these steps; after a failure the status of the failed step.
        failed_at: number of the macro step that failed; -1 if no step failed.

    Raises:
        FileNotFoundError: the path does not exist.
        ValueError: the path is no store, or a damaged one.
    """

    origin: Origin = UNKNOWN

    def __init__(self, path):
        self.path = Path(path)
        if self.path.is_file():
            advice = f"a run written by Trajectory.save is read by Trajectory.load({str(path)!r})"
            raise Refused(f"{path} is not a stored run but a file; {advice}.")
        self.attributes: dict[str, Any] = read_attributes(self.path, "run")
        self.num_steps: int = self.attributes["num_steps"]
        self.save_every: int = self.attributes["save_every"]
        self.chunk: int = self.attributes["chunk"]
        self.record = Record.last_of(self.path)
        self.step, self.result, self.failed_at = self.record.step, Result(self.record.result), self.record.failed_at
        self.origin = Origin.from_file(self.attributes.get("names"))

    def __repr__(self) -> str:
        state = "complete" if self.complete else "not complete" if self.success else f"failed: {self.result.name}"
        lines = {"status": f"{self.step} of {self.num_steps} macro steps, {state}"}
        if len(self):
            ends = [float(self[node].t) for node in (0, -1)]
            lines["times"] = f"t = {ends[0]:.6g} to {ends[1]:.6g}"
            lines |= named_coordinates(self.origin.names, self[:1])
        title = f"StoredTrajectory {self.path}: {len(self)} saved nodes, one every {self.save_every} macro steps"
        return summary(title, lines)

    def of(self, moving: Movable) -> "StoredTrajectory":
        """The same run with its system, see `Trajectory.of`."""
        self[-1:].of(moving)  # refuses the system of another run
        return self.with_origin(self[:1].of(moving).origin)

    def with_origin(self, origin: Origin) -> "StoredTrajectory":
        """The same run with another origin."""
        stored = copy(self)
        stored.origin = origin
        return stored

    @property
    def success(self) -> bool:
        """Whether no step has failed."""
        return self.result.success

    @property
    def complete(self) -> bool:
        """Whether all steps are done, without a failure."""
        return self.success and self.step == self.num_steps

    def __getattr__(self, name: str) -> Any:
        """A field, property or method of the `Trajectory` of all nodes, or of one node if that suffices."""
        if name.startswith("_") or not (hasattr(Trajectory, name) or name in Trajectory.__dataclass_fields__):
            raise AttributeError(f"StoredTrajectory has no attribute {name!r}")
        return getattr(self[OF_ONE_NODE.get(name, slice(None))], name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *dir(Trajectory), *Trajectory.__dataclass_fields__})

    def load(self) -> Trajectory:
        """All saved nodes.

        Raises:
            ValueError: no chunk is complete yet, or a file is damaged.
        """
        return self[:]

    def __len__(self) -> int:
        return self.record.saved + 1 if self.record.saved else 0

    @overload
    def __getitem__(self, nodes: int) -> State: ...
    @overload
    def __getitem__(self, nodes: slice) -> Trajectory: ...
    def __getitem__(self, nodes):
        chosen = chosen_nodes(self, nodes)
        if isinstance(chosen, int):
            return self[chosen : chosen + 1][0]
        return part_of(self, self._rows, chosen, self.attributes["save_micro"])

    def chunks(self):
        """The trajectory in pieces of a chunk each; a piece starts with the last node of the previous piece."""
        for first in range(0, len(self) - 1, self.chunk):
            yield self[first : first + self.chunk + 1]

    def _rows(self, name: str, rows: slice) -> np.ndarray:
        """Committed rows of an array, see `part_of`; refuses missing and damaged files."""
        import zarr

        shift = name not in NODES  # the first row of arrays of intervals is blank
        rows = slice(rows.start + shift, rows.stop + shift, rows.step)
        try:
            array = zarr.open_array(self.path / name, mode="r")
            for k in range(rows.start // self.chunk, -(-rows.stop // self.chunk)):
                # zarr would return fill values
                if array.size and not chunk_file(self.path / name, array.ndim, k).is_file():
                    raise Refused(f"chunk {k} is missing")
            return np.asarray(array[rows])
        except Exception as error:
            raise Refused(f"{self.path}: {name} cannot be read ({error}); the store is damaged.") from error
