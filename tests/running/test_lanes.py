"""Lanes of batches: each is the single run, with parameters and steps of its own; failures, chunks, devices, and what
is refused."""

import subprocess
import sys
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.stability.systems import swinging
from tests.support import PROBLEMS, largest_difference, until_failure
from tests.user_systems import cart, two_oscillators


def spread(problem, lanes: int) -> vm.State:
    """States that differ in their velocities."""
    state = problem.state()
    scale = 1 + 0.02 * np.arange(lanes)[:, None]
    q_s, q_f = np.tile(state.q_s, (lanes, 1)), np.tile(state.q_f, (lanes, 1))
    return vm.State(np.zeros(lanes), q_s, q_f, scale * np.asarray(state.p_s), scale * np.asarray(state.p_f))


SYSTEMS = PROBLEMS | {"chain": partial(vm.systems.fermi_pasta_ulam, 1), "pendulum": swinging, "cart": cart}
RUN: dict[str, Any] = {"num_steps": 20, "save": 5}
MARCH = vm.Solver("masses")
"""Without the exact solve behind it, which takes long to compile in a batch."""
SOLVERS = {"nested": MARCH, "drift along constraints": MARCH}
WAYS = {  # system, scheme, macro_dt, largest difference of a lane from its single run
    "kicks": ("chain", vm.fully_explicit(3), 0.05, 1e-13),  # measured 3e-15
    "nested": ("pendulum", vm.fully_implicit(3), 0.05, 1e-13),
    "drift along constraints": ("tsp", vm.fully_explicit(1), 0.002, 1e-13),
    "collocation": ("pendulum", vm.galerkin(1, 2), 0.05, 1e-12),
    "composition": ("chain", vm.compose(vm.fully_explicit(2), "yoshida4"), 0.02, 1e-13),
}


def lane_of(states: vm.State, lane: int) -> vm.State:
    return jax.tree.map(lambda a: a[lane], states)


@cache
def single(way: str, lane: int):
    """The run of one of five lanes."""
    name, scheme, macro_dt, _ = WAYS[way]
    problem = SYSTEMS[name]()
    return vm.simulate(
        problem.system, scheme, lane_of(spread(problem, 5), lane), macro_dt=macro_dt, solver=SOLVERS.get(way), **RUN
    )


LONG = ("collocation", "composition", "kicks")
"""Ways for --full alone: the nested iteration also has decisions that each lane takes for itself, and lanes of kicks
have a test below."""


@pytest.mark.parametrize("way", [pytest.param(way, marks=pytest.mark.full if way in LONG else ()) for way in WAYS])
def test_lanes_equal_single_runs(way):
    name, scheme, macro_dt, bound = WAYS[way]
    problem = SYSTEMS[name]()
    chunk = 2 if way == "nested" else None
    how = {"macro_dt": macro_dt, "chunk": chunk, "solver": SOLVERS.get(way)} | RUN
    batch = vm.simulate_batch(problem.system, scheme, spread(problem, 5), **how)
    assert batch.q_f.shape == (5, 5, problem.q_f.size)
    assert np.all(np.asarray(batch.result) <= vm.Result.CONVERGED_AT_ROUNDOFF)
    for lane in (0, 4):
        assert largest_difference(batch.q_f[lane], single(way, lane).q_f) < bound
        assert largest_difference(batch.t[lane], single(way, lane).t) == 0


STEPS, OMEGAS = np.array([0.01, 0.02, 0.03]), np.array([30.0, 50.0, 60.0])
KICKS = WAYS["kicks"][1]


def batch_of_three(chain, states: vm.State):
    """Each lane with a step size and a stiffness of its own."""
    return vm.simulate_batch(chain.system, KICKS, states, macro_dt=STEPS, params={"omega": OMEGAS}, **RUN)


@pytest.fixture(scope="module")
def chain():
    return SYSTEMS["chain"]()


@pytest.fixture(scope="module")
def three(chain):
    return batch_of_three(chain, spread(chain, 3))


def well(q_f, params):
    return jnp.sum(q_f**4)


