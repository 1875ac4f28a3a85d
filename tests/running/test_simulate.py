"""simulate: times, saving, resuming, failures, compilation."""

import inspect
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import largest_difference, until_failure
from tests.user_systems import cart
from vmri_jax.running.engine import Cursor
from vmri_jax.scene import Body, Scene, Spring

SCHEME = vm.fully_explicit(3)
H = 0.03


def run(problem, scheme=SCHEME, **changes):
    arguments = {"state": problem.state(), "macro_dt": H, "num_steps": 20, "save": 2} | changes
    return vm.simulate(problem.system, scheme, **arguments)


@pytest.fixture(scope="module")
def every_step(fpu):
    return run(fpu, save=vm.Save(micro=True))


def assert_equal(a, b, tolerance=0.0):
    for name in ("t", "q_s", "q_f", "p_s", "p_f", "energy"):
        assert largest_difference(getattr(a, name), getattr(b, name)) <= tolerance, name


def test_times_are_computed_from_the_step_number(fpu):
    start = fpu.state()
    state = vm.State(np.asarray(0.1), start.q_s, start.q_f, start.p_s, start.p_f)
    trajectory = run(fpu, state=state, num_steps=2000, save=100)
    exact = 0.1 + 100 * np.arange(21) * H
    accumulated = 0.1 + np.concatenate([[0.0], np.cumsum(np.full(2000, H))])[::100]
    assert np.abs(accumulated - exact).max() > 1e-13
    assert np.abs(np.asarray(trajectory.t) - exact).max() < 1.5e-14  # two units of round-off of 60


def test_nodes_of_a_run(fpu, every_step):
    """The first one is the start; micro nodes end where the step ends, and lie at equal distances in time."""
    assert every_step.q_s.shape == every_step.p_f.shape == (21, 3)
    assert every_step.energy.shape == (21,)
    assert every_step.constraint_residual.shape == (21, 2)
    assert every_step.info.iterations.shape == every_step.info.residual.shape == (20,)
    assert every_step.q_f_micro.shape == (20, 3, 3)
    assert every_step.success
    assert int(every_step.failed_at) == -1
    assert run(fpu).q_f_micro is None
    for name in ("q_s", "q_f", "p_s", "p_f"):
        assert np.array_equal(getattr(every_step, name)[0], getattr(fpu.state(), name))
    assert np.array_equal(every_step.q_f_micro[:, -1], every_step.q_f[1:])
    expected = np.asarray(every_step.t)[:-1, None] + H * np.array([1, 2, 3]) / 3
    assert largest_difference(every_step.t_micro, expected) < 1e-15


def test_save_every_keeps_a_part_of_the_same_run(fpu, every_step):
    sparse = run(fpu, save=vm.Save(4, micro=True))
    for name in ("t", "q_s", "q_f", "p_s", "p_f", "energy"):
        assert largest_difference(getattr(sparse, name), getattr(every_step, name)[::4]) < 1e-14
    assert np.allclose(sparse.q_f_micro, every_step.q_f_micro[3::4], rtol=0, atol=1e-14)
    assert np.array_equal(sparse.info.iterations, np.max(np.reshape(every_step.info.iterations, (5, 4)), axis=1))


def test_saved_intervals_by_number(fpu):
    by_number = run(fpu, save=vm.Save(number=10))
    jax.tree.map(np.testing.assert_array_equal, run(fpu), by_number)
    with pytest.raises(ValueError, match="got every = 2 and number = 10; give one"):
        vm.Save(2, number=10)
    assert len(inspect.signature(vm.simulate).parameters) <= 10


def test_a_run_is_a_chain_of_macro_steps(fpu, every_step):
    step = jax.jit(lambda state: vm.macro_step(fpu.system, SCHEME, state, H)[0])
    state = fpu.state()
    for k in range(1, 6):
        state = step(state)
        assert largest_difference(state.q_f, every_step.q_f[k]) < 1e-14
        assert largest_difference(state.p_s, every_step.p_s[k]) < 1e-13
    assert float(state.t) == pytest.approx(float(every_step.t[5]), abs=1e-15)


@pytest.mark.parametrize("macro_dt", [-H, 0.0, np.nan, None, [H, H], "0.1"])
def test_a_macro_step_refuses_what_a_run_refuses(fpu, macro_dt):
    with pytest.raises((ValueError, TypeError), match="macro_dt"):
        vm.macro_step(fpu.system, SCHEME, fpu.state(), macro_dt)
    with pytest.raises((ValueError, TypeError), match="macro_dt"):
        vm.diagnostics.step_condition(fpu, SCHEME, macro_dt=macro_dt)


