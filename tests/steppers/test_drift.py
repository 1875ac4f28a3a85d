"""Drift along the constraints: the multipliers alone are solved for, and the step is that of the whole equations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import largest_difference
from tests.user_systems import FULL_MASS, lifted, sphere
from vmri_jax import (
    Method,
    Newton,
    Result,
    Rheonomic,
    State,
    System,
    compose,
    fully_explicit,
    initial_state,
    simulate,
    simulate_batch,
)

DT = 0.002


def phases(problem_or_system, newton, scheme=None, state=None, macro_dt=DT, num_steps=20):
    """(num_steps + 1, 2 n) positions and momenta of a run, and its info."""
    system = getattr(problem_or_system, "system", problem_or_system)
    start = problem_or_system.state() if state is None else state
    run = simulate(system, scheme or fully_explicit(1), start, macro_dt=macro_dt, num_steps=num_steps, newton=newton)
    return np.concatenate([run.q_s, run.q_f, run.p_s, run.p_f], axis=1), run.info


def pull(q_s, q_f, params):
    return params * (q_s[1] + q_f[1]) + jnp.sum(q_s) * jnp.sum(q_f) / 5


def general():
    """Full mass matrices, all kinds of constraints, one of them moved; and a consistent start."""
    system = System(FULL_MASS, pull, constraint=Rheonomic(lifted), slow_constraint=sphere, params=jnp.asarray(3.0))
    return system, initial_state(system, [0.6, 0.8], [0.0, 1.0, 0.6], [0.4, -0.3], [0.2, 0.1, -0.1])


def started(name, request) -> tuple[System, State]:
    """A system and its start."""
    if name == "general":
        return general()
    problem = request.getfixturevalue(name)
    return problem.system, problem.state()


@pytest.mark.parametrize("composed", [False, True])
@pytest.mark.parametrize("name", ["tsp", "sam", "general"])
def test_it_solves_the_equations_of_the_step(name, composed, request):
    system, start = started(name, request)
    scheme = compose(fully_explicit(1), "suzuki4") if composed else fully_explicit(1)
    (found, info), (expected, _) = (phases(system, Newton(method), scheme, start) for method in ("nested", "arrowhead"))
    assert int(info.method.max()) == Method.MARCH
    assert largest_difference(found, expected) / np.abs(expected).max() < 1e-13  # measured 1.4e-14


@pytest.mark.parametrize("tolerance", [1e-3, 1e-9])
@pytest.mark.parametrize("name", ["tsp", "sam"])
def test_what_is_accepted_is_within_the_tolerance(name, tolerance, request):
    problem = request.getfixturevalue(name)
    n = problem.q_s.size + problem.q_f.size
    exact, found = (phases(problem, newton)[0][:, :n] for newton in (Newton("arrowhead"), Newton("nested", tolerance)))
    motion = np.abs(np.diff(exact, axis=0)).max()
    assert largest_difference(found, exact) < tolerance * motion


@pytest.mark.parametrize(("name", "coefficients"), [("sam", "suzuki4"), ("tsp", [1.0, -1.0, 1.0]), ("general", None)])
def test_momenta_are_projected_where_they_are_saved(name, coefficients, request):
    """Between saved nodes they are not, which changes multipliers alone, also where two stages undo each other."""
    system, start = started(name, request)
    scheme = fully_explicit(1) if coefficients is None else compose(fully_explicit(1), coefficients)
    step = {"macro_dt": DT, "num_steps": 24}
    often, rarely = (simulate(system, scheme, start, **step, save_every=k) for k in (1, 8))
    for a, b in zip(
        (often.q_s, often.q_f, often.p_s, often.p_f), (rarely.q_s, rarely.q_f, rarely.p_s, rarely.p_f), strict=True
    ):
        assert largest_difference(a[::8], b) / np.abs(a).max() < 1e-12
    assert np.all(rarely.constraint_residual < 1e-11)
    assert int(rarely.info.method.max()) == Method.MARCH
    assert int(rarely.info.iterations.max()) <= int(often.info.iterations.max()) + 1


def test_one_correction_where_the_motion_is_smooth(tsp):
    _, info = phases(tsp, Newton(), macro_dt=2.5e-4, num_steps=500)
    assert np.asarray(info.iterations).mean() < 1.1  # measured 1.0


def test_where_it_fails_the_whole_equations_are_asked(tsp):
    """A step so long that the rods cannot follow."""
    start = tsp.state()
    fast = dataclasses.replace(start, p_s=40 * start.p_s, p_f=40 * start.p_f)
    step = {"macro_dt": 0.2, "num_steps": 1, "throw": False}
    march, auto = (
        simulate(tsp.system, fully_explicit(1), fast, newton=Newton(method), **step) for method in ("nested", "auto")
    )
    assert Result(int(march.result)) is Result.NON_FINITE
    assert Result(int(auto.result)) is Result.STAGNATED
    assert int(auto.info.method[0]) == Method.ARROWHEAD


def test_fixed_iterations(tsp):
    free, _ = phases(tsp, Newton())
    fixed, info = phases(tsp, Newton(fixed_iterations=4))
    assert np.all(np.asarray(info.iterations) == 4)
    assert largest_difference(free, fixed) < 1e-11
    few = Newton(fixed_iterations=1)
    run = simulate(tsp.system, fully_explicit(1), tsp.state(), macro_dt=0.02, num_steps=5, newton=few, throw=False)
    assert Result(int(run.result)) is Result.STAGNATED


def test_lanes_of_a_batch_are_runs(tsp):
    start = tsp.state()
    scale = np.linspace(0.8, 1.2, 5)
    states = jax.tree.map(lambda a: np.stack([a] * 5), start)
    states = State(states.t, states.q_s, states.q_f, scale[:, None] * states.p_s, scale[:, None] * states.p_f)
    batch = simulate_batch(tsp.system, fully_explicit(1), states, macro_dt=DT, num_steps=20)
    for i in range(5):
        one = simulate(
            tsp.system, fully_explicit(1), jax.tree.map(lambda a, i=i: a[i], states), macro_dt=DT, num_steps=20
        )
        assert largest_difference(one.q_f, batch.q_f[i]) < 1e-13


def test_derivatives_by_parameters():
    system, state = general()

    def end(weight):
        run = simulate(system.replace(params=weight), fully_explicit(1), state, macro_dt=0.05, num_steps=10)
        return jnp.concatenate([run.q_s[-1], run.q_f[-1]])

    eps = 1e-5
    expected = (end(jnp.asarray(3 + eps)) - end(jnp.asarray(3 - eps))) / (2 * eps)
    forward, reverse = jax.jacfwd(end)(jnp.asarray(3.0)), jax.jacrev(end)(jnp.asarray(3.0))
    assert largest_difference(forward, expected) < 1e-8
    assert largest_difference(forward, reverse) < 1e-12
