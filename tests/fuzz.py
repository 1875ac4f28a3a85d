"""Random systems, most of them hard: every run ends in a valid trajectory, a named status or a clear refusal.

Runs happen in a process of their own, which is replaced where it hangs or dies. Outcomes are written as they come.

    python -m tests.fuzz --help
"""

import dataclasses
import itertools
import json
import multiprocessing
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Annotated

import jax
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import vmri_jax as vm
from benchmarks.gail2014.dense import named
from tests.support import until_failure
from tests.verification import random_systems as rs
from vmri_jax.mechanics.constraints import CONSTRAINT_TOLERANCE
from vmri_jax.refusals import Refused
from vmri_jax.running.progress import progress_shown

Tell = Callable[[str], None]
"""Called with what comes next."""
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


def verdicts(of: rs.Structure, draws: list[rs.Draw]) -> list[str]:
    """What becomes of each draw; those of a batch share masses and scheme of the first."""
    try:
        first, problems = draws[0], [rs.problem(of, at) for at in draws]
        how = {
            "num_steps": of.num_saves * first.save_every,
            "save": vm.Save(first.save_every, micro=of.save_micro),
            "solver": named(of.method, tolerance=first.tolerance, max_iterations=first.max_iterations),
        }
        made = rs.scheme(of, first)
        if of.lanes is None:
            start = _start(problems[0], first.project or None)
            found = [until_failure(problems[0].system, made, start, macro_dt=first.macro_dt, **how)]
        else:
            found = _batch(problems, made, draws, how)
    except Exception as error:
        return [refusal(error)] * len(draws)
    return [judge(run, first.tolerance, how["num_steps"]) for run in found]


def _start(problem: vm.Problem, project: bool | None = None) -> vm.State:
    """Its state; velocities against the constraints are of no interest here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return problem.state(project)


def _batch(problems, made, draws, how) -> list[vm.Trajectory]:
    """Lanes that `initial_state` refuses start at rest, where nobody checks them."""
    starts = []
    for at in problems:
        try:
            starts.append(_start(at))
        except ValueError:
            starts.append(vm.State(at.t, at.q_s, at.q_f, np.zeros_like(at.q_s), np.zeros_like(at.q_f)))
    states, params = (
        jax.tree.map(lambda *lanes: np.stack(lanes), *some) for some in (starts, [p.system.params for p in problems])
    )
    dt = np.array([at.macro_dt for at in draws])
    runs = vm.simulate_batch(problems[0].system, made, states, params=params, macro_dt=dt, warn=False, **how)
    return [jax.tree.map(lambda a, i=i: a[i], runs) for i in range(len(draws))]


HONEST = "REFUSED", *vm.Result.__members__
"""Outcomes of a run that are as they should be; all others say what is wrong."""


def refusal(error: Exception) -> str:
    """ "REFUSED" for a refusal of this package, else the error and its place."""
    if isinstance(error, Refused):
        return "REFUSED"
    frame, _ = list(traceback.walk_tb(error.__traceback__))[-1]
    where = frame.f_globals.get("__name__", "?")
    return f"foreign error: {type(error).__name__} in {where}: {str(error)[:200]}"


def judge(run: vm.Trajectory, tolerance: float, num_steps: int) -> str:
    """The name of the `Result` of an honest run, else what is wrong with it."""
    code, failed_at, saves = int(run.result), int(run.failed_at), len(run.t) - 1
    if code not in set(vm.Result):
        return f"unknown status: {code}"
    status = vm.Result(code)
    if status.success != (failed_at < 0) or failed_at >= num_steps:
        return f"status at odds: {status.name} with failed_at {failed_at}"
    nodes = {name: np.asarray(getattr(run, name)) for name in ("q_s", "q_f", "p_s", "p_f", "energy")}
    kept = 1 + (saves if status.success else failed_at * saves // num_steps)
    if not status.success and not np.isfinite(nodes["energy"][0]):
        kept = 0  # the start itself is outside the domain of a function
    for name, a in nodes.items():
        finite = np.isfinite(a).reshape(len(a), -1)
        if not finite[:kept].all():
            return f"not finite: {name} at a node with success (status {status.name})"
        if finite[kept:].any() and finite.size:
            return f"stale numbers: {name} after a failure (status {status.name})"
    if run.q_f_micro is not None and not np.isfinite(np.asarray(run.q_f_micro)[: max(0, kept - 1)]).all():
        return "not finite: q_f_micro at a node with success"
    # positions of 1e8 and more, as some draws have, round constraints to a part of their size
    size = np.maximum(1.0, np.abs(np.concatenate([nodes["q_s"], nodes["q_f"]], axis=-1)).max(axis=-1))[:kept]
    g = (np.asarray(run.constraint_residual)[:kept, 0] / size).max(initial=0.0)
    if not g <= max(CONSTRAINT_TOLERANCE, 100 * tolerance):
        return f"constraint violated: by {g:.1e} of the positions at a node with success (status {status.name})"
    if not np.isfinite(np.asarray(run.info.residual)[: max(0, kept - 1)]).all():
        return "not finite: residual of a step with success"
    return status.name


def compute(seed: int, runs: tuple[int, ...]) -> list[str]:
    """The outcomes of runs that are computed together."""
    structure = draws_of(seed, runs[0])[0]
    draws = [draws_of(seed, run)[1] for run in runs]
    draws += draws[-1:] * ((structure.lanes or 1) - len(draws))
    return verdicts(structure, draws)[: len(runs)]


def _work(connection, seed: int, runs: list[int]) -> None:
    """Tell what is computed next, and what came of it."""
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


def silent(_: str) -> None:
    """A `Tell` that prints nothing."""


def fuzz(count: int, seed: int, path: Path, limit: float, tell: Tell = silent) -> dict[int, str]:
    """Outcomes of the runs 0 to count - 1; those that `path` has are not computed again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = path.read_text().splitlines() if path.exists() else []
    found = {entry["run"]: entry["outcome"] for entry in map(json.loads, lines) if entry["run"] < count}
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
    return {run: outcome for run, outcome in sorted(found.items()) if outcome not in HONEST}


