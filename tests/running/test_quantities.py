"""Velocities, multipliers, reaction forces and work of a run, by name, against formulas and independent integrals."""

import copy
import pickle
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pandas
import pytest

import vmri_jax as vm
from tests.support import until_failure
from tests.user_systems import GRAVITY, LENGTH, MASS, drag, hanging_weight, own_rod, swinging_rod
from vmri_jax.plots.runs import _moduli
from vmri_jax.running.origin import _at_all
from vmri_jax.scene import Anchor, Body, Gravity, LinearDamping, RigidLink, Scene, Spring


def pendulum(**changes) -> vm.Problem:
    arguments = {"fast_potential": hanging_weight, "constraint": own_rod} | changes
    system = vm.System(vm.ConstantMass([], [MASS, MASS]), **arguments)
    names = vm.Names(fast={"bob": 2}, constraint={"rod": 1})
    return vm.Problem(system, [], [LENGTH, 0.0], [], [0.0, 0.0], names=names, project=True)


@pytest.fixture(scope="module")
def swing():
    scheme = vm.fully_explicit(10)
    return vm.simulate(pendulum(), scheme, macro_dt=0.05, num_steps=40, save=vm.Save(micro=True))


@pytest.fixture(scope="module")
def hanging():
    hook, load = Body("hook", 50.0, [0.0, -1.0]), Body("load", 1.0, [0.4, -1.3])
    bodies = [hook, load, Body("bell", 1.0, [0.4, -2.3], [0.0, 3.0])]
    effects = [Gravity(), Anchor("hook", [0.0, 0.0]), RigidLink(("hook", "load")), Spring(("load", "bell"), 4e4, 1.0)]
    return Scene(bodies, [*effects, LinearDamping(0.5, bodies=["bell"])])


@pytest.fixture(scope="module")
def hanging_run(hanging):
    return vm.simulate(hanging, vm.fully_implicit(40), macro_dt=0.02, num_steps=50, save=vm.Save(micro=True))


def test_velocities_are_those_of_the_momenta(swing):
    assert np.allclose(swing.v_f, swing.p_f / MASS, rtol=1e-14)
    assert swing.v_s.shape == (41, 0)
    assert np.array_equal(swing.velocity("bob"), swing.v_f)
    assert np.array_equal(swing.position("bob"), swing.q_f)
    with pytest.raises(ValueError, match=r"there is no body 'bop'. Did you mean bob\? There are bob"):
        swing.position("bop")
    with pytest.raises(ValueError, match=r"reaction_forces: there is no constraint 'rods'. Did you mean rod\?"):
        swing.reaction_forces("rods")
    with pytest.raises(ValueError, match=r"micro is 'rod'; it must be True or False"):
        swing.multipliers("rod")


@pytest.mark.parametrize("micro", [False, True])
def test_the_tension_of_a_pendulum(swing, micro):
    """``m (v^2 - g y) / L`` along the rod; from the height alone, since the energy is kept."""
    y = (swing.q_f_micro if micro else swing.q_f)[..., 1]
    speed_squared = -2 * GRAVITY * y  # released at y = 0
    tension = MASS * (speed_squared - GRAVITY * y) / LENGTH
    force = swing.reaction_forces("rod", micro=micro)["bob"]
    assert force.shape == (*y.shape, 2)
    assert np.allclose(np.linalg.norm(force, axis=-1), tension, atol=2e-3 * tension.max())  # measured 4e-4
    (multiplier,) = swing.multipliers(micro=micro).values()
    assert np.allclose(multiplier[..., 0] * LENGTH, tension, atol=2e-3 * tension.max())


def test_micro_nodes_must_be_there(swing):
    with pytest.raises(ValueError, match="some macro steps only; simulate with save"):
        swing[::2].multipliers(micro=True)
    back = swing.micro._replace(t=swing.micro.t[:, ::-1])  # as of a composition
    with pytest.raises(ValueError, match=r"the stages of its composition go back in time"):
        replace(swing, micro=back).multipliers(micro=True)
    with pytest.raises(ValueError, match="kept none; simulate with save"):
        replace(swing, micro=None).reaction_forces("rod", micro=True)


def test_work_accounts_for_the_energy():
    problem = pendulum(constraint=vm.Rheonomic(swinging_rod), force=drag)
    run = vm.simulate(problem, vm.fully_implicit(4), macro_dt=0.01, num_steps=300)
    assert run.constraint_residual.max() < 1e-11
    work = run.work()
    assert np.abs(work.forces).max() > 0.5
    assert np.abs(work.constraints).max() > 0.5
    assert np.abs(work.balance).max() < 1e-3 * np.abs(run.energy - run.energy[0]).max()  # measured 2e-4
    assert work.uncertainty < 1e-2


