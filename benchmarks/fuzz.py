"""Fuzzing: random systems, most of them hard; every run must end in a valid trajectory, a named status or a clear refusal.

Runs happen in a process of their own, which is ended where one takes longer than allowed and replaced where it dies. Outcomes
are written as they come, so that a run that was stopped goes on where it was.
"""

import dataclasses
import json
import multiprocessing
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random

from rich.console import Console
from rich.table import Table

from benchmarks.measure import Tell, silent
from tests.verification import random_systems as rs

DRAWS = 50
"""Runs of a structure, which share its compiled programs."""
FORGET = 10
"""Compiled programs are dropped after so many structures: a process has only so many memory maps for them."""


def draws_of(seed: int, run: int) -> tuple[rs.Structure, rs.Draw]:
    """Structure and numbers of a run."""
    structure = rs.structure(Random(f"{seed} structure {run // DRAWS}"))
    return structure, rs.draw(Random(f"{seed} draw {run}"), structure)


def calls(runs: list[int], seed: int) -> Iterator[tuple[int, ...]]:
    """Runs as they are computed together: one, or the lanes of a batch (the last one filled up by itself)."""
    left = list(runs)
    while left:
        lanes = draws_of(seed, left[0])[0].lanes or 1
        together = [run for run in left[:lanes] if run // DRAWS == left[0] // DRAWS]
        left = left[len(together) :]
        yield tuple(together)


def compute(seed: int, runs: tuple[int, ...]) -> list[str]:
    """The outcomes of runs that are computed together."""
    structure = draws_of(seed, runs[0])[0]
    draws = [draws_of(seed, run)[1] for run in runs]
    draws += draws[-1:] * ((structure.lanes or 1) - len(draws))
    return rs.run(structure, draws)[: len(runs)]


def _work(connection, seed: int, runs: list[int]) -> None:
    """Tell what is computed next, and what came of it."""
    import jax

    jax.config.update("jax_enable_x64", True)
    structure, seen = None, 0
    for together in calls(runs, seed):
        if together[0] // DRAWS != structure:
            structure, seen = together[0] // DRAWS, seen + 1
            if seen % FORGET == 0:
                rs.functions.cache_clear()
                jax.clear_caches()
        connection.send((together, None))
        connection.send((together, compute(seed, together)))


def outcomes(seed: int, runs: list[int], limit: float) -> Iterator[tuple[int, str]]:
    """(run, outcome) of all these runs; "hang" after `limit` seconds, "crash" where the process died."""
    context, left = multiprocessing.get_context("spawn"), list(runs)
    while left:
        here, there = context.Pipe()
        worker = context.Process(target=_work, args=(there, seed, left), daemon=True)
        worker.start()
        there.close()
        now, ended = (), None
        while left and ended is None:
            try:
                if not here.poll(limit):
                    ended = f"hang: longer than {limit:g} s"
                else:
                    now, found = here.recv()
                    for run, outcome in zip(now, found or (), strict=False):
                        left.remove(run)
                        yield run, outcome
                    now = now if found is None else ()
            except EOFError:
                worker.join()
                ended = f"crash: exit code {worker.exitcode}"
        worker.kill()
        worker.join()
        if ended is not None:
            if not now:
                raise RuntimeError(f"fuzz: the process for the runs ended between two of them ({ended}).")
            for run in now:
                left.remove(run)
                yield run, ended


def fuzz(count: int, seed: int, path: Path, limit: float, tell: Tell = silent) -> dict[int, str]:
    """Outcomes of the runs 0 to count - 1; those that `path` has are not computed again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    found = {}
    if path.exists():
        found = {entry["run"]: entry["outcome"] for entry in map(json.loads, path.read_text().splitlines())}
    found = {run: outcome for run, outcome in found.items() if run < count}
    for run in found:
        tell(f"run {run}")
    with path.open("a") as file:
        for run, outcome in outcomes(seed, [run for run in range(count) if run not in found], limit):
            found[run] = outcome
            file.write(json.dumps({"run": run, "outcome": outcome}) + "\n")
            file.flush()
            tell(f"run {run}: {kind(outcome)}")
    return found


def kind(outcome: str) -> str:
    """An outcome without its figures."""
    return outcome.split(":")[0]


def wrong(found: dict[int, str]) -> dict[int, str]:
    """The runs that did not end as they should."""
    return {run: outcome for run, outcome in sorted(found.items()) if outcome not in rs.HONEST}


def table(found: dict[int, str], console: Console) -> None:
    """Print how often each kind of outcome came, and every run that is wrong."""
    number = Counter(map(kind, found.values()))
    counts = Table("outcome", "runs", title=f"{len(found)} runs", title_justify="left", box=None, header_style="bold")
    for name in (*rs.HONEST, *sorted(set(number) - set(rs.HONEST))):
        counts.add_row(name, str(number[name]))
    console.print(counts)
    console.print(f"{len(wrong(found))} ended wrong")
    for run, outcome in wrong(found).items():
        console.print(f"run {run}: {outcome}")


def reduce(seed: int, run: int, tell: Tell = silent) -> tuple[rs.Structure, rs.Draw, str]:
    """The simplest case found that goes wrong as this run does: fields put to their defaults one by one."""
    structure, draw = draws_of(seed, run)

    def outcome(structure, draw):
        return rs.run(structure, [draw] * (structure.lanes or 1))[0]

    wrong = outcome(structure, draw)
    simpler = [
        (0, f.name, f.default) for f in dataclasses.fields(structure) if f.name not in ("dimension", "slow", "fast")
    ]
    simpler += [(1, f.name, f.default) for f in dataclasses.fields(draw) if f.default is not dataclasses.MISSING]
    simpler += [(1, name, tuple(x(i) for i in range(len(draw.positions)))) for name, x in _SIMPLE.items()]
    for which, name, value in simpler:
        case = [structure, draw]
        if getattr(case[which], name) == value:
            continue
        tell(name)
        case[which] = dataclasses.replace(case[which], **{name: value})
        if kind(outcome(*case)) == kind(wrong):
            structure, draw = case
    return structure, draw, outcome(structure, draw)


_SIMPLE = {"velocities": lambda i: 0.0, "masses": lambda i: 1.0, "positions": float}
