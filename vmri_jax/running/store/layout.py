"""Layout of a store on disk, and the order in which its files are written.

A store is a folder, a zarr group of format 3 that any zarr library reads, and `xarray.open_zarr` as a dataset:

    t, q_s, q_f, ...   one array per field of `Trajectory`, a row per saved node, the start first, one file per chunk of rows
    resume/checkpoint  one file of bytes, an .npz: number of saved intervals, status, and the `Checkpoint` of the run
    attributes         format, identity of the run, chunk, names, versions and machine

Row k of the solver's arrays has its work from node k - 1 to node k, so that their first row is empty.

The checkpoint commits a chunk: it is replaced as a whole after the files of the chunk are on disk. Rows beyond the checkpoint do not count;
a resumed run writes them again. A new store is made beside its place and moved there when it is complete, so that a kill at any moment
leaves a valid store or none.

zarr takes seconds to import: the functions that need it import it themselves.
"""

import io
import json
import os
import warnings
import zipfile
from collections.abc import Iterator, Sequence
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
"""File of the checkpoint within a store; in a separate group, which datasets leave out."""
CONFIG: Any = {"write_empty_chunks": True}
"""Configuration of the arrays: every chunk gets a file, even if all its values are the fill value, so that a missing file is an error."""
KEYS: Any = {"name": "default", "separator": "."}
"""Names of the files of an array: c.0.0, c.1.0, ..."""


class Record(NamedTuple):
    """Contents of a checkpoint file.

    saved: number of committed saved intervals.
    result, failed_at: status of these intervals, as in `Trajectory`.
    step, fell_back: as in `Checkpoint`.
    leaves: state and memory of the `Checkpoint` as a list of arrays.
    """

    saved: int
    result: int
    failed_at: int
    step: int
    fell_back: bool
    leaves: list[np.ndarray]

    @classmethod
    def of(cls, checkpoint: Checkpoint, saved=0, result=int(Result.CONVERGED), failed_at=-1) -> "Record":
        """The record of a checkpoint."""
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((checkpoint.state, checkpoint.memory))]
        return cls(saved, result, failed_at, checkpoint.step, checkpoint.fell_back, leaves)

    def checkpoint(self, like: Checkpoint) -> Checkpoint:
        """The checkpoint, with the tree structure of `like`, any checkpoint of the same run; a ValueError if the arrays do not fit it."""
        expected, structure = jax.tree.flatten((like.state, like.memory))
        if [(leaf.shape, leaf.dtype) for leaf in self.leaves] != [(leaf.shape, leaf.dtype) for leaf in expected]:
            raise ValueError("the checkpoint was made by a version of vmri_jax whose steps remember something else")
        state, memory = jax.tree.unflatten(structure, map(jnp.asarray, self.leaves))
        return Checkpoint(self.step, state, memory, self.fell_back, is_first=self.step == 0)


def create(path: Path, attributes: dict[str, Any], record: Record) -> None:
    """Make a store without rows; it replaces an existing store when it is complete."""
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
    """Appends the pieces of a run to a store of `rows` rows, the start and one for each saved interval."""

    def __init__(self, path: Path, rows: int, chunk: int):
        self._path, self._rows, self._chunk = path, rows, chunk
        self._arrays: dict[str, Any] = {}

    def append(self, piece: Trajectory, saved: int) -> None:
        """Write a piece after the `saved` intervals in the store; every piece but the last fills whole chunks; it counts after `commit`."""
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
            files += [chunk_file(self._path / name, value.ndim, k) for k in chunks]
        # At the end: while the system writes the first file, it writes most of the others, too.
        synchronize_files(files)

    def _make(self, values: dict[str, np.ndarray]) -> list[Path]:
        """Make all arrays; returns all files of the store."""
        import zarr

        group = zarr.open_group(self._path, mode="r+")
        for name, value in values.items():
            shape = (self._rows, *value.shape[1:])
            self._arrays[name] = create_array(group, name, shape, value.dtype, self._chunk, DIMENSIONS[name])
        consolidate(self._path)
        return _files(self._path)

    def _open(self, values: dict[str, np.ndarray]) -> list[Path]:
        """Open all arrays, and give them more rows if the run became longer; returns their metadata files."""
        import zarr

        for name, value in values.items():
            array = zarr.open_array(self._path / name, mode="r+").with_config(CONFIG)
            if array.shape[0] != self._rows:
                array.resize((self._rows, *value.shape[1:]))
            self._arrays[name] = array
        consolidate(self._path)
        return [self._path / METADATA, *(self._path / name / METADATA for name in values)]