def test_a_macro_step_refuses_a_state_of_another_system(fpu):
    with pytest.raises(ValueError, match="the state has 1 slow ones"):
        vm.macro_step(fpu.system, SCHEME, vm.systems.fermi_pasta_ulam(1).state(), H)
    with pytest.raises(TypeError, match="scheme is str; give a Scheme"):
        vm.macro_step(fpu.system, "fully-implicit", fpu.state(), H)  # pyright: ignore[reportArgumentType]


def test_progress_changes_nothing(fpu, every_step, capsys):
    assert_equal(run(fpu, save=vm.Save(micro=True, progress=True)), every_step, 1e-14)
    with_progress = run(fpu, save=vm.Save(micro=True, progress=True), num_steps=60)
    without = run(fpu, save=vm.Save(micro=True), num_steps=60)  # two saved nodes per part
    assert_equal(with_progress, without, 1e-13)
    assert np.array_equal(with_progress.info.iterations, without.info.iterations)
    assert np.array_equal(with_progress.t_micro, without.t_micro)


@pytest.mark.parametrize("scheme", [SCHEME, vm.fully_implicit(2)], ids=["explicit", "implicit"])
def test_a_run_is_resumed_from_its_final_state(fpu, scheme):
    whole = run(fpu, scheme)
    first = run(fpu, scheme, num_steps=10)
    second = run(fpu, scheme, num_steps=10, state=first.final_state)
    assert float(second.t[-1]) == pytest.approx(float(whole.t[-1]), abs=1e-14)
    assert largest_difference(second.q_f, whole.q_f[5:]) < 1e-12  # measured 0
    assert largest_difference(second.p_f, whole.p_f[5:]) < 1e-12


def test_jit_of_simulate_is_simulate(fpu):
    inside = jax.jit(lambda state, dt: vm.simulate(fpu.system, SCHEME, state, macro_dt=dt, num_steps=20, save=2))
    assert_equal(inside(fpu.state(), H), run(fpu), 1e-13)


# --- failures ------------------------------------------------------------------------------------------------------
def walled(q_s, q_f, params):
    """A potential that is not a number beyond a wall."""
    return -jnp.sum(jnp.sqrt(1.2 - q_s)) + jnp.sum(q_f**2) / 2


@pytest.fixture(scope="module")
def hits_the_wall(fpu):
    """Runs into the wall at q_s = 1.2 after a few steps at unit velocity from 1."""
    return vm.Problem(fpu.system.replace(slow_potential=walled), fpu.q_s, fpu.q_f, fpu.v_s, fpu.v_f)


def test_failure_is_raised_with_all_there_is_to_know(hits_the_wall):
    with pytest.raises(vm.SimulationError, match=r"macro step \d+ at t = .* failed \(NON_FINITE\)") as caught:
        run(hits_the_wall, vm.fully_explicit(3), save=vm.Save(micro=True))
    error = caught.value
    trajectory, k = error.trajectory, error.step
    assert error.result is vm.Result.NON_FINITE
    assert 2 < k < 10
    assert error.time == pytest.approx(k * H)
    assert int(trajectory.failed_at) == k
    assert int(trajectory.result) == vm.Result.NON_FINITE
    assert not trajectory.success
    for name in ("q_s", "q_f", "p_s", "p_f", "energy"):
        values = np.asarray(getattr(trajectory, name)).reshape(21, -1)
        assert np.isfinite(values[: k + 1]).all()
        assert np.isnan(values[k + 1 :]).all()
    assert np.isfinite(trajectory.q_f_micro[:k]).all()
    assert np.isnan(trajectory.q_f_micro[k:]).all()
    assert np.isfinite(trajectory.t).all()
    assert str(k) in str(error)
    assert ".trajectory has the run up to there" in str(error)
    assert int(failed(hits_the_wall, save=4).failed_at) == k
    parts = failed(hits_the_wall, save=vm.Save(micro=True, progress=True))
    assert int(parts.failed_at) == k
    assert np.array_equal(parts.q_f, trajectory.q_f, equal_nan=True)


def failed(problem, **changes) -> vm.Trajectory:
    with pytest.raises(vm.SimulationError) as caught:
        run(problem, vm.fully_explicit(3), **changes)
    return caught.value.trajectory


