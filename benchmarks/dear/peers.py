"""Other programs on the same problems: what each can state, and its ladder of settings."""

from collections.abc import Callable
from importlib.util import find_spec

import numpy as np

import vmri_jax as vm
from benchmarks import c_loops
from benchmarks.dear.systems import BOND, STIFFNESS, bonds
from benchmarks.peers import autodiff
from benchmarks.peers.cases import Case, Ladder, doubled_steps

FIRST_STEPS, COUNTS = 16, 17
"""Macro steps of the first run of programs with fixed steps, and numbers of runs: up to 2^20 steps."""


def diffrax(problem: vm.Problem, t_end: float, num_micro: int) -> Ladder:
    """Dopri8 with adaptive steps, equations by automatic differentiation of the same potentials."""
    from benchmarks.peers import diffrax

    return diffrax.ladders(Case("", "", problem, t_end, problem.q_f), autodiff)[0]


def openmm(problem: vm.Problem, t_end: float, num_micro: int) -> Ladder:
    """Its r-RESPA integrator in doubles on the Reference platform: all pairs at macro nodes, bonds at micro nodes."""
    import openmm as mm  # pyright: ignore[reportMissingImports]

    from benchmarks.peers.openmm import FAST, SLOW, add_forces, context_of, end_of

    system, stiff, soft = mm.System(), mm.HarmonicBondForce(), mm.NonbondedForce()
    soft.setNonbondedMethod(mm.NonbondedForce.NoCutoff)
    for i in range(problem.q_f.size // 3):
        system.addParticle(1.0)
        soft.addParticle(0.0, 1.0, 1.0)  # charge, diameter, depth
        if i % 2:
            stiff.addBond(i - 1, i, BOND, STIFFNESS)
            soft.addException(i - 1, i, 0.0, 1.0, 0.0)
    add_forces(system, {soft: SLOW, stiff: FAST})
    context = context_of(system, num_micro)
    x, v = (np.asarray(a, dtype=float).reshape(-1, 3) for a in (problem.q_f, problem.v_f))
    return _doubled(lambda num_steps: end_of(context, x, v, t_end, num_steps).reshape(-1))


def c_loop(problem: vm.Problem, t_end: float, num_micro: int) -> Ladder:
    """The impulse method by hand."""

    def run(num_steps: int) -> np.ndarray:
        return c_loops.molecules(problem, BOND, STIFFNESS, num_micro, t_end / num_steps / num_micro, num_steps)()[1]

    return _doubled(run)


def _doubled(run: Callable[[int], np.ndarray]) -> Ladder:
    return doubled_steps("", FIRST_STEPS, COUNTS, lambda num_steps: lambda: run(num_steps))


PEERS = {"diffrax Dopri8": diffrax, "OpenMM": openmm, "C loop": c_loop}
FIXED_STEPS = ("OpenMM", "C loop")
"""Peers with macro steps, of as many micro steps as our kicks need least time with."""


def chosen(problem: vm.Problem) -> tuple[list[str], list[str]]:
    """Peers that can run a problem here, and notes on the others."""
    are_molecules = getattr(problem.system.fast_potential, "function", None) is bonds
    ready = {
        "diffrax Dopri8": find_spec("diffrax") is not None,
        "OpenMM": find_spec("openmm") is not None,
        "C loop": c_loops.compiler() is not None,
    }
    stated = ["diffrax Dopri8", *(("OpenMM", "C loop") if are_molecules else ())]
    missing = [f"{name} is not installed and left out." for name in stated if not ready[name]]
    return [name for name in stated if ready[name]], missing
