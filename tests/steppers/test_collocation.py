"""A single interval of higher degree in modes of time: the step is that of the whole equations, in few passes. With
constraints of all kinds it is held to the textbook in `tests/textbook`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import largest_difference, phase
from tests.user_systems import FULL_MASS, lifted, sphere
from vmri_jax.schemes.path import control_nodes
from vmri_jax.steppers.solver import Solver
from vmri_jax.steppers.time_modes import TimeModes, times_i


def phases(system, scheme, state, solver=None, macro_dt=0.02, num_steps=10):
    """(num_steps + 1, 2 n) positions and momenta of a run, and its info."""
    run = vm.simulate(system, scheme, state, macro_dt=macro_dt, num_steps=num_steps, solver=solver)
    return phase(run), run.info


def soft(q_s, q_f, params):
    return params * (q_s[1] + q_f[1]) + jnp.sum(q_s**2) * jnp.sum(q_f) / 5


def stiff(q_f, params):
    return 20 * jnp.cosh(q_f[0] - q_f[1]) + 10 * q_f[2] ** 4


def general():
    """Full mass matrices, all kinds of constraints, one of them moved; and a consistent start."""
    system = vm.System(
        FULL_MASS, soft, stiff, constraint=vm.Rheonomic(lifted), slow_constraint=sphere, params=np.asarray(3.0)
    )
    return system, vm.initial_state(system, [0.6, 0.8], [0.0, 1.0, 0.6], [0.4, -0.3], [0.2, 0.1, -0.1], project=True)


def free():
    """No constraints."""
    system = vm.System(FULL_MASS, soft, stiff, params=np.asarray(3.0))
    return system, vm.initial_state(system, [0.6, 0.8], [0.0, 1.0, 0.6], [0.4, -0.3], [0.2, 0.1, -0.1], project=True)


def slow_only():
    """A single potential of slow variables alone."""
    system = vm.System(
        vm.ConstantMass(np.array([1.0, 2.0]), np.zeros(0)),
        lambda q_s, q_f, params: 50 * jnp.cosh(q_s[0] - q_s[1]) + q_s[0],
        slow_constraint=lambda q_s, params: jnp.sum(q_s**2, keepdims=True) - 1.0,
    )
    return system, vm.initial_state(system, [0.6, 0.8], [], [0.4, -0.3], [])


def weight_only():
    """A potential without curvature, so that there is nothing but constraints to solve for."""
    mass = vm.ConstantMass(np.array([1.0, 2.0]), np.zeros(0))
    system = vm.System(mass, lambda q_s, q_f, params: 9.81 * q_s[1], slow_constraint=sphere)
    return system, vm.initial_state(system, [0.6, 0.8], [], [0.4, -0.3], [])


def start_of(name, request):
    if name in ("tsp", "sam"):
        problem = request.getfixturevalue(name)
        return problem.system, problem.state()
    return {"general": general, "free": free, "slow only": slow_only, "weight only": weight_only}[name]()


@pytest.mark.parametrize("rule", ["gauss", "lobatto"])
@pytest.mark.parametrize("degree", [2, 3, 8, 9, 10])
def test_modes_are_eigenvectors(degree, rule):
    """``sum_j l_j' y_j`` against ``sum_j l_j y_j``: what the modes diagonalise, from values at the nodes and back."""
    scheme = vm.galerkin(1, degree, rule)
    modes = TimeModes.of(scheme)
    nodes, weights = np.array(scheme.fast.rule.nodes), np.asarray(scheme.fast.rule.weights)

    def form(derivative):
        at = [np.polynomial.Polynomial.fit(control_nodes(degree), e, degree, [0, 1]) for e in np.eye(degree + 1)]
        at = np.stack([(p.deriv() if derivative else p)(nodes) for p in at], axis=1)
        return (at.T * weights @ at)[:-1, 1:]

    turned = np.asarray(jax.jit(times_i)(modes.of_values))

    def back(matrix, gamma):
        re, im = gamma[:, modes.mode]
        return ((re * modes.of_values + im * turned) @ matrix).T

    a, b = form(True), form(False)
    diagonalised = np.linalg.solve(a, b)
    bound = 100 * np.finfo(float).eps * np.linalg.cond(np.linalg.eig(diagonalised)[1])
    one = np.stack([np.ones_like(modes.gamma[0]), np.zeros_like(modes.gamma[0])])
    assert largest_difference(back(modes.increments, one), np.eye(degree)) < bound
    assert largest_difference(back(modes.increments, modes.gamma), diagonalised) < bound
    assert largest_difference(back(modes.multipliers, one), a) / np.abs(a).max() < bound


