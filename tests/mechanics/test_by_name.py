"""Configurations as dictionaries of arrays: the same runs bit by bit as with vectors, and results by name."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm

HOOK, LOAD = 1.0, 20.0
PARAMS = {"stiffness": 2.0e4, "drag": 0.3, "speed": 0.5}
RUN = {"scheme": vm.fully_explicit(1), "macro_dt": 0.02, "num_steps": 6}


def weight(q_s, q_f, params):
    return 9.81 * (HOOK * q_f["hook"][1] + LOAD * q_f["load"][1])


def sling(q_f, params):
    return params["stiffness"] / 2 * (jnp.linalg.norm(q_f["load"] - q_f["hook"]) - 1.0) ** 2


def rope(q_s, q_f, params):
    x, y = q_f["hook"]
    return {"rope": ((x - q_s["trolley"]) ** 2 + y**2 - 25.0) / 2}


def drag(t, q_s, q_f, v_s, v_f, params):
    return {"trolley": -params["drag"] * v_s["trolley"]}, {"load": -params["drag"] * v_f["load"]}


def flat_weight(q_s, q_f, params):
    return 9.81 * (HOOK * q_f[1] + LOAD * q_f[3])


def flat_sling(q_f, params):
    return params["stiffness"] / 2 * (jnp.linalg.norm(q_f[2:] - q_f[:2]) - 1.0) ** 2


def flat_rope(q_s, q_f, params):
    return jnp.array([((q_f[0] - q_s[0]) ** 2 + q_f[1] ** 2 - 25.0) / 2])


def flat_drag(t, q_s, q_f, v_s, v_f, params):
    return -params["drag"] * v_s, jnp.concatenate([jnp.zeros(2), -params["drag"] * v_f[2:]])


MASSES = {"slow": {"trolley": 500.0}, "fast": {"hook": HOOK, "load": LOAD}}
CRANE = vm.Problem(
    vm.System(vm.ConstantMass(**MASSES), weight, sling, rope, force=drag, params=PARAMS),
    q_s={"trolley": 0.0},
    q_f={"hook": [3.0, -4.0], "load": [3.0, -5.0]},
    v_f={"load": [0.0, 0.1]},
)
FLAT_MASSES = vm.ConstantMass([500.0], [HOOK, HOOK, LOAD, LOAD])
FLAT = vm.Problem(
    vm.System(FLAT_MASSES, flat_weight, flat_sling, flat_rope, force=flat_drag, params=PARAMS),
    q_s=[0.0],
    q_f=[3.0, -4.0, 3.0, -5.0],
    v_f=[0.0, 0.0, 0.0, 0.1],
)


def test_dictionaries_and_vectors_make_the_same_run():
    by_name, flat = vm.simulate(CRANE, **RUN), vm.simulate(FLAT, **RUN)
    for name, values in vars(flat.states).items():
        np.testing.assert_array_equal(getattr(by_name.states, name), values)
    assert jax.tree.map(np.shape, by_name.q_f) == {"hook": (7, 2), "load": (7, 2)}
    np.testing.assert_array_equal(by_name.q_f["load"], flat.q_f[:, 2:])
    np.testing.assert_array_equal(by_name.p_s["trolley"], flat.p_s[:, 0])
    np.testing.assert_array_equal(by_name.v_f["hook"], flat.v_f[:, :2])
    np.testing.assert_array_equal(by_name.q_f["load"], by_name.position("load"))
    assert by_name.names.constraint == {"rope": 1}
    assert by_name.names.fast_coordinates == ["hook x", "hook y", "load x", "load y"]


def test_functions_of_one_layout_are_compiled_once():
    other = dataclasses.replace(
        CRANE, q_f={"load": [3.0, -5.1], "hook": [3.0, -4.0]}
    )  # in the order of the first problem
    assert jax.tree.structure(other.system) == jax.tree.structure(CRANE.system)
    np.testing.assert_array_equal(other.q_f, [3.0, -4.0, 3.0, -5.1])


def test_a_gradient_by_a_start_by_name():
    """Of the momentum, from which a run is differentiated as from vectors; the run is traced alone."""

    def problem(y):
        return dataclasses.replace(CRANE, v_f={"load": jnp.stack([0.0, y])})

    slope = jax.jit(jax.jacfwd(lambda y: problem(y).state().p_f))(0.1)
    np.testing.assert_allclose(slope, [0, 0, 0, LOAD], atol=1e-14)
    traced = jax.eval_shape(lambda y: vm.simulate(problem(y), **RUN).q_f["load"], 0.1)
    assert traced.shape == (7, 2)


def test_arrays_of_any_shape():
    def pairs(q_s, q_f, params):
        return jnp.sum((q_f["atoms"][1:] - q_f["atoms"][:-1]) ** 2) / 2

    def moving(t, q_s, q_f, params):
        return {"wall": q_f["wall"] - jnp.sin(t)}

    chain = vm.Problem(
        vm.System(
            vm.ConstantMass([], {"atoms": [[1.0], [2.0], [3.0]], "wall": 1.0}), pairs, constraint=vm.Rheonomic(moving)
        ),
        q_s=[],
        q_f={"atoms": np.arange(9.0).reshape(3, 3), "wall": 0.0},
        v_f={"wall": 1.0},
    )
    np.testing.assert_array_equal(chain.system.kinetic.fast, [1, 1, 1, 2, 2, 2, 3, 3, 3, 1])
    run = vm.simulate(chain, vm.fully_explicit(1), macro_dt=0.01, num_steps=3)
    assert jax.tree.map(np.shape, run.q_f) == {"atoms": (4, 3, 3), "wall": (4,)}
    assert run.names.constraint == {"wall": 1}
    np.testing.assert_allclose(run.q_f["wall"], np.sin(run.t), atol=1e-14)
    assert run.names.fast_coordinates[:4] == ["atoms[0] x", "atoms[0] y", "atoms[0] z", "atoms[1] x"]
    assert run.names.fast_coordinates[-1] == "wall"


def test_shapes_go_through_plain_data():
    names = vm.Names({"hub": 2}, {"atoms": (2, 3), "wall": ()}, {"rod": 1})
    read = vm.Names.from_dict(json.loads(json.dumps(names.to_dict())))
    assert (read.slow, read.fast, read.constraint) == (names.slow, names.fast, names.constraint)
    arrays = names.shaped("f", np.arange(14.0).reshape(2, 7))
    assert {name: array.shape for name, array in arrays.items()} == {"atoms": (2, 2, 3), "wall": (2,)}
    assert names.shaped("s", np.zeros((2, 2))).shape == (2, 2)
    assert vm.Names(fast={"wall": ()}).shaped("s", np.zeros((2, 0))) == {}


def problem(**changes):
    return vm.Problem(
        **{"system": CRANE_BY_NAME, "q_s": {"trolley": 0.0}, "q_f": {"hook": [3.0, -4.0], "load": [3.0, -5.0]}}
        | changes
    )


CRANE_BY_NAME = vm.System(vm.ConstantMass(**MASSES), weight, sling, rope, params=PARAMS)


def misspelt(q_f, params):
    return q_f["laod"][0]


def unknown_force(t, q_s, q_f, v_s, v_f, params):
    return {}, {"laod": v_f["load"]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q_f": {"hook": [3.0, -4.0]}}, "fast has the keys hook, load; give hook"),
        ({"v_f": {"laod": [0.0, 0.0]}}, "v_f has the keys laod; give hook, load"),
        ({"v_f": {"load": [0.0, 0.0, 0.0]}}, r"v_f\['load'\] has shape \(3,\), and the position has \(2,\)"),
        ({"q_f": {1: [0.0]}}, "q_f has the key 1"),
        ({"q_s": [0.0]}, "masses by name, trolley, but the slow coordinates are a vector"),
        ({"q_s": [0.0], "v_s": {"trolley": 0.0}}, "v_s is a dictionary and q_s is none"),
        ({"system": CRANE_BY_NAME.replace(fast_potential=misspelt)}, "'laod' is not there; q_s has trolley and q_f"),
        ({"system": CRANE_BY_NAME.replace(params={"mass": 1.0})}, "is not there; .* and params has mass"),
        ({"system": CRANE_BY_NAME.replace(force=unknown_force)}, "F_f has the keys laod; give hook, load"),
    ],
)
def test_bad_input(changes, message):
    with pytest.raises((ValueError, TypeError), match=message):
        problem(**changes)


@pytest.mark.parametrize("nothing", [{}, []])
def test_no_bodies_by_name_are_a_vector_without_entries(nothing):
    """Beside vectors and beside dictionaries."""
    assert vm.Problem(vm.System(vm.ConstantMass({}, [2.0])), nothing, [1.0], v_f=[3.0]).state().p_f == 6.0
    assert (
        vm.Problem(vm.System(vm.ConstantMass({}, {"a": 2.0})), nothing, {"a": 1.0}, v_f={"a": 3.0}).state().p_f == 6.0
    )


def test_a_system_by_name_needs_a_problem():
    with pytest.raises(TypeError, match=r"q_f is a dictionary; give real numbers, or Problem"):
        vm.initial_state(CRANE_BY_NAME, [0.0], {"hook": [3.0, -4.0]}, [0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match=r"sizes of these bodies are not known"):
        vm.initial_state(CRANE_BY_NAME, [0.0], [3.0, -4.0, 3.0, -5.0], [0.0], [0.0] * 4)


def test_a_fast_potential_of_slow_variables_is_told_where_stiff_springs_belong():
    with pytest.raises(TypeError, match=r"whatever a stiff spring joins is fast"):
        vm.System(vm.ConstantMass([1.0], [1.0]), fast_potential=lambda q_s, q_f, params: 0.0)