def test_work_at_nodes_that_are_too_far_apart_is_uncertain(hanging_run):
    """The bell vibrates at 283 rad/s: what its damper takes is not seen at every 50th of a second, but at micro
    nodes."""
    coarse = replace(hanging_run, micro=None).work()
    fine = hanging_run.work()
    assert fine.uncertainty < coarse.uncertainty / 20
    assert np.abs(fine.balance).max() < np.abs(coarse.balance).max() / 5


def test_a_scene_gives_its_names(hanging_run):
    run = hanging_run
    assert run.names.slow_coordinates == ["hook x", "hook y"]
    assert run.names.fast_coordinates == ["load x", "load y", "bell x", "bell y"]
    assert run.position("bell").shape == (51, 2)
    forces = run.reaction_forces("links")
    assert set(forces) == {"hook", "load"}
    assert np.allclose(forces["hook"], -forces["load"], atol=1e-9)  # what a link does to one end it does to the other
    programs = _at_all.cache_info().misses
    assert set(run.reaction_forces("anchors")) == {"hook"}
    assert _at_all.cache_info().misses == programs  # which constraint is asked for is no part of the program


def test_reaction_forces_are_drawn_by_constraint(hanging_run):
    """A curve of the largest modulus over the bodies; a batch is refused."""
    (axes,) = hanging_run.plot_forces("hanging").axes
    curves = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert axes.get_ylabel() == "reaction force\nN in SI units"
    assert set(curves) == {"links", "anchors"}
    pull = np.linalg.norm(hanging_run.reaction_forces("links")["load"], axis=1)
    np.testing.assert_allclose(curves["links"], pull, rtol=1e-12)
    with pytest.raises(ValueError, match=r"this is a batch of runs; take one of them, run.lane\(i\)"):
        jax.tree.map(lambda a: np.asarray(a)[None], hanging_run).plot_forces()


def test_torques_on_rigid_bodies_have_a_panel_of_their_own():
    """A force f at the point d_1 of the body: f on the centre, and on the director; and a torque on an angle."""
    force = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
    run = SimpleNamespace(
        names=SimpleNamespace(rigid=["hub"], numbered=["wheel"], angles=["wheel"]),
        position=lambda body: np.array([[5.0, 5.0, 5.0, 1.0, 0.0, 0.0]] * 2),
        reaction_forces=lambda: {
            "pin": {"hub": np.concatenate([force, force], axis=1)},
            "gear": {"wheel": np.array([[-4.0], [4.0]])},
            "rigid hub": {"hub": np.array([[0.0, 0.0, 0.0, 7.0, 0.0, 0.0]] * 2)},  # along the director
        },
    )
    panels = {label.partition("\n")[0]: curves for label, curves in _moduli(run).items()}
    assert {name: list(curves) for name, curves in panels.items()} == {
        "reaction force": ["pin"],
        "torque about centres": ["pin"],
        "torque on angles": ["gear"],
    }
    np.testing.assert_allclose(panels["torque about centres"]["pin"], [2.0, 3.0])


def test_a_system_without_names(swing):
    run = swing.of(vm.Problem(pendulum().system, [], [LENGTH, 0.0]))
    assert run.names.fast_coordinates == ["q_f[0]", "q_f[1]"]
    assert np.array_equal(run.position("q_f"), run.q_f)
    assert list(run.multipliers()) == ["constraint"]
    assert list(run.reaction_forces("constraint")) == ["q_f"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"fast": {"bob": 3}}, r"fast is {'bob': 3}, which names 3; the system has 2"),
        ({"constraint": {"rod": 1, "rope": 1}}, r"constraint is .*, which names 2; the system has 1"),
        ({"fast": ["bob"]}, r"Names: fast is \['bob'\]; give a dictionary of names and sizes"),
        ({"slow": {"bob": 1}, "fast": {"bob": 1}}, r"bob in slow and in fast"),
    ],
)
def test_names_that_do_not_add_up(names, message):
    with pytest.raises(vm.Refused, match=message):
        vm.Problem(pendulum().system, [], [LENGTH, 0.0], [], [0.0, 0.0], names=vm.Names(**names))


def weighed(q_s, q_f, v_s, v_f, params):
    return params["m"] / 2 * v_f @ v_f


