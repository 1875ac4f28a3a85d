"""vmap over starts, parameters and step sizes equals the loop, and a bad lane disturbs no other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import PROBLEMS, largest_difference
from vmri_jax import Result, explicit_slow, fully_implicit, initial_state, simulate

LANES = 64


@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt"), [("fpu", fully_implicit(3), 0.05), ("tsp", explicit_slow(3), 0.02)]
)
def test_a_batch_of_starts_equals_the_loop(name, scheme, macro_dt):
    problem = PROBLEMS[name]()
    rng = np.random.default_rng(5)
    v_s = problem.v_s + 0.3 * rng.normal(size=(LANES, problem.v_s.size))
    v_f = problem.v_f + 0.3 * rng.normal(size=(LANES, problem.v_f.size))

    def make(v_s, v_f):
        return initial_state(problem.system, problem.q_s, problem.q_f, v_s, v_f)

    states = jax.jit(jax.vmap(make))(v_s, v_f)

    def go(state):
        return simulate(problem.system, scheme, state, macro_dt=macro_dt, num_steps=20, save_every=5)

    batch = jax.jit(jax.vmap(go))(states)
    assert batch.q_f.shape == (LANES, 5, problem.q_f.size)
    assert bool(jnp.all(batch.success))
    worst = 0.0
    for lane in range(LANES):
        single = go(jax.tree.map(lambda a, lane=lane: a[lane], states))
        for field in ("q_s", "q_f", "p_s", "p_f"):
            a, b = np.asarray(getattr(batch, field)[lane]), np.asarray(getattr(single, field))
            worst = max(worst, largest_difference(a, b) / np.abs(b).max())
        assert np.abs(np.asarray(batch.info.iterations[lane] - single.info.iterations)).max() <= 1  # at the tolerance
    assert worst < 3e-13  # measured 3.7e-14


def test_batches_over_params_and_step_sizes(fpu):
    omegas, steps = jnp.linspace(20.0, 80.0, 4), jnp.linspace(0.01, 0.04, 4)
    state = fpu.state()

    def go(omega, macro_dt):
        system = fpu.system.replace(params={"omega": omega})
        return simulate(system, fully_implicit(3), state, macro_dt=macro_dt, num_steps=10, save_every=5)

    batch = jax.jit(jax.vmap(go))(omegas, steps)
    for i in range(4):
        single = go(omegas[i], steps[i])
        assert largest_difference(batch.q_f[i], single.q_f) < 1e-12
        assert largest_difference(batch.t[i], single.t) < 1e-15


def test_a_bad_lane_reports_its_failure_and_leaves_the_others_alone(fpu):
    """One start with velocities beyond what a double can square."""
    v_f = jnp.stack([fpu.v_f, fpu.v_f * 1e200, 0.5 * fpu.v_f])

    def go(v_f):
        return simulate(
            fpu.system,
            fully_implicit(3),
            initial_state(fpu.system, fpu.q_s, fpu.q_f, fpu.v_s, v_f),
            macro_dt=0.05,
            num_steps=10,
            save_every=5,
        )

    batch = jax.jit(jax.vmap(go))(v_f)
    assert [bool(s) for s in batch.success] == [True, False, True]
    assert Result(int(batch.result[1])) in (Result.NON_FINITE, Result.DIVERGED, Result.STAGNATED)
    assert int(batch.failed_at[1]) == 0
    assert np.isnan(batch.q_f[1, 1:]).all()
    for lane in (0, 2):
        assert largest_difference(batch.q_f[lane], go(v_f[lane]).q_f) < 1e-12
