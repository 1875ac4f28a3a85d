"""The C loops of this repository: r-RESPA for the chain, RATTLE for the pendulum and the model."""

import numpy as np

from benchmarks import c_loops
from benchmarks.peers import equations
from benchmarks.peers.cases import Case, Ladder, step_counts

NUM_MICRO = (1, 4, 16)
"""Micro steps per macro step of r-RESPA that are tried."""


def ladders(case: Case) -> list[Ladder]:
    """Numbers of macro steps.

    Raises:
        NoCompiler: there is no C compiler.
    """
    if c_loops.compiler() is None:
        raise c_loops.NoCompiler("there is no C compiler (cc, gcc or clang) on the PATH")

    def ladder(name: str, loop) -> Ladder:
        def build(num_steps: int):
            program = loop(case.t_end / num_steps, num_steps)
            return lambda: np.concatenate(program()[:2])

        return Ladder(name, "steps", step_counts(4 * case.t_end, 1e7 * case.t_end), build)

    if case.is_chain:
        return [
            ladder(f"r-RESPA {n}", lambda dt, steps, n=n: c_loops.fpu(case.problem, n, dt / n, steps))
            for n in NUM_MICRO
        ]
    loop = {"TSP": c_loops.tsp, "SAM": c_loops.sam}[case.system]
    return [ladder("RATTLE", lambda dt, steps: loop(case.problem, dt, steps))]


energy = equations.energy
