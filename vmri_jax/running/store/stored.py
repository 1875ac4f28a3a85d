"""`StoredTrajectory`: reads the status of a store and any part of its trajectory."""

from copy import copy
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import HasProblem, Problem, State
from vmri_jax.mechanics.summary import summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.export import MICRO, Exports
from vmri_jax.running.origin import Origin
from vmri_jax.running.store.layout import chunk_file, read_attributes
from vmri_jax.running.store.record import Record
from vmri_jax.running.summaries import named_coordinates
from vmri_jax.running.trajectory import NODES, RunInfo, Trajectory, from_named_arrays, with_origin
from vmri_jax.steppers.results import Result


class StoredTrajectory(Exports):
    """A trajectory on disk, written by `stream`; it reads only the nodes that are requested.

    ``len(stored)`` is the number of saved nodes, including the start (0 before the first chunk is complete); ``stored[i]`` is
    the `State` at a node, ``stored[a:b]`` and ``stored[a:b:n]`` are a `Trajectory` of these nodes, ``stored.load()`` is the `Trajectory` of
    all nodes. Its `Quantities` cover all nodes. Length and status are from the moment when the store was opened: open it again to
    follow a running simulation. `xarray.open_zarr` reads its folder, too.

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

    def __init__(self, path):
        self.path = Path(path)
        if self.path.is_file():
            raise Refused(
                f"{path} is not a stored run but a file; a run written by Trajectory.save is read by "
                f"Trajectory.load({str(path)!r})."
            )
        self.attributes: dict[str, Any] = read_attributes(self.path, "run")
        self.num_steps: int = self.attributes["num_steps"]
        self.save_every: int = self.attributes["save_every"]
        self.chunk: int = self.attributes["chunk"]
        self.record = Record.last_of(self.path)
        self.step, self.result, self.failed_at = self.record.step, Result(self.record.result), self.record.failed_at
        self._origin = Origin.from_file(self.attributes.get("names"))

    def __repr__(self) -> str:
        state = "complete" if self.complete else "not complete" if self.success else f"failed: {self.result.name}"
        lines = {"status": f"{self.step} of {self.num_steps} macro steps, {state}"}
        if len(self):
            ends = [float(self[node].t) for node in (0, -1)]
            lines["times"] = f"t = {ends[0]:.6g} to {ends[1]:.6g}"
            lines |= named_coordinates(self.origin.names, self[:1])
        title = f"StoredTrajectory {self.path}: {len(self)} saved nodes, one every {self.save_every} macro steps"
        return summary(title, lines)

    @property
    def origin(self) -> Origin:
        return self._origin

    def of(self, moving: System | Problem | HasProblem) -> "StoredTrajectory":
        """The same run with its system, see `Trajectory.of`."""
        return self.with_origin(self[:1].of(moving).origin)

    def with_origin(self, origin: Origin) -> "StoredTrajectory":
        """The same run with another origin."""
        stored = copy(self)
        stored._origin = origin
        return stored

    @property
    def success(self) -> bool:
        """Whether no step has failed."""
        return self.result.success

    @property
    def complete(self) -> bool:
        """Whether all steps are done, without a failure."""
        return self.success and self.step == self.num_steps

    @property
    def names(self) -> Names:
        return self[:1].names

    def load(self) -> Trajectory:
        """All saved nodes.

        Raises:
            ValueError: no chunk is complete yet, or a file is damaged.
        """
        return self[:]

    whole = load

    def __len__(self) -> int:
        return self.record.saved + 1 if self.record.saved else 0

    def _node(self, number: int) -> State:
        return self[number : number + 1][0]

    def _part(self, first: int, last: int, stride: int) -> Trajectory:
        arrays = {name: self._rows(name, slice(first, last + 1, stride)) for name in NODES}
        for name in RunInfo._fields:  # the maximum over the intervals between two nodes
            rows = self._rows(name, slice(first + 1, last + 1))
            arrays[name] = np.maximum.reduceat(rows, range(0, len(rows), stride)) if len(rows) else rows
        if self.attributes["save_micro"]:
            arrays |= {name: self._rows(name, slice(first + stride, last + 1, stride)) for name in MICRO}
        arrays |= {"result": np.asarray(int(Result.CONVERGED)), "failed_at": np.asarray(-1)}
        if self.failed_at < last * self.save_every:
            arrays |= {"result": np.asarray(int(self.result)), "failed_at": np.asarray(self.failed_at)}
        return with_origin(from_named_arrays(arrays), self.origin)

    def chunks(self):
        """The trajectory in pieces of a chunk each; a piece starts with the last node of the previous piece."""
        for first in range(0, len(self) - 1, self.chunk):
            yield self[first : first + self.chunk + 1]

    def _rows(self, name: str, rows: slice) -> np.ndarray:
        """Committed rows of an array; a ValueError if one of their files is missing or damaged."""
        import zarr

        try:
            array = zarr.open_array(self.path / name, mode="r")
            for k in range(rows.start // self.chunk, -(-rows.stop // self.chunk)):
                if (
                    array.size and not chunk_file(self.path / name, array.ndim, k).is_file()
                ):  # zarr would return fill values
                    raise Refused(f"chunk {k} is missing")
            return np.asarray(array[rows])
        except Exception as error:
            raise Refused(f"{self.path}: {name} cannot be read ({error}); the store is damaged.") from error
