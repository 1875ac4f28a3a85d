"""Where micro steps pay: an engine with surging valve springs and a satellite with vibrating booms, error against time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks.measure import Ratio, Tell, silent
from benchmarks.report import Claim, Report
from benchmarks.scenes import gallery_scene
from vmri_jax import plots
from vmri_jax.running.timing import interleaved
from vmri_jax.study.reference_solution import joined

COLUMNS = ("scene", "num_micro", "H", "error", "ms", "saving")
SURGE = 4.0
"""m/s, of the middle of a valve spring."""
EXCITED = 1.05
"""The velocity of the tips of the booms over that of the rigid satellite."""


@dataclass(frozen=True)
class Case:
    """A scene, its scheme, and runs.

    steps: numbers of macro steps by num_micro; fine: those of the run that errors are measured against, of single steps.
    """

    name: str
    problem: Callable[[], vm.Problem]
    t_end: float
    steps: dict[int, tuple[int, ...]]
    fine: int


@dataclass(frozen=True)
class Size:
    """Cases, and samples of a time."""

    cases: tuple[Case, ...]
    repeats: int


def engine() -> vm.Problem:
    """The engine of the gallery, with a surge in its valve spring."""
    problem = gallery_scene("engine").problem()
    v_f = np.array(problem.v_f)
    for k, name in enumerate(_names(problem)):
        if name.startswith("coil") and name.endswith(" z"):
            v_f[k] += SURGE * np.sin(np.pi * int(name.split()[1]) / 5)
    return replace(problem, v_f=v_f)


def satellite() -> vm.Problem:
    """The satellite of the gallery, its booms vibrating along themselves."""
    problem = gallery_scene("satellite").problem()
    v_f = np.array(problem.v_f)
    v_f[[k for k, name in enumerate(_names(problem)) if "tip" in name]] *= EXCITED
    return replace(problem, v_f=v_f)


def _names(problem: vm.Problem) -> list[str]:
    assert problem.names is not None  # of a scene
    return problem.names.fast_coordinates


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    boom = {1: (400, 800, 1600, 3200), 5: (80, 160, 320, 640), 10: (40, 80, 160, 320), 50: (40, 80, 160)}
    booms = Case("satellite", satellite, 2.0, boom, 25600)
    if name == "quick":
        return Size((booms,), 3)
    spring = {1: (100, 200, 400, 800, 1600), 5: (40, 80, 160, 320), 10: (40, 80, 160, 320), 50: (20, 40, 80)}
    return Size((Case("engine", engine, 0.02, spring, 12800), booms), 5)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each scene."""
    rows, claims, notes, curves = [], [], [], {}
    for case in size.cases:
        found = measured(case, size.repeats, tell)
        curves[case.name] = found
        for num_micro, (error, ms) in found.items():
            steps = case.steps[num_micro]
            savings = [ratio_at(found[1], e, t) for e, t in zip(error, ms, strict=True)]
            rows += [
                {"scene": case.name, "num_micro": num_micro, "H": case.t_end / n, "error": e, "ms": t, "saving": s}
                for n, e, t, s in zip(steps, error, ms, savings, strict=True)
            ]
        best = max((row for row in rows if row["scene"] == case.name and row["saving"]), key=lambda row: row["saving"])
        saving = Ratio(best["saving"], best["saving"], best["saving"])
        claims.append(Claim(f"{case.name}: time of single steps over that of num_micro = {best['num_micro']}", saving))
        notes.append(f"{case.name}: {best['saving']:.1f} times as fast at an error of {best['error']:.1e}.")
        draw = partial(_draw, dict(curves))
        yield Report("savings", name, list(rows), list(claims), list(notes), {"savings": draw})


def measured(case: Case, repeats: int, tell: Tell) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Errors of the positions at the end and milliseconds, by num_micro."""
    problem = case.problem()
    tell(f"{case.name}, fine steps")
    length = {"macro_dt": case.t_end / case.fine, "num_steps": case.fine, "save": case.fine}
    exact, _ = joined(vm.simulate(problem, vm.explicit_slow(1), **length))
    errors, calls = {}, {}
    for num_micro, steps in case.steps.items():
        run = vm.prepare(problem, vm.explicit_slow(num_micro), macro_dt=case.t_end, num_steps=1)
        for n in steps:
            tell(f"{case.name}, num_micro = {num_micro}, {n} steps")
            length = {"macro_dt": case.t_end / n, "num_steps": n}
            q, _ = joined(run(**length, throw=False))
            errors[num_micro, n] = float(np.abs(q[-1] - exact[-1]).max())
            calls[f"{num_micro} {n}"] = run.timed(**length)
    seconds = interleaved(calls, repeats)
    return {
        num_micro: (
            np.array([errors[num_micro, n] for n in steps]),
            np.array([1e3 * np.median(seconds[f"{num_micro} {n}"]) for n in steps]),
        )
        for num_micro, steps in case.steps.items()
    }


def ratio_at(single: tuple[np.ndarray, np.ndarray], error: float, ms: float) -> float | None:
    """Time of single steps at this error, between those measured, over `ms`; None outside of them."""
    if not len(single[0]):
        return None
    errors, times = (np.log(part[np.argsort(single[0])]) for part in single)
    if not errors[0] <= np.log(error) <= errors[-1]:
        return None
    return float(np.exp(np.interp(np.log(error), errors, times)) / ms)


def _draw(curves: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]]):
    """Error against time, a panel for each scene."""
    with plots.new_figure(1.0 + 3.4 * len(curves), 3.2, "", plots.LIGHT) as figure:
        for axes, (name, found) in zip(plots.panel_grid(figure, len(curves), len(curves)), curves.items(), strict=True):
            for marker, (num_micro, (error, ms)) in zip(plots.MARKERS, found.items(), strict=False):
                axes.loglog(ms, error, marker=marker, markersize=4, label=f"num_micro = {num_micro}")
            axes.set(title=name, xlabel="ms", ylabel="error of the positions at the end")
        figure.axes[-1].legend()
    return figure
