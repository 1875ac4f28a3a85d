"""Layout of a store on disk, and the order in which its files are written, for long runs and for ensembles.

A store is a folder, a zarr group of format 3 that any zarr library reads, and `xarray.open_zarr` as a dataset:

    t, q_s, energy, ...  one array for each quantity, a row for each saved node or each run, one file per chunk of rows
    resume/chunks/0, ... a note for each committed chunk: some bytes of the writer
    resume/chunks/table.npz  columns of a design that is a table
    attributes           format, kind, rows, rows of a chunk, identity, names, versions and machine

The note commits a chunk: it is written as a whole after all other files of the chunk are on disk. Readers leave out
chunks without a note, and whoever resumes writes them again. Any number of processes can write chunks at once, and be
killed at any moment. A new store is made beside its place and moved there when it is complete: a kill leaves a valid
store or none.

zarr takes seconds to import: the functions that need it import it themselves.
"""

import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from vmri_jax.mechanics.checks import check_flags
from vmri_jax.refusals import Refused
from vmri_jax.running.export import FILL
from vmri_jax.running.files import check_writable, explained, made_beside, replaced, synchronize
from vmri_jax.steppers.results import Result

FORMAT = "vmri_jax store 4"
METADATA = "zarr.json"
NOTES = Path("resume", "chunks")
"""Folder of the notes within a store; in a group of its own, which datasets leave out."""
TABLE = NOTES / "table.npz"
CONFIG: Any = {"write_empty_chunks": True}
"""Configuration of the arrays: every chunk gets a file, even if all its values are the fill value, so that a missing
file is an error."""
KEYS: Any = {"name": "default", "separator": "."}
"""Names of the files of an array: c.0.0, c.1.0, ..."""
FLAGS = {
    "flag_values": [int(result) for result in Result],
    "flag_meanings": " ".join(result.name.lower() for result in Result),
}
"""Attributes of an array "result", by the conventions of CF: the numbers and the names of all statuses."""
CHUNK_SECONDS = 1.0
"""Target seconds of computation of a chunk.

A larger one loses more at a kill; with a smaller one runs wait for files.
"""
MOST_CHUNK_BYTES = 2**26
"""Largest size of a chunk, which is in memory as a whole, in bytes: 64 MiB. A larger one needs more memory per
worker."""


class Kept(eqx.Module):
    """A row of an array of a store, or its shape and type; the names of its axes, and a description of its meaning."""

    value: Any
    dimensions: tuple[str, ...] = eqx.field(default=(), static=True)
    description: str = eqx.field(default="", static=True)


def rows_per_chunk(rows: int, seconds: float, size: int, most_chunks: int) -> float:
    """Rows of a chunk, from seconds and bytes of a row: `CHUNK_SECONDS`, more where `most_chunks` do not suffice."""
    return min(max(CHUNK_SECONDS / seconds, rows / most_chunks), MOST_CHUNK_BYTES / size)


