"""`ensemble`: many runs of a system, in chunks, on one core or on a cluster, into a store that nothing makes lose them."""

import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vmri_jax.ensembles import store
from vmri_jax.ensembles.design import Design, Draws, Product, Table
from vmri_jax.ensembles.executors import Here, as_done, executor_of
from vmri_jax.ensembles.prepared import attributes_of, check_same, prepared
from vmri_jax.ensembles.task import Chunks, Done, Job, job_of, run_chunk, run_packed_chunk
from vmri_jax.ensembles.work import AnyScheme, Steps, Work
from vmri_jax.ensembles.worker import NotAWorker, call_in_worker, known_versions, packed
from vmri_jax.mechanics.arrays import require_x64, whole_number
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.running.files import check_writable, clear_partial
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.progress import Progress, ShowsProgress, progress_to
from vmri_jax.running.store.layout import locked
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solvers import Newton

GIVE_UP = 10
"""So many chunks that cannot be computed, and none that can: then others are not tried."""


class EnsembleError(RuntimeError):
    """Chunks of an ensemble could not be computed, all others are in its store.

    Attributes:
        ensemble: the `Ensemble`.
        failures: by number of the chunk, why.
    """

    def __init__(self, ensemble: "Ensemble"):
        self.ensemble, self.failures = ensemble, ensemble.failures
        first, why = next(iter(self.failures.items()))
        lanes = ", ".join(_runs(ensemble.chunks, number) for number in list(self.failures)[:5])
        more = f" and {len(self.failures) - 5} more" if len(self.failures) > 5 else ""
        whole = len(ensemble.done) + len(self.failures) == ensemble.chunks.count
        rest = "All others are" if whole else f"No chunk could; others were not tried. {len(ensemble.done)} chunks are"
        super().__init__(
            f"{len(self.failures)} of {ensemble.chunks.count} chunks could not be computed: runs {lanes}{more}. Chunk {first}: "
            f"{why.splitlines()[-1]} "
            f"{rest} in {ensemble.path}; with resume=True only those that are missing are tried again."
        )


