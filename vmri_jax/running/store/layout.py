"""Layout of a store on disk, and what is written in which order.

A store is a folder, a zarr group of format 3 that any zarr library reads, and `xarray.open_zarr` as a dataset:

    t, q_s, q_f, ...   one array per field of `Trajectory`, a row per saved node, the start first, one file per chunk of rows
    resume/checkpoint  one file of bytes, an .npz: how many intervals are saved, the status, and all that the next ones
                       depend on
    attributes         format, identity of the run, chunk, names, what it was made with

What the steps before a node did is in the row of that node, so that the first row of these arrays is empty.

The checkpoint is what commits a chunk: it is replaced as a whole after the files of the chunk are on disk. What lies beyond
it does not count and is written again. A new store is made beside its place and moved there when it is complete, so a kill at
any moment leaves a valid store or none.

zarr takes seconds to import: only the functions that need it do so.
"""

import io
import json
import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.running.export import DIMENSIONS, FILL, rows_of
from vmri_jax.running.files import made_beside, replaced, synchronize
from vmri_jax.running.simulation import Checkpoint
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.steppers.results import Result

FORMAT = "vmri_jax trajectory store 2"
METADATA = "zarr.json"
CHECKPOINT = Path("resume", "checkpoint", "c", "0")
"""File of the checkpoint within a store; in a group of its own, which datasets leave out."""
CONFIG: Any = {"write_empty_chunks": True}
"""Of arrays that are written to: every chunk has its file, so that one that is missing is noticed."""


class Record(NamedTuple):
    """What a checkpoint file holds.

    saved: intervals that count.
    result, failed_at: status up to there, as in `Trajectory`.
    step, fell_back, leaves: the `Checkpoint`, its state and memory as a list of arrays.
    """

    saved: int
    result: int
    failed_at: int
    step: int
    fell_back: bool
    leaves: list[np.ndarray]

    @classmethod
    def of(cls, at: Checkpoint, saved: int = 0, result: int = int(Result.CONVERGED), failed_at: int = -1) -> "Record":
        """With what a checkpoint consists of."""
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((at.state, at.memory))]
        return cls(saved, result, failed_at, at.step, at.fell_back, leaves)

    def checkpoint(self, like: Checkpoint) -> Checkpoint:
        """The checkpoint, with the structure of another one of the same run (shapes alone will do).

        Raises:
            ValueError: the arrays are not those of this structure.
        """
        expected, structure = jax.tree.flatten((like.state, like.memory))
        if [(leaf.shape, leaf.dtype) for leaf in self.leaves] != [(leaf.shape, leaf.dtype) for leaf in expected]:
            raise ValueError("the checkpoint was made by a version of vmri_jax whose steps remember something else")
        state, memory = jax.tree.unflatten(structure, map(jnp.asarray, self.leaves))
        return Checkpoint(self.step, state, memory, self.fell_back, starts=self.step == 0)


def create(path: Path, attributes: dict[str, Any], record: Record) -> None:
    """Make a store without rows; one that is at this place gives way when the new one is complete."""
    import zarr

    with locked(path) if path.exists() else nullcontext(), made_beside(path) as partial:
        group = zarr.create_group(partial, attributes={"format": FORMAT, **attributes})
        size = len(_packed(record))
        resume = group.create_group("resume")
        resume.create_array("checkpoint", shape=(size,), dtype="uint8", chunks=(size,), compressors=None)
        commit(partial, record)
        synchronize_files(_files(partial))


def change_attributes(path: Path, **changes) -> None:
    """Set attributes of a store."""
    metadata = json.loads((path / METADATA).read_text())
    metadata["attributes"] |= changes
    with replaced(path / METADATA) as file:
        file.write(json.dumps(metadata, indent=2).encode())