def commit(path: Path, record: Record) -> None:
    """Replace the checkpoint: the rows of this record count from now on."""
    file = path / CHECKPOINT
    file.parent.mkdir(exist_ok=True)
    with replaced(file) as out:
        out.write(_packed(record))


def read_attributes(path: Path) -> dict[str, Any]:
    """Attributes of a store, see `attributes_in`."""
    if path.is_file():
        raise ValueError(
            f"{path} is not a stored trajectory but a file; a run written by Trajectory.save is read by Trajectory.load({str(path)!r})."
        )
    return attributes_in(path, FORMAT, "a stored trajectory", "a stored trajectory")


def attributes_in(path: Path, format_name: str, contents: str, kind: str) -> dict[str, Any]:
    """Attributes of a group of Zarr with an attribute "format"; `contents` and `kind` of the folder are for messages."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give the folder of {contents}.")
    try:
        attributes = json.loads((path / METADATA).read_text())["attributes"]
        if attributes["format"] != format_name:
            raise ValueError(f"its format is {attributes['format']!r}, the format of this version {format_name!r}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not {kind} ({type(error).__name__}: {error}).") from error
    return attributes


def read_record(path: Path) -> Record:
    """The checkpoint of a store; a ValueError if it is missing or damaged."""
    try:
        with np.load(io.BytesIO((path / CHECKPOINT).read_bytes()), allow_pickle=False) as data:
            *counts, fell_back = data["counts"].tolist()
            leaves = [data[f"leaf_{k}"] for k in range(len(data.files) - 1)]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: the checkpoint is damaged ({error}); the run cannot go on.") from error
    return Record._make((*counts, bool(fell_back), leaves))


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Context in which no other process writes to this store; the operating system releases the lock even if this process is killed."""
    try:
        import fcntl
    except ImportError:  # Windows has no such locks
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
    """A record as the bytes of an .npz file, of the same length throughout a run."""
    out = io.BytesIO()
    counts = np.array(record[:-1], dtype=np.int64)
    np.savez(out, counts=counts, **{f"leaf_{k}": leaf for k, leaf in enumerate(record.leaves)})  # pyright: ignore[reportArgumentType]
    return out.getvalue()


def create_array(group, name: str, shape: tuple[int, ...], dtype, chunk: int, dimensions: Sequence[str], **options):
    """An array of a group, one file per `chunk` rows; `options` of `zarr.Group.create_array` come on top."""
    from zarr.codecs import Crc32cCodec

    return group.create_array(
        name,
        shape=shape,
        chunks=(chunk, *(max(n, 1) for n in shape[1:])),
        dtype=dtype,
        fill_value=FILL.get(np.dtype(dtype).kind, 0),
        compressors=Crc32cCodec(),
        dimension_names=dimensions,
        config=CONFIG,
        chunk_key_encoding=KEYS,
        overwrite=True,
        **options,
    )


def consolidate(path: Path) -> None:
    """Copy the metadata of all arrays into the metadata of the group, where `xarray` looks for it first."""
    import zarr

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")  # of format 3, but widely read
        zarr.consolidate_metadata(path)


def chunk_file(array: Path, dimensions: int, k: int) -> Path:
    """The file of chunk number k of an array."""
    return array / ".".join(["c", str(k)] + ["0"] * (dimensions - 1))


def _files(path: Path) -> list[Path]:
    return [file for file in path.rglob("*") if file.is_file()]


def synchronize_files(files: list[Path]) -> None:
    """Wait until these files and the lists of files of their folders are on disk."""
    for file in files:
        if file.exists():  # arrays without coordinates have no files
            synchronize(file)
    for folder in {file.parent for file in files}:
        synchronize(folder)