@dataclass
class Ensemble:
    """An ensemble and how far it is.

    path: folder of its store.
    chunks: how its runs are divided.
    done: chunks that are in the store, each with the number of its runs that failed.
    failures: chunks that could not be computed, and why.
    seconds, computed: wall time of this call, and the runs that it computed.
    """

    path: Path
    chunks: Chunks
    done: dict[int, int]
    failures: dict[int, str] = field(default_factory=dict)
    seconds: float = 0.0
    computed: int = 0

    def __len__(self) -> int:
        """Number of runs."""
        return self.chunks.lanes

    @property
    def complete(self) -> bool:
        """Whether all chunks are in the store."""
        return len(self.done) == self.chunks.count

    @property
    def failed_runs(self) -> int:
        """Runs in the store that did not come to their end, see their result there."""
        return sum(self.done.values())

    @property
    def runs_per_second(self) -> float:
        """Of this call."""
        return self.computed / self.seconds if self.seconds else float("nan")

    def open(self):
        """The results, see `vmri_jax.open_ensemble`."""
        from vmri_jax.ensembles.reading import open_ensemble  # xarray takes a second

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
    micro_dt: float | None = None,
    num_micro: int | None = None,
    save: str | Sequence[str] = "end",
    num_saves: int = 1,
    solver: Newton | None = None,
    project: bool | None = None,
    chunk: int | None = None,
    executor: Any = None,
    processes: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    throw: bool = True,
    progress: ShowsProgress = False,
) -> Ensemble:
    """Simulate a system many times, for all rows of a design, and keep what is asked for in a store on disk.

        runs = vm.ensemble("fpu", "explicit-slow", {"omega": np.linspace(10, 100, 91), "num_micro": [1, 5, 10]},
                           t_end=1.0, macro_dt=0.01, out="runs.zarr", processes=4)
        data = vm.open_ensemble("runs.zarr")

    Runs are computed chunk by chunk. A chunk counts when all of it is on disk, so that whatever dies (a worker, this process,
    the scheduler), all chunks before stay, and `resume` computes the missing ones only. A chunk is the same to the last bit
    wherever it is computed, on processors of the same kind with the same versions. A run that fails is NaN and has its status
    in the results; others do not notice.

    Args:
        system: a problem or scene; or its name: a built-in one, ``my_file.py:my_problem``, ``my_package.my_module:my_problem``.
            Problems whose functions belong to the running program, or to no module, can only be computed in this process.
        scheme: how; a `Scheme`, the name of one, or a function that makes one for a num_micro, such as `vmri_jax.fully_implicit`.
            Several by label are an axis "scheme" of the design.
        design: `Product`, `Table` or `Draws` of `vmri_jax.ensembles`; a mapping is a `Product`. Columns are parameters of the
            system ("omega", "spring.stiffness", "masses[2]"), parts of the start ("q_s[0]", "v hub x", "q_f"), steps
            ("macro_dt", "micro_dt", "num_steps") and schemes ("num_micro", "scheme"). All else stays: a parameter changes the
            system, and not the positions and velocities that the problem starts from.
        out: folder of the store, a zarr group; conventionally named .zarr. All workers must see it.
        t_end, num_steps, macro_dt, micro_dt: two of them: the time at the end, the number of macro steps, and a step size.
        num_micro: for schemes given by name or by what makes them.
        save: what is kept of each run, names from `vmri_jax.ensembles.QUANTITIES` or own functions of a trajectory, given like
            systems in a file.
        num_saves: nodes of a run, equally spaced after the start, that `save` sees: all k-th macro steps for num_steps / k.
        solver, project: as in `simulate` and `initial_state`.
        chunk: runs of a chunk; None for about a second's work. The store keeps it.
        executor: where chunks are computed: None for this process; a `dask.distributed.Client`, of a cluster of any kind; or a
            `concurrent.futures.Executor` that spawns processes.
        processes: or so many workers on this machine, started by Dask (needs the extra ``vmri_jax[ensemble]``). They import the
            program that starts them, which therefore begins with ``if __name__ == "__main__":``.
        resume: go on with the ensemble that is in `out`, which must be the same; start it if there is none.
        overwrite: replace an ensemble that is in `out`.
        throw: raise `EnsembleError` at the end if chunks could not be computed.
        progress: True for a bar that shows how many runs are done, how fast, and how many failed, or a function that is told.

    Returns:
        The `Ensemble`; ``.open()`` gives its results.

    Raises:
        ValueError, TypeError: bad arguments, a store of another ensemble, before anything is computed.
        FileExistsError: there is something in `out`, and neither `resume` nor `overwrite` is asked for.
        OSError: `out` cannot be written; of a full disk what was there before is kept.
        EnsembleError: chunks could not be computed, the others are in the store.
        Interrupted: Ctrl-C; the chunks that were done are in the store.
    """
    require_x64()
    path = Path(out)
    _check_place(path, resume, overwrite)
    if not isinstance(system, str):
        system = problem_of("ensemble", system)
    schemes, design = _schemes(scheme), _design(design)
    if len(schemes) > 1 and "scheme" not in design.described():
        if not isinstance(design, Product):
            raise ValueError(
                "ensemble: there are several schemes, but the design has no column 'scheme' that says which."
            )
        design = Product({"scheme": list(schemes), **design.axes})
    work = Work(
        system=system,
        schemes=schemes,
        columns=tuple(design.described()),
        steps=Steps(t_end, num_steps, macro_dt, micro_dt),
        num_micro=num_micro,
        solver=solver,
        project=project,
        save=(save,) if isinstance(save, str) else tuple(save),
        num_saves=whole_number("ensemble: num_saves", num_saves),
    ).with_sources()
    arrays, chunks, run = prepared(work, design, chunk)
    attributes = attributes_of(work, design, run, chunks)
    if resume and path.exists():
        there = store.read_attributes(path)
        chunks = chunks._replace(size=there["chunk"], width=there["width"])
        check_same(path, attributes, there, chunk)
    with ExitStack() as opened:
        tasks, room = opened.enter_context(executor_of("ensemble", executor, processes))
        if not isinstance(tasks, Here):
            packed("ensemble", work)
        if not (resume and path.exists()):
            columns = design.rows(0, len(design)) if isinstance(design, Table) else {}
            try:
                store.create(path, attributes, arrays, columns, chunks.size)
            except OSError as error:
                raise _unwritable(path, error, "Give another place.") from error
        opened.enter_context(locked(path))
        clear_partial(path)
        tell = opened.enter_context(progress_to("ensemble", progress))
        interrupted = opened.enter_context(interrupts_noted())
        found = Ensemble(path, chunks, store.committed(path))
        _compute(found, job_of(path, chunks, work, design), tasks, room, tell, interrupted)
    if found.failures and throw:
        raise EnsembleError(found)
    return found