def check_place(caller: str, path: Path, kind: str, resume: bool, overwrite: bool) -> None:
    """Refuse a place where no store of a kind can be made, or where one is that shall neither go on nor be replaced."""
    check_flags(**{f"{caller}: resume": resume, f"{caller}: overwrite": overwrite})
    if resume and overwrite:
        raise Refused(f"{caller}: both resume and overwrite are true; choose one of them.")
    if not path.resolve().parent.is_dir():
        raise FileNotFoundError(f"{caller}: out is {path}, but the folder {path.parent} does not exist; make it first.")
    if not path.exists():
        check_writable(path)
        return
    stored = read_attributes(path, kind)
    if not (resume or overwrite):
        count = -(-stored["rows"] // stored["chunk"])
        advice = "Go on with it (resume=True), replace it (overwrite=True), or give another name"
        raise FileExistsError(f"{path} is a stored {kind}, {len(committed(path))} of {count} chunks done. {advice}.")


@contextmanager
def writing(
    path: Path, attributes: Mapping[str, Any], arrays: Mapping[str, Kept], overwrite: bool, **design
) -> Iterator[None]:
    """Context in which this process alone may write to a store, which is made if there is none, or one to overwrite.

    A new store gets these attributes, "kind", "rows" and "chunk" among them, and these arrays, each without its first
    axis, the rows; `design` has the name of this `dimension` and a `table` of columns.
    """
    if overwrite or not path.exists():
        with explained(path, "Give another place."):
            _create(path, attributes, arrays, **design)
    with locked(path):
        _remove_torn_files(path)
        yield
        _remove_torn_files(path)  # of workers that were killed meanwhile


def _remove_torn_files(path: Path) -> None:
    """Remove files that a `replaced` has begun and, killed, has not ended."""
    for file in path.rglob("*.partial"):
        file.unlink()


def _create(path: Path, attributes, arrays, dimension: str = "t", table=None) -> None:
    import zarr
    from zarr.codecs import Crc32cCodec

    rows, chunk = attributes["rows"], attributes["chunk"]
    with locked(path) if path.exists() else nullcontext(), made_beside(path) as partial:
        group = zarr.create_group(partial, attributes={"format": FORMAT, **attributes})
        for name, kept in arrays.items():
            value, words = kept.value, {"description": kept.description} if kept.description else {}
            group.create_array(
                name,
                shape=(rows, *value.shape),
                chunks=(chunk, *(max(n, 1) for n in value.shape)),
                dtype=value.dtype,
                fill_value=FILL.get(value.dtype.kind, 0),
                compressors=Crc32cCodec(),
                dimension_names=(dimension, *kept.dimensions),
                config=CONFIG,
                chunk_key_encoding=KEYS,
                attributes=words | (FLAGS if name == "result" else {}),
            )
        # An empty array, since zarr libraries warn of folders that are neither arrays nor groups.
        group.require_group(NOTES.parent.name).create_array(NOTES.name, shape=(), dtype="uint8")
        if table:
            np.savez(partial / TABLE, **table)
        _consolidate(partial)
        synchronize(*(file for file in partial.rglob("*") if file.is_file()))


class Writer:
    """Writes chunks of a store; arrays of a run that became longer or shorter get their rows first."""

    def __init__(self, path: Path):
        import zarr

        group = zarr.open_group(path, mode="r+", use_consolidated=False)
        attributes: Any = group.attrs
        rows, self._chunk = attributes["rows"], attributes["chunk"]
        self._path = path
        self._arrays = {name: array.with_config(CONFIG) for name, array in group.arrays()}
        changed = [array for array in self._arrays.values() if array.shape[0] != rows]
        for array in changed:
            array.resize((rows, *array.shape[1:]))
        if changed:
            _consolidate(path)
            synchronize(*path.rglob(METADATA))

    def write(self, first: int, values: Mapping[str, np.ndarray], note: bytes) -> None:
        """Write rows from number `first` on, and commit their chunks with a note."""
        last = first + len(next(iter(values.values()))) - 1
        numbers, files = range(first // self._chunk, last // self._chunk + 1), []
        for name, value in values.items():
            array = self._arrays[name]
            array[first : last + 1] = value
            files += [chunk_file(self._path / name, array.ndim, number) for number in numbers]
        synchronize(*files)  # after all writes: while the system writes the first file, it writes most of the others
        for number in numbers:
            commit(self._path, number, note)


def commit(path: Path, number: int, note: bytes) -> None:
    """Write the note of a chunk, whose rows count from now on."""
    with replaced(path / NOTES / str(number)) as file:
        file.write(note)


def committed(path: Path) -> list[int]:
    """Numbers of the committed chunks, in ascending order."""
    return sorted(int(name) for name in os.listdir(path / NOTES) if name.isdecimal())


def note(path: Path, number: int) -> bytes:
    """The note of a committed chunk."""
    return (path / NOTES / str(number)).read_bytes()


def change_attributes(path: Path, **changes) -> None:
    """Set attributes of a store."""
    metadata = json.loads((path / METADATA).read_text())
    metadata["attributes"] |= changes
    with replaced(path / METADATA) as file:
        file.write(json.dumps(metadata, indent=2).encode())


def read_attributes(path: Path, kind: str) -> dict[str, Any]:
    """Attributes of the store of a kind, "run" or "ensemble"; refuses another store, and another format."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give the folder of a stored {kind}.")
    try:
        attributes = json.loads((path / METADATA).read_text())["attributes"]
        known = attributes["format"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Refused(f"{path} is not a stored {kind} ({type(error).__name__}: {error}).") from error
    if known != FORMAT:
        version = attributes.get("made_with", {}).get("vmri_jax", "of another format")
        formats = f"the format {known!r}, and this version of vmri_jax reads {FORMAT!r}"
        raise Refused(f"{path} has {formats}; read it with vmri_jax {version}, or compute it again.")
    if attributes["kind"] != kind:
        raise Refused(f"{path} is not a stored {kind} but a stored {attributes['kind']}.")
    return attributes


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Context in which no other process writes to this store; the system releases the lock even if this process is
    killed."""
    try:
        import fcntl
    except ImportError:  # Windows has no such locks
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = f"{path} is being written by another process; wait for it or stop it."
            raise BlockingIOError(error.errno, text) from error
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(descriptor)


def chunk_file(array: Path, dimensions: int, number: int) -> Path:
    """The file of a chunk of an array."""
    return array / ".".join(["c", str(number)] + ["0"] * (dimensions - 1))


def _consolidate(path: Path) -> None:
    """Copy the metadata of all arrays into the metadata of the group, where `xarray` looks for it first."""
    import zarr

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part")  # of format 3, but widely read
        zarr.consolidate_metadata(path)