class Writer:
    """Appends the pieces of a run to a store that is to have `rows` rows, the start and one for each saved interval."""

    def __init__(self, path: Path, rows: int, chunk: int):
        self._path, self._rows, self._chunk = path, rows, chunk
        self._arrays: dict[str, Any] = {}

    def append(self, piece: Trajectory, saved: int) -> None:
        """Write the next intervals, the last ones of a chunk of rows, behind `saved` ones; they count from `commit` on."""
        values = rows_of(piece)
        files = []
        if saved == 0:
            files = self._make(values)
        elif not self._arrays:
            files = self._open(values)
        first, last = (saved + 1 if saved else 0), saved + len(piece) - 1
        for name, value in values.items():
            self._arrays[name][first : last + 1] = value[1 if saved else 0 :]
            chunks = range(first // self._chunk, last // self._chunk + 1)
            files += [_chunk_file(self._path / name, value.ndim, k) for k in chunks]
        synchronize_files(files)  # after all have been written: the first wait is one for most of the others

    def _make(self, values: dict[str, np.ndarray]) -> list[Path]:
        """Make all arrays; returns the files there are."""
        import zarr

        group = zarr.open_group(self._path, mode="r+")
        self._arrays = {name: _create_array(group, name, v, self._rows, self._chunk) for name, v in values.items()}
        consolidate(self._path)
        return _files(self._path)

    def _open(self, values: dict[str, np.ndarray]) -> list[Path]:
        """Open all arrays; those of a run that is made longer get more rows. Returns their metadata."""
        import zarr

        for name, value in values.items():
            array = zarr.open_array(self._path / name, mode="r+").with_config(CONFIG)
            if array.shape[0] != self._rows:
                array.resize((self._rows, *value.shape[1:]))
            self._arrays[name] = array
        consolidate(self._path)
        return [self._path / METADATA, *(self._path / name / METADATA for name in values)]


def commit(path: Path, record: Record) -> None:
    """From now on the rows of this record count."""
    file = path / CHECKPOINT
    file.parent.mkdir(exist_ok=True)
    with replaced(file) as out:
        out.write(_packed(record))


def read_attributes(path: Path) -> dict[str, Any]:
    """Attributes of a store.

    Raises:
        FileNotFoundError: nothing there.
        ValueError: something else than a store, or a damaged one.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give the folder of a stored trajectory.")
    if path.is_file():
        raise ValueError(
            f"{path} is not a stored trajectory but a file; a run written by Trajectory.save is read by Trajectory.load({str(path)!r})."
        )
    try:
        attributes = json.loads((path / METADATA).read_text())["attributes"]
        if attributes["format"] != FORMAT:
            raise ValueError(f"its format is {attributes['format']!r}, that of this version {FORMAT!r}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not a stored trajectory ({type(error).__name__}: {error}).") from error
    return attributes


def read_record(path: Path) -> Record:
    """The checkpoint of a store.

    Raises:
        ValueError: it is missing or damaged.
    """
    try:
        with np.load(io.BytesIO((path / CHECKPOINT).read_bytes()), allow_pickle=False) as data:
            saved, result, failed_at, step, fell_back = data["counts"].tolist()
            leaves = [data[f"leaf_{k}"] for k in range(len(data.files) - 1)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: the checkpoint is damaged ({error}); the run cannot go on.") from error
    return Record(saved, result, failed_at, step, bool(fell_back), leaves)


def read_rows(path: Path, name: str, rows: slice, chunk: int) -> np.ndarray:
    """Rows of one array; they must have been committed.

    Raises:
        ValueError: a file of these rows is missing or damaged.
    """
    import zarr

    try:
        array = zarr.open_array(path / name, mode="r")
        for k in range(rows.start // chunk, -(-rows.stop // chunk)):
            if array.size and not _chunk_file(path / name, array.ndim, k).is_file():  # zarr would fill it in
                raise ValueError(f"chunk {k} is missing")
        return np.asarray(array[rows])
    except Exception as error:
        raise ValueError(f"{path}: {name} cannot be read ({error}); the store is damaged.") from error


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Within, no other process writes to this store; released by the system whatever happens to this process."""
    try:
        import fcntl
    except ImportError:  # a system without such locks
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        text = f"{path} is being written by another process; wait for it or stop it."
        raise BlockingIOError(error.errno, text) from error
    except OSError:  # a file system without locks
        pass
    try:
        yield
    finally:
        os.close(descriptor)


def _packed(record: Record) -> bytes:
    """A record as the bytes of an .npz file; of the same length all along a run."""
    out = io.BytesIO()
    counts = np.array([record.saved, record.result, record.failed_at, record.step, record.fell_back], dtype=np.int64)
    leaves = {f"leaf_{k}": leaf for k, leaf in enumerate(record.leaves)}
    np.savez(out, counts=counts, **leaves)  # pyright: ignore[reportArgumentType]
    return out.getvalue()


def _create_array(group, name: str, like: np.ndarray, rows: int, chunk: int):
    from zarr.codecs import Crc32cCodec

    shape = like.shape[1:]
    return group.create_array(
        name,
        shape=(rows, *shape),
        chunks=(chunk, *(max(n, 1) for n in shape)),
        dtype=like.dtype,
        fill_value=FILL[like.dtype.kind],
        compressors=Crc32cCodec(),
        dimension_names=DIMENSIONS[name],
        config=CONFIG,
        chunk_key_encoding={"name": "default", "separator": "."},
        overwrite=True,
    )


def consolidate(path: Path) -> None:
    """Copy the metadata of all arrays into that of the group, where datasets look for it first."""
    import zarr

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")  # of format 3, but widely read
        zarr.consolidate_metadata(path)


def _chunk_file(array: Path, dimensions: int, k: int) -> Path:
    return array / ".".join(["c", str(k)] + ["0"] * (dimensions - 1))


def _files(path: Path) -> list[Path]:
    return [file for file in path.rglob("*") if file.is_file()]


def synchronize_files(files: list[Path]) -> None:
    """Wait until these files, and that they are there, are on disk."""
    for file in files:
        if file.exists():  # a vector of no coordinates has none
            synchronize(file)
    for folder in {file.parent for file in files}:
        synchronize(folder)
