"""Batches: every lane is the single run, whatever the chunks; failures stay in their lane."""

import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import largest_difference
from vmri_jax import (
    Method,
    Newton,
    Result,
    State,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    simulate,
    simulate_batch,
)


def spread(problem, lanes: int) -> State:
    """States that differ in their velocities."""
    state = problem.state()
    scale = 1 + 0.02 * jnp.arange(lanes)[:, None]
    q_s, q_f = jnp.tile(state.q_s, (lanes, 1)), jnp.tile(state.q_f, (lanes, 1))
    return State(jnp.zeros(lanes), q_s, q_f, scale * state.p_s, scale * state.p_f)


@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt"),
    [("fpu", fully_explicit(5), 0.05), ("fpu", explicit_slow(5), 0.05), ("tsp", fully_implicit(5), 0.005)],
)
@pytest.mark.parametrize("chunk", [None, 2])
def test_lanes_equal_single_runs(name, scheme, macro_dt, chunk, request):
    problem = request.getfixturevalue(name)
    states = spread(problem, 5)
    batch = simulate_batch(problem.system, scheme, states, macro_dt=macro_dt, num_steps=20, save_every=5, chunk=chunk)
    assert batch.q_f.shape == (5, 5, problem.q_f.size)
    assert np.all(np.asarray(batch.result) <= Result.CONVERGED_AT_ROUNDOFF)
    for lane in (0, 4):
        state = jax.tree.map(lambda a, lane=lane: a[lane], states)
        single = simulate(problem.system, scheme, state, macro_dt=macro_dt, num_steps=20, save_every=5)
        assert largest_difference(batch.q_f[lane], single.q_f) < 1e-13  # measured 3e-15
        assert largest_difference(batch.t[lane], single.t) == 0


def test_step_sizes_and_params_per_lane(fpu):
    steps, omegas = jnp.array([0.01, 0.02, 0.03]), jnp.array([30.0, 50.0, 60.0])
    batch = simulate_batch(
        fpu.system, fully_implicit(4), spread(fpu, 3), macro_dt=steps, num_steps=10, params={"omega": omegas}
    )
    for lane in range(3):
        system = fpu.system.replace(params={"omega": omegas[lane]})
        state = jax.tree.map(lambda a, lane=lane: a[lane], spread(fpu, 3))
        single = simulate(system, fully_implicit(4), state, macro_dt=steps[lane], num_steps=10)
        assert largest_difference(batch.p_f[lane], single.p_f) < 1e-12


def test_a_failing_lane_leaves_the_others_alone(fpu):
    states = spread(fpu, 3)
    states = State(states.t, states.q_s.at[1, 0].set(1e200), states.q_f, states.p_s, states.p_f)
    batch = simulate_batch(fpu.system, fully_implicit(4), states, macro_dt=0.02, num_steps=10)
    assert np.asarray(batch.failed_at).tolist() == [-1, 0, -1]
    assert bool(jnp.all(jnp.isnan(batch.q_f[1, 1:])))
    alone = simulate_batch(fpu.system, fully_implicit(4), spread(fpu, 3), macro_dt=0.02, num_steps=10)
    assert largest_difference(batch.q_f[2], alone.q_f[2]) == 0


def test_lanes_that_the_march_does_not_solve_are_solved_exactly(fpu):
    run = simulate_batch(
        fpu.system, fully_implicit(100), spread(fpu, 3), macro_dt=1.0, num_steps=5, newton=Newton(max_iterations=8)
    )
    assert np.all(np.asarray(run.result) <= Result.CONVERGED_AT_ROUNDOFF)
    assert np.any(np.asarray(run.info.method) == Method.ARROWHEAD)