def test_lanes_that_start_at_the_nodes_of_a_run_without_slow_coordinates():
    """The empty array of slow positions of a run has other strides than a copy of it."""
    single = vm.Problem(vm.System(vm.ConstantMass([], [1.0]), fast_potential=well), [], [1.0])
    run = vm.simulate(single, vm.fully_explicit(2), macro_dt=0.05, num_steps=6)
    lanes = vm.simulate_batch(single, vm.fully_explicit(2), run.states, macro_dt=0.05, num_steps=2)
    np.testing.assert_allclose(lanes.q_f[:-2, 2], run.q_f[2:], rtol=1e-14)


def test_step_sizes_and_params_per_lane(chain, three):
    for lane in range(3):
        system = chain.system.replace(params={"omega": OMEGAS[lane]})
        state = lane_of(spread(chain, 3), lane)
        alone = vm.simulate(system, KICKS, state, macro_dt=STEPS[lane], **RUN)
        assert largest_difference(three.p_f[lane], alone.p_f) < 1e-12


def test_a_failing_lane_leaves_the_others_alone(chain, three):
    states = spread(chain, 3)
    states.q_s[1, 0] = 1e200
    with pytest.warns(vm.FailedLanesWarning, match=r"1 of 3 lanes failed .* lane 1, at macro step 0 \(NON_FINITE\)"):
        batch = batch_of_three(chain, states)
    assert np.asarray(batch.failed_at).tolist() == [-1, 0, -1]
    assert np.isnan(batch.q_f[1, 1:]).all()
    assert largest_difference(batch.q_f[2], three.q_f[2]) == 0


LANES, BAD = 16, 7


def test_vmap_of_simulate_equals_the_loop():
    """Over starts, step sizes and parameters. One start has velocities beyond what a double can square."""
    problem, scheme, macro_dt, rng = SYSTEMS["cart"](), vm.explicit_slow(2), 0.02, np.random.default_rng(5)
    v_s = np.array(problem.v_s + 0.3 * rng.normal(size=(LANES, problem.v_s.size)))
    v_f = np.array(problem.v_f + 0.3 * rng.normal(size=(LANES, problem.v_f.size)))
    v_f[BAD] *= 1e200
    steps = macro_dt * np.linspace(0.2, 1.0, LANES)
    params = jax.tree.map(lambda stiffness: stiffness * np.linspace(0.4, 1.0, LANES), problem.system.params)

    def go(v_s, v_f, macro_dt, params):
        system = problem.system.replace(params=params)
        state = vm.initial_state(system, problem.q_s, problem.q_f, v_s, v_f, project=True)
        return until_failure(system, scheme, state, macro_dt=macro_dt, solver=MARCH, **RUN)

    batch = jax.device_get(jax.jit(jax.vmap(go))(v_s, v_f, steps, params))
    assert batch.q_f.shape == (LANES, 5, problem.q_f.size)
    assert np.flatnonzero(~np.asarray(batch.success)).tolist() == [BAD]
    assert vm.Result(int(batch.result[BAD])) in (vm.Result.NON_FINITE, vm.Result.DIVERGED, vm.Result.STAGNATED)
    assert int(batch.failed_at[BAD]) == 0
    assert np.isnan(batch.q_f[BAD, 1:]).all()
    worst = 0.0
    for lane in [*range(BAD), *range(BAD + 1, LANES)]:
        alone = go(v_s[lane], v_f[lane], steps[lane], jax.tree.map(lambda a, lane=lane: a[lane], params))
        assert largest_difference(batch.t[lane], alone.t) < 1e-15
        for field in ("q_s", "q_f", "p_s", "p_f"):
            a, b = np.asarray(getattr(batch, field)[lane]), np.asarray(getattr(alone, field))
            worst = max(worst, largest_difference(a, b) / np.abs(b).max())
        assert np.abs(np.asarray(batch.info.iterations[lane] - alone.info.iterations)).max() <= 1  # at the tolerance
    assert worst < 3e-13  # measured 3.7e-14


def test_lanes_that_the_march_does_not_solve_are_solved_exactly():
    """At H = 2 the curvature of V outweighs the mass of the slow variables."""
    problem = two_oscillators(kappa=25.0)
    step = {"macro_dt": 40.0, "num_steps": 3, "solver": vm.Solver(max_iterations=20)}
    run = vm.simulate_batch(problem.system, vm.fully_implicit(20), spread(problem, 3), **step)
    assert np.all(np.asarray(run.result) <= vm.Result.CONVERGED_AT_ROUNDOFF)
    assert np.any(np.asarray(run.info.method) == vm.Method.EXACT)


