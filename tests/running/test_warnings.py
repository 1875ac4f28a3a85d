"""All roads say the same about a run: the grid of roads and of causes, written once."""

import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.running.engine import Cursor, _interval
from vmri_jax.running.origin import _at_all
from vmri_jax.scene import Body, Scene, SpringAnchor

EXPLICIT, MIDPOINT = vm.fully_explicit(1), vm.fully_implicit(1)
MASSES = vm.Solver("masses")
"""Without the exact solve behind it, which takes long to compile where JAX traces a run."""


# --- causes: systems of one structure, so that a road compiles one program for all causes of a structure -------------
def potential(q_f, params):
    """A spring, and a logarithm that is no number for negative q, though its force is: it acts on a point that passes q
    = 0."""
    beyond = jnp.log(jnp.where(params["pole"] > 0.0, q_f[0], 1.0))
    return params["k"] * q_f[0] ** 2 / 2 + 1e-9 * params["pole"] * beyond


def push(t, q_s, q_f, v_s, v_f, params):
    return jnp.zeros(0), params["push"] * jnp.cos(3.0 * t) * jnp.ones(1)


def kinetic(q_s, q_f, v_s, v_f, params):
    return jnp.sum(v_f**2) / 2


def line(q_s, q_f, params):
    return q_f[:1]


def tilted_line(q_s, q_f, params):
    return q_f[:1] + 1e-3 * params["k"] * q_f[1:2]


def in_angles(q_s, q_f, v_s, v_f, params):
    return (v_f[0] ** 2 + jnp.sin(q_f[0]) ** 2 * v_f[1] ** 2) / 2


def weight(q_f, params):
    return -9.81 * params["k"] * jnp.cos(q_f[0])


def problem(masses, W, q, v, k=1.0, **terms) -> vm.Problem:
    params = {"k": np.array(k)} | {name: np.array(terms.pop(name, 0.0)) for name in ("pole", "push")}
    return vm.Problem(vm.System(masses, None, W, params=params, **terms), [], q, [], v)


def of_masses(*masses):
    return vm.ConstantMass([], masses)


def one(masses, q, v, **params) -> vm.Problem:
    return problem(masses, potential, [q], [v], **params)


STIFF = {"q": 0.1, "v": 0.0, "k": 1e4}
PASSES_ZERO = {"q": 0.105, "v": -1.0, "k": 1.0, "pole": 1.0}
DRIVEN: dict[str, Any] = {"q": 0.0, "v": 0.0, "k": 9.0, "push": 1.0, "force": push}
CAUSES = {  # problem, scheme, macro step, steps, outcome
    "lost energy": (one(of_masses(1.0), **STIFF), EXPLICIT, 0.0205, 40, vm.LostEnergyWarning),
    "NaN": (one(of_masses(1.0), **PASSES_ZERO), EXPLICIT, 0.01, 40, vm.Result.NON_FINITE),
    "driven": (one(of_masses(1.0), **DRIVEN), EXPLICIT, 0.05, 400, None),
    "off constraints": (
        problem(of_masses(1.0, 1.0), None, [0.0, 0.0], [0.0, 1.0], constraint=line, implied=tilted_line),
        EXPLICIT,
        0.01,
        40,
        vm.Result.NOT_IMPLIED,
    ),
    # constant masses have no poles
    "pole": (problem(in_angles, weight, [1.0, 0.0], [0.0, 0.001]), MIDPOINT, 0.002, 400, vm.SingularCoordinatesWarning),
    "lost energy, T(q, v)": (one(kinetic, **STIFF), EXPLICIT, 0.0205, 40, vm.LostEnergyWarning),
    "NaN, T(q, v)": (one(kinetic, **PASSES_ZERO), EXPLICIT, 0.01, 40, vm.Result.NON_FINITE),
}


class PushedStart(vm.Problem):
    """A start whose momenta are off the hidden constraints."""

    def state(self, project=None):
        state = super().state(project)
        return replace(state, p_f=state.p_f + np.array([0.5, 0.0]))


# --- roads -----------------------------------------------------------------------------------------------------------
def by_simulate(moving, scheme, steps, out):
    return vm.simulate(moving, scheme, **steps).result


