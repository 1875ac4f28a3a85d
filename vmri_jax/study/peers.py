"""Another program on the same problem: adaptive Runge-Kutta steps of diffrax, if installed, for problems ``q'' = f(q)``."""

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.invariants import potential_energy
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.timing import interleaved
from vmri_jax.study.reference_solution import ReferenceSolution
from vmri_jax.study.staircase import Stair, confirmed, front
from vmri_jax.study.work import SLOWEST, WorkRow

LARGEST_POWER = 43
"""Bound of the powers: tolerances stay above ``2^-43``, about 1e-13. Below, round-off of float64 lets errors fall no further."""
STRIDE = 3
"""Step from one power to the next, so that each tolerance is an eighth of the one before; a larger step leaves a coarser staircase."""
MAX_STEPS = 200_000
"""Steps after which diffrax gives up; a larger number lengthens only runs that are too slow to be compared."""


def can_run_dopri8(problem: Problem) -> bool:
    """Whether diffrax is installed and the system has constant masses, no constraints, and no forces besides potentials."""
    system = problem.system
    plain = isinstance(system.kinetic, ConstantMass) and system.force is None
    return plain and not any(system.num_constraints(problem.q_s, problem.q_f)) and find_spec("diffrax") is not None


def dopri8_runs(problem: Problem, t_end: float, num_saves: int) -> Iterator[tuple[int, Callable[[], np.ndarray]]]:
    """Runs of Dopri8 with smaller and smaller tolerances ``2^-power``: the power, and a function that gives q (num_saves + 1, n), slow first."""
    import diffrax  # pyright: ignore[reportMissingImports]

    system, n_s = problem.system, problem.q_s.size
    mass: Any = system.kinetic
    start = tuple(
        jnp.concatenate([jnp.asarray(a), jnp.asarray(b)])
        for a, b in ((problem.q_s, problem.q_f), (problem.v_s, problem.v_f))
    )
    gradient = jax.grad(lambda q: potential_energy(system, q[:n_s], q[n_s:]))

    def acceleration(q):
        force = -gradient(q)
        return jnp.concatenate(mass.velocity(force[:n_s], force[n_s:]))

    term: Any = diffrax.ODETerm(lambda t, y, args: (y[1], acceleration(y[0])))

    @jax.jit
    def solve(tolerance):
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        solution = diffrax.diffeqsolve(
            term,
            diffrax.Dopri8(),
            0.0,
            t_end,
            None,
            start,
            saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, t_end, num_saves + 1)),
            stepsize_controller=controller,
            max_steps=MAX_STEPS,
            throw=False,
        )
        return solution.ys[0]  # pyright: ignore[reportOptionalSubscript]

    for power in range(7, LARGEST_POWER, STRIDE):
        yield power, lambda tolerance=2.0**-power: np.asarray(solve(tolerance))


def dopri8_stairs(problem: Problem, t_end: float, reference: ReferenceSolution, least: float) -> list[Stair]:
    """The staircase of Dopri8: largest confirmed errors of q at the saved nodes and times over falling tolerances.

    Args:
        least: smallest error of interest; tolerances fall until an error is a tenth of it, so that smaller steps confirm it.
    """
    runs, errors = {}, {}
    for power, run in dopri8_runs(problem, t_end, reference.num_saves):
        errors[power] = float(np.abs(run() - reference.q).max())
        runs[str(power)] = run
        if errors[power] < least / 10 or interleaved({"": run}, 1, 0.0)[""][0] > SLOWEST:
            break
    seconds = interleaved(runs, 3)
    rows = [
        # diffrax chooses its steps, so that the row needs a stand-in for their number: it doubles with each tolerance, and
        # each run then confirms the one before
        WorkRow(
            scheme="diffrax Dopri8",
            num_micro=1,
            order=8,
            num_steps=2 ** (power // STRIDE),
            macro_dt=np.nan,
            error_q=error,
            error_p=np.nan,
        ).timed(seconds[str(power)])
        for power, error in errors.items()
    ]
    return front(confirmed(rows))