def test_chunks_of_a_batch_do_not_change_it(fpu):
    """Eighteen chunks of two lanes, the last of them half full; one program serves all chunks and step sizes."""
    calls = 0

    def counted(q_f, params):
        nonlocal calls
        calls += 1
        return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)

    states, system = spread(fpu, 35), fpu.system.replace(fast_potential=counted)
    run = {"macro_dt": 0.02, "num_steps": 12, "save": 4}
    whole = vm.simulate_batch(system, vm.fully_explicit(3), states, **run)
    in_chunks = vm.simulate_batch(system, vm.fully_explicit(3), states, chunk=2, **run)
    assert in_chunks.q_f.shape == whole.q_f.shape == (35, 4, 3)
    for name in ("q_s", "p_f", "energy"):
        assert largest_difference(getattr(in_chunks, name), getattr(whole, name)) < 1e-13
    assert np.array_equal(in_chunks.failed_at, np.full(35, -1))
    before = calls
    vm.simulate_batch(system, vm.fully_explicit(3), spread(fpu, 5), macro_dt=0.01, num_steps=6, save=2, chunk=2)
    assert calls == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"macro_dt": np.ones(2)}, r"states.p_f has 3, macro_dt has 2; give params, states or steps with one value"),
        ({"macro_dt": np.ones((3, 1))}, r"macro_dt has shape \(3, 1\); give \(\) for all lanes"),
        ({"num_steps": None, "t_end": 1.0, "macro_dt": np.array([0.1, 0.2, 0.1])}, "t_end with steps or start times"),
        ({"params": {"omga": [1.0, 2.0, 3.0]}}, "there is no parameter 'omga'. Did you mean omega. There are omega"),
        ({"params": {"omega": np.ones((3, 2))}}, r"params\['omega'\] has shape \(3, 2\); give \(\) for all lanes"),
        ({"macro_dt": np.array([0.1, -0.1, 0.1])}, r"macro_dt is .*; it must be a positive number"),
        ({"num_steps": 0}, "num_steps is 0; it must be an integer of at least 1"),
        ({"devices": 99}, "devices is 99, but JAX has"),
        ({"chunk": 0}, "chunk is 0; it must be an integer of at least 1, or None"),
    ],
)
def test_bad_input_is_refused(fpu, changes, message):
    with pytest.raises(ValueError, match=message):
        vm.simulate_batch(
            fpu.system, vm.fully_explicit(4), spread(fpu, 3), **({"macro_dt": 0.1, "num_steps": 2} | changes)
        )


def test_states_without_a_batch_axis_and_tracers_are_refused(fpu):
    def go(omega):
        params = {"omega": jnp.stack([omega, omega])}
        return vm.simulate_batch(fpu, vm.explicit_slow(5), macro_dt=0.01, num_steps=10, params=params).q_s[-1, -1, 0]

    with pytest.raises(ValueError, match="no argument has an axis of lanes; give params"):
        vm.simulate_batch(fpu.system, vm.fully_explicit(4), fpu.state(), macro_dt=0.1, num_steps=1)
    with pytest.raises(ValueError, match=r"simulate_batch: arguments are tracers; .*jax\.vmap of simulate"):
        jax.grad(go)(50.0)


