"""`ensemble`: many runs of a system, in chunks, on one core or on a cluster, into a store that keeps them whatever
stops the program."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax.ensembles.design import Chunks, Design, Draws, Product, Rows, Table, Vary
from vmri_jax.ensembles.quantities import Saved
from vmri_jax.ensembles.reading import LANE, open_ensemble
from vmri_jax.ensembles.work import AnyScheme, Work, prepared
from vmri_jax.executors.executor import NotAWorker, as_done, executor_of, submitter
from vmri_jax.mechanics.arrays import require_x64, whole_number
from vmri_jax.mechanics.checks import check_type
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.mechanics.summary import listed, summary
from vmri_jax.refusals import Refused
from vmri_jax.running.files import explained
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.progress import Progress, ShowsProgress, progress_to
from vmri_jax.running.store import layout
from vmri_jax.running.store.identity import check_same
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver

FAILURES_TO_STOP = 10
"""Number of failed chunks, before any chunk succeeds, at which the ensemble stops; a larger one takes longer."""
NOTE_BYTES = 4
"""Bytes of the note of a chunk, the number of its runs that failed; fewer could not hold it."""


class EnsembleError(RuntimeError):
    """Some chunks of an ensemble could not be computed; the computed ones are in its store.

    Attributes:
        ensemble: the `Ensemble`.
        failures: error of each failed chunk, by its number.
    """

    def __init__(self, ensemble: "Ensemble"):
        self.ensemble, self.failures = ensemble, ensemble.failures
        number, error = next(iter(self.failures.items()))
        lanes = listed([f"{first} to {last - 1}" for first, last in map(ensemble.chunks.ends, self.failures)], 5)
        reason = f"{type(error).__name__}: {error}".rstrip(".").splitlines()[-1]
        count = ensemble.chunks.count
        super().__init__(
            f"{len(self.failures)} of {count} chunks could not be computed: runs {lanes}. Chunk {number}: "
            f"{reason}. {len(ensemble.done)} of {count} chunks are in {ensemble.path}; with resume=True only the "
            "missing ones are tried."
        )


@dataclass(repr=False)
class Ensemble:
    """An ensemble and its progress.

    path: folder of its store.
    chunks: the division of its runs.
    done: the chunks in the store, each with the number of its failed runs.
    failures: error of each chunk that could not be computed.
    seconds: wall time of this call.
    computed: number of runs that this call computed.
    """

    path: Path
    chunks: Chunks
    done: dict[int, int]
    failures: dict[int, Exception] = field(default_factory=dict)
    seconds: float = 0.0
    computed: int = 0

    def __repr__(self) -> str:
        done = f"{self.runs_done} of {len(self)} runs, {self.failed_runs} of them failed"
        return summary(f"Ensemble {self.path}", {"done": done, "to see more": "vm.open_ensemble(path), .failures"})

    def __len__(self) -> int:
        """Number of runs."""
        return self.chunks.lanes

    @property
    def complete(self) -> bool:
        """Whether all chunks are in the store."""
        return len(self.done) == self.chunks.count

    @property
    def runs_done(self) -> int:
        """Number of runs in the store."""
        last = self.chunks.count - 1
        absent_from_last = self.chunks.count * self.chunks.size - len(self)
        return len(self.done) * self.chunks.size - (absent_from_last if last in self.done else 0)

    @property
    def failed_runs(self) -> int:
        """Number of runs in the store that failed before their end; "result" in the store has the status of each."""
        return sum(self.done.values())

    @property
    def runs_per_second(self) -> float:
        """Computed runs over wall time of this call."""
        return self.computed / self.seconds if self.seconds else float("nan")

    def open(self):
        """The results, see `vmri_jax.open_ensemble`."""
        return open_ensemble(self.path)


def ensemble(
    system: str | Problem | HasProblem,
    scheme: AnyScheme | Mapping[str, AnyScheme],
    design: Design | Mapping[str, Any],
    *,
    out: str | os.PathLike,
    t_end: float | None = None,
    num_steps: int | None = None,
    macro_dt: float | None = None,
    num_micro: int | None = None,
    vary: Vary | None = None,
    save: Saved | Sequence[Saved] = "end",
    num_saves: int = 1,
    solver: Solver | None = None,
    project: bool | None = None,
    chunk: int | None = None,
    executor: Any = None,
    processes: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    throw: bool = True,
    progress: ShowsProgress = False,
) -> Ensemble:
    """Simulate a system once for each row of a design, and keep the quantities `save` of each run in a store on disk.

        def stiffer(problem, row):
            return replace(problem, system=problem.system.with_params({"omega": row["omega"]}))

        axes = {"omega": np.linspace(10, 100, 91), "num_micro": [1, 5, 10]}
        runs = vm.ensemble("fpu", "explicit-slow", axes, vary=stiffer, t_end=1.0, macro_dt=0.01, out="runs.zarr")
        data = vm.open_ensemble("runs.zarr")

    Runs are computed chunk by chunk. A chunk is committed when all its files are on disk: whatever ends early (a
    worker, this process, the scheduler), committed chunks stay, and `resume` computes the missing ones only. Processors
    of the same kind with the same versions compute a chunk to the same last bit. A run that fails is NaN from there on
    and has its status in the results; it does not change other runs.

    Args:
        system: a problem, a scene, or a name: of a built-in system, ``my_file.py:my_problem``,
            ``my_package.my_module:my_problem``. Problems whose functions belong to the running program, or to no
            module, can only be computed in this process.
        scheme: a `Scheme`, the name of one, or a function that makes a scheme from num_micro, such as
            `vmri_jax.fully_implicit`. A mapping from labels to schemes is an axis "scheme" of the design.
        design: `Product`, `Table` or `Draws` of `vmri_jax.ensembles`; a mapping is a `Product`. The columns "macro_dt",
            "num_steps", "num_micro" and "scheme" choose steps and schemes; `vary` takes all others.
        out: folder of the store, a zarr group; conventionally named .zarr. All workers must see it.
        t_end, num_steps, macro_dt: two of: the time at the end, the number of macro steps, the macro step H.
        num_micro: number of micro steps, for schemes given by name or by a function.
        vary: a function ``(problem, row) -> problem`` that makes the problem of a run from the values of its row by
            column, ``lambda problem, row: replace(problem, v_s=row["speed"] * problem.v_s)``, for example. It may
            change the values of parameters and of the start, and is traced, so that its operations must be operations
            of JAX.
        save: quantities that are kept of each run: names from `vmri_jax.ensembles.QUANTITIES`, or functions of a
            trajectory, themselves or as ``my_file.py:function``. A function returns an array, or a dictionary of
            arrays.
        num_saves: number of saved nodes of a run after the start, equally spaced, from which the quantities are
            computed.
        solver, project: as in `simulate` and `initial_state`.
        chunk: number of runs of a chunk; None for about a second of computation. The store keeps this number.
        executor: computes the chunks: None for this process; a `dask.distributed.Client`, of a cluster of any kind; or
            a `concurrent.futures.Executor` that spawns processes.
        processes: in place of an executor, the number of workers that Dask starts on this machine (needs the extra
            ``vmri_jax[ensemble]``). They import the program that starts them, which therefore needs
            ``if __name__ == "__main__":``.
        resume: compute the missing chunks of the store in `out`, which must be of this ensemble; start a store if there
            is none.
        overwrite: replace the store in `out`.
        throw: raise `EnsembleError` at the end if chunks could not be computed.
        progress: True for a bar with the number of runs done, their speed and the number of failed runs; or a function
            that is called with this text and the numbers of runs.

    Returns:
        The `Ensemble`; ``.open()`` gives its results.

    Raises:
        ValueError, TypeError: bad arguments, or the store of another ensemble; raised before anything is computed.
        FileExistsError: `out` has a store, and neither `resume` nor `overwrite` is true.
        OSError: `out` cannot be written; committed chunks stay if the disk is full.
        EnsembleError: some chunks could not be computed; the others are in the store.
        Interrupted: Ctrl-C; committed chunks are in the store.
    """
    require_x64()
    path = Path(out)
    layout.check_place("ensemble", path, "ensemble", resume, overwrite)
    if not isinstance(system, str):
        system = problem_of("ensemble", system)
    schemes, design = _schemes(scheme), Product(design) if isinstance(design, Mapping) else design
    designs = "a Product, Table or Draws of vmri_jax.ensembles, or a mapping of axes, {'omega': [10, 50]}"
    check_type("ensemble: design", design, Product | Table | Draws, designs)
    if len(schemes) > 1 and "scheme" not in design.described():
        if not isinstance(design, Product):
            raise Refused("ensemble: there are several schemes; give a column 'scheme' that chooses one for each run.")
        design = Product({"scheme": list(schemes), **design.axes})
    steps = {"t_end": t_end, "num_steps": num_steps, "macro_dt": macro_dt}
    work = Work(
        system=system,
        schemes=schemes,
        columns=tuple(design.described()),
        steps={name: value for name, value in steps.items() if value is not None},
        num_micro=num_micro,
        solver=solver,
        project=project,
        save=tuple(save) if isinstance(save, list | tuple) else (save,),  # pyright: ignore[reportArgumentType]
        num_saves=whole_number("ensemble: num_saves", num_saves),
        vary=vary,
    ).with_sources()
    attributes, arrays, chunks = prepared(work, design, chunk)
    if resume and path.exists():
        stored = layout.read_attributes(path, "ensemble")
        # On another machine the default division may differ; files in the store have the old one.
        chunks = chunks._replace(size=stored["chunk"], width=stored["width"])
        check_same(path, attributes, stored, chunk, len(layout.committed(path)) == chunks.count)
    table = design if isinstance(design, Table) else None
    with ExitStack() as opened:
        tasks = opened.enter_context(executor_of("ensemble", executor, processes))
        submit = submitter("ensemble", tasks, chunk_task, path.resolve(), chunks, work)
        columns = None if table is None else table.rows(0, len(table))
        opened.enter_context(layout.writing(path, attributes, arrays, overwrite, dimension=LANE, table=columns))
        tell = opened.enter_context(progress_to("ensemble", progress))
        interrupted = opened.enter_context(interrupts_noted())
        done = {number: int.from_bytes(layout.note(path, number), "little") for number in layout.committed(path)}
        runs = Ensemble(path, chunks, done)
        rows = (lambda _: design) if table is None else lambda number: table.rows(*chunks.ends(number))
        _compute(runs, lambda number: submit(number, rows(number)), tell, interrupted)
    if runs.failures and throw:
        raise EnsembleError(runs) from next(iter(runs.failures.values()))
    return runs


def chunk_task(path: Path, chunks: Chunks, work: Work, number: int, rows: Rows | Design) -> int:
    """Compute a chunk, write and commit its results to the store, and return how many runs failed; `rows` are its rows,
    or the design that makes them."""
    first, last = chunks.ends(number)
    rows = rows if isinstance(rows, dict) else rows.rows(first, last)
    values = work.compute(rows, last - first, chunks.width)
    failed = int(np.count_nonzero(values["failed_at"] >= 0))
    layout.Writer(path).write(first, values, failed.to_bytes(NOTE_BYTES, "little"))
    return failed


def _compute(runs: Ensemble, submit: Callable[[int], Future], tell: Progress, interrupted) -> None:
    """Compute the missing chunks and record them in `runs`."""
    begin = time.perf_counter()
    missing = (number for number in range(runs.chunks.count) if number not in runs.done)
    tell(_progress(runs), runs.runs_done, len(runs))
    try:
        for number, future in as_done(submit, missing, interrupted):
            try:
                runs.done[number] = future.result()
            except (BrokenExecutor, CancelledError, NotAWorker):
                raise
            except Exception as error:
                _raise_if_full(error, runs)
                runs.failures[number] = error
            else:
                first, last = runs.chunks.ends(number)
                runs.computed += last - first
            if not runs.computed and len(runs.failures) >= FAILURES_TO_STOP:
                return
            runs.seconds = time.perf_counter() - begin
            tell(_progress(runs), runs.runs_done, len(runs))
    except KeyboardInterrupt:
        again = f"go on with resume=True, {runs.path}"
        raise Interrupted(runs, len(runs.done), runs.chunks.count, "chunks", again) from None
    except (BrokenExecutor, CancelledError) as gone:
        kept = f"{len(layout.committed(runs.path))} of {runs.chunks.count} chunks are in {runs.path}"
        reason = "ensemble: the workers, or their scheduler, are gone"
        raise RuntimeError(f"{reason}. {kept}; go on with resume=True.") from gone


def _raise_if_full(error: Exception, runs: Ensemble) -> None:
    """Raise the error of a file system that takes no more files: all chunks would have it."""
    of_files = isinstance(error, OSError) and error.errno is not None
    if of_files and not isinstance(error, FileNotFoundError | ConnectionError):
        kept = f"{len(runs.done)} of {runs.chunks.count} chunks are kept; go on with resume=True when there is room."
        with explained(runs.path, kept):
            raise error


def _progress(runs: Ensemble) -> str:
    parts = [f"{runs.runs_done:,} of {len(runs):,} runs"]
    if runs.computed:
        left = (len(runs) - runs.runs_done) / runs.runs_per_second
        parts += [f"{runs.runs_per_second:,.0f} a second", f"{left:,.0f} s left"]
    if runs.failed_runs:
        parts.append(f"{runs.failed_runs:,} failed")
    if runs.failures:
        parts.append(f"{len(runs.failures)} chunks not computed")
    return ", ".join(parts)


def _schemes(scheme) -> dict[str, AnyScheme]:
    if not isinstance(scheme, Mapping):
        scheme = {scheme if isinstance(scheme, str) else "scheme": scheme}
    known = (isinstance(entry, str | SchemeLike) or callable(entry) for entry in scheme.values())
    if not scheme or not all(known) or not all(isinstance(label, str) for label in scheme):
        one = "a Scheme, the name of one, or a function that makes one for a num_micro"
        raise Refused(f"ensemble: scheme is {scheme!r}; give {one}, or several by label.")
    return dict(scheme)
