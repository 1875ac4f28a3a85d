"""The discrete Lagrangian against loops written by hand, and where each term is evaluated."""

from collections import Counter
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.user_systems import bent_system
from vmri_jax.schemes.path import control_nodes, lagrange_basis, lagrange_derivative

N, H = 4, 0.3


def control_points(degree, n_s=3, n_f=3):
    rng = np.random.default_rng(degree)
    return rng.normal(size=(degree + 1, n_s)), rng.normal(size=(N * degree + 1, n_f))


ALPHA = 0.3


@pytest.mark.parametrize("make", [vm.fully_implicit, vm.explicit_slow, vm.fully_explicit])
def test_reference_schemes_are_the_formulas_of_the_paper(fpu, make):
    """Slow linear over the macro step, fast linear between micro nodes."""
    s, f = control_points(1)
    system, middle, theta = fpu.system, (f[1:] + f[:-1]) / 2, (np.arange(N)[:, None] + 0.5) / N

    def V(q_s, q_f):
        return float(system.slow_potential(q_s, q_f, system.params))

    def W(q_f):
        return float(system.fast_potential(q_f, system.params))

    kicks = ALPHA * V(s[0], f[0]) + (1 - ALPHA) * V(s[1], f[-1])
    slow = np.mean(list(map(V, (1 - theta) * s[0] + theta * s[1], middle))) if make is vm.fully_implicit else kicks
    ends = np.mean([ALPHA * W(a) + (1 - ALPHA) * W(b) for a, b in pairwise(f)])
    fast = ends if make is vm.fully_explicit else np.mean(list(map(W, middle)))
    kinetic = (np.sum((s[1] - s[0]) ** 2) / H + np.sum((f[1:] - f[:-1]) ** 2) * N / H) / 2  # unit masses
    scheme = make(N) if make is vm.fully_implicit else make(N, ALPHA)
    value = float(jax.jit(vm.discrete_lagrangian(system, scheme))(s, f, H))
    assert value == pytest.approx(kinetic - H * (slow + fast), rel=1e-14)


def galerkin_action(system, s, f, degree, rule):
    """The Galerkin sum as a double loop over micro intervals and nodes."""

    @jax.jit
    def lagrangian(q_s, q_f, v_s, v_f):
        potential = system.slow_potential(q_s, q_f, system.params) + system.fast_potential(q_f, system.params)
        return system.kinetic_energy(q_s, q_f, v_s, v_f) - potential

    value = 0.0
    for m in range(N):
        points = f[m * degree : (m + 1) * degree + 1]
        for c, w in zip(rule.nodes, np.asarray(rule.weights), strict=True):
            theta = (m + c) / N
            q_s, v_s = lagrange_basis(degree, theta) @ s, lagrange_derivative(degree, theta) @ s / H
            q_f, v_f = lagrange_basis(degree, c) @ points, lagrange_derivative(degree, c) @ points * N / H
            value += H / N * w * lagrangian(q_s, q_f, v_s, v_f)
    return value


@pytest.mark.parametrize("name", ["gauss", "lobatto"])
def test_degree_two_is_a_sum_over_nodes(fpu, name):
    rule = vm.quadrature.gauss(2) if name == "gauss" else vm.quadrature.lobatto(3)
    s, f = control_points(2)
    for system in (fpu.system, bent_system()):
        expected = galerkin_action(system, s, f, 2, rule)
        value = float(jax.jit(vm.discrete_lagrangian(system, vm.galerkin(N, 2, name)))(s, f, H))
        assert value == pytest.approx(float(expected), rel=1e-13)


@pytest.mark.parametrize("scheme", [vm.explicit_slow(N, 0.3), vm.galerkin(N, 2)], ids=["explicit slow", "gauss 2"])
def test_discrete_legendre_transforms_are_slot_derivatives(fpu, scheme):
    s, f = control_points(scheme.degree)
    L_d = jax.jit(vm.discrete_lagrangian(fpu.system, scheme))
    start, end = jax.jit(vm.discrete_legendre(fpu.system, scheme))(s, f, H)
    eps = 1e-5
    for (p_s, p_f), k, sign in ((start, 0, -1), (end, -1, 1)):
        for p, slot in ((p_s, s), (p_f, f)):
            for i in range(3):
                shifted = []
                for step in (eps, -eps):
                    moved = slot.copy()
                    moved[k, i] += step
                    shifted.append(L_d(moved, f, H) if slot is s else L_d(s, moved, H))
                difference = sign * (shifted[0] - shifted[1]) / (2 * eps)
                assert float(p[i]) == pytest.approx(float(difference), rel=1e-6, abs=1e-6)  # measured 1e-8


def test_straight_motion_has_its_own_momentum(fpu):
    """Without potentials, the Legendre transforms of a straight path are mass times velocity."""
    free = fpu.system.replace(slow_potential=None, fast_potential=None)
    v_s, v_f = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.2, -1.0])
    for degree in (1, 2, 3):
        fast_times = np.array([(m + c) / N for m in range(N) for c in control_nodes(degree)[bool(m) :]])
        path = H * control_nodes(degree)[:, None] * v_s, H * fast_times[:, None] * v_f
        for p_s, p_f in jax.jit(vm.discrete_legendre(free, vm.galerkin(N, degree)))(*path, H):
            assert np.allclose(p_s, v_s, rtol=0, atol=1e-13)
            assert np.allclose(p_f, v_f, rtol=0, atol=1e-13)


EVALUATIONS = Counter()


@pytest.fixture
def counted(fpu):
    """The chain, whose potentials count every evaluation at run time (each lane of a vmap once)."""

    def counting(name, function):
        def call(*args):
            jax.debug.callback(lambda _: EVALUATIONS.update([name]), jnp.sum(args[0]))
            return function(*args)

        return call

    V, W = counting("V", fpu.system.slow_potential), counting("W", fpu.system.fast_potential)
    return fpu.system.replace(slow_potential=V, fast_potential=W)


@pytest.mark.parametrize("alpha", [0.5, 0.0])
def test_explicit_chain_evaluates_v_once_and_w_num_micro_times_per_macro_step(fpu, counted, alpha):
    counts = []
    for n in (10, 25):
        EVALUATIONS.clear()
        run = vm.simulate(counted, vm.fully_explicit(7, alpha), fpu.state(), macro_dt=0.01, num_steps=n, save=n)
        jax.effects_barrier()
        counts.append(EVALUATIONS.copy())
    assert counts[1]["V"] - counts[0]["V"] == 15
    assert counts[1]["W"] - counts[0]["W"] == 15 * 7
    assert np.max(run.info.iterations) == 0