def test_chunks_of_a_batch_do_not_change_it(fpu):
    """Eighteen chunks of two lanes, the last of them half full."""
    states = spread(fpu, 35)
    run = {"macro_dt": 0.02, "num_steps": 12, "save_every": 4}
    whole = simulate_batch(fpu.system, fully_explicit(3), states, **run)
    in_chunks = simulate_batch(fpu.system, fully_explicit(3), states, chunk=2, **run)
    assert in_chunks.q_f.shape == whole.q_f.shape == (35, 4, 3)
    for name in ("q_s", "p_f", "energy"):
        assert largest_difference(getattr(in_chunks, name), getattr(whole, name)) < 1e-13
    assert np.array_equal(in_chunks.failed_at, np.full(35, -1))


def test_one_compilation_for_all_chunks_and_step_sizes(fpu):
    calls = 0

    def counted(q_f, params):
        nonlocal calls
        calls += 1
        return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)

    system = fpu.system.replace(fast_potential=counted)
    simulate_batch(system, fully_explicit(4), spread(fpu, 7), macro_dt=0.02, num_steps=10, chunk=2)
    before = calls
    simulate_batch(system, fully_explicit(4), spread(fpu, 5), macro_dt=0.01, num_steps=20, save_every=2, chunk=2)
    assert calls == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"macro_dt": np.ones(2)}, r"macro_dt has shape \(2,\); give a number, or one for each of the 3 lanes"),
        ({"macro_dt": np.array([0.1, -0.1, 0.1])}, "every macro_dt must be a positive number"),
        ({"num_steps": 0}, "num_steps is 0; it must be an integer of at least 1"),
        ({"devices": 99}, "devices is 99, but JAX has"),
        ({"chunk": 0}, "chunk is 0; it must be an integer of at least 1, or None"),
    ],
)
def test_bad_input_is_refused(fpu, changes, message):
    with pytest.raises(ValueError, match=message):
        simulate_batch(fpu.system, fully_explicit(4), spread(fpu, 3), **({"macro_dt": 0.1, "num_steps": 2} | changes))


def test_states_without_a_batch_axis_are_refused(fpu):
    with pytest.raises(ValueError, match="give t \\(batch,\\) and all others \\(batch, n\\)"):
        simulate_batch(fpu.system, fully_explicit(4), fpu.state(), macro_dt=0.1, num_steps=1)


def test_devices_share_a_batch_and_configure_comes_first():
    """In a process of its own: flags are read when JAX starts."""
    program = """
import numpy as np
import vmri_jax as vm
vm.configure(devices=2)
import jax, jax.numpy as jnp
problem = vm.systems.fermi_pasta_ulam()
states = jax.tree.map(lambda a: a + 1e-3 * jnp.arange(5.0).reshape(5, *[1] * a.ndim), problem.state())
one, two, chunks = (
    vm.simulate_batch(problem.system, vm.fully_implicit(4), states, macro_dt=0.02, num_steps=5, **how)
    for how in ({}, {"devices": 2}, {"devices": 2, "chunk": 1})
)
assert jax.device_count() == 2
assert np.abs(one.q_f - two.q_f).max() < 1e-13 and np.abs(one.q_f - chunks.q_f).max() < 1e-13
try:
    vm.configure(devices=3)
except RuntimeError as error:
    assert "already started" in str(error)
vm.configure(devices=2)  # nothing new: fine
print("same")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.strip() == "same", done.stderr


def test_a_lane_off_the_constraints_has_failed(tsp):
    states = jax.tree.map(lambda a: jnp.stack([a, a]), tsp.state())
    states = eqx.tree_at(lambda s: s.q_f, states, states.q_f.at[1].multiply(1.01))
    march = Newton("nested")  # spares the arrowhead, which would fail too
    run = simulate_batch(tsp.system, fully_implicit(2), states, macro_dt=0.01, num_steps=2, newton=march)
    assert run.result.tolist() == [Result.CONVERGED, Result.CONSTRAINT_VIOLATED]
    assert run.failed_at.tolist() == [-1, 0]
    assert np.isnan(run.q_f[1]).all()
    assert run.constraint_residual[0].max() < 1e-10
