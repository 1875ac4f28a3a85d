"""Other programs on the same problems: what each can state, and its runs from coarse to fine."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks import c_loops
from benchmarks.dear.systems import BOND, STIFFNESS, bonds
from benchmarks.peers import autodiff
from benchmarks.peers.cases import Case

Runs = Iterator[tuple[int, Callable[[], np.ndarray]]]
"""Number of macro steps, or -log2 of the tolerance, and a function that gives the positions at the end."""
FIRST_STEPS, MOST_STEPS = 16, 2**20
"""Macro steps of the first and the longest run of programs with fixed steps."""
LARGEST_POWER = 43
"""Bound of the powers: tolerances stay above ``2^-43``, about 1e-13. Below, round-off of float64 lets errors fall no further."""
STRIDE = 3
"""Step from one power to the next, so that each tolerance is an eighth of the one before; a larger step leaves a coarser staircase."""


def diffrax(problem: vm.Problem, t_end: float, num_micro: int) -> Runs:
    """Dopri8 with adaptive steps and tolerances ``2^-power``, equations by automatic differentiation of the same potentials."""
    import diffrax  # pyright: ignore[reportMissingImports]

    from benchmarks.peers.diffrax import solution

    case = Case("", "", problem, t_end, problem.q_f)
    solve, start = jax.jit(solution(case, diffrax.Dopri8(), autodiff)), (jnp.asarray(case.q), jnp.asarray(case.v))
    for power in range(7, LARGEST_POWER, STRIDE):
        yield power, lambda tolerance=2.0**-power: np.asarray(solve(start, tolerance))


def openmm(problem: vm.Problem, t_end: float, num_micro: int) -> Runs:
    """Its r-RESPA integrator in doubles on the Reference platform: all pairs at macro nodes, bonds at micro nodes."""
    import openmm as mm  # pyright: ignore[reportMissingImports]

    n = problem.q_f.size // 3
    system, stiff, soft = mm.System(), mm.HarmonicBondForce(), mm.NonbondedForce()
    soft.setNonbondedMethod(mm.NonbondedForce.NoCutoff)
    for _ in range(n):
        system.addParticle(1.0)
        soft.addParticle(0.0, 1.0, 1.0)  # charge, diameter, depth
    for i in range(0, n, 2):
        stiff.addBond(i, i + 1, BOND, STIFFNESS)
        soft.addException(i, i + 1, 0.0, 1.0, 0.0)
    for group, force in enumerate((soft, stiff)):
        force.setForceGroup(group)
        system.addForce(force)
    integrator = mm.MTSIntegrator(1e-3, [(0, 1), (1, num_micro)])
    context = mm.Context(system, integrator, mm.Platform.getPlatformByName("Reference"))
    x, v = (np.asarray(a, dtype=float).reshape(-1, 3) for a in (problem.q_f, problem.v_f))

    def run(num_steps: int) -> np.ndarray:
        integrator.setStepSize(t_end / num_steps)
        context.setPositions(x)
        context.setVelocities(v)
        integrator.step(num_steps)
        return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value).reshape(-1)

    return _doubled(run)


def c_loop(problem: vm.Problem, t_end: float, num_micro: int) -> Runs:
    """The impulse method by hand."""

    def run(num_steps: int) -> np.ndarray:
        return c_loops.molecules(problem, BOND, STIFFNESS, num_micro, t_end / num_steps / num_micro, num_steps)()[1]

    return _doubled(run)


def _doubled(run: Callable[[int], np.ndarray]) -> Runs:
    num_steps = FIRST_STEPS
    while num_steps <= MOST_STEPS:
        yield num_steps, lambda n=num_steps: run(n)
        num_steps *= 2


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
