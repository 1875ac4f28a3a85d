"""A streaming run, and an ensemble or its workers, killed at random moments: resumed they are the same to the last
bit."""

import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks.ensembles import moved
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from vmri_jax.ensembles import Draws, Ensemble
from vmri_jax.executors.executor import local_workers
from vmri_jax.running.export import STATUS, named_arrays
from vmri_jax.running.store.layout import committed

CHUNKS, PER_CHUNK = 40, 5
"""Of the streaming run."""
LANES, CHUNK = 30_000, 500
"""Runs of the ensemble, and of each of its chunks."""
PER_ENSEMBLE = 10
"""Workers that are killed during one ensemble."""
EARLY = 5
"""One kill in this number comes at any time after the start of the process, the others after its next chunk."""
FROM_START, FROM_CHUNK = 6.0, 0.5
"""Most seconds to a kill: from the start of a process, and from its next chunk."""
PATIENCE = 300.0
"""Seconds to wait for a chunk, and for the end of a process that was killed."""


@dataclass(frozen=True)
class Kind:
    """Processes that are killed.

    start: how Python starts them; "forkserver" from a process that has imported everything.
    target: ``target(path)`` in a process of its own, starts a store or goes on with it.
    same: ``same(whole, path, complete)``, whether a store has all of one that nobody disturbed, before the end its
        beginning.
    """

    name: str
    start: str
    target: Callable[[Path], None]
    same: Callable[[Path, Path, bool], bool]

    def process(self, path: Path):
        """A process that has just been started."""
        context: Any = multiprocessing.get_context(self.start)
        if self.start == "forkserver":
            context.set_forkserver_preload(["benchmarks.kills"])
        child = context.Process(target=self.target, args=(path,))
        child.start()
        return child

    def finish(self, child) -> None:
        """Wait for the end of a process."""
        child.join()
        if child.exitcode != 0:
            raise RuntimeError(f"kills: a process that nobody killed ended with exit code {child.exitcode}.")

    def killed(self, child, path: Path, random, *, early: bool) -> bool:
        """Kill a process that has just been started, if it is still running then; whether it was killed."""
        if not early:
            known, deadline = chunks_of(path), time.monotonic() + PATIENCE
            while child.is_alive() and time.monotonic() < deadline and chunks_of(path) <= known:
                time.sleep(0.002)
        child.join(random.uniform(0.0, FROM_START if early else FROM_CHUNK))
        if child.exitcode is None:
            child.kill()
            child.join(PATIENCE)
            return True
        return False


@dataclass(frozen=True)
class Size:
    """Kills of streaming runs, of workers and of whole ensembles; the seed of their moments."""

    runs: int
    workers: int
    ensembles: int
    seed: int = 0


