"""Checks of refusals: single precision, and one bad lane in a batch."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.accuracy.batch import simulate_batch
from vmri_jax.accuracy.simulate import simulate
from vmri_jax.hard_cases.case import Outcome
from vmri_jax.hard_cases.measures import difference, run
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.schemes.scheme import fully_implicit
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solvers import Newton

OVERFLOWING_MOMENTUM = 1e160
"""A momentum whose square, and so its kinetic energy, overflows float64."""


def single_precision(problem: Problem, macro_dt: float = 0.01) -> Outcome:
    """Whether a run with the 64-bit mode off, and a start with positions in float32, are refused with the line that mends them."""
    state = problem.state()
    with jax.enable_x64(False):
        off = _refusal(lambda: simulate(problem.system, fully_implicit(2), state, macro_dt=macro_dt, num_steps=1))
    q_s, q_f = (np.asarray(q, np.float32) for q in (problem.q_s, problem.q_f))
    data = _refusal(lambda: initial_state(problem.system, q_s, q_f, problem.v_s, problem.v_f))
    fix = 'jax.config.update("jax_enable_x64", True)' in off
    cast = "float32" in data and "astype(float)" in data
    return Outcome(
        f"64-bit mode off: {'refused with the line to add' if fix else off or 'accepted'}; float32 positions: "
        f"{'refused with the cast' if cast else data or 'accepted'}",
        fix and cast,
        {"mode_refused": fix, "data_refused": cast},
    )


def _refusal(call) -> str:
    """The message of the ValueError that a call raises; empty if it raises none."""
    try:
        call()
    except ValueError as error:
        return str(error)
    return ""


def bad_lane(
    problem: Problem, scheme, macro_dt, num_steps: int, solver: Newton, *, lanes: int = 256, compared: int = 4
) -> Outcome:
    """A batch whose lanes start at the nodes of a run, one of them with overflowing momenta, compared with single runs of some lanes."""
    bad = lanes // 3
    along = run(problem, scheme, macro_dt, lanes - 1, solver=solver)  # its nodes are consistent with all constraints
    p_s, p_f = (jnp.asarray(p).at[bad].set(OVERFLOWING_MOMENTUM) for p in (along.p_s, along.p_f))
    states = State(along.t, along.q_s, along.q_f, p_s, p_f)
    options = {"macro_dt": macro_dt, "num_steps": num_steps, "save_every": num_steps, "solver": solver}
    batch = simulate_batch(problem.system, scheme, states, **options, warn=False)
    failed = np.flatnonzero(np.asarray(batch.failed_at) >= 0)
    apart = 0.0
    for lane in sorted({*np.linspace(0, lanes - 1, compared, dtype=int), bad - 1, bad + 1} - {bad}):
        state = jax.tree.map(lambda a, lane=lane: a[lane], states)
        single = run(problem, scheme, state=state, **options)
        for name in ("q_s", "q_f"):
            size = max(float(jnp.max(jnp.abs(getattr(single, name)), initial=0.0)), 1e-300)
            apart = max(apart, difference(getattr(batch, name)[lane], getattr(single, name)) / size)
    result = Result(int(batch.result[bad])).name
    return Outcome(
        f"{lanes} lanes: lane {bad} {result}, {len(failed)} failed in all; others within {apart:.0e} of their single runs",
        list(failed) == [bad] and apart < 1e-12,
        {"failed": len(failed), "apart": apart},
    )
