"""The programs that are timed: the built-in systems under the schemes of the reference study."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks.worker import Case
from vmri_jax.catalogue import imported
from vmri_jax.scene import Scene

SCHEMES: dict[str, Callable[[int], vm.Scheme]] = {
    "fully implicit": vm.fully_implicit,
    "explicit slow": vm.explicit_slow,
    "fully explicit": vm.fully_explicit,
}
GALLERY = Path(__file__).parents[1] / "notebooks" / "scenes"
TRUTH = Path(__file__).parent.parent / "tests" / "data" / "ground_truth"
FILES = {"FPU l=3": "fpu3", "FPU l=200": "fpu200", "TSP": "tsp", "SAM": "sam"}


def problem(name: str) -> vm.Problem:
    """``"TSP"``, ``"SAM"``, or the chain with a number of springs, ``"FPU l=50"``."""
    return Case("", name).problem()


def gallery_scene(name: str) -> Scene:
    """The scene in a file of the gallery."""
    return imported(f"{GALLERY / name}.py:scene")


def ground_truth(system: str, t_end: str) -> Path:
    """File of a solution of high precision."""
    return TRUTH / f"{FILES[system]}_t{t_end}.npz"


def masses(problem: vm.Problem) -> np.ndarray:
    """(n,) masses per coordinate, slow ones first."""
    kinetic: Any = problem.system.kinetic
    return np.concatenate([kinetic.slow, kinetic.fast])


def program(problem: vm.Problem, scheme: vm.Scheme | vm.Composition, macro_dt, solver: vm.Solver | None = None):
    """``run(num_steps)``, a prepared run that saves the last node only, NaN if it fails."""
    start = problem.state()
    prepared = vm.prepare(problem.system, scheme, start, macro_dt=macro_dt, num_steps=1, solver=solver)
    return lambda num_steps, **other: prepared(num_steps=num_steps, **other, throw=False)