def sizes(name: str, runs: int = 100, workers: int = 50, ensembles: int = 20) -> Size:
    """So many kills, whatever the name."""
    return Size(runs, workers, ensembles)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A row for each run or ensemble that came to its end."""
    report, random, moments = Report("kills", name), np.random.default_rng(size.seed), Counter()
    with TemporaryDirectory() as place:
        parts = (
            kill_processes(RUNS, size.runs, random, Path(place), tell, moments),
            kill_workers(size.workers, random, Path(place), tell),
            kill_processes(ENSEMBLES, size.ensembles, random, Path(place), tell, moments),
        )
        for row in chain(*parts):
            report.rows.append(row)
            yield report
    report.note(f"processes were killed {', '.join(f'{count} times {word}' for word, count in moments.items())}")
    same = sum(row["identical"] == "yes" for row in report.rows)
    report.note(f"{sum(row['kills'] for row in report.rows)} kills; {same} of {len(report.rows)} identical.")
    yield report


def kill_processes(kind: Kind, count: int, random, folder: Path, tell: Tell, moments: Counter[str]) -> Iterator[dict]:
    """Processes are killed and started again until their store is complete, and further ones until `count` were
    killed."""
    done, whole, out = 0, folder / f"whole {kind.name}.zarr", folder / f"{kind.name}.zarr"
    if count:
        kind.finish(kind.process(whole))
    while done < count:
        chunks, calls, same, complete = [], 0, True, False
        shutil.rmtree(out, ignore_errors=True)
        while not complete:
            child, calls, wanted = kind.process(out), calls + 1, done + len(chunks) < count
            if wanted and kind.killed(child, out, random, early=calls % EARLY == 0):
                chunks.append(chunks_of(out))
                moments[_moment(out)] += 1
            else:
                kind.finish(child)
                complete = True
            same = same and kind.same(whole, out, complete)
            tell(f"{kind.name}: {done + len(chunks)} of {count} processes killed")
        done += len(chunks)
        yield _row(kind.name, len(chunks), chunks, calls, same and chunks_of(out) == chunks_of(whole))


def _moment(path: Path) -> str:
    """The part of its work in which the process was killed; files beyond the completed chunks belong to the chunk that
    it was writing."""
    if not path.exists():
        return "before there was a store"
    torn = any(path.rglob("*.partial")) or any(path.glob(f"*/c.{chunks_of(path)}*"))
    return "while writing" if torn else "starting or computing"


def chunks_of(path: Path) -> int:
    """Committed chunks."""
    return len(committed(path)) if path.exists() else 0


def _row(kind: str, kills: int, chunks: list[int], calls: int, same: bool) -> dict:
    row = {"killed": kind, "kills": kills, "chunks before a resume": ", ".join(map(str, chunks)) or "-"}
    return row | {"calls": calls, "identical": "yes" if same else "no"}


# --- a streaming run -------------------------------------------------------------------------------------------------
def streaming(out: Path) -> None:
    """Start the run, or go on with it; programs are compiled once for all processes."""
    vm.configure(cache=out.parent / "cache")
    problem = vm.systems.fermi_pasta_ulam()
    scheme, steps = vm.fully_implicit(3), CHUNKS * PER_CHUNK * 2
    arguments = {"macro_dt": 0.01, "num_steps": steps, "save": vm.Save(2, micro=True), "chunk": PER_CHUNK}
    vm.stream(problem.system, scheme, problem.state(), out=out, resume=True, **arguments)


def _begins(whole: Path, path: Path, complete: bool) -> bool:
    """Whether every array of a store is the beginning of the same array of the whole one, bit by bit."""
    if not chunks_of(path):
        return not complete
    begun, expected = (named_arrays(vm.StoredTrajectory(store).load()) for store in (path, whole))
    pairs = [(np.asarray(begun[name]), np.asarray(expected[name])) for name in begun if name not in STATUS]
    return all(a.tobytes() == b[: len(a)].tobytes() for a, b in pairs)


RUNS = Kind("streaming run", "forkserver", streaming, _begins)


# --- an ensemble -----------------------------------------------------------------------------------------------------
def ensemble(out: Path, **how) -> Ensemble:
    """The one that is disturbed."""
    design = Draws(LANES, {"omega": ("uniform", 20.0, 80.0), "v_s": ("normal", 0.0, 0.1)}, seed=1)
    steps = {"num_micro": 5, "t_end": 2.0, "macro_dt": 0.02}
    return vm.ensemble("fpu", "fully-implicit", design, vary=moved, **steps, out=out, chunk=CHUNK, **how)


def by_two_workers(out: Path) -> None:
    """Start the ensemble, or go on with it."""
    vm.configure()
    ensemble(out, processes=2, resume=True)


def _same_files(whole: Path, path: Path, complete: bool) -> bool:
    """Whether a complete store has the same files as the whole one."""
    contents = ({str(f.relative_to(p)): f.read_bytes() for f in p.rglob("*") if f.is_file()} for p in (whole, path))
    return not complete or next(contents) == next(contents)


ENSEMBLES = Kind("ensemble", "spawn", by_two_workers, _same_files)


def kill_workers(count: int, random, folder: Path, tell: Tell) -> Iterator[dict]:
    """Ensembles of two workers, of which one is killed again and again."""
    done, whole, out = 0, folder / "whole.zarr", folder / "workers.zarr"
    if count:
        ensemble(whole)
    while done < count:
        kills, calls, chunks, complete = 0, 0, [], False
        shutil.rmtree(out, ignore_errors=True)
        while not complete:
            wanted = min(PER_ENSEMBLE - kills, count - done - kills)
            with local_workers(2) as client, _killing(client.cluster.workers, wanted, random) as seen:
                partial_store = ensemble(out, executor=client, resume=True, throw=False)
            kills, calls, complete = kills + len(seen), calls + 1, partial_store.complete
            chunks.append(len(partial_store.done))
            tell(f"{done + kills} of {count} workers killed")
        done += kills
        yield _row("workers of an ensemble", kills, chunks[:-1], calls, _same_files(whole, out, complete))


@contextmanager
def _killing(nannies: Mapping[Any, Any], wanted: int, random) -> Iterator[list[int]]:
    """Meanwhile, some of these workers are killed at random moments; yields the list of the killed ones."""
    stop, seen = threading.Event(), []

    def kill() -> None:
        while len(seen) < wanted and not stop.wait(random.uniform(0.05, 1.5)):
            pids = [nanny.pid for nanny in nannies.values() if nanny.pid is not None]
            if pids:
                seen.append(int(random.choice(pids)))
                os.kill(seen[-1], signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    yield seen
    stop.set()
    killer.join()
