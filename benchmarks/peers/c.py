"""The C loops of this repository: r-RESPA for the chain, RATTLE for the pendulum and the model."""

import numpy as np

from benchmarks import c_loops
from benchmarks.peers import equations
from benchmarks.peers.cases import Case, Ladder, steps_ladder

NUM_MICRO = (1, 4, 16)
"""Micro steps per macro step of r-RESPA that are tried."""


def ladders(case: Case) -> list[Ladder]:
    """Numbers of macro steps."""
    if c_loops.compiler() is None:
        raise c_loops.NoCompiler("there is no C compiler (cc, gcc or clang) on the PATH")

    def ladder(name: str, num_micro: int) -> Ladder:
        def build(num_steps: int):
            micro_dt = case.t_end / num_steps / num_micro
            loop = c_loops.c_loop(case.system, case.problem, num_micro, micro_dt, num_steps)
            return lambda: np.concatenate(loop()[:2])

        return steps_ladder(case, name, build)

    if case.is_chain:
        return [ladder(f"r-RESPA {n}", n) for n in NUM_MICRO]
    return [ladder("RATTLE", 1)]


energy = equations.energy