def test_a_batch_with_its_own_parameters():
    system = vm.System(weighed, fast_potential=spring, params={"k": 100.0, "m": 2.0})
    state = vm.initial_state(system, [], [0.1, 0.0], [], [0.0, 1.0])
    states = jax.tree.map(lambda a: np.stack([a, a]), state)
    params = {"k": np.array([100.0, 200.0]), "m": np.array([2.0, 5.0])}
    runs = vm.simulate_batch(system, vm.fully_implicit(1), states, macro_dt=0.01, num_steps=10, params=params)
    assert len(runs) == 11
    assert runs[-1].q_f.shape == (2, 2)
    assert runs[2:5].q_f.shape == (2, 3, 2)
    assert np.allclose(runs.v_f, runs.p_f / params["m"][:, None, None], rtol=1e-12)
    assert np.allclose(runs.lane(1).v_f, runs.v_f[1], rtol=1e-14)
    assert runs.to_xarray().sizes["lane"] == 2
    with pytest.raises(ValueError, match=r"this is a batch of runs; take one of them"):
        runs.columns()
    of_time = vm.Problem(system, [], [0.1, 0.0], names=vm.Names(fast={"t": 1, "x": 1}))
    with pytest.raises(ValueError, match=r"columns: t would be the name of two columns\. Give the body"):
        runs.lane(0).of(of_time).columns()


def spring(q_f, params):
    return params["k"] / 2 * q_f @ q_f


WEIGHED = vm.Problem(vm.System(weighed, params={"m": 2.0}), [], [0.0], [], [1.0])
HOW = {"scheme": vm.fully_implicit(1), "macro_dt": 0.1, "num_steps": 2, "solver": vm.Solver("masses")}


def test_transformations_keep_the_origin(swing):
    v_f = np.asarray(swing.v_f)
    for other in (jax.device_put(swing), jax.jit(lambda run: run)(swing), copy.deepcopy(swing)):
        assert np.array_equal(other.v_f, v_f)
        assert other.names.fast_coordinates == ["bob x", "bob y"]
    both = jax.tree.map(lambda *a: np.stack(a), swing, swing)
    assert np.array_equal(both.v_f, np.stack([v_f, v_f]))
    assert np.array_equal(jax.tree.map(lambda a: a[1], both).multipliers()["rod"], swing.multipliers()["rod"])


def test_multipliers_are_traced(swing):
    """As a quantity of a store or a derivative needs them; the splines through micro nodes are not."""
    traced = jax.jit(lambda run: run.multipliers()["rod"])(swing)
    assert np.allclose(traced, swing.multipliers()["rod"], rtol=1e-12)
    with pytest.raises(ValueError, match=r"reaction_forces: the run.*run.multipliers\(\), of saved nodes, can"):
        jax.eval_shape(lambda run: run.reaction_forces(), swing)
    with pytest.raises(ValueError, match="multipliers: the run is traced"):
        jax.eval_shape(lambda run: run.multipliers(micro=True), swing)


def test_lanes_of_vmap_have_their_parameters():
    def run(m):
        return vm.simulate(replace(WEIGHED, system=WEIGHED.system.replace(params={"m": m})), **HOW)

    lanes = jax.jit(jax.vmap(run))(np.array([1.0, 4.0]))
    assert np.allclose(lanes.v_f, 1.0)
    for second in (lanes.lane(1), jax.tree.map(lambda a: np.asarray(a)[1], lanes)):
        assert np.allclose(second.p_f, 4.0)
        assert np.allclose(second.v_f, 1.0)


def test_pickles_keep_the_origin_where_python_can():
    run = vm.simulate(WEIGHED, **HOW)
    assert np.array_equal(pickle.loads(pickle.dumps(run)).v_f, run.v_f)
    local = replace(WEIGHED, system=WEIGHED.system.replace(kinetic=lambda *arguments: weighed(*arguments)))
    run = pickle.loads(pickle.dumps(vm.simulate(local, **HOW)))
    with pytest.raises(ValueError, match=r"does not know its system.*run.of\(problem\)"):
        run.v_f  # noqa: B018
    assert np.allclose(run.of(local).v_f, 1.0)
    with pytest.raises(ValueError, match=r"of: the run has 0 slow and 1 fast coordinates. ConstantMass: slow is for 3"):
        run.of(vm.systems.fermi_pasta_ulam())


def test_prepared_runs_know_their_parameters():
    """A run of a problem keeps the velocities of its start, as `simulate` of the problem with these parameters does; a
    run of a state the momenta."""
    run, of_state = vm.prepare(WEIGHED, **HOW), vm.prepare(WEIGHED.system, state=WEIGHED.state(), **HOW)
    heavier = run(params={"m": 4.0})
    assert np.allclose(heavier.v_f, 1.0)
    assert np.allclose(heavier.p_f, 4.0)
    assert np.allclose(run().v_f, 1.0)
    assert np.allclose(of_state(params={"m": 4.0}).v_f, 0.5)


