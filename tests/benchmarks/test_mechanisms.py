"""Mechanisms: the equations by hand, scenes and other integrators are the same mechanics, and their times are compared
at equal error."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import vmri_jax as vm
from benchmarks import __main__ as command_line
from benchmarks import mechanisms
from benchmarks.mechanisms import cases, compare, plane, scenes

QUICK = ("satellite 1", "engine", "squeezer", "four-bar", "chain 1")
NAMES = [name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in cases.CASES]


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_starts_with_the_energy_of_the_equations_by_hand(name):
    mechanism = cases.CASES[name]()
    by_hand = float(mechanism.kinetic(mechanism.q, mechanism.v) + mechanism.potential(mechanism.poses(mechanism.q)))
    scene = scenes.scene(mechanism, "joint")
    q_s, q_f, v_s, v_f = scene.start
    system = scene.system()
    energy = float(system.kinetic_energy(q_s, q_f, v_s, v_f))  # pyright: ignore[reportCallIssue]
    energy += 0.0 if system.slow_potential is None else float(system.slow_potential(q_s, q_f, system.params))
    energy += 0.0 if system.fast_potential is None else float(system.fast_potential(q_f, system.params))
    assert energy == pytest.approx(by_hand, rel=1e-10, abs=1e-10)  # of springs in hinges, too: at rest at the start


def test_andrews_squeezer_ends_where_it_is_published_to_end():
    squeezer = cases.squeezer()
    expected = squeezer.centres(cases.PUBLISHED)
    assert np.abs(squeezer.end("LSODA") - expected).max() < 1e-10  # m


def test_loops_and_minimal_coordinates_accelerate_alike():
    """The four-bar linkage in three angles with a loop, and in the angle of its crank."""
    minimal = cases.four_bar()
    crank, rod, rocker, apart = 0.3, 1.0, 0.8, jnp.array([1.0, 0.0])

    def poses(q):
        pin, end = plane.turn(q[0], crank, 0.0), apart + plane.turn(q[2], rocker, 0.0)
        half = plane.turn(q[1], rod / 2, 0.0)
        middle = jnp.stack([pin / 2, pin + half, (apart + end) / 2])
        return jnp.concatenate([middle, q[:, None]], axis=1)

    def loops(q):
        return plane.turn(q[0], crank, 0.0) + plane.turn(q[1], rod, 0.0) - apart - plane.turn(q[2], rocker, 0.0)

    q, v = (np.array([part[2] for part in pair]) for pair in zip(*minimal.start.values(), strict=True))
    other = plane.Mechanism("", minimal.bars, minimal.hinges, poses, q, v, 1.0, 1.0, 1, loops=loops, gravity=9.81)
    ours, theirs = jax.jit(other.acceleration)(q, v), jax.jit(minimal.acceleration)(minimal.q, minimal.v)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-10)


def test_a_way_that_cannot_state_a_mechanism_says_so():
    mujoco = pytest.importorskip("benchmarks.mechanisms.mujoco", exc_type=ImportError)
    with pytest.raises(compare.NotRepresentable, match="loops"):
        mujoco.build(cases.four_bar(), "RK4", 1)
    end = mujoco.build(cases.chain(1), "RK4", 200)()
    assert np.abs(end - cases.chain(1).end("DOP853")).max() < 1e-8  # m


def test_command(tmp_path, monkeypatch):
    tiny = compare.Size(("chain 1",), (), (), (1e-2,), 0.05, 1, ("joint", "scipy", "MuJoCo RK4", "Exudyn gen"))
    monkeypatch.setattr(mechanisms, "sizes", lambda *_, **__: tiny)
    monkeypatch.setattr(command_line, "prepare", lambda *_, **__: None)  # the tests have started JAX already
    done = CliRunner().invoke(command_line.app, ["mechanisms", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.exception
    written = json.loads((tmp_path / "mechanisms.json").read_text())
    rows = {row["way"]: row for row in written["rows"]}
    assert rows.keys() >= {"joint, Gauss", "scipy DOP853"}
    assert all(row["error"] <= 1e-2 and row["µs per s"] > 0 for row in rows.values())
    assert min(row["to best"] for row in rows.values()) == pytest.approx(1.0)
    assert (tmp_path / "mechanisms.png").exists()


def test_unknown_mechanisms_are_refused():
    with pytest.raises(ValueError, match="there is no crane"):
        compare.sizes("full", only=("crane",))


@pytest.mark.full
def test_functions_of_angles_run():
    squeezer = cases.squeezer()
    problem = scenes.functions(squeezer)
    run = vm.simulate(problem, vm.galerkin(1, 2), macro_dt=1e-4, num_steps=300)
    assert np.abs(np.asarray(run.q_s[-1]) - cases.PUBLISHED).max() < 3e-6  # 1.0e-6