@pytest.mark.parametrize(
    "scheme", [vm.galerkin(1, 4, "lobatto"), vm.galerkin(1, 3, "gauss"), vm.galerkin(1, 2, "gauss")]
)
def test_potentials_are_taken_at_the_nodes_of_their_rule_alone(scheme):
    """A potential that is undefined at the end of the step, where none of these rules has a node that is solved for."""
    mass = vm.ConstantMass(np.zeros(0), np.ones(2))
    system = vm.System(mass, fast_potential=lambda q_f, params: 1e-3 * jnp.sum(jnp.sqrt(q_f)))
    none, one, h = np.zeros(0), np.ones(2), 0.1
    state = vm.State(jnp.zeros(()), none, one, none, -1.05 / h * one)
    planned = vm.plan(system, scheme, state, Solver("modes"))
    end, info, _ = jax.jit(lambda state: planned.step(state, planned.init(state, h), h))(state)
    assert np.all(np.asarray(end.q_f) < 0)
    assert vm.Result(int(info.result)).success or scheme.fast.rule.nodes[-1] == 1.0  # there is no momentum there


COMPOSED = vm.compose(vm.galerkin(1, 2, "lobatto"), [0.5, -0.3, 0.8])


@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt", "passes"),
    [
        pytest.param("sam", vm.galerkin(1, 2), 0.01, 9, marks=pytest.mark.full),
        ("general", vm.galerkin(1, 3), 0.1, 15),
        pytest.param("general", COMPOSED, 0.1, 15, marks=pytest.mark.full),
        ("free", vm.galerkin(1, 4), 0.2, 9),  # measured 7.5
        ("slow only", vm.galerkin(1, 4), 0.1, 12),  # measured 10.1
        ("weight only", vm.galerkin(1, 3), 0.05, 10),  # measured 8.6
    ],
)
def test_few_passes_and_errors_within_the_tolerance(name, scheme, macro_dt, passes, request):
    """Few passes: the matrix is that of the equations at the start."""
    system, state = start_of(name, request)
    n = state.q_s.size + state.q_f.size
    expected, info = phases(system, scheme, state, Solver("modes"), macro_dt)
    assert int(info.method.max()) == vm.Method.MODES
    assert info.iterations.mean() < passes, info.iterations.mean()
    motion = np.abs(np.diff(expected[:, :n], axis=0)).max()
    for tolerance in (1e-3, 1e-9):
        loose, _ = phases(system, scheme, state, Solver("modes", tolerance), macro_dt)
        assert largest_difference(loose[:, :n], expected[:, :n]) < tolerance * motion


@pytest.mark.parametrize(
    ("make", "scheme", "macro_dt"),
    [
        (free, vm.galerkin(1, 4), 0.2),
        (slow_only, vm.galerkin(1, 4), 0.1),
        pytest.param(weight_only, vm.galerkin(1, 3), 0.05, marks=pytest.mark.full),  # constraints are in slow_only, too
    ],
    ids=["free", "slow only", "weight only"],
)
def test_it_solves_the_equations_of_the_step(make, scheme, macro_dt):
    system, state = make()
    runs = [phases(system, scheme, state, Solver(matrix), macro_dt)[0] for matrix in ("modes", "exact")]
    assert largest_difference(*runs) / np.abs(runs[1]).max() < 1e-12  # measured 1e-14


@pytest.mark.parametrize(("name", "bound"), [("tsp", 8), pytest.param("sam", 6, marks=pytest.mark.full)])
def test_few_iterations_at_high_degree(name, bound, request):
    """Steps of about two thirds of a period of the stiff springs; the first of them settles the springs, the others the
    rotation."""
    run = vm.simulate(request.getfixturevalue(name), vm.galerkin(1, 8), macro_dt=0.04, num_steps=25)
    assert run.info.iterations.mean() < bound  # measured 6.7 and 5.0


@pytest.mark.full
def test_derivatives_by_parameters():
    system, state = general()

    def end(weight):
        run = vm.simulate(system.replace(params=weight), vm.galerkin(1, 3), state, macro_dt=0.1, num_steps=5)
        return jnp.concatenate([run.q_s[-1], run.q_f[-1]])

    eps = 1e-5
    expected = (end(np.asarray(3 + eps)) - end(np.asarray(3 - eps))) / (2 * eps)
    forward, reverse = jax.jacfwd(end)(np.asarray(3.0)), jax.jacrev(end)(np.asarray(3.0))
    assert largest_difference(forward, expected) < 1e-8
    assert largest_difference(forward, reverse) < 1e-12