def test_files_carry_names(swing, tmp_path):
    swing.save(tmp_path / "run.npz")
    read = vm.Trajectory.load(tmp_path / "run.npz")
    assert np.array_equal(read.position("bob"), swing.position("bob"))
    assert np.load(tmp_path / "run.npz")["fast_names"].tolist() == ["bob x", "bob y"]
    with pytest.raises(ValueError, match=r"read from a file"):
        read.multipliers()
    assert np.array_equal(read.of(pendulum()).multipliers()["rod"], swing.multipliers()["rod"])
    swing.to_csv(tmp_path / "run.csv")
    swing.to_parquet(tmp_path / "run.parquet")
    for table in (pandas.read_csv(tmp_path / "run.csv"), pandas.read_parquet(tmp_path / "run.parquet")):
        assert list(table) == list(swing.columns())
        assert {"t", "bob x", "v bob y", "p bob x", "energy"} <= set(table)
        assert np.array_equal(table["bob x"], swing.q_f[:, 0])
    assert np.array_equal(swing.to_pandas()["v bob y"], np.asarray(swing.v_f)[:, 1])
    data = swing.to_xarray()
    assert np.array_equal(data["q_f"].sel(fast="bob y"), swing.q_f[:, 1])
    with pytest.raises(ValueError, match=r"run.npz is not a stored run but a file; .* is read by Trajectory.load"):
        vm.StoredTrajectory(tmp_path / "run.npz")


def test_a_streamed_run_is_the_same(swing, tmp_path):
    how = {"macro_dt": 0.05, "num_steps": 40, "save": vm.Save(micro=True)}
    stored = vm.stream(pendulum(), vm.fully_explicit(10), out=tmp_path / "run.zarr", **how)
    assert np.array_equal(stored.multipliers()["rod"], swing.multipliers()["rod"])
    read = vm.StoredTrajectory(tmp_path / "run.zarr")
    assert np.array_equal(read.position("bob"), swing.q_f)
    assert np.array_equal(read.of(pendulum())[5:].v_f, np.asarray(swing.v_f)[5:])
    assert list(read.columns()) == [name for name in swing.columns() if not name.startswith("v ")]
    with pytest.raises(ValueError, match=r"run.zarr is a folder; .* opened by StoredTrajectory"):
        vm.Trajectory.load(tmp_path / "run.zarr")


def test_parts_of_a_run_that_failed():
    """Before its failure nothing failed."""
    scheme = vm.fully_explicit(1, 0.5)
    system = vm.System(vm.ConstantMass([], [1.0]), fast_potential=lambda q_f, params: 50.0 * q_f[0] ** 4)
    problem = vm.Problem(system, [], [1.0], [], [0.0])
    run = until_failure(problem, scheme, macro_dt=1.0, num_steps=20)
    assert not run.success
    last = int(np.flatnonzero(np.isfinite(run.energy))[-1])
    assert run[: last + 1].success
    assert not run[: last + 2].success
    assert np.isfinite(run[: last + 1].v_f).all()
    assert np.isnan(run.v_f[last + 1 :]).all()


@pytest.mark.parametrize("name", ["fermi_pasta_ulam", "triple_spherical_pendulum", "simple_atomic_model"])
def test_the_systems_of_the_study_have_names(name):
    problem = getattr(vm.systems, name)()
    names = problem.names.of(problem.system, problem.q_s.size, problem.q_f.size)
    assert names.to_dict() == problem.names.to_dict() | {"numbered": names.numbered}  # nothing was left to be named
    assert len(names.slow_coordinates) == problem.q_s.size


def test_general_coordinates_are_numbered():
    scene = Scene([Body("modes", 1.0, [0.1, 0.2, 0.3], block=True), Body("one", 1.0, [0.0])])
    assert scene.names.slow_coordinates == ["modes[0]", "modes[1]", "modes[2]", "one"]


def test_a_scene_where_a_system_is_needed(hanging):
    with pytest.raises(TypeError, match=r"Problem: system is Scene; give a vmri_jax.System"):
        vm.Problem(hanging, [], [], [], [])
    with pytest.raises(TypeError, match=r"macro_step: system is Scene"):
        vm.macro_step(hanging, vm.fully_implicit(1), hanging.state(), 0.1)
