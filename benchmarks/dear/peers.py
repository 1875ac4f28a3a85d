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
HEYOKA_POWERS = (9, 50)
"""Tolerances 2^-9 to 2^-49: each is compiled anew, half a minute for 16 atoms."""
HEYOKA_ATOMS = 32
"""Atoms up to which heyoka compiles all pairs of them; its expressions of 128 atoms have 8064 pairs and take minutes to compile."""
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


def heyoka(problem: vm.Problem, t_end: float, num_micro: int) -> Runs:
    """Taylor's method of adaptive step and order, compiled for the equations of the molecules."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    n = problem.q_f.size
    q, v = ([hy.expression(f"{name}{i}") for i in range(n)] for name in "qv")
    pulls: list[list] = [[] for _ in range(n)]
    for i in range(0, n, 3):
        for j in range(i + 3, n, 3):
            d = [q[j + a] - q[i + a] for a in range(3)]
            square = hy.sum([x * x for x in d])
            if i % 6 == 0 and j == i + 3:  # a bond
                factor = STIFFNESS * (1.0 - BOND / hy.sqrt(square))
            else:
                cube = square**-3.0
                factor = -24.0 * cube * (2.0 * cube - 1.0) / square
            for a in range(3):
                pulls[i + a].append(factor * d[a])
                pulls[j + a].append(-factor * d[a])
    system = list(zip([*q, *v], [*v, *map(hy.sum, pulls)], strict=True))
    start = np.concatenate([problem.q_f, problem.v_f])

    for power in range(HEYOKA_POWERS[0], HEYOKA_POWERS[1], 8):
        taylor = hy.taylor_adaptive(system, start, tol=2.0**-power, compact_mode=True)

        def run(taylor=taylor) -> np.ndarray:
            taylor.time = 0.0
            taylor.state[:] = start
            taylor.propagate_until(t_end)
            return taylor.state[:n].copy()

        yield power, run


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


PEERS = {"diffrax Dopri8": diffrax, "OpenMM": openmm, "heyoka": heyoka, "C loop": c_loop}
FIXED_STEPS = ("OpenMM", "C loop")
"""Peers with macro steps, of as many micro steps as our kicks need least time with."""


def chosen(problem: vm.Problem) -> tuple[list[str], list[str]]:
    """Peers that can run a problem here, and notes on the others."""
    are_molecules = getattr(problem.system.fast_potential, "function", None) is bonds
    ready = {
        "diffrax Dopri8": find_spec("diffrax") is not None,
        "OpenMM": find_spec("openmm") is not None,
        "heyoka": find_spec("heyoka") is not None,
        "C loop": c_loops.compiler() is not None,
    }
    stated = ["diffrax Dopri8", *(("OpenMM", "C loop") if are_molecules else ())]
    if are_molecules and problem.q_f.size <= 3 * HEYOKA_ATOMS:
        stated.append("heyoka")
    missing = [f"{name} is not installed and left out." for name in stated if not ready[name]]
    return [name for name in stated if ready[name]], missing
