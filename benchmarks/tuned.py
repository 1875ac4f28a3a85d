"""What a run of an accuracy costs over the best setting that the search over all schemes finds for the same error."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.dear.systems import molecules
from benchmarks.measure import Tell, quartiles, ratio, silent
from benchmarks.report import Claim, Report
from vmri_jax.accuracy.companions import UncertifiedWarning
from vmri_jax.accuracy.simulate import AccuracyNotReached
from vmri_jax.mechanics.state import problem_of
from vmri_jax.running.timing import interleaved, stopwatch
from vmri_jax.study import families, reference_solution, tune
from vmri_jax.study.tuning import NothingReached

NODES = 10
"""Saved intervals, at whose ends errors are compared."""
ERRORS = (1e-3, 1e-6)
REPEATS = 5
AT_MOST = 2.0
"""The median of the ratios that is held to."""


@dataclass(frozen=True)
class Case:
    """A system, an error, and the menu of the search.

    menu: families; None for all.
    """

    system: str
    problem: Callable[[], Any]
    t_end: float
    error: float
    menu: tuple[str, ...] | None = None


def sizes(name: str, only: Sequence[str] = ()) -> list[Case]:
    """ "quick": two systems and four families of schemes; "full": eight systems and all families.

    Args:
        name: "quick" or "full".
        only: systems; none for all.
    """

    systems = {
        "FPU l=3": (partial(programs.problem, "FPU l=3"), 2.0),
        "2 molecules": (partial(molecules, 2), 0.3),
        "FPU l=10": (partial(programs.problem, "FPU l=10"), 1.0),
        "TSP": (partial(programs.problem, "TSP"), 1.0),
        "SAM": (partial(programs.problem, "SAM"), 1.0),
        "molecule": (partial(programs.gallery_scene, "molecule"), 1.0),
        "upright_pendulum": (partial(programs.gallery_scene, "upright_pendulum"), 1.0),
        "three_scales": (partial(programs.gallery_scene, "three_scales"), 1.0),
    }
    few = ("fully explicit", "fully explicit, suzuki4", "fully explicit, kahan-li6", "galerkin 4")
    menu = few if name == "quick" else None
    chosen = list(systems)[:2] if name == "quick" else list(systems)
    return [
        Case(system, systems[system][0], systems[system][1], error, menu)
        for system in chosen
        if not only or system in only
        for error in ERRORS
    ]


def run(cases: list[Case], name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each case."""
    report = Report("tuned", name)
    for case in cases:
        tell(f"{case.system}, {case.error:g}")
        try:
            report.rows.append(_row(case))
        except (NothingReached, ValueError) as refused:
            report.note(f"{case.system}, {case.error:g}: {refused}")
        ratios = [row["ratio"] for row in report.rows]
        if ratios:
            words = "time of an accuracy over the search, median of all"
            report.claims[:] = [Claim(words, quartiles(ratios), at_most=AT_MOST)]
        yield report


def _row(case: Case) -> dict:
    """Both runs, timed in turn."""
    problem = problem_of("tuned", case.problem())
    elapsed = stopwatch()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UncertifiedWarning)
        warnings.simplefilter("ignore", AccuracyNotReached)
        settings = vm.simulate(problem, accuracy=case.error, t_end=case.t_end, save=vm.Save(number=NODES)).settings
    seconds = elapsed()
    reference = reference_solution(problem, case.t_end, num_saves=NODES)
    menu = None if case.menu is None else [f for f in families() if f.name in case.menu]
    elapsed = stopwatch()
    best = tune(problem, case.error, case.t_end, menu=menu, num_saves=NODES)
    of_search = elapsed()
    runs = [
        vm.prepare(problem, it.scheme, macro_dt=it.macro_dt, num_steps=it.num_steps, save=it.num_steps // NODES)
        for it in (settings, best)
    ]
    true, true_of_search = (reference.errors(run(throw=False))[0] for run in runs)
    timed = (run.timed() for run in runs)
    samples = interleaved(dict(zip(("ours", "theirs"), timed, strict=True)), REPEATS)
    return {
        "system": case.system,
        "error": case.error,
        "by accuracy": f"{settings.python}, {settings.num_steps} steps",
        "its error": true,
        "ms": 1e3 * float(np.median(samples["ours"])),
        "by search": f"{best.setting.scheme}, {best.num_steps} steps",
        "error there": true_of_search,
        "ms there": 1e3 * float(np.median(samples["theirs"])),
        "ratio": ratio(samples["ours"], samples["theirs"]).value,
        "seconds": seconds,
        "of search": of_search,
    }
