"""The check of a recommended setting by runs from another start, which the search has not seen.

At one start the error of a run may be small by chance, as where its leading term changes sign near t_end.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from vmri_jax.mechanics.projection import legendre, project_momentum
from vmri_jax.mechanics.state import Problem, State
from vmri_jax.steppers.solvers import Newton
from vmri_jax.study.program import Program
from vmri_jax.study.reference_solution import ReferenceSolution
from vmri_jax.study.search import TIMED_RUNS, Setting
from vmri_jax.study.work import work_row

RELATIVE_VELOCITY_CHANGE = 0.01
"""Standard deviation of the change of velocities over the largest velocity. The motion is another one with the same time scales; a
larger change may lead to a motion of another kind, with another error."""
MAX_ERROR_RATIO = 2.0
"""Ratio of the error from the other start to the error in the search above which the setting was good by chance; a larger
ratio accepts more such settings."""
MAX_CHECKS = 4
"""Settings that are checked, the fastest first, until one passes; each costs a compilation."""


@dataclass(frozen=True)
class Verification:
    """A run from another start: its error and time, and the ratio of the error to the error in the search."""

    error_q: float
    seconds: float
    error_ratio: float


def another_start(problem: Problem, speed: float) -> Problem:
    """The problem with velocities that differ by about a hundredth and satisfy its constraints, moving ones included.

    Random numbers are added to the velocities; the momenta of the sums are projected onto the hidden constraints
    ``G v + dg/dt = 0``. `speed` is the mean speed of the run: the size of velocities where the run starts at rest.
    """
    system, state, random = problem.system, problem.state(), np.random.default_rng(1)
    velocities = problem.v_s, problem.v_f
    size = RELATIVE_VELOCITY_CHANGE * max(speed, *(float(np.abs(v).max(initial=0.0)) for v in velocities))
    changed = [np.asarray(v) + size * random.normal(size=np.shape(v)) for v in velocities]
    momenta = legendre(system, state.q_s, state.q_f, *changed)
    *_, v_s, v_f = jax.jit(project_momentum)(system, State(state.t, state.q_s, state.q_f, *momenta), velocities)
    return replace(problem, q_s=state.q_s, q_f=state.q_f, v_s=v_s, v_f=v_f, project=False)


def first_verified(
    settings: Sequence[Setting], problem: Problem, reference: ReferenceSolution, t_end: float, solver: Newton | None
) -> tuple[Setting, Verification]:
    """The first setting whose error is not small by chance, the fastest one first; the very first setting if all are."""
    checks: list[Verification] = []
    for setting in settings[:MAX_CHECKS]:
        program = Program(problem, setting.scheme, t_end, reference.num_saves, solver)
        seconds = program.seconds(setting.num_steps, TIMED_RUNS)
        row = work_row(setting.row.scheme, program, setting.num_steps, reference).timed(seconds)
        # a search in which nothing moves has errors of exactly 0
        error_ratio = row.error_q / setting.row.error_q if setting.row.error_q else 1.0
        checks.append(Verification(row.error_q, row.seconds, error_ratio))
        if checks[-1].error_ratio <= MAX_ERROR_RATIO:
            return setting, checks[-1]
    return settings[0], checks[0]
