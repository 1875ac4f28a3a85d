"""Motion between the saved nodes: exact where it should be, of its order elsewhere, and never beyond a failure."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.animation.support import PENDULUM, swinging, trajectory
from vmri_jax.animation import Drawing, motion
from vmri_jax.scene import Body, Scene, Spring

LINE = Drawing.from_dict(
    {"bodies": [{"name": "a", "coordinates": [["s", 0]]}, {"name": "b", "coordinates": [["f", 0]]}]}
)
MASS = 3.0


def harmonic(q_s, q_f, params):
    return 0.5 * MASS * jnp.sum(q_s**2)


def stiff(q_f, params):
    return 0.5 * 16.0 * jnp.sum(q_f**2)


OSCILLATORS = vm.System(vm.ConstantMass([MASS], [1.0]), harmonic, stiff)


def oscillating(count: int, **fields) -> vm.Trajectory:
    """``q_s = sin t`` of mass 3 and ``q_f = sin 4 t`` of mass 1 on [0, 2]."""
    t = np.linspace(0.0, 2.0, count)
    q_s, q_f, p_s, p_f = (a[:, None] for a in (np.sin(t), np.sin(4 * t), MASS * np.cos(t), 4 * np.cos(4 * t)))
    return trajectory(t, q_s, q_f, p_s, p_f, energy=np.full(count, MASS / 2 + 8.0), **fields)


def error(count: int, system) -> float:
    """Largest error of both bodies between the nodes."""
    times = np.linspace(0.0, 2.0, 777)
    seen = motion(oscillating(count), LINE, system).at(times)[..., 0]
    return float(np.abs(seen - np.stack([np.sin(times), np.sin(4 * times)], axis=1)).max())


@pytest.mark.parametrize(("system", "order"), [(OSCILLATORS, 4), (None, 3)])
def test_order_between_nodes(system, order):
    errors = [error(count, system) for count in (41, 81)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)  # measured 4.0 and 2.9


def test_nodes_are_met_and_times_beyond_the_ends_are_held():
    run = swinging()
    moved = motion(run, Drawing.from_dict(PENDULUM))
    np.testing.assert_allclose(moved.at(run.t)[:, 0, [0, 2]], run.q_s, atol=1e-14)
    np.testing.assert_allclose(moved.at([-1.0, 99.0]), moved.points[[0, -1]], atol=1e-14)
    assert np.abs(moved.energy).max() == pytest.approx(5e-4, rel=1e-2)
    assert moved.relative


def test_scenes_and_problems_stand_for_their_drawings():
    scene = Scene([Body("bob", 1.0, [1.0, 0.0])], [Spring(("bob", ("ground", [0.0, 0.0])), 10.0)])
    run = vm.simulate(scene, vm.fully_implicit(1), macro_dt=0.01, num_steps=2)
    drawing = Drawing.from_dict(scene.drawing())
    for shown in (scene, scene.problem(), scene.drawing(), drawing):
        assert motion(run, shown).drawing.bodies == drawing.bodies
    unseen = dataclasses.replace(scene.problem(), drawing=None)
    assert [body.name for body in motion(run, unseen).drawing.bodies] == ["bob x", "bob y"]
    with pytest.raises(TypeError, match="drawing is int; give the scene or the problem of the run, or a Drawing"):
        motion(run, 3)  # pyright: ignore[reportArgumentType]


def test_micro_nodes_are_nodes_where_the_run_kept_all_of_them():
    coarse, micro = oscillating(11), np.linspace(0.0, 2.0, 101)[1:].reshape(10, 10)
    fields = {"t_micro": micro, "q_f_micro": np.sin(4 * micro)[..., None]}
    fine = motion(oscillating(11, **fields), LINE, OSCILLATORS)
    np.testing.assert_allclose(fine.t[1:], micro.reshape(-1))
    times = np.linspace(0.0, 2.0, 777)
    assert np.abs(fine.at(times)[:, 1, 0] - np.sin(4 * times)).max() < 3e-4  # measured 1.1e-4; from macro nodes 1e-3
    assert np.abs(fine.at(times)[:, 0, 0] - np.sin(times)).max() < 1e-5
    last_steps_only = {"t_micro": micro[:, -2:], "q_f_micro": np.sin(4 * micro[:, -2:])[..., None]}
    assert len(motion(oscillating(11, **last_steps_only), LINE).t) == len(coarse.t)
    backwards = {"t_micro": micro[:, ::-1], "q_f_micro": np.sin(4 * micro[:, ::-1])[..., None]}
    assert len(motion(oscillating(11, **backwards), LINE).t) == len(coarse.t)


def test_a_failed_run_is_drawn_up_to_its_failure():
    run = swinging()
    broken = np.where(np.arange(41) < 25, 1.0, np.nan)
    fields = {name: getattr(run, name) * broken[:, None] for name in ("q_s", "q_f", "p_s", "p_f")}
    failed = run.with_arrays(**fields, energy=run.energy * broken, result=4, failed_at=24)
    moved = motion(failed, Drawing.from_dict(PENDULUM))
    assert len(moved.t) == 25
    assert np.isfinite(moved.points).all()
    assert np.isfinite(moved.velocities).all()
    assert moved.ending == "The run failed in macro step 24, after t = 2.4 (NON_FINITE); it is drawn up to there."
    nothing = failed.with_arrays(q_s=np.full_like(run.q_s, np.nan))
    with pytest.raises(ValueError, match="no node with finite positions"):
        motion(nothing, Drawing.from_dict(PENDULUM))


def test_wrong_systems_and_batches_are_refused():
    run = oscillating(11)
    heavier = OSCILLATORS.replace(kinetic=vm.ConstantMass([2 * MASS], [1.0]))
    with pytest.raises(ValueError, match=r"of the system is 8\.75 where the energy of the run is 9\.5"):
        motion(run, LINE, heavier)
    larger = vm.System(vm.ConstantMass([1.0, 1.0, 1.0], [1.0]), harmonic, stiff)
    with pytest.raises(ValueError, match="the run has 2 slow and 1 fast coordinates"):
        motion(run.with_arrays(q_s=np.ones((11, 2)), p_s=np.ones((11, 2))), LINE, larger)
    batch = run.with_arrays(t=np.ones((5, 11)))
    with pytest.raises(ValueError, match=r"batch of shape \(5,\)"):
        motion(batch, LINE)


def test_thinning_keeps_both_ends_and_the_largest_values_left_out():
    run = swinging(1001)
    moved = motion(run, Drawing.from_dict(PENDULUM))
    peak = np.zeros_like(moved.energy)
    peak[503] = -7.0
    thin = dataclasses.replace(moved, energy=peak).thinned(100)
    assert 90 < len(thin.t) <= 102
    assert (thin.t[0], thin.t[-1]) == (0.0, 4.0)
    assert thin.energy.min() == -7.0
    np.testing.assert_allclose(thin.at([1.234]), moved.at([1.234]), atol=1e-5)
    assert moved.thinned(5000) is moved


def test_between_keeps_the_nodes_around():
    moved = motion(swinging(), Drawing.from_dict(PENDULUM))
    part = moved.between(1.05, 2.0)
    np.testing.assert_allclose(part.t, moved.t[10:21])
    assert moved.between().t.size == 41
    for start, end in ((2.0, 1.0), (-1.0, 2.0), (1.0, 9.0)):
        with pytest.raises(ValueError, match="no part of the run, which goes from t = 0 to 4"):
            moved.between(start, end)
