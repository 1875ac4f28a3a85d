"""vmri_jax itself: every scheme as a prepared run, compiled once for all numbers of steps."""

from functools import cache

import numpy as np

import vmri_jax as vm
from benchmarks import programs
from benchmarks.peers.cases import Case, Ladder, step_counts, tolerances
from vmri_jax.schemes.composition import stage_scheme

COMPOSED = {"kahan-li8": (1, 2, 4), "kahan-li6": (1, 2, 4), "suzuki4": (1, 2, 4, 8)}
"""Compositions of `vm.fully_explicit` that are tried, with numbers of micro steps; the finest first."""
EXPLICIT = (4, 8, 16)
"""Numbers of micro steps of `vm.fully_explicit` on its own."""
CORRECTED = (1, 2, 4, 8)
"""Numbers of micro steps of `vm.takahashi_imada`."""
LOBATTO = (4, 5, 6, 8, 11, 12, 16)
"""Degrees of `vm.galerkin` with one interval to a step, where there are constraints."""
LOOSE = (1e-2, 1e-4, 1e-6)
"""Newton tolerances for moderate errors, where there are constraints; equations are also solved to round-off."""
LOOSE_HIGH = tuple(tolerances(1e-3, 1e-10))
"""The same for high degrees, whose steps are long: tolerances are relative to the motion."""
TOLERANCE = vm.Solver().tolerance


def first_solver(problem: vm.Problem, scheme: vm.Scheme | vm.Composition, tolerance: float) -> vm.Solver:
    """As `vm.simulate` starts a run. What it does not solve fails here, and is not solved again in another way."""
    return vm.plan(problem, scheme, solver=vm.Solver(tolerance=tolerance)).first


def schemes(case: Case) -> dict[str, vm.Scheme | vm.Composition]:
    """Those that are the fastest somewhere on these problems, or close to it."""
    explicit = vm.fully_explicit
    by_name: dict[str, vm.Scheme | vm.Composition] = {
        f"explicit {n}, {name}": vm.compose(explicit(n), name) for name, micro in COMPOSED.items() for n in micro
    }
    if not case.is_chain:
        by_name |= {f"Lobatto {degree}": vm.galerkin(1, degree, "lobatto") for degree in LOBATTO}
    by_name |= {f"explicit {n}": explicit(n) for n in EXPLICIT}
    return by_name | {f"Takahashi-Imada {n}": vm.takahashi_imada(n) for n in CORRECTED}


def loose(case: Case, scheme: vm.Scheme | vm.Composition) -> tuple[float, ...]:
    """Newton tolerances that are tried besides round-off."""
    if case.is_chain:
        return ()
    return LOOSE_HIGH if stage_scheme(scheme).degree > 1 else LOOSE


def ladders(case: Case) -> list[Ladder]:
    """One per scheme and tolerance of Newton's iteration: numbers of macro steps of a prepared run."""

    def ladder(name: str, scheme, tolerance: float) -> Ladder:
        @cache
        def prepared():
            solver = first_solver(case.problem, scheme, tolerance)
            return programs.program(case.problem, scheme, case.t_end, solver)

        def build(num_steps: int):
            simulate, macro_dt = prepared(), case.t_end / num_steps

            return lambda: last_positions(simulate(num_steps, macro_dt=macro_dt))

        return Ladder(name, "steps", step_counts(max(2, 2 * case.t_end), 1e6 * case.t_end), build)

    tried = []
    for name, scheme in schemes(case).items():
        tried.append(ladder(name, scheme, TOLERANCE))
        tried += [ladder(f"{name}, tolerance {tol:.1e}", scheme, tol) for tol in loose(case, scheme)]
    return tried


def last_positions(run: vm.Trajectory) -> np.ndarray:
    """At the end, slow ones first."""
    return np.concatenate([run.q_s[-1], run.q_f[-1]])


def energy(case: Case) -> float:
    """Of the start."""
    return case.energy