def by_prepare(moving, scheme, steps, out):
    return vm.prepare(moving, scheme, **steps)().result


def by_accuracy(moving, scheme, steps, out):
    return vm.simulate(moving, scheme, accuracy=1e-3, t_end=steps["macro_dt"] * steps["num_steps"]).result


def by_stream(moving, scheme, steps, out):
    return vm.stream(moving, scheme, out=out, chunk=steps["num_steps"] // 2, **steps).result


def by_batch(moving, scheme, steps, out):
    states = jax.tree.map(lambda a: np.stack([a] * 2), moving.state())
    return vm.simulate_batch(moving, scheme, states, solver=MASSES, warn=False, **steps).result[1]


def by_ensemble(moving, scheme, steps, out):
    design = {"k": float(moving.system.params["k"]) * np.array([0.999, 1.0])}
    vary = lambda problem, row: replace(  # noqa: E731
        problem, system=problem.system.with_params(problem.system.params | {"k": row["k"]})
    )
    vm.ensemble(moving, scheme, design, vary=vary, out=out, num_saves=steps["num_steps"], **steps)
    return int(vm.open_ensemble(out)["result"].values.ravel()[1])


@partial(jax.jit, static_argnames="num_steps")
def traced(system, scheme, state, macro_dt, num_steps):
    return vm.simulate(system, scheme, state, macro_dt=macro_dt, num_steps=num_steps, solver=MASSES)


def by_trace(moving, scheme, steps, out):
    """Nothing warns while JAX traces: the run is asked afterwards."""
    run = traced(moving.system, scheme, moving.state(), steps["macro_dt"], steps["num_steps"]).of(moving)
    for concern in run.concerns():
        warnings.warn(concern, stacklevel=1)
    return run.result


BEYOND_A_POLE = (by_prepare, by_batch, by_ensemble, by_trace)
"""Roads whose steps past a pole compile for up to 18 s; `test_lanes_and_runs_that_are_asked_afterwards` has their
nodes."""
AS_SIMULATE = (by_prepare, by_trace)
"""Roads to which a force is nothing of its own, where another road has its nodes or lanes."""
ROADS = (by_simulate, by_prepare, by_stream, by_batch, by_ensemble, by_trace)
"""Ensembles have lanes with parameters of their own, and serve as that road."""


@pytest.mark.parametrize(
    ("road", "cause"),
    [
        (road, cause)
        for road in ROADS
        for cause in CAUSES
        if (road is by_simulate or "T(q, v)" not in cause)
        and (road not in BEYOND_A_POLE or cause != "pole")
        and (road not in AS_SIMULATE or cause != "driven")
    ],
)
def test_every_road_says_it(road, cause, tmp_path):
    """Observables of a run do not ask how its steps were taken: one road suffices for a kinetic energy that is a
    function."""
    moving, scheme, macro_dt, num_steps, expected = CAUSES[cause]
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", vm.CompiledAgainWarning)
        step = None
        try:
            result = road(moving, scheme, {"macro_dt": macro_dt, "num_steps": num_steps}, tmp_path / "run.zarr")
        except vm.SimulationError as error:
            result, step = error.result, error.step
    if step is not None:
        assert (step == 10) == (expected is vm.Result.NON_FINITE)  # q = 0 at t = 0.1046
    kinds = [warning.category for warning in given]
    if isinstance(expected, vm.Result):
        assert (int(result), kinds) == (expected, [])
    else:
        assert (int(result) <= 1, kinds) == (True, [expected] if expected else [])
    if expected is vm.SingularCoordinatesWarning:
        assert "the coordinates are singular near t = 0.53" in str(given[0].message)


@pytest.mark.parametrize("road", [by_simulate, by_prepare, by_accuracy, by_stream, by_batch])
def test_every_road_says_that_the_momenta_of_the_start_are_projected(road, tmp_path):
    moving = problem(of_masses(1.0, 1.0), None, [0.0, 0.0], [0.0, 1.0], constraint=line)
    pushed = PushedStart(moving.system, moving.q_s, moving.q_f, moving.v_s, moving.v_f)
    with pytest.warns(UserWarning, match="off the hidden constraints, by 0.5 where the largest of them is 1;"):
        road(pushed, EXPLICIT, {"macro_dt": 0.01, "num_steps": 40}, tmp_path / "run.zarr")


def test_no_road_computes_observables_again(tmp_path):
    """The first chunk of a store, and the trial that an accuracy chooses, have the observables of their nodes."""
    moving, asked = problem(of_masses(1.0), potential, [1.0], [0.0]), _at_all.cache_info()
    vm.stream(moving, EXPLICIT, macro_dt=0.01, num_steps=20, out=tmp_path / "run.zarr")
    vm.simulate(moving, EXPLICIT, accuracy=1e-3, t_end=0.4)
    assert _at_all.cache_info() == asked


@pytest.mark.filterwarnings("ignore::vmri_jax.SingularCoordinatesWarning")
def test_lanes_and_runs_that_are_asked_afterwards():
    moving, scheme, macro_dt, num_steps, kind = CAUSES["pole"]
    run = vm.simulate(moving, scheme, macro_dt=macro_dt, num_steps=num_steps)
    for asked, said in ((run, ""), (jax.tree.map(lambda a: np.stack([a, a]), run), "in 2 of 2 lanes")):
        assert asked[:1].concerns() == []  # a single node, which has no step
        [concern] = asked.concerns()
        assert type(concern) is kind
        assert said in str(concern)
        assert "the coordinates are singular near t = 0.53" in str(concern)


def test_scenes_say_it():
    """A stiff spring beyond stability; for all other causes scenes are systems."""
    body = Body("b", 1.0, [0.1, 0.0], pace="fast")
    scene = Scene([body], [SpringAnchor("b", [0.0, 0.0], 1e4)])
    with pytest.warns(vm.LostEnergyWarning, match="the computed motion is wrong"):
        vm.simulate(scene, EXPLICIT, macro_dt=0.0205, num_steps=10)


def pumped(t, q_s, q_f, v_s, v_f, params):
    """A trap that opens and closes: the motion grows like exp(L t), and so do all errors."""
    return jnp.zeros(0), -4.0 * jnp.cos(2.0 * t) * q_f


@pytest.mark.parametrize(
    ("moving", "scheme", "macro_dt", "t_end", "said"),
    [
        (problem(of_masses(1.0), potential, [1.0], [0.0], force=pumped), EXPLICIT, 0.3, 24.0, "Take smaller steps"),
        (CAUSES["pole"][0], MIDPOINT, 0.002, 2.0, "the coordinates are singular near t = 0.53"),
    ],
)
def test_growth_of_errors_is_not_always_chaos(moving, scheme, macro_dt, t_end, said):
    """A driven motion, and a motion past a pole of its angles."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        vm.simulate(moving, scheme, macro_dt=macro_dt, t_end=t_end, error=True)
    [uncertified] = [str(w.message) for w in given if w.category is vm.UncertifiedWarning]
    assert said in uncertified
    assert "chaotic" not in uncertified


# --- programs --------------------------------------------------------------------------------------------------------
def cosine(q_f, params):
    return -jnp.cos(q_f[0])


def test_the_steps_have_no_energy_and_one_program_serves_all_lengths():
    """Steps need the sine, the force; the observables, after the loop of steps, need the cosine."""
    moving = problem(of_masses(1.0), cosine, [1.0], [0.0])
    for num_steps in (5, 40):
        vm.simulate(moving, EXPLICIT, macro_dt=0.1, num_steps=num_steps)
    prepared = vm.prepare(moving, EXPLICIT, macro_dt=0.1, num_steps=5)
    program: Any = prepared._engine_of_pieces.program
    assert program._cache_size() == 1
    stepper, interval = prepared.plan, _interval(prepared.plan, prepared, partial(jax.lax.fori_loop, 0))
    cursor = Cursor.at_start(prepared.state, stepper.init(prepared.state, prepared.macro_dt))
    steps = str(jax.jit(interval).lower(cursor, 5).compile().as_text())
    whole = str(prepared.compiled().as_text())
    assert ["sine(" in text for text in (steps, whole)] == [True, True]
    assert [" cosine(" in text for text in (steps, whole)] == [False, True]
