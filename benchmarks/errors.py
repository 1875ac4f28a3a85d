"""Estimated errors of runs over true ones, and their shares over the limits of each grid."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from vmri_jax.accuracy.companions import UncertifiedWarning
from vmri_jax.catalogue import find_problem
from vmri_jax.running.timing import least_seconds
from vmri_jax.schemes.composition import stage_scheme
from vmri_jax.study import reference_solution
from vmri_jax.study.reference_solution import joined

COLUMNS = (
    *("system", "scheme", "num_micro", "order", "steps", "true", "of reference", "estimate / true"),
    *("slow share", "slow limit", "fast share", "fast limit", "time / run"),
)
NODES = 10
"""Saved intervals of every run."""
MANY = 16
"""Micro steps of the limit of the fast share, over those of the run: the rest of the share is below half a percent at order 2."""
FEW = 4
"""Micro steps from which on the slow share has a limit to compare with: single steps of the length of a micro step."""
SCENES = Path(__file__).parent.parent / "notebooks" / "scenes"


@dataclass(frozen=True)
class Case:
    """A run with an estimated error.

    system: "FPU l=3", "TSP", "SAM", or the name of a scene of the gallery.
    t_end: in the units of the system.
    """

    system: str
    t_end: float
    label: str = ""
    scheme: vm.Scheme | vm.Composition | None = None
    num_steps: int = 0

    def problem(self) -> Any:
        """The system with its start."""
        gallery = SCENES / f"{self.system}.py"
        return find_problem(f"{gallery}:scene") if gallery.exists() else programs.problem(self.system)


def sizes(name: str) -> list[Case]:
    """ "quick": FPU and the spinning top; "full": all systems."""
    kicks, midpoint, slow = vm.fully_explicit, vm.fully_implicit, vm.explicit_slow
    table: dict[tuple[str, float], dict[str, tuple[Any, int]]] = {
        ("FPU l=3", 2.0): {
            "fully implicit": (midpoint(5), 200),
            "fully explicit": (kicks(10), 100),
            "explicit slow": (slow(5), 100),
            "takahashi imada": (vm.takahashi_imada(10), 50),
            "galerkin 3": (vm.galerkin(1, 3), 20),
            "suzuki4": (vm.compose(kicks(10), "suzuki4"), 50),
            "kahan-li6": (vm.compose(kicks(5), "kahan-li6"), 50),
            "kahan-li8": (vm.compose(kicks(5), "kahan-li8"), 40),
        },
        ("spinning_top", 1.0): {"fully implicit": (midpoint(1), 200), "galerkin 2": (vm.galerkin(1, 2), 50)},
        ("TSP", 2.0): {
            "fully implicit": (midpoint(5), 200),
            "fully explicit": (kicks(5), 400),
            "explicit slow": (slow(5), 200),
            "galerkin 2": (vm.galerkin(1, 2), 40),
            "suzuki4": (vm.compose(kicks(4), "suzuki4"), 100),
        },
        ("SAM", 2.0): {
            "fully implicit": (midpoint(5), 100),
            "fully explicit": (kicks(5), 100),
            "galerkin 3": (vm.galerkin(1, 3), 40),
            "galerkin 4": (vm.galerkin(2, 4, "lobatto"), 20),
        },
        ("molecule", 1.0): {"fully explicit": (kicks(8), 100), "suzuki4": (vm.compose(kicks(4), "suzuki4"), 50)},
        ("upright_pendulum", 1.0): {"fully implicit": (midpoint(1), 200), "galerkin 3": (vm.galerkin(1, 3), 50)},
        ("engine", 0.02): {"fully implicit": (midpoint(5), 50), "explicit slow": (slow(5), 50)},
    }
    chosen = dict(list(table.items())[:2]) if name == "quick" else table
    return [
        Case(system, t_end, label, scheme, num_steps)
        for (system, t_end), runs in chosen.items()
        for label, (scheme, num_steps) in runs.items()
    ]


def run(cases: list[Case], name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each case."""
    rows = []
    for case in cases:
        tell(f"{case.system}, {case.label}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UncertifiedWarning)
            rows.append(_row(case))
        near = sum(0.5 <= row["estimate / true"] <= 2 for row in rows)
        notes = [f"{near} of {len(rows)} estimates are between 0.5 and 2 of the true error."]
        yield Report("errors", name, rows, [], notes)


def _row(case: Case) -> dict:
    """A run with its estimate, the true error, and the limits of its shares."""
    problem, scheme = case.problem(), case.scheme
    assert scheme is not None
    num_micro = stage_scheme(scheme).num_micro

    def simulated(scheme, parts: int = 1, **more) -> vm.Trajectory:
        step = {"macro_dt": case.t_end / case.num_steps / parts, "num_steps": case.num_steps * parts}
        return vm.simulate(problem, scheme, **step, save=case.num_steps * parts // NODES, **more)

    run = simulated(scheme, error="shares")
    reference = reference_solution(problem, case.t_end, num_saves=NODES)
    true = reference.errors(run)[0]
    row = {
        "system": case.system,
        "scheme": case.label,
        "num_micro": num_micro,
        "order": scheme.order,
        "steps": case.num_steps,
    }
    row |= {"true": true, "of reference": reference.error_q, "estimate / true": run.error.largest / true}
    without_fast = _difference(run, simulated(scheme.with_num_micro(MANY * num_micro)))
    row |= {"slow share": run.error.slow.max(), "fast share": run.error.fast.max(), "fast limit": without_fast}
    if num_micro >= FEW:
        row["slow limit"] = _difference(run, simulated(scheme.with_num_micro(1), num_micro))
    alone, whole = least_seconds([partial(simulated, scheme), partial(simulated, scheme, error=True)], 4)
    return row | {"time / run": whole / alone}


def _difference(a: vm.Trajectory, b: vm.Trajectory) -> float:
    """Largest difference of a position."""
    return float(np.abs(joined(a)[0] - joined(b)[0]).max())
