"""A streaming run killed at random moments: resumed it is the same to the last bit."""

import multiprocessing
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import vmri_jax as vm
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from vmri_jax.running.export import STATUS, named_arrays
from vmri_jax.running.store.layout import committed

COLUMNS = ("kill", "after, s", "chunks", "new", "moment", "identical")
CHUNKS, PER_CHUNK = 40, 5
EARLY = 5
"""Every so many kills come at any time after the start of the process, the others after its first chunk."""
PATIENCE = 300.0


@dataclass(frozen=True)
class Size:
    """Kills, and the seed of their moments."""

    count: int
    seed: int = 0


def sizes(name: str, count: int = 100) -> Size:
    """So many kills, whatever the name."""
    return Size(count)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Kill, look at what is there, resume, kill ..., each completed run compared with one that nobody killed."""
    with TemporaryDirectory() as folder:
        rows, runs = kill_often(size, Path(folder), tell)
    identical = sum(row["identical"] == "yes" for row in rows)
    moments = {row["moment"] for row in rows}
    counts = ", ".join(f"{sum(row['moment'] == m for row in rows)} {m}" for m in sorted(moments))
    notes = [
        f"{len(rows)} kills ({counts}), each resumed: {identical} times everything on disk identical to the uninterrupted run.",
        f"{sum(runs)} of {len(runs)} completed runs identical in every array.",
    ]
    yield Report("kills", name, rows, [], notes)


def kill_often(size: Size, folder: Path, tell: Tell = silent) -> tuple[list[dict], list[bool]]:
    """One row per kill; and whether the completed runs are identical to the uninterrupted one."""
    context = multiprocessing.get_context("forkserver")  # children start from a process that has imported everything
    context.set_forkserver_preload(["benchmarks.kills"])
    random = np.random.default_rng(size.seed)
    first, path = folder / "uninterrupted.zarr", folder / "run.zarr"

    def start(out: Path):
        child = context.Process(target=_child, args=(str(out), str(folder / "cache")), daemon=True)
        child.start()
        return child

    to_first_chunk, whole = [_timed(start, first) for _ in range(2)][1]  # the second one finds the programs compiled
    expected = vm.StoredTrajectory(first).load()

    rows, runs = [], []
    while len(rows) < size.count:
        tell(f"kill {len(rows) + 1}")
        before = chunks_of(path)
        child, begin = start(path), time.perf_counter()
        if kill_at_random(child, path, random, None if len(rows) % EARLY else to_first_chunk, whole / 3):
            after = chunks_of(path)
            same = "yes" if after == 0 or _identical(vm.StoredTrajectory(path).load(), expected) else "no"
            row = {"kill": len(rows) + 1, "after, s": time.perf_counter() - begin, "chunks": after}
            rows.append(row | {"new": after - before, "moment": _moment(path, after), "identical": same})
        else:
            runs.append(_complete(child, path, expected))
            shutil.rmtree(path)
    child = start(path)
    child.join(PATIENCE)
    runs.append(_complete(child, path, expected))
    return rows, runs


def _timed(start, path: Path) -> tuple[float, float]:
    """Seconds of a run to its first chunk, and from there to its end."""
    shutil.rmtree(path, ignore_errors=True)
    begin = time.perf_counter()
    child = start(path)
    wait_for_chunk(child, path, 0)
    to_first_chunk = time.perf_counter() - begin
    child.join(PATIENCE)
    if child.exitcode != 0:
        raise RuntimeError(f"kills: the uninterrupted run ended with exit code {child.exitcode}.")
    return to_first_chunk, time.perf_counter() - begin - to_first_chunk


def _child(out: str, cache: str) -> None:
    """Start the run, or go on with it."""
    vm.configure(cache=cache)
    problem = vm.systems.fermi_pasta_ulam()
    scheme, steps = vm.fully_implicit(3), CHUNKS * PER_CHUNK * 2
    arguments = {"macro_dt": 0.01, "num_steps": steps, "save": vm.Save(2, micro=True), "chunk": PER_CHUNK}
    vm.stream(problem.system, scheme, problem.state(), out=out, resume=True, **arguments)


def chunks_of(path: Path) -> int:
    """Committed chunks."""
    return len(committed(path)) if path.exists() else 0


def wait_for_chunk(child, path: Path, known: int) -> None:
    """Until there are more chunks, or the process has ended."""
    deadline = time.monotonic() + PATIENCE
    while child.is_alive() and time.monotonic() < deadline and chunks_of(path) <= known:
        time.sleep(0.002)


def kill_at_random(child, path: Path, random, early: float | None, late: float) -> bool:
    """Kill a process that has just been started, if it is still running then.

    Args:
        child: the process.
        path: the store that it writes.
        random: generator of the moment.
        early: most seconds from its start to the kill; None to wait for its next chunk.
        late: most seconds from its next chunk to the kill.

    Returns:
        Whether it was killed.
    """
    if early is None:
        wait_for_chunk(child, path, chunks_of(path))
    child.join(random.uniform(0.0, late if early is None else early))
    if child.exitcode is None:
        child.kill()
        child.join(PATIENCE)
        return True
    return False


def _moment(path: Path, chunks: int) -> str:
    """What the process was at; files beyond the completed chunks are what it was writing."""
    if not path.exists():
        return "before there was a store"
    torn = any(path.rglob("*.partial")) or any(path.glob(f"*/c.{chunks}*"))
    return "while writing" if torn else "starting or computing"


def _complete(child, path: Path, expected: vm.Trajectory) -> bool:
    """Whether the child ended well, and wrote the expected run."""
    stored = vm.StoredTrajectory(path)
    whole = child.exitcode == 0 and stored.complete and len(stored) == len(expected.t)
    return whole and _identical(stored.load(), expected)


def _identical(part: vm.Trajectory, expected: vm.Trajectory) -> bool:
    """Whether every array is the beginning of the expected one, bit by bit."""
    begun, whole = named_arrays(part), named_arrays(expected)
    pairs = [(np.asarray(begun[name]), np.asarray(whole[name])) for name in begun if name not in STATUS]
    return all(a.tobytes() == b[: len(a)].tobytes() for a, b in pairs)
