"""The C loops of this repository: r-RESPA for the chain, RATTLE for the pendulum and the model."""

from functools import partial

import numpy as np

from benchmarks import c_loops
from benchmarks.peers import equations
from benchmarks.peers.cases import Case, Ladder, steps_ladder
from benchmarks.peers.jax_loops import NUM_MICRO


def ladders(case: Case) -> list[Ladder]:
    """Numbers of macro steps."""
    if c_loops.compiler() is None:
        raise c_loops.NoCompiler("there is no C compiler (cc, gcc or clang) on the PATH")

    def ladder(name: str, loop) -> Ladder:
        def build(num_steps: int):
            program = loop(case.t_end / num_steps, num_steps)
            return lambda: np.concatenate(program()[:2])

        return steps_ladder(case, name, build)

    if case.is_chain:
        respa = c_loops.fpu
        return [ladder(f"r-RESPA {n}", lambda dt, steps, n=n: respa(case.problem, n, dt / n, steps)) for n in NUM_MICRO]
    rattle = {"TSP": c_loops.tsp, "SAM": c_loops.sam}[case.system]
    return [ladder("RATTLE", partial(rattle, case.problem))]


energy = equations.energy