def test_too_few_iterations_fail_the_run(fpu):
    with pytest.raises(vm.SimulationError, match=r"step 0 .*STAGNATED.* after 1 Newton") as caught:
        run(fpu, vm.fully_implicit(2), solver=vm.Solver("masses", max_iterations=1))
    assert caught.value.iterations == 1
    assert caught.value.residual > 1e-12


def test_an_unstable_explicit_step_fails_cleanly_and_says_what_to_ask_next(fpu):
    """omega h = 2.1 is beyond the limit 2: it grows until it overflows."""
    with pytest.raises(vm.SimulationError) as caught:
        run(fpu, macro_dt=3 * 2.1 / 50, num_steps=3000, save=300)
    assert caught.value.result is vm.Result.NON_FINITE
    assert np.isnan(caught.value.trajectory.q_f[-1]).all()
    [note] = caught.value.__notes__
    assert "advise(problem, scheme, macro_dt=0.126)" in note
    assert "swapped" in note
    assert run(fpu, macro_dt=3 * 1.9 / 50, num_steps=3000, save=300).success


# --- compilation -----------------------------------------------------------------------------------------------------
CALLS = Counter()


def watched_slow(q_s, q_f, params):
    CALLS.update(["V"])
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2)


def watched_fast(q_f, params):
    CALLS.update(["W"])
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


@pytest.mark.parametrize("make", [vm.explicit_slow, vm.fully_explicit])
def test_sweeps_trace_the_users_functions_once(fpu, make):
    def swept(kappa=25.0, alpha=0.5, macro_dt=0.01, save_every=1):
        params = {"kappa": np.asarray(kappa), "omega": np.asarray(50.0)}
        system = fpu.system.replace(slow_potential=watched_slow, fast_potential=watched_fast, params=params)
        return vm.simulate(
            system, make(2, alpha), fpu.state(), macro_dt=macro_dt, num_steps=4 * save_every, save=save_every
        )

    first = swept()
    CALLS.clear()
    others = [
        swept(kappa=30.0),
        swept(alpha=0.2),
        swept(macro_dt=0.02),
        swept(save_every=5),
        swept(25.0, 1.0, 0.015, 3),
    ]
    assert Counter() == CALLS
    assert all(largest_difference(first.q_f[-1], other.q_f[-1]) > 1e-6 for other in others)


@pytest.mark.parametrize("given", ["problem", "scene", "system"])
def test_a_problem_or_a_scene_is_enough(given, fpu):
    if given == "scene":
        bodies = [Body("heavy", 10.0, 0.0, pace="slow"), Body("light", 1.0, 1.0, pace="fast")]
        moved = Scene(bodies, [Spring(("heavy", "light"), 100.0, 0.5)])
        system, state = moved.system(), moved.state()
    else:
        moved, system, state = fpu, fpu.system, fpu.state()
    start = None
    if given == "system":
        moved, start = system, state
    run = vm.simulate(moved, SCHEME, start, macro_dt=0.05, t_end=0.2)
    expected = vm.simulate(system, SCHEME, state, macro_dt=0.05, num_steps=4)
    assert np.array_equal(run.q_f, expected.q_f)
    assert str(vm.plan(moved, SCHEME, start)) == str(vm.plan(system, SCHEME, state))


def test_ends_of_runs(fpu):
    def until(t_end, **changes):
        return vm.simulate(fpu, vm.fully_implicit(2), **{"macro_dt": 0.1, "t_end": t_end} | changes)

    assert float(until(0.3).t[-1]) == pytest.approx(0.3, abs=1e-15)
    no_whole_number = (
        r"there are 2.5 macro steps of 0.1, no whole number. Take macro_dt = 0.08333333333, or give num_st"
    )
    for arguments, message in (
        ({"t_end": 0.25}, no_whole_number),
        ({"t_end": -1.0}, r"t_end is -1, less than a macro step of 0.1 after the start at 0"),
        ({"t_end": 1.0, "num_steps": 10}, r"got both of num_steps and t_end"),
        ({"t_end": None}, r"got neither of num_steps and t_end"),
    ):
        with pytest.raises(ValueError, match=message):
            until(**arguments)


