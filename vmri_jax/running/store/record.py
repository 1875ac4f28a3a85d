"""The note of a chunk of a run: its status, and everything that the next steps depend on."""

import io
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.refusals import Refused
from vmri_jax.running.simulation import Checkpoint
from vmri_jax.running.store import layout
from vmri_jax.steppers.results import Result


class Record(NamedTuple):
    """A run as far as its chunks are committed.

    saved: number of committed saved intervals.
    result, failed_at: status of these intervals, as in `Trajectory`.
    step, fell_back: as in `Cursor` and `Checkpoint`.
    leaves: state and memory of the `Checkpoint` as a list of arrays.
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
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((state, memory))]
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
            raise Refused(f"{path}: the checkpoint is damaged ({error}); the run cannot go on.") from error

    def packed(self) -> bytes:
        """The bytes of an .npz file."""
        out, counts = io.BytesIO(), np.array(self[:-1], dtype=np.int64)
        leaves = {f"leaf_{k}": leaf for k, leaf in enumerate(self.leaves)}
        np.savez(out, counts=counts, **leaves)  # pyright: ignore[reportArgumentType]
        return out.getvalue()

    def checkpoint(self, like: Checkpoint) -> Checkpoint:
        """The checkpoint, in the structure of `like`, the blank one of the run; a ValueError if the arrays do not fit."""
        if not self.leaves:
            return like
        cursor = like.cursor
        expected, structure = jax.tree.flatten((cursor.state, cursor.memory))
        if [(leaf.shape, leaf.dtype) for leaf in self.leaves] != [(leaf.shape, leaf.dtype) for leaf in expected]:
            raise Refused("the checkpoint was made by a version of vmri_jax whose steps remember something else")
        state, memory = jax.tree.unflatten(structure, map(jnp.asarray, self.leaves))
        status = map(np.asarray, (self.step, self.result, self.failed_at))
        return Checkpoint(type(cursor)(state, memory, *status), fell_back=self.fell_back)
