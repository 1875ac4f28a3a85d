"""States: consistent starts, projections, and constraints that no micro grid can keep."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support import largest_difference
from tests.user_systems import arms_kinetic, bent_system, double_pendulum
from vmri_jax import ConstantMass, Problem, Rheonomic, State, System, fully_implicit, initial_state, simulate
from vmri_jax.diagnostics import constraint_residual, velocity
from vmri_jax.mechanics.projection import legendre, project_momentum
from vmri_jax.steppers.results import Method
from vmri_jax.systems import triple_spherical_pendulum


def test_momenta_are_mass_times_velocity(fpu):
    state = fpu.state()
    assert np.array_equal(state.p_s, fpu.v_s)
    assert np.array_equal(state.q_f, fpu.q_f)
    assert float(state.t) == 0.0
    problem = Problem(System(ConstantMass([1.0], [1.0, 2.0])), [0.5], [1.0, 2.0])  # at rest by default
    np.testing.assert_array_equal(problem.v_s, [0.0])
    np.testing.assert_array_equal(problem.state().p_f, [0.0, 0.0])


def test_a_problem_takes_plain_lists():
    """Functions of the system get arrays, also where studies call them with the start of a problem."""
    ring = System(ConstantMass([1.0, 1.0], [1.0]), slow_constraint=lambda q_s, params: jnp.array([q_s @ q_s - 1.0]))
    problem = Problem(ring, [0.0, 1], [2], [0.5, 0.0], [0])
    assert {getattr(problem, name).dtype for name in ("q_s", "q_f", "v_s", "v_f")} == {np.dtype(float)}
    assert problem.system.num_constraints(problem.q_s, problem.q_f) == (0, 1)
    with pytest.raises(TypeError, match=r"Problem: system is int; give a vmri_jax\.System"):
        Problem(1, [0.0], [1.0], [0.0], [0.0])  # pyright: ignore[reportArgumentType]


def test_momenta_of_a_mass_matrix(fpu):
    matrix = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.1], [0.0, 0.1, 3.0]])
    system = fpu.system.replace(kinetic=ConstantMass(matrix, 2 * np.ones(3)))
    v_s, v_f = np.array([1.0, 2.0, 3.0]), np.ones(3)
    state = initial_state(system, fpu.q_s, fpu.q_f, v_s, v_f, t=2.0)
    assert np.allclose(state.p_s, matrix @ v_s, rtol=1e-15)
    assert np.allclose(state.p_f, 2 * v_f, rtol=1e-15)
    assert float(state.t) == 2.0
    back = jax.jit(ConstantMass.velocity)(system.kinetic, state.p_s, state.p_f)
    assert largest_difference(back[0], v_s) < 1e-14


def test_legendre_transform_of_a_kinetic_function():
    problem = double_pendulum()
    q_s, q_f, v_s, v_f = problem.q_s, problem.q_f, np.array([0.7]), np.array([-3.0])
    state = initial_state(problem.system, q_s, q_f, v_s, v_f)
    (m_1, m_2), (l_1, l_2) = (np.asarray(problem.system.params[name]) for name in ("masses", "lengths"))
    coupling = m_2 * l_1 * l_2 * np.cos(q_s - q_f)
    assert largest_difference(state.p_s, (m_1 + m_2) * l_1**2 * v_s + coupling * v_f) < 1e-14
    assert largest_difference(state.p_f, m_2 * l_2**2 * v_f + coupling * v_s) < 1e-14
    _, _, *back, _ = projected(problem.system, state)
    assert largest_difference(np.concatenate(back), np.concatenate([v_s, v_f])) < 1e-12


residual_of, projected = jax.jit(constraint_residual), jax.jit(project_momentum)


def test_momenta_are_projected_onto_the_hidden_constraints(tsp):
    rng = np.random.default_rng(1)
    v_s, v_f = rng.normal(size=tsp.q_s.shape), rng.normal(size=tsp.q_f.shape)
    state = initial_state(tsp.system, tsp.q_s, tsp.q_f, v_s, v_f, project=True)
    assert np.asarray(residual_of(tsp.system, state))[1] < 1e-12  # measured 1.5e-13
    raw = jax.device_get(jax.jit(legendre)(tsp.system, tsp.q_s, tsp.q_f, v_s, v_f))
    residual = np.asarray(residual_of(tsp.system, State(np.zeros(()), tsp.q_s, tsp.q_f, *raw)))
    assert residual[1] > 0.1
    # the correction is along the constraint normals: G^T mu
    jacobians = jax.jit(lambda *q: jax.jacrev(tsp.system.constraints, argnums=(1, 2))(0.0, *q))
    jacobian = np.concatenate(jacobians(tsp.q_s, tsp.q_f), axis=1)
    correction = np.concatenate([raw[0] - state.p_s, raw[1] - state.p_f])
    mu = np.linalg.lstsq(jacobian.T, correction, rcond=None)[0]
    assert np.abs(jacobian.T @ mu - correction).max() < 1e-12
    momenta = np.concatenate([state.p_s, state.p_f])
    assert largest_difference(np.concatenate(projected(tsp.system, state)[:2]), momenta) < 1e-12

    def kinetic(q_s, q_f, v_s, v_f, params):
        return tsp.system.kinetic(q_s, q_f, v_s, v_f, params)

    of_function = tsp.system.replace(kinetic=kinetic)
    of_raw = projected(of_function, State(np.zeros(()), tsp.q_s, tsp.q_f, *raw))
    assert largest_difference(np.concatenate(of_raw[:2]), momenta) < 1e-11


def test_velocities_against_a_constraint_are_said_or_refused():
    def constraint(q_s, q_f, params):
        return jnp.array([q_f @ q_f - 1.0]) / 2

    def start(radial: float, **options):
        return initial_state(pendulum, [], [1.0, 0.0], [], [radial, 1.0], **options)

    pendulum = System(ConstantMass([], [1.0, 1.0]), constraint=constraint)
    with pytest.raises(ValueError, match=r"differ by 44.72% .* Correct the velocities, or pass project=True"):
        start(0.5)  # 0.5 / sqrt(1.25)
    with pytest.warns(UserWarning, match=r"differ by 0.10%"):
        assert np.allclose(start(1e-3).p_f, [0.0, 1.0], atol=1e-15)
    with pytest.warns(UserWarning, match=r"differ by 89.44% .* project=True has replaced them; for a scene"):
        assert np.allclose(start(2.0, project=True).p_f, [0.0, 1.0], atol=1e-14)
    for quiet in (start(1e-8), start(0.5, project=True)):
        assert np.allclose(quiet.p_f, [0.0, 1.0], atol=1e-15)
    in_program = jax.jit(lambda radial: start(radial).p_f)
    assert np.isnan(in_program(0.5)).all()  # the run of this start fails
    assert np.allclose(in_program(1e-3), [0.0, 1.0], atol=1e-15)


def test_moving_constraints_say_that_they_change_a_start_at_rest():
    """A winch pulls the second coordinate at speed 2; a start at rest cannot fit, one with another speed is refused."""
    winds = Rheonomic(lambda t, q_s, q_f, params: jnp.array([q_f[1] - 2.0 * t]))
    winch = System(ConstantMass([], [1.0, 1.0]), constraint=winds)

    def start(*v_f, **options):
        return initial_state(winch, [], [1.0, 0.0], [], v_f, **options)

    with pytest.warns(UserWarning, match=r"all velocities are zero, but the constraints move") as warned:
        assert np.allclose(start(0.0, 0.0).p_f, [0.0, 2.0], atol=1e-15)
    assert warned[0].filename == __file__  # it points at the line of the user
    with pytest.raises(ValueError, match=r"differ by 100.00% "):  # 2 / sqrt(4 + 1e-6)
        start(1e-3, 0.0)
    for quiet in (start(0.0, 0.0, project=True), start(0.0, 2.0), jax.jit(start)(0.0, 0.0)):
        assert np.allclose(quiet.p_f, [0.0, 2.0], atol=1e-15)


def test_a_kinetic_energy_without_mass_is_refused_at_the_start():
    def kinetic(q_s, q_f, v_s, v_f, params):
        return 0.5 * jnp.sum(v_s**2) + 0.5 * v_f[0] ** 2

    def quartic(q_s, q_f, v_s, v_f, params):
        return 0.5 * jnp.sum(v_s**2) + jnp.sum(v_f**4)

    with pytest.raises(ValueError, match=r"not positive definite at these positions, along q_f\[1\]"):
        initial_state(System(kinetic), [0.0], [1.0, 2.0], [1.0], [0.0, 0.0])
    assert np.allclose(initial_state(System(quartic), [0.0], [1.0], [1.0], [0.5]).p_f, [0.5], atol=1e-15)


def test_projection_repairs_positions(tsp):
    q_f = tsp.q_f + 0.1 * np.eye(6)[1]  # rod of length 2: (2.1^2 - 2^2) / 2 = 0.205
    with pytest.raises(ValueError, match=r"violate constraint, row 0, by 2.050e-01 .*pass project=True"):
        initial_state(tsp.system, tsp.q_s, q_f, tsp.v_s, tsp.v_f)
    state = initial_state(tsp.system, tsp.q_s, q_f, tsp.v_s, tsp.v_f, project=True)
    assert np.asarray(residual_of(tsp.system, state)).max() < 1e-13
    # nearest in the mass metric: masses 1 and 100 at the ends of the rod share 0.1 as 100 : 1 (about)
    assert np.asarray(state.q_f)[1] - q_f[1] == pytest.approx(-0.1 * 100 / 101, rel=0.01)
    assert np.asarray(state.q_s)[1] == pytest.approx(0.1 / 101, rel=0.01)
    system = tsp.system.replace(constraint=lambda q_s, q_f, params: jnp.sum(q_f**2, keepdims=True) + 1.0)
    with pytest.raises(ValueError, match="projection did not reach the constraints; start closer"):
        initial_state(system, tsp.q_s, tsp.q_f, tsp.v_s, tsp.v_f, project=True)


def first_rod_as_constraint(q_s, q_f, params):
    return (jnp.sum(q_s**2, keepdims=True) - params["lengths"][0] ** 2) / 2


def both_rods(q_s, q_f, params):
    rods = jnp.stack([jnp.sum(q_s**2), jnp.sum((q_f[:3] - q_s) ** 2)])
    return (rods - params["lengths"][:2] ** 2) / 2


@pytest.mark.parametrize(
    ("constraint", "which"),
    [(first_rod_as_constraint, r"row\(s\) \[0\] of constraint do"), (both_rods, r"row\(s\) \[0\] of constraint")],
)
def test_slow_only_constraint_on_the_micro_grid_is_refused(tsp, constraint, which):
    system = tsp.system.replace(constraint=constraint, slow_constraint=None)
    message = rf"{which}.* not depend on the fast variables.*rank deficit.*num_micro - 1.*slow_constraint"
    with pytest.raises(ValueError, match=message):
        initial_state(system, tsp.q_s, tsp.q_f, tsp.v_s, tsp.v_f)
    with pytest.raises(ValueError, match=message):
        simulate(system, fully_implicit(5), tsp.state(), macro_dt=0.01, num_steps=1)


def two_constraints(q_s, q_f, params):
    return jnp.stack([jnp.sum(q_f) - jnp.sum(q_s), jnp.sum(q_f**2) - jnp.sum(q_s**2)])


def the_same_twice(q_s, q_f, params):
    g = jnp.sum((q_f - q_s) ** 2) - 2.0
    return jnp.stack([g, 2 * g])


def test_more_constraints_than_variables_are_refused():
    one = np.ones(1)
    kinetic = double_pendulum().system.params
    system = System(arms_kinetic, constraint=two_constraints, params=kinetic)
    with pytest.raises(ValueError, match="constraint returns 2 values for 1 fast variables"):
        initial_state(system, one, one, one, one)
    system = System(arms_kinetic, slow_constraint=lambda q_s, params: jnp.stack([q_s[0], q_s[0] ** 2]), params=kinetic)
    with pytest.raises(ValueError, match="slow_constraint returns 2 values for 1 slow variables; at most 1"):
        initial_state(system, 0 * one, one, one, one)


def test_redundant_constraints_are_refused():
    system = bent_system().replace(constraint=the_same_twice, slow_constraint=None)
    q_s, q_f = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    with pytest.raises(ValueError, match=r"rows \[0, 1\] of constraint depend on each other: 2 rows have rank 1 in"):
        initial_state(system, q_s, q_f, q_s, q_f)


def quartic_kinetic(q_s, q_f, v_s, v_f, params):
    return jnp.sum(v_s**2 / 2 + v_s**4 / 4) + jnp.sum(v_f**2) / 2


def relativistic_kinetic(q_s, q_f, v_s, v_f, params):
    """With the same equations of motion as -sqrt(1 - v^2); infinite slope at v = 1."""
    return jnp.sum(1 - jnp.sqrt(1 - v_s**2)) + jnp.sum(v_f**2) / 2


def soft_and_coupled(q_s, q_f, params):
    return jnp.sum(q_s**2 + q_s * q_f) / 2


@pytest.mark.parametrize(("kinetic", "v"), [(quartic_kinetic, 3.0), (relativistic_kinetic, 1 - 5e-8)])
def test_velocity_of_a_kinetic_energy_that_is_not_quadratic(kinetic, v):
    system = System(kinetic, slow_potential=soft_and_coupled)
    state = initial_state(system, [0.0], [0.1], [v], [0.5])
    found = jax.jit(velocity)(system, state.q_s, state.q_f, state.p_s, state.p_f)
    np.testing.assert_allclose(np.concatenate(found), [v, 0.5], rtol=1e-13)


def test_relativistic_run_keeps_its_energy_band():
    system = System(relativistic_kinetic, slow_potential=soft_and_coupled)
    state = initial_state(system, [0.0], [0.1], [0.9], [0.0])
    run = simulate(system, fully_implicit(4), state, macro_dt=0.02, num_steps=500)
    assert np.abs(run.energy - run.energy[0]).max() < 5e-4  # measured 4e-5 with a stiff spring besides
    assert run.info.method.max() == Method.MASSES  # masses of the motion, 12 times those at rest


def test_velocities_may_be_traced_where_the_kinetic_energy_is_a_function():
    """The mass matrix at positions that are not traced is checked while the velocities are."""
    problem = double_pendulum()

    def momenta(v_s, v_f):
        state = initial_state(problem.system, problem.q_s, problem.q_f, v_s, v_f)
        return state.p_s, state.p_f

    expected, traced = momenta(problem.v_s, problem.v_f), jax.jit(momenta)(problem.v_s, problem.v_f)
    for a, b in zip(expected, traced, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


def test_the_state_of_a_problem(fpu):
    assert initial_state(fpu) == fpu.state()
    moved = initial_state(fpu, v_s=2 * fpu.v_s, t=3.0)
    assert moved == replace(fpu, v_s=2 * fpu.v_s, t=3.0).state()
    resting = initial_state(fpu.system, fpu.q_s, fpu.q_f)
    assert not np.any(resting.p_s)
    with pytest.raises(TypeError, match="a System has no start; give q_s and q_f, or a Problem"):
        initial_state(fpu.system)


def test_an_equal_start_is_made_once(monkeypatch):
    """Its checks take longer than a short run; another number makes another start."""
    problem, equal = triple_spherical_pendulum(), triple_spherical_pendulum()
    state = problem.state()
    monkeypatch.setattr("vmri_jax.mechanics.state.consistent_momenta", None)
    assert equal.state() == state
    with pytest.raises(TypeError, match="not callable"):
        replace(problem, v_s=2 * np.asarray(problem.v_s)).state()