def _compute(found: Ensemble, job: Job, tasks, room, tell: Progress, interrupted) -> None:
    """Compute the chunks that are missing."""
    begin = time.perf_counter()
    missing = ((number,) for number in range(job.chunks.count) if number not in found.done)
    if isinstance(tasks, Here):
        submit = lambda number: tasks.submit(run_chunk, job, number)  # noqa: E731
    else:
        data, versions = packed("ensemble", job), known_versions()
        submit = lambda number: tasks.submit(*call_in_worker(versions, run_packed_chunk, data, number))  # noqa: E731
    tell(_progress(found), _lanes_done(found), job.chunks.lanes)
    try:
        for (number,), future in as_done(submit, room, missing, interrupted):
            try:
                done: Done = future.result()
            except Exception as error:
                found.failures[number] = _why(error, found)
            else:
                found.done[number] = done.failed
                found.computed += done.lanes
            if not found.computed and len(found.failures) >= GIVE_UP:
                return
            found.seconds = time.perf_counter() - begin
            tell(_progress(found), _lanes_done(found), job.chunks.lanes)
    except KeyboardInterrupt:
        again = f"go on with resume=True, {found.path}"
        raise Interrupted(found, len(found.done), found.chunks.count, "chunks", again) from None
    except CancelledError as gone:
        raise _gone(found) from gone


def _why(error: Exception, found: Ensemble) -> str:
    """Why a chunk failed, in words; errors that all chunks would have are raised.

    Raises:
        OSError: the store cannot be written.
        RuntimeError: workers are gone, do not have this package, or have other versions.
    """
    if (
        isinstance(error, OSError)
        and error.errno is not None
        and not isinstance(error, FileNotFoundError | ConnectionError)
    ):
        kept = f"{len(found.done)} of {found.chunks.count} chunks are kept; go on with resume=True when there is room."
        raise _unwritable(found.path, error, kept) from error
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "vmri_jax":
        raise RuntimeError(
            "ensemble: a worker does not have vmri_jax. Install it in the environment of the workers, the version of this process."
        ) from error
    if isinstance(error, NotAWorker):
        raise error
    if isinstance(error, BrokenExecutor | CancelledError):
        raise _gone(found) from error
    return f"{type(error).__name__}: {error}".rstrip(".") + "."


def _gone(found: Ensemble) -> RuntimeError:
    return RuntimeError(
        f"ensemble: the workers, or their scheduler, are gone. {len(store.committed(found.path))} of {found.chunks.count} chunks are in {found.path}; "
        "go on with resume=True."
    )


def _unwritable(path: Path, error: OSError, kept: str) -> OSError:
    return OSError(error.errno, f"{path} cannot be written: {error.strerror or error}. {kept}")


def _progress(found: Ensemble) -> str:
    parts = [f"{_lanes_done(found):,} of {len(found):,} runs"]
    if found.computed:
        left = (len(found) - _lanes_done(found)) / found.runs_per_second
        parts += [f"{found.runs_per_second:,.0f} a second", f"{left:,.0f} s left"]
    if found.failed_runs:
        parts.append(f"{found.failed_runs:,} failed")
    if found.failures:
        parts.append(f"{len(found.failures)} chunks not computed")
    return ", ".join(parts)


def _lanes_done(found: Ensemble) -> int:
    count = len(found.done) * found.chunks.size
    last = found.chunks.count - 1
    return count - (found.chunks.count * found.chunks.size - len(found) if last in found.done else 0)


def _runs(chunks: Chunks, number: int) -> str:
    first, last = chunks.ends(number)
    return f"{first} to {last - 1}"


def _schemes(scheme) -> dict[str, AnyScheme]:
    if not isinstance(scheme, Mapping):
        scheme = {scheme if isinstance(scheme, str) else "scheme": scheme}
    if not scheme or not all(
        isinstance(label, str) and (isinstance(one, str | Scheme | Composition) or callable(one))
        for label, one in scheme.items()
    ):
        raise TypeError(
            f"ensemble: scheme is {scheme!r}; give a Scheme, the name of one, a function that makes one for a num_micro, or several "
            "by label."
        )
    return dict(scheme)


def _design(design) -> Design:
    if isinstance(design, Mapping):
        return Product(design)
    if not isinstance(design, Product | Table | Draws):
        raise TypeError(
            f"ensemble: design is {type(design).__name__}; give a Product, Table or Draws of vmri_jax.ensembles, or a mapping of axes, "
            "{'omega': [10, 50]}."
        )
    return design


def _check_place(path: Path, resume: bool, overwrite: bool) -> None:
    """Refuse what is in the way, and a place that does not exist."""
    if resume and overwrite:
        raise ValueError("ensemble: both resume and overwrite are asked for; choose one of them.")
    if not path.resolve().parent.is_dir():
        raise FileNotFoundError(f"ensemble: out is {path}, but the folder {path.parent} does not exist; make it first.")
    if not path.exists():
        check_writable(path)
        return
    there = store.read_attributes(path)  # or it is something else
    if not (resume or overwrite):
        done, count = len(store.committed(path)), -(-there["lanes"] // there["chunk"])
        raise FileExistsError(
            f"{path} holds an ensemble of {there['lanes']} runs, {done} of {count} chunks done. Go on with it (resume=True), replace it "
            "(overwrite=True), or give another name."
        )