def test_lengths_of_runs_share_a_program(fpu, request):
    """Six step sizes, all nodes saved, and the companion of an error: one program.

    A node is the same whatever the length of its run.
    """
    compiled = []

    def note(event: str, duration_secs: float, **_: str | int) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    request.addfinalizer(lambda: jax.monitoring.unregister_event_duration_listener(note))
    scheme = vm.fully_implicit(2)
    vm.simulate(fpu, scheme, macro_dt=0.05, num_steps=3)
    jax.jit(lambda x: 2 * x)(1.0)
    assert compiled  # the listener hears
    compiled.clear()
    for num_steps in (10, 20, 40, 80, 160, 320):
        run = vm.simulate(fpu, scheme, macro_dt=1 / num_steps, num_steps=num_steps)
        assert len(run) == num_steps + 1 == len(run.info.iterations) + 1
    assert vm.simulate(fpu, scheme, macro_dt=1 / 320, num_steps=320, error=True).error.is_certified
    assert not compiled
    longest = vm.simulate(fpu, scheme, macro_dt=0.05, num_steps=36)
    for num_steps in (33, 34, 35):
        run = vm.simulate(fpu, scheme, macro_dt=0.05, num_steps=num_steps)
        np.testing.assert_array_equal(run.q_f, longest.q_f[: num_steps + 1])


def test_pieces_of_a_run_make_the_whole(fpu, every_step, hits_the_wall, monkeypatch):
    """Short pieces: the same nodes, to the last bit, with what steps remember of those before, and micro nodes; and
    after a failure in one of them NaN to the end."""
    whole, known = run(fpu, vm.fully_implicit(2), num_steps=36), failed(hits_the_wall, save=vm.Save(micro=True))
    monkeypatch.setattr("vmri_jax.running.simulation.NUMBERS_PER_PIECE", 100)
    jax.tree.map(np.testing.assert_array_equal, whole, run(fpu, vm.fully_implicit(2), num_steps=36))
    jax.tree.map(np.testing.assert_array_equal, every_step, run(fpu, save=vm.Save(micro=True)))
    jax.tree.map(np.testing.assert_array_equal, known, failed(hits_the_wall, save=vm.Save(micro=True)))

    # each piece starts with the saved node at which the one before ends, momenta on the hidden constraints
    constrained = vm.prepare(cart(), vm.fully_explicit(1), macro_dt=0.02, num_steps=8, save=2)
    first, cursor, _ = constrained.advance(Cursor.at_start(constrained.state), 2)
    second, *_ = constrained.advance(cursor, 2)
    for column in ("p_f", "table"):
        np.testing.assert_array_equal(getattr(second.nodes, column)[0], getattr(first.nodes, column)[-1])
    assert second.nodes.table[:, 2].max() < 1e-11


def test_a_single_step_ends_as_a_run_does():
    """Beyond the pole of a logarithm, where forces are numbers and the energy is none."""
    system = vm.System(vm.ConstantMass([], [1.0]), fast_potential=lambda q_f, params: 1e-3 * jnp.log(1.0 - q_f[0]))
    state = vm.initial_state(system, [], [0.9], [], [10.0])
    _, info = vm.macro_step(system, vm.fully_explicit(1), state, 0.1)
    assert info.result == until_failure(system, vm.fully_explicit(1), state, macro_dt=0.1, num_steps=1).result
    assert info.result == vm.Result.NON_FINITE


def springs(q_s, q_f, params):
    return jnp.sum(q_s**2) / 2 + jnp.sum(q_f**2) / 2 + jnp.sum(q_s) * jnp.sum(q_f) / 10


def test_systems_of_the_same_functions_and_other_sizes(monkeypatch):
    """Pieces with room for as many nodes, which are of other sizes."""
    monkeypatch.setattr("vmri_jax.running.simulation.NUMBERS_PER_PIECE", 1)
    for n_s, n_f in ((1, 2), (2, 1), (2, 2), (1, 2)):
        system = vm.System(vm.ConstantMass([1.0] * n_s, [1.0] * n_f), springs, None)
        problem = vm.Problem(system, q_s=[0.1] * n_s, q_f=[0.2] * n_f)
        run = vm.simulate(problem, vm.fully_explicit(2), macro_dt=0.01, num_steps=4, save=vm.Save(micro=True))
        assert (run.q_s.shape, run.q_f.shape, run.q_f_micro.shape) == ((5, n_s), (5, n_f), (4, 2, n_f))
        np.testing.assert_allclose(run.q_s[-1], 0.1, atol=1e-3)
        np.testing.assert_allclose(run.q_f[-1], 0.2, atol=1e-3)
