"""The store of an ensemble on disk, and the order in which its files are written.

A store is a folder, a zarr group of format 3, that `xarray.open_zarr` reads as a dataset:

    q_s, energy_error, ...   one array for each kept quantity, a row for each run, one file per chunk of runs
    result, failed_at        the status of every run
    design/...               columns of a design that is a table
    resume/chunks            one file per committed chunk: the number of its runs that failed
    attributes               format, design, settings, identity of the ensemble, versions that made it

The last file of a chunk commits the chunk: a worker writes it when all other files of the chunk are on disk. Readers ignore a chunk
without this file, and the ensemble computes it again. So any number of workers can write at once, and be killed at any moment.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax.ensembles.design import Rows
from vmri_jax.ensembles.quantities import Kept
from vmri_jax.running.files import made_beside, replaced
from vmri_jax.running.store.layout import (
    CONFIG,
    KEYS,
    METADATA,
    attributes_in,
    chunk_file,
    consolidate,
    create_array,
    synchronize_files,
)
from vmri_jax.steppers.results import Result

FORMAT = "vmri_jax ensemble store 1"
COMMITTED = Path("resume", "chunks")
DESIGN = "design"
LANE = "lane"
FLAGS = {
    "flag_values": [int(result) for result in Result],
    "flag_meanings": " ".join(result.name.lower() for result in Result),
}
"""Attributes of the array "result", by the conventions of CF: the numbers and the names of all statuses."""
LABELS = "labels"
"""Attribute of a column of labels: the list of labels, whose numbers in the list are the values of the column."""


def create(path: Path, attributes: Mapping[str, Any], arrays: Mapping[str, Kept], columns: Rows, chunk: int) -> None:
    """Make a store without runs, with the `columns` of a design that is a table. When it is complete it replaces a store at this place."""
    import zarr

    lanes = attributes["lanes"]
    with made_beside(path) as partial:
        group = zarr.create_group(partial, attributes={"format": FORMAT, **attributes})
        for name, (value, dimensions, description) in arrays.items():
            words = {"description": description} if description else {}
            words |= FLAGS if name == "result" else {}
            shape = (lanes, *value.shape)
            create_array(group, name, shape, value.dtype, chunk, (LANE, *dimensions), attributes=words)
        for name, values in columns.items():
            _store_column(group.require_group(DESIGN), name, values, chunk)
        count = -(-lanes // chunk)
        group.require_group(COMMITTED.parent.name).create_array(
            COMMITTED.name,
            shape=(count,),
            chunks=(1,),
            dtype="<i4",
            fill_value=-1,
            compressors=None,
            chunk_key_encoding=KEYS,
        )
        (partial / COMMITTED).mkdir(parents=True, exist_ok=True)
        consolidate(partial)
        synchronize_files([file for file in partial.rglob("*") if file.is_file()])


def _store_column(group, name: str, values: np.ndarray, chunk: int) -> None:
    """Write a column of a table; labels as their numbers in a list, since zarr has no standard type for text."""
    attributes = {}
    if values.dtype.kind == "U":
        labels, values = np.unique(values, return_inverse=True)
        attributes = {LABELS: labels.tolist()}
    dimensions = [LANE, *(f"{name}_{i}" for i in range(values.ndim - 1))]
    create_array(group, name, values.shape, values.dtype, chunk, dimensions, attributes=attributes)[:] = values


class Writer:
    """Writes chunks of a store."""

    def __init__(self, path: Path, chunk: int):
        import zarr

        self._path, self._chunk = path, chunk
        group = zarr.open_group(path, mode="r+", use_consolidated=False)
        self._arrays = {name: array.with_config(CONFIG) for name, array in group.arrays()}
        self._columns = dict(group[DESIGN].arrays()) if DESIGN in group else {}  # pyright: ignore[reportAttributeAccessIssue]

    def columns(self, first: int, last: int) -> Rows:
        """Rows `first` to `last - 1` of a design that is a table."""
        return {name: labelled(np.asarray(array[first:last]), array.attrs) for name, array in self._columns.items()}

    def write(self, number: int, values: Rows) -> int:
        """Write a chunk and commit it; returns how many of its runs failed."""
        first = number * self._chunk
        files = []
        for name, value in values.items():
            array = self._arrays[name]
            if first + len(value) > array.shape[0]:  # zarr would write nothing, without an error
                raise ValueError(f"{self._path}: {name} has {array.shape[0]} rows, none for chunk {number}.")
            array[first : first + len(value)] = value
            files.append(chunk_file(self._path / name, array.ndim, number))
        synchronize_files(files)  # after all writes: the system writes them together
        failed = int(np.count_nonzero(values["failed_at"] >= 0))
        with replaced(self._path / COMMITTED / f"c.{number}") as file:
            file.write(np.array([failed], "<i4").tobytes())
        return failed


def labelled(values, attributes: Mapping[str, Any]):
    """Values of a column of a table, with labels in place of their numbers."""
    return np.asarray(attributes[LABELS])[values] if LABELS in attributes else values


def made(path: Path) -> tuple[int, int]:
    """Inode and time of the metadata file, which differ between stores that follow each other at one place."""
    file = (path / METADATA).stat()
    return file.st_ino, file.st_mtime_ns


def committed(path: Path) -> dict[int, int]:
    """Committed chunks, each with the number of its runs that failed."""
    failed_runs = {}
    with os.scandir(path / COMMITTED) as entries:
        for entry in entries:
            if entry.name.startswith("c."):
                failed_runs[int(entry.name[2:])] = int(np.frombuffer(Path(entry.path).read_bytes(), "<i4")[0])
    return failed_runs


def read_attributes(path: Path) -> dict[str, Any]:
    """Attributes of a store, see `attributes_in`."""
    return attributes_in(path, FORMAT, "an ensemble", "the store of an ensemble")
