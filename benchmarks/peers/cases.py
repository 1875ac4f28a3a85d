"""The problems that all integrators are given, and what an integrator hands over to be compared."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.peers.mechanics import Particles

LEVELS = (1e-2, 2e-4, 2e-6, 1e-8)
"""Largest errors ``max |q - q_ref|`` at the end that are asked for."""
NAMES = ("FPU l=3 t=1", "FPU l=3 t=100", "FPU l=200 t=1", "TSP t=1", "TSP t=10", "SAM t=1", "SAM t=10")


class NotRepresentable(ValueError):
    """A peer has no means to state this problem exactly; the message says which one it lacks."""


@dataclass(frozen=True)
class Case:
    """Integrate `problem` to `t_end`; q_end (n,) are positions there of a far better solution, slow ones first."""

    name: str
    system: str
    problem: vm.Problem
    t_end: float
    q_end: np.ndarray

    @cached_property
    def state(self) -> vm.State:
        """The start, velocities consistent with the constraints."""
        return self.problem.state()

    @cached_property
    def masses(self) -> np.ndarray:
        """(n,) masses per coordinate, slow ones first."""
        return programs.masses(self.problem)

    @cached_property
    def q(self) -> np.ndarray:
        """(n,) positions at the start."""
        return np.concatenate([self.state.q_s, self.state.q_f])

    @cached_property
    def v(self) -> np.ndarray:
        """(n,) velocities at the start."""
        return np.concatenate([self.state.p_s, self.state.p_f]) / self.masses

    @cached_property
    def energy(self) -> float:
        """Energy of the start as this project evaluates it."""
        s = self.state
        return float(vm.diagnostics.energy(self.problem.system, s.q_s, s.q_f, s.p_s, s.p_f))

    @property
    def is_chain(self) -> bool:
        """Whether it is a Fermi-Pasta-Ulam chain; else it is made of `particles`."""
        return self.system.startswith("FPU")

    @property
    def omega(self) -> float:
        """Frequency of the stiff springs of a chain."""
        return float(self.problem.system.params["omega"])

    @cached_property
    def particles(self) -> Particles:
        """Masses, springs and rods of a system of particles."""
        return Particles.of(self.problem)

    def error(self, q) -> float:
        """``max |q - q_end|``, no number for a run that failed."""
        return float(np.max(np.abs(np.asarray(q) - self.q_end)))


def case(name: str) -> Case:
    """One of `NAMES`."""
    if name not in NAMES:
        raise ValueError(f"case: there is no {name!r}; there are {', '.join(NAMES)}.")
    system, _, t_end = name.rpartition(" t=")
    with np.load(programs.ground_truth(system, t_end)) as file:
        q_end = file["q"][-1]
    return Case(name, system, programs.problem(system), float(t_end), q_end)


@dataclass(frozen=True)
class Ladder:
    """One method of one integrator, from coarse to fine settings.

    kind: what a setting is, "tol" or "steps".
    build: makes what is made once; what it returns gives the positions at the end, slow ones first.
    """

    method: str
    kind: str
    settings: Sequence[float]
    build: Callable[[Any], Callable[[], Any]]

    def label(self, setting: float) -> str:
        """Method and setting."""
        return f"{self.method}, {setting:.1e}" if self.kind == "tol" else f"{self.method}, {setting:g} steps"

    def between(self, a: float, b: float) -> float:
        """The setting between two, the geometric mean."""
        middle = float(np.sqrt(a * b))
        return middle if self.kind == "tol" else round(middle)


def steps_ladder(case: Case, method: str, build: Callable[[int], Callable[[], Any]], first: float = 4.0) -> Ladder:
    """From `first` steps per unit of time up to 1e7."""
    return Ladder(method, "steps", step_counts(first * case.t_end, 1e7 * case.t_end), build)


def doubled_steps(method: str, first: int, count: int, build: Callable[[int], Callable[[], Any]]) -> Ladder:
    """`count` numbers of steps, each twice the one before."""
    return Ladder(method, "steps", [first * 2**k for k in range(count)], build)


def tolerances(first: float, last: float) -> list[float]:
    """Tolerances from `first` down to `last`, two per decade."""
    count = round(2 * np.log10(first / last)) + 1
    return [float(x) for x in np.geomspace(first, last, count)]


def step_counts(first: float, last: float) -> list[int]:
    """Numbers of steps from `first` up to `last`, four per octave."""
    count = round(4 * np.log2(last / first)) + 1
    return sorted({max(1, round(x)) for x in np.geomspace(first, last, count)})
