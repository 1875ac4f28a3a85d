"""A task: one chunk of runs, computed and written to its part of the store. It needs the store and some bytes, nothing else."""

import pickle
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from vmri_jax.ensembles.design import Design, Table
from vmri_jax.ensembles.store import Writer, made
from vmri_jax.ensembles.work import Work


class Chunks(NamedTuple):
    """How the runs of an ensemble are divided.

    lanes: their number.
    size: runs of a chunk.
    width: runs that are computed side by side.
    """

    lanes: int
    size: int
    width: int

    @property
    def count(self) -> int:
        """Number of chunks."""
        return -(-self.lanes // self.size)

    def ends(self, number: int) -> tuple[int, int]:
        """First run of a chunk, and the first one after it."""
        return number * self.size, min((number + 1) * self.size, self.lanes)


class Job(NamedTuple):
    """All that tasks of an ensemble share.

    work: what is computed.
    design: its rows; None of a table, whose rows are in the store.
    """

    path: str
    chunks: Chunks
    work: Work
    design: Design | None


class Done(NamedTuple):
    """What a task says when its chunk is written: its runs, and those of them that failed."""

    lanes: int
    failed: int


def job_of(path: Path, chunks: Chunks, work: Work, design: Design) -> Job:
    """The job of an ensemble whose store is there."""
    return Job(str(path.resolve()), chunks, work, None if isinstance(design, Table) else design)


def run_chunk(job: Job, number: int) -> Done:
    """Compute a chunk and write it."""
    first, last = job.chunks.ends(number)
    writer = _writer(job.path, job.chunks.size, made(Path(job.path)))
    rows = writer.columns(first, last) if job.design is None else job.design.rows(first, last)
    values = job.work.compute(rows, last - first, job.chunks.width)
    return Done(last - first, writer.write(number, values))


def run_packed_chunk(packed: bytes, number: int) -> Done:
    """`run_chunk` of a job that was pickled."""
    return run_chunk(_job(packed), number)


@lru_cache(maxsize=4)
def _job(packed: bytes) -> Job:
    job = pickle.loads(packed)
    job.work.check_sources()
    return job


@lru_cache(maxsize=4)
def _writer(path: str, chunk: int, made: tuple[int, int]) -> Writer:
    """Of a store, told apart from others that were at its place before by when it was made."""
    return Writer(Path(path), chunk)