def test_devices_share_a_batch():
    """In a process of its own: flags are read when JAX starts; `tests/test_configure.py` has settings that come too
    late."""
    program = """
import numpy as np
import vmri_jax as vm
vm.configure(devices=2)
import jax, jax.numpy as jnp
problem = vm.systems.fermi_pasta_ulam(1)
states = jax.tree.map(lambda a: a + 1e-3 * jnp.arange(5.0).reshape(5, *[1] * a.ndim), problem.state())
one, two, chunks = (
    vm.simulate_batch(problem.system, vm.fully_explicit(2), states, macro_dt=0.02, num_steps=5, **how)
    for how in ({}, {"devices": 2}, {"devices": 2, "chunk": 1})
)
assert jax.device_count() == 2
assert np.abs(one.q_f - two.q_f).max() < 1e-13 and np.abs(one.q_f - chunks.q_f).max() < 1e-13
print("same")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.strip() == "same", done.stderr


def test_a_lane_off_the_constraints_has_failed():
    name, scheme, macro_dt, _ = WAYS["drift along constraints"]
    problem = SYSTEMS[name]()
    states = spread(problem, 5)
    states.q_f[1] *= 1.01
    run = vm.simulate_batch(problem.system, scheme, states, macro_dt=macro_dt, solver=MARCH, warn=False, **RUN)
    assert np.flatnonzero(run.result).tolist() == [1]
    assert run.result[1] == vm.Result.CONSTRAINT_VIOLATED
    assert run.failed_at.tolist() == [-1, 0, -1, -1, -1]
    assert np.isnan(run.q_f[1]).all()
    assert run.constraint_residual[0].max() < 1e-10


SWEEP = {"scheme": vm.fully_explicit(3), "macro_dt": 0.02, "t_end": 0.4}


def test_a_sweep_in_one_line(chain):
    """From the problem, with the error of each lane; params whole, for all lanes, are those of the problem."""
    batch = vm.simulate_batch(chain, params={"omega": [30.0, 50.0]}, error=True, **SWEEP)
    assert batch.error.largest.shape == (2,)
    for lane, omega in enumerate((30.0, 50.0)):
        problem = replace(chain, system=chain.system.replace(params={"omega": np.asarray(omega)}))
        alone = vm.simulate(problem, error=True, **SWEEP)
        assert largest_difference(batch.q_f[lane], alone.q_f) < 1e-13  # measured 1e-17
        assert batch.error.largest[lane] == pytest.approx(alone.error.largest, rel=1e-9)
        assert batch.lane(lane).error.is_certified
    assert "positions are wrong by about" in repr(batch)


def length(q_s, q_f, params):
    return jnp.array([(q_f @ q_f - params["rods"]["length"] ** 2) / 2])


def heavy(q_s, q_f, params):
    return params["rods"]["mass"] * params["gravity"][1] * q_f[1]


def rod() -> vm.Problem:
    params = {"rods": {"mass": 2.0, "length": 1.0}, "gravity": np.array([0.0, 9.81])}
    system = vm.System(vm.ConstantMass([], [2.0, 2.0]), heavy, constraint=length, params=params)
    return vm.Problem(system, q_s=[], q_f=[1.0, 0.0], v_f=[0.0, 1.0])


def test_params_nested_partial_and_shared():
    """Momenta of the start fit the constraint of each lane; an array of the shape of the parameter holds for all
    lanes."""
    heavier = {"rods": {"mass": [2.0, 6.0, 2.0]}, "gravity": np.array([0.0, 4.0])}
    batch = vm.simulate_batch(rod(), vm.fully_explicit(1), params=heavier, macro_dt=0.01, num_steps=3)
    assert (np.asarray(batch.failed_at) == -1).all()
    assert largest_difference(batch.q_f[0], batch.q_f[2]) == 0
    assert largest_difference(batch.q_f[0], batch.q_f[1]) > 1e-4
    lanes: Any = batch.origin.simulated
    assert lanes.params["gravity"].shape == (3, 2)
    dots = {"rods.mass": [6.0, 6.0, 6.0], "gravity": heavier["gravity"]}
    with_dots = vm.simulate_batch(rod(), vm.fully_explicit(1), params=dots, macro_dt=0.01, num_steps=3)
    assert largest_difference(with_dots.q_f[0], batch.q_f[1]) == 0
    with pytest.raises(ValueError, match=r"no parameter 'rods.maas'. Did you mean rods.mass. There are gravity"):
        vm.simulate_batch(rod(), vm.fully_explicit(1), params={"rods": {"maas": [1.0]}}, macro_dt=0.01, num_steps=3)


def test_errors_before_a_failure_are_certified_by_the_motion_up_to_it():
    """The second step of the lane fails, and its first one is wrong by a third of it."""
    with pytest.warns(vm.FailedLanesWarning, match="1 of 2 lanes"):
        batch = vm.simulate_batch(rod(), vm.fully_explicit(1), macro_dt=np.array([0.01, 0.55]), num_steps=3, error=True)
    assert np.isfinite(batch.q_f[1, 1]).all()
    assert batch.error.certified_until.tolist() == [0.03, 0.0]
    assert np.nanmax(batch.error.positions) < 1e-4  # measured 1e-5 of the other lane
