"""The null space method: the same trajectory without multipliers among the unknowns, and a matrix that no step makes
worse."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from scipy.linalg import block_diag, null_space

import vmri_jax as vm
from tests.scene.gallery_scenes import gallery_scene
from tests.user_systems import cart
from vmri_jax import systems
from vmri_jax.diagnostics.linear import newton_matrix
from vmri_jax.steppers.null_space import inverse_with_multipliers, inverse_without_multipliers, motions

NULL_SPACE = vm.Solver("null_space")
REFERENCE = "triple_spherical_pendulum", pytest.param("simple_atomic_model", marks=pytest.mark.full)


def test_bases_span_what_is_free_and_what_is_held():
    jacobian = np.asarray(np.random.default_rng(1).normal(size=(4, 3, 7)))
    basis, right_inverse = map(np.asarray, jax.jit(motions)(jacobian))
    np.testing.assert_allclose(jacobian @ basis, np.zeros((4, 3, 4)), atol=1e-14)
    np.testing.assert_allclose(jacobian @ right_inverse, np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-13)
    np.testing.assert_allclose(np.swapaxes(basis, 1, 2) @ basis, np.broadcast_to(np.eye(4), (4, 4, 4)), atol=1e-14)
    assert jax.eval_shape(motions, jacobian[:, :0])[0].shape == (4, 7, 7)


@pytest.mark.parametrize("degree", [1, 2])
def test_the_inverse_is_that_with_multipliers(degree):
    random = np.random.default_rng(degree)
    a = random.normal(size=(6 * degree, 6 * degree)) + 8 * np.eye(6 * degree)
    g_0, g_1 = (block_diag(*random.normal(size=(degree, 2, 6))) for _ in range(2))
    inverses = [
        jax.jit(partial(inverse, nodes=degree)) for inverse in (inverse_without_multipliers, inverse_with_multipliers)
    ]
    np.testing.assert_allclose(*(inverse(a, -g_0.T, g_1) for inverse in inverses), atol=1e-11)


LONG = pytest.mark.full  # the motion is chaotic: over longer times both part, as does every other method


@pytest.mark.parametrize(
    ("make", "step", "steps"),
    [
        (cart, 0.01, 200),
        *(
            pytest.param(make, step, steps, marks=LONG)
            for make in (systems.triple_spherical_pendulum, systems.simple_atomic_model)
            for step, steps in ((0.01, 200), (0.001, 10_000))
        ),
    ],
)
def test_trajectories_are_those_of_the_method_with_multipliers(make, step, steps):
    problem = make()
    arguments = {"macro_dt": step, "num_steps": steps, "save": 20}
    runs = [
        vm.simulate(problem, vm.fully_implicit(num_micro=5), solver=solver, **arguments)
        for solver in (NULL_SPACE, vm.Solver("exact"))
    ]
    assert runs[0].info.method[0] == vm.Method.NULL_SPACE
    assert float(runs[0].constraint_residual.max()) < 1e-12
    for found, other in ((runs[0].q_s, runs[1].q_s), (runs[0].q_f, runs[1].q_f)):
        np.testing.assert_allclose(found, other, atol=1e-11)
    first, second = (run.multipliers() for run in runs)
    for constraint in first:
        np.testing.assert_allclose(first[constraint], second[constraint], atol=1e-6)


@pytest.mark.full
@pytest.mark.parametrize(("name", "num_micro"), [("spinning_top", 1), ("four_bar", 1), ("rigid_satellite", 5)])
def test_trajectories_of_rigid_bodies(name, num_micro):
    scene = replace(gallery_scene(name), coordinates="directors")
    runs = [
        vm.simulate(scene, vm.fully_implicit(num_micro), macro_dt=0.005, num_steps=100, solver=solver)
        for solver in (NULL_SPACE, None)
    ]
    np.testing.assert_allclose(runs[0].q_s, runs[1].q_s, atol=1e-11)
    np.testing.assert_allclose(runs[0].q_f, runs[1].q_f, atol=1e-11)


def null_space_condition(system, scheme, state, macro_dt) -> float:
    """Condition number of ``P_0^T A P_1`` with the Newton matrix A and bases of null spaces, ``G_0 P_0 = 0`` at the
    start, ``G_1 P_1 = 0`` at the end."""
    whole = np.asarray(newton_matrix(system, scheme, state, macro_dt))
    n, r = scheme.num_micro, scheme.degree
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    sizes = r * state.q_s.size, r * n_gs, n * r * state.q_f.size, n * r * n_g
    held = np.repeat([False, True, False, True], sizes)  # the order of `Unknowns`
    left, right = null_space(whole[np.ix_(~held, held)].T), null_space(whole[np.ix_(held, ~held)])
    return float(np.linalg.cond(left.T @ whole[np.ix_(~held, ~held)] @ right))


@pytest.mark.parametrize("name", REFERENCE)
def test_the_condition_does_not_depend_on_the_step(name):
    problem = getattr(systems, name)()
    found = [
        null_space_condition(problem.system, vm.fully_implicit(num_micro=3), problem.state(), step)
        for step in 10.0 ** -np.arange(1, 7)
    ]
    assert max(found) < 1.01 * min(found)  # measured 1.000


@pytest.mark.parametrize(("name", "few", "many"), [("triple_spherical_pendulum", 5, 7), ("simple_atomic_model", 9, 15)])
def test_a_plan_says_how_many_unknowns_are_left(name, few, many):
    planned = vm.plan(getattr(systems, name)(), vm.fully_implicit(num_micro=5), solver=NULL_SPACE)
    assert f"unknowns of each micro interval: {few}, with multipliers {many}" in str(planned)
