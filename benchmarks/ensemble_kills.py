"""Ensembles whose workers, or whose own process, are killed at random moments: resumed they are the same to the last bit."""

import multiprocessing
import os
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks.ensembles import moved
from benchmarks.kills import EARLY, chunks_of, kill_at_random
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from vmri_jax.ensembles import Draws, Ensemble
from vmri_jax.executors.executor import local_workers

COLUMNS = ("ensemble", "kills", "chunks before a resume", "calls", "identical")
LANES, CHUNK = 30_000, 500
PER_ENSEMBLE = 10
"""Workers that are killed during one ensemble."""
EARLIEST, LATEST = 6.0, 1.0
"""Most seconds to a kill: from the start of a process, and from its next chunk."""


@dataclass(frozen=True)
class Size:
    """Kills of workers, and of whole processes; the seed of their moments."""

    workers: int
    mains: int
    seed: int = 0


def sizes(name: str, workers: int = 50, mains: int = 20) -> Size:
    """So many kills, whatever the name."""
    return Size(workers, mains)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A row for each ensemble that came to its end."""
    random, rows = np.random.default_rng(size.seed), []
    with TemporaryDirectory() as place:
        folder = Path(place)
        expected = contents(ensemble(folder / "undisturbed.zarr").path)
        rows += kill_workers(size.workers, random, folder, expected, tell)
        killed = sum(row["kills"] for row in rows)
        rows += kill_processes(size.mains, random, folder, expected, tell)
    same = sum(row["identical"] == "yes" for row in rows)
    mains = sum(row["kills"] for row in rows) - killed
    notes = [f"{killed} kills of workers and {mains} of the whole process; {same} of {len(rows)} ensembles identical."]
    yield Report("ensemble_kills", name, rows, [], notes)


def ensemble(out: Path, **how) -> Ensemble:
    """The one that is disturbed."""
    design = Draws(LANES, {"omega": ("uniform", 20.0, 80.0), "v_s": ("normal", 0.0, 0.1)}, seed=1)
    return vm.ensemble(
        "fpu", "fully-implicit", design, vary=moved, num_micro=5, t_end=2.0, macro_dt=0.02, out=out, chunk=CHUNK, **how
    )


def contents(path: Path) -> dict[str, bytes]:
    """All files of a store."""
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def kill_workers(count: int, random, folder: Path, expected: dict[str, bytes], tell: Tell) -> Iterator[dict]:
    """Ensembles of two workers, of which one is killed again and again."""
    done = 0
    while done < count:
        out, kills, calls, chunks = folder / "workers.zarr", 0, 0, []
        shutil.rmtree(out, ignore_errors=True)
        complete = False
        while not complete:
            wanted = min(PER_ENSEMBLE - kills, count - done - kills)
            with local_workers(2) as client, killing(client.cluster.workers, wanted, random) as seen:
                found = ensemble(out, executor=client, resume=True, throw=False)
            kills, calls, complete = kills + len(seen), calls + 1, found.complete
            chunks.append(len(found.done))
            tell(f"{done + kills} of {count} workers killed")
        done += kills
        yield _row("workers killed", kills, chunks[:-1], calls, contents(out) == expected)


@contextmanager
def killing(nannies: Mapping[Any, Any], wanted: int, random) -> Iterator[list[int]]:
    """Meanwhile, so many of these workers are killed at random moments; yields the list of those that were."""
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


def kill_processes(count: int, random, folder: Path, expected: dict[str, bytes], tell: Tell) -> Iterator[dict]:
    """Ensembles whose process is killed, until they are complete."""
    context, done = multiprocessing.get_context("spawn"), 0
    while done < count:
        out, kills, calls, chunks, code = folder / "process.zarr", 0, 0, [], None
        shutil.rmtree(out, ignore_errors=True)
        while code != 0:
            child = context.Process(target=_child, args=(str(out),))
            child.start()
            if done + kills >= count:
                child.join()
            elif kill_at_random(child, out, random, EARLIEST if calls % EARLY == EARLY - 1 else None, LATEST):
                kills += 1
                chunks.append(chunks_of(out))
            calls, code = calls + 1, child.exitcode
            tell(f"{done + kills} of {count} processes killed")
        done += kills
        yield _row("process killed", kills, chunks, calls, contents(out) == expected)


def _row(what: str, kills: int, chunks: list[int], calls: int, same: bool) -> dict:
    before = ", ".join(map(str, chunks)) or "-"
    return {
        "ensemble": what,
        "kills": kills,
        "chunks before a resume": before,
        "calls": calls,
        "identical": "yes" if same else "no",
    }


def _child(out: str) -> None:
    """Start the ensemble with two workers, or go on with it."""
    vm.configure()
    ensemble(Path(out), processes=2, resume=True)
