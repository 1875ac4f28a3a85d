"""A task: one chunk of runs, computed and written to its part of the store. A task needs the store and the pickled `Job`, nothing else."""

import pickle
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from vmri_jax.ensembles.design import Design
from vmri_jax.ensembles.store import Writer, made
from vmri_jax.ensembles.work import Work


class Chunks(NamedTuple):
    """The division of the runs of an ensemble.

    lanes: number of runs.
    size: number of runs of a chunk; the last chunk may have fewer.
    width: number of runs that are computed side by side.
    """

    lanes: int
    size: int
    width: int

    @property
    def count(self) -> int:
        """Number of chunks."""
        return -(-self.lanes // self.size)

    def ends(self, number: int) -> tuple[int, int]:
        """Number of the first run of a chunk, and of the first run after it."""
        return number * self.size, min((number + 1) * self.size, self.lanes)


class Job(NamedTuple):
    """Arguments that all tasks of an ensemble share.

    path: folder of the store.
    chunks: the division of the runs.
    work: computes them.
    design: makes the rows; None for a table, whose rows are in the store.
    """

    path: str
    chunks: Chunks
    work: Work
    design: Design | None


def run_chunk(job: Job, number: int) -> int:
    """Compute a chunk of runs, write it and commit it; returns how many of its runs failed."""
    first, last = job.chunks.ends(number)
    writer = _writer(job.path, job.chunks.size, made(Path(job.path)))
    rows = writer.columns(first, last) if job.design is None else job.design.rows(first, last)
    return writer.write(number, job.work.compute(rows, last - first, job.chunks.width))


def run_packed_chunk(packed: bytes, number: int) -> int:
    """`run_chunk` of a pickled job."""
    return run_chunk(_job(packed), number)


@lru_cache(maxsize=4)
def _job(packed: bytes) -> Job:
    job = pickle.loads(packed)
    job.work.check_sources()
    return job


@lru_cache(maxsize=4)
def _writer(path: str, chunk: int, made: tuple[int, int]) -> Writer:
    """The writer of a store. `made` is part of the cache key: a store that replaced another one gets a new writer."""
    return Writer(Path(path), chunk)
