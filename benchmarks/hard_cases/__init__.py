"""Hard cases of this project beside those of `vmri check`: where multirate variational integrators break, and what
counts as a pass."""

import importlib
import inspect
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.measure import prepare
from vmri_jax.cli.right import Full, Numbers, Out, run_and_show
from vmri_jax.hard_cases import Case, Outcome
from vmri_jax.running.trajectory import Trajectory

MODULES = ("resonance", "large_steps", "chains", "long_runs", "encounters")


def hard_case(title: str) -> Callable[..., Case]:
    """Makes a `Case` of ``run(full)``, whose docstring is the set-up, an empty line and the criterion; the catalogue
    numbers it."""

    def made(run: Callable[[bool], Outcome]) -> Case:
        setup, criterion = inspect.cleandoc(run.__doc__ or "").split("\n\n")
        return Case(0, title, setup, criterion, run)

    return made


def iterations(trajectory: Trajectory) -> int:
    """The most iterations of a step."""
    return int(np.max(np.asarray(trajectory.info.iterations)))


def catalogue() -> tuple[Case, ...]:
    """All cases, numbered in the order of their modules, which are imported now: some hold arrays, which start JAX."""
    modules = [importlib.import_module(f"benchmarks.hard_cases.{name}") for name in MODULES]
    cases = [value for module in modules for value in vars(module).values() if isinstance(value, Case)]
    return tuple(replace(case, number=number) for number, case in enumerate(cases, start=1))


def hard(case: Numbers = None, full: Full = False, out: Out = None) -> None:
    """Hard cases: resonances, large and tiny steps, constraints under stress, contact, long runs.

    Ends with code 1 if a criterion is not met.
    """
    prepare()
    run_and_show(catalogue(), case or (), full, out)
