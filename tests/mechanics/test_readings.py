"""Shapes and names that could be read in two ways: one reading is right on every road, or the input is refused."""

from collections import OrderedDict
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.functions import in_order, order_of
from vmri_jax.scene import Body, Drive, Potential, Scene

MASSES = np.array([1.0, 4.0, 9.0])


def springs(q_f, params):
    """The k of each name belongs to the position of this name, if both keep the order of writing."""
    return sum(k * jnp.sum(x**2) / 2 for k, x in zip(params["k"].values(), q_f.values(), strict=True))


def at_rest(**changes) -> vm.Problem:
    """Three atoms in space and a weight, on springs."""
    mass = vm.ConstantMass(slow={}, fast={"weights": MASSES, "bob": 1.0} | changes)
    system = vm.System(mass, None, springs, params={"k": {"weights": 1.0, "bob": 9.0}})
    return vm.Problem(system, q_s={}, q_f={"weights": np.ones((3, 3)), "bob": 1.0})


def test_masses_are_per_atom_and_params_keep_their_order():
    run = vm.simulate(at_rest(), vm.fully_explicit(1), macro_dt=0.01, t_end=1.0)
    by_mass = np.broadcast_to(np.cos(1 / np.sqrt(MASSES))[:, None], (3, 3))
    np.testing.assert_allclose(run.q_f["weights"][-1], by_mass, atol=1e-5)  # measured 4e-6
    np.testing.assert_allclose(run.q_f["bob"][-1], np.cos(3.0), atol=5e-5)  # measured 2e-5


@pytest.mark.parametrize(
    ("mass", "expected"),
    [
        (2.0, np.full((3, 3), 2.0)),
        (MASSES[:, None], np.repeat(MASSES, 3).reshape(3, 3)),
        (MASSES[None], np.tile(MASSES, (3, 1))),
        (np.arange(1.0, 10.0).reshape(3, 3), np.arange(1.0, 10.0).reshape(3, 3)),
    ],
)
def test_masses_of_all_axes_and_single_ones(mass, expected):
    np.testing.assert_array_equal(at_rest(weights=mass).system.kinetic.fast[:9].reshape(3, 3), expected)


def test_masses_of_the_last_axes_are_refused():
    system = at_rest().system.replace(kinetic=vm.ConstantMass({}, {"pairs": MASSES}), params={"k": {"pairs": 1.0}})
    with pytest.raises(ValueError, match=r"\(3,\), and the position has \(2, 3\); .*\(2,\) with a number for each row"):
        vm.Problem(system, q_s={}, q_f={"pairs": np.ones((2, 3))})


def push(t, q_s, q_f, v_s, v_f, params):
    return {}, {"x": params["push"]}


def driven(size, position) -> vm.Problem:
    system = vm.System(vm.ConstantMass({}, {"x": 1.0}), force=push, params={"push": size})
    return vm.Problem(system, q_s={}, q_f={"x": position})


def test_forces_and_velocities_have_the_shape_of_their_position():
    with pytest.raises(ValueError, match=r"F_f\['x'\] has shape \(\), and the position has \(3,\)"):
        driven(1.0, np.zeros(3))
    with pytest.raises(ValueError, match=r"v_f\['x'\] has shape \(3,\), and the position has \(3, 3\)"):
        replace(driven(np.ones((3, 3)), np.zeros((3, 3))), v_f={"x": np.ones(3)})
    one_number = replace(driven(1.0, [0.0]), v_f={"x": 2.0})
    np.testing.assert_array_equal(one_number.v_f, [2.0])


def uniform(history, t, q, v, params):
    return (params["force"],)


def test_one_vector_is_no_force_on_several_elements():
    class Uniform(Drive):
        function = staticmethod(uniform)  # pyright: ignore[reportAssignmentType]

    bodies = [Body("a", 1.0, [0.0, 0.0]), Body("b", 1.0, [1.0, 0.0])]
    with pytest.raises(ValueError, match=r"function returns \(shape \(2,\)\); .* a force for each body"):
        Scene(bodies, [Uniform(["a", "b"], lambda t, params: jnp.zeros(2), {"force": np.array([0.0, 1.0])})]).system()


TREE = {"z": {"d": 1.0, "c": [{"y": 2.0, "x": 3.0}]}, "a": OrderedDict(q=4.0, p={"n": 5.0, "m": 6.0}), "e": None}


def test_an_order_survives_sorting():
    in_sorted_order = jax.tree.map(lambda x: x, TREE)
    assert list(in_sorted_order) == ["a", "e", "z"]
    assert str(in_order(in_sorted_order, order_of(TREE))) == str(TREE)
    assert list(in_order({"b": 1, "a": 2, "z": 3}, order_of({"z": 0, "a": 0}))) == ["z", "a", "b"]
    assert order_of([1.0, {"a": 2.0}, np.zeros(2)]) is None
    assert hash(order_of(TREE)) == hash(order_of(TREE | {"e": None}))


NEW = {"k": {"bob": 4.0, "weights": 2.0}}
RIGHT = 2.0 * 9 / 2 + 4.0 / 2
"""Energy at q = 1 with the stiffness 2 of nine coordinates, and 4 of one."""


@pytest.mark.parametrize("way", ["plain", "jit", "grad", "vmap"])
def test_other_params_have_the_order_of_the_first(way):
    problem = at_rest()

    def energy(params):
        potential: Any = problem.system.replace(params=params).fast_potential
        return potential(problem.q_f, params)

    if way == "grad":
        slopes = jax.grad(energy)(NEW)
        assert (slopes["k"]["weights"], slopes["k"]["bob"]) == (4.5, 0.5)
    elif way == "vmap":
        np.testing.assert_allclose(
            jax.vmap(energy)(jax.tree.map(lambda k: np.array([k, 2 * k]), NEW)), [RIGHT, 2 * RIGHT]
        )
    else:
        assert (jax.jit(energy) if way == "jit" else energy)(NEW) == RIGHT


def weighted(q, params):
    return sum(k * jnp.sum(x) for k, x in zip(params.values(), q, strict=True))


def test_params_of_effects_keep_their_order():
    bodies = [Body("a", 1.0, [1.0, 0.0]), Body("b", 1.0, [0.0, 10.0])]
    scene = Scene(bodies, [Potential(weighted, ("a", "b"), {"of_a": 2.0, "of b": 3.0})])
    start = scene.problem()
    assert sum(start.system.all_potentials(start.q_s, start.q_f).values()) == 2.0 + 30.0
    turned = Scene(bodies, [Potential(weighted, ("b", "a"), {"of_b": 3.0, "of a": 2.0})]).problem()
    assert sum(turned.system.all_potentials(turned.q_s, turned.q_f).values()) == 2.0 + 30.0


def test_bounds_and_errors_of_fits():
    with pytest.raises(ValueError, match=r"lower has shape \(3,\); give a number, or \(3, 3\)"):
        vm.fitting.Unknown(np.ones((3, 3)), lower=np.zeros(3))
    times = np.arange(3.0)
    with pytest.raises(ValueError, match=r"one for each quantity, \(1, 3\), one for each time, \(3, 1\)"):
        vm.fitting.Measured(times, np.zeros((3, 3)), sigma=np.ones(3))
    np.testing.assert_array_equal(vm.fitting.Measured(times, np.zeros(3), sigma=times + 1).sigma[:, 0], times + 1)
    by_quantity = vm.fitting.Measured(times, np.zeros((3, 2)), sigma=[1.0, 2.0]).sigma
    np.testing.assert_array_equal(by_quantity, np.tile([1.0, 2.0], (3, 1)))