def table(found: dict[int, str], console: Console) -> None:
    """Print how often each kind of outcome came, and every run that is wrong."""
    number = Counter(map(kind, found.values()))
    counts = Table("outcome", "runs", title=f"{len(found)} runs", title_justify="left", box=None, header_style="bold")
    for name in (*HONEST, *sorted(set(number) - set(HONEST))):
        counts.add_row(name, str(number[name]))
    console.print(counts)
    console.print(f"{len(wrong(found))} ended wrong")
    for run, outcome in wrong(found).items():
        console.print(f"run {run}: {outcome}")


def reduce(seed: int, run: int, tell: Tell = silent) -> tuple[rs.Structure, rs.Draw, str]:
    """The simplest case found that goes wrong as this run does: fields put to their defaults one by one."""
    structure, draw = draws_of(seed, run)

    def outcome(structure, draw):
        return verdicts(structure, [draw] * (structure.lanes or 1))[0]

    wrong = outcome(structure, draw)
    wanted = dataclasses.fields(structure)
    simpler = [(0, f.name, f.default) for f in wanted if f.name not in ("dimension", "slow", "fast")]
    simpler += [(1, f.name, f.default) for f in dataclasses.fields(draw) if f.default is not dataclasses.MISSING]
    points = range(len(draw.positions))
    simple = {"velocities": [0.0 for _ in points], "masses": [1.0 for _ in points], "positions": map(float, points)}
    simpler += [(1, name, tuple(values)) for name, values in simple.items()]
    for which, name, value in simpler:
        case = [structure, draw]
        if getattr(case[which], name) == value:
            continue
        tell(name)
        case[which] = dataclasses.replace(case[which], **{name: value})
        if kind(outcome(*case)) == kind(wrong):
            structure, draw = case
    return structure, draw, outcome(structure, draw)


def main(
    count: Annotated[int, typer.Option(min=1, help="Runs in all; those done before are kept.")] = 2000,
    seed: Annotated[int, typer.Option(help="Other seeds are other systems.")] = 0,
    limit: Annotated[float, typer.Option(help="Seconds after which a run, compiling included, hangs.")] = 600.0,
    reduced: Annotated[
        int | None, typer.Option("--reduce", help="Simplify this run, as long as it goes wrong in the same way.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the outcomes.")] = Path("out/fuzz"),
) -> None:
    """Random systems: how their runs end, and every one that ends wrong."""
    vm.configure()
    console = Console()
    if reduced is not None:
        for part in reduce(seed, reduced, console.log):
            console.print(part)
        return
    with progress_shown() as tell:
        told = itertools.count()
        ended = fuzz(count, seed, out / f"fuzz_{seed}.jsonl", limit, lambda run: tell(run, next(told), count))
    table(ended, console)
    if bad := wrong(ended):
        console.print(f"\nsimplify one with: python -m tests.fuzz --seed {seed} --reduce {min(bad)}")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
