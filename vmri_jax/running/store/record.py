"""The note of a chunk of a run: its status, and everything that the next steps depend on."""

import io
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.running.engine import Cursor
from vmri_jax.running.simulation import Checkpoint, Simulation
from vmri_jax.running.store import layout
from vmri_jax.steppers.results import Result


class Record(NamedTuple):
    """A `Checkpoint` in a store: a run as far as its chunks are committed.

    saved: number of committed saved intervals.
    result, failed_at, step, fell_back: of these intervals, as in `Cursor` and `Checkpoint`.
    leaves: state and memory of the cursor.
    """

    saved: int = 0
    result: int = int(Result.CONVERGED)
    failed_at: int = -1
    step: int = 0
    fell_back: bool = False
    leaves: list[np.ndarray] = []  # noqa: RUF012 (never changed)

    @classmethod
    def of(cls, checkpoint: Checkpoint, saved: int) -> "Record":
        """The record of a checkpoint."""
        state, memory, *counts = checkpoint.cursor
        step, result, failed_at = map(int, counts)
        leaves = list(map(np.asarray, jax.tree.leaves((state, memory))))
        return cls(saved, result, failed_at, step, checkpoint.fell_back, leaves)

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
            raise ValueError(f"{path}: the checkpoint is damaged ({error}); the run cannot go on.") from error

    def packed(self) -> bytes:
        """The bytes of an .npz file."""
        out, leaves = io.BytesIO(), {f"leaf_{k}": leaf for k, leaf in enumerate(self.leaves)}
        np.savez(out, counts=np.array(self[:-1], dtype=np.int64), **leaves)  # pyright: ignore[reportArgumentType]
        return out.getvalue()

    def checkpoint(self, run: Simulation) -> Checkpoint:
        """The checkpoint of the run; a ValueError if the arrays do not fit the memory of its stepper."""
        if not self.leaves:
            return run.start()
        expected, structure = jax.tree.flatten((run.state, run.blank_memory(self.fell_back)))
        if [(leaf.shape, leaf.dtype) for leaf in self.leaves] != [(leaf.shape, leaf.dtype) for leaf in expected]:
            raise ValueError("the checkpoint was made by a version of vmri_jax whose steps remember something else")
        state, memory = jax.tree.unflatten(structure, map(jnp.asarray, self.leaves))
        status = map(np.asarray, (self.step, self.result, self.failed_at))
        return Checkpoint(Cursor(state, memory, *status), self.fell_back)
