"""Potentials with rates of their own: r-RESPA of three levels written out in numpy, and what holds for every placement.

A chain of four atoms in the plane, all of them fast: bonds on every micro node, bends on every fourth, pairs at the
macro nodes.
"""

from collections import Counter
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import NAMES, area_change
from tests.textbook.residual import residual
from vmri_jax import textbook
from vmri_jax.schemes.quadrature import gauss, midpoint, simpson, trapezoidal

NUM_MICRO, EVERY, H = 32, 8, 0.05
MASS = np.array([2.0, 2.0, 1.0, 1.0, 1.5, 1.5, 1.0, 1.0])
POINTS = np.array([0.0, 0.0, 1.0, 0.1, 1.9, -0.2, 2.9, 0.1])
VELOCITY = np.array([0.1, 0.3, -0.2, -0.1, 0.05, -0.2, -0.1, 0.2])
LENGTHS = jnp.linalg.norm(jnp.diff(POINTS.reshape(4, 2), axis=0), axis=1)
NONE = np.zeros(0)


def pairs(q_s, q_f, params):
    """Soft repulsion of atoms that no bond joins."""
    x = q_f.reshape(-1, 2)
    i, j = np.array([0, 0, 1]), np.array([2, 3, 3])
    return jnp.sum(1 / jnp.sum((x[i] - x[j]) ** 2, axis=1))


def bends(q_s, q_f, params):
    """Springs at the angles."""
    d = jnp.diff(q_f.reshape(-1, 2), axis=0)
    sine = d[:-1, 0] * d[1:, 1] - d[:-1, 1] * d[1:, 0]
    return params["bends"] / 2 * jnp.sum(jnp.arctan2(sine, jnp.sum(d[:-1] * d[1:], axis=1)) ** 2)


def bonds(q_s, q_f, params):
    """Stiff springs between neighbours."""
    lengths = jnp.linalg.norm(jnp.diff(q_f.reshape(-1, 2), axis=0), axis=1)
    return params["bonds"] / 2 * jnp.sum((lengths - LENGTHS) ** 2)


def rigid(q_s, q_f, params):
    """Bonds of constant length."""
    d = jnp.diff(q_f.reshape(-1, 2), axis=0)
    return (jnp.sum(d * d, axis=1) - LENGTHS**2) / 2


PARAMS = {"bends": np.asarray(40.0), "bonds": np.asarray(2000.0)}
LEVELS = {"pairs": pairs, "bends": bends, "bonds": bonds}
RULES = {"pairs": vm.macro(trapezoidal), "bends": vm.micro(trapezoidal, every=EVERY), "bonds": vm.micro(trapezoidal)}
SCHEME = vm.fully_explicit(NUM_MICRO).with_potentials(**RULES)
CHAIN = vm.System(vm.ConstantMass(NONE, MASS), params=PARAMS, potentials=LEVELS)
START = vm.initial_state(CHAIN, NONE, POINTS, NONE, VELOCITY)


def respa(q, p, num_steps: int, rows=None):
    """(q, p) after steps of nested velocity Verlet; with constraint `rows` its drifts are SHAKE's, and p is projected
    at the end."""
    inverse, (slow, between, fast) = 1 / np.asarray(MASS), map(_force, LEVELS.values())
    h = H / NUM_MICRO
    value = jax.jit(rows or (lambda q: q[:0]))
    jacobian = jax.jit(jax.jacrev(value))

    def drift(q, p):
        if rows is None:
            return q + h * inverse * p, p
        G, new = np.asarray(jacobian(q)), q + h * inverse * p
        for _ in range(12):
            mu = np.linalg.solve(np.asarray(jacobian(new)) @ (inverse[:, None] * G.T), np.asarray(value(new)))
            new = new - inverse * (G.T @ mu)
        return new, (new - q) / (h * inverse)

    for _ in range(num_steps):
        p = p + H / 2 * slow(q)
        for _ in range(NUM_MICRO // EVERY):
            p = p + EVERY * h / 2 * between(q)
            for _ in range(EVERY):
                p = p + h / 2 * fast(q)
                q, p = drift(q, p)
                p = p + h / 2 * fast(q)
            p = p + EVERY * h / 2 * between(q)
        p = p + H / 2 * slow(q)
    if rows is not None:
        G = np.asarray(jacobian(q))
        p = p - G.T @ np.linalg.solve(G @ (inverse[:, None] * G.T), G @ (inverse * p))
    return q, p


@cache
def _force(potential):
    compiled = jax.jit(jax.grad(lambda q: -potential(NONE, q, PARAMS)))
    return lambda q: np.asarray(compiled(q))


def test_equals_respa():
    run = vm.simulate(CHAIN, SCHEME, START, macro_dt=H, num_steps=10, save=10)
    q, p = respa(np.asarray(START.q_f), np.asarray(START.p_f), 10)
    assert np.abs(run.q_f[-1] - q).max() < 1e-13
    assert np.abs(run.p_f[-1] - p).max() < 1e-12
    assert int(run.info.iterations[-1]) == 0


def test_equals_respa_with_constraints():
    system = CHAIN.replace(constraint=rigid)
    start = vm.initial_state(system, NONE, POINTS, NONE, VELOCITY, project=True)
    run = vm.simulate(system, SCHEME, start, macro_dt=H, num_steps=10, save=10)
    q, p = respa(np.asarray(start.q_f), np.asarray(start.p_f), 10, lambda q: rigid(NONE, q, PARAMS))
    assert np.abs(run.q_f[-1] - q).max() < 1e-12
    # SHAKE divides differences of positions by h: a start that is off by round-off moves its p by 4e-12
    assert np.abs(run.p_f[-1] - p).max() < 1e-11  # measured 3e-12
    assert np.abs(run.constraint_residual).max() < 1e-14  # measured 6e-16


EVALUATIONS = Counter()


def counted(name, function):
    """The function, counting every evaluation at run time."""

    def call(*args):
        jax.debug.callback(lambda _: EVALUATIONS.update([name]), jnp.sum(args[1]))
        return function(*args)

    return call


def test_evaluations():
    """As `describe` says, and one more at the start of the run."""
    system = CHAIN.replace(potentials={name: counted(name, function) for name, function in LEVELS.items()})
    counts = []
    for num_steps in (3, 13):
        EVALUATIONS.clear()
        vm.simulate(system, SCHEME, START, macro_dt=H, num_steps=num_steps, save=num_steps)
        jax.effects_barrier()
        counts.append(EVALUATIONS.copy())
    per_step = {name: (counts[1][name] - counts[0][name]) / 10 for name in LEVELS}
    assert per_step == {"pairs": 1, "bends": 4, "bonds": 32} == SCHEME.describe().evaluations


def test_order():
    """Of positions and momenta together; measured 2.00. Compositions are in `tests/schemes/test_composition.py`."""
    steps = 16, 24, 32
    assert SCHEME.order == 2
    runs = [vm.simulate(CHAIN, SCHEME, START, macro_dt=0.8 / n, num_steps=n, save=n) for n in (*steps, 512)]
    ends = np.array([np.concatenate([run.q_f[-1], run.p_f[-1]]) for run in runs])
    errors = np.linalg.norm(ends[:-1] - ends[-1], axis=1)
    assert abs(-np.polyfit(np.log(steps), np.log(errors), 1)[0] - 2) < 0.2


def invariants(state):
    """Linear momentum in the plane, and the angular momentum."""
    p, x = state.p_f.reshape(-1, 2), state.q_f.reshape(-1, 2)
    return jnp.append(p.sum(0), jnp.sum(x[:, 0] * p[:, 1] - x[:, 1] * p[:, 0]))


def test_symplectic_with_momentum_maps():
    def ends(x):
        start = vm.initial_state(CHAIN, NONE, POINTS + 0.3 * x[:8], NONE, VELOCITY + 0.3 * x[8:])
        return start, vm.simulate(CHAIN, SCHEME, start, macro_dt=H, num_steps=1)[-1]

    assert area_change(ends, 16) < 1e-11
    run = vm.simulate(CHAIN, SCHEME, START, macro_dt=H, num_steps=50)
    values = np.asarray(jax.jit(jax.vmap(lambda q, p: invariants(vm.State(0.0, NONE, q, NONE, p))))(run.q_f, run.p_f))
    assert np.abs(values - values[0]).max() < 2e-13  # measured 2e-14
    assert np.ptp(run.energy) < 2e-2 * float(run.energy[0])  # measured 1.2e-2


def test_batch_and_gradient():
    """Lanes of values and gradients equal runs, and their finite differences by a stiffness."""

    def end(stiffness):
        system = CHAIN.replace(params={**PARAMS, "bends": stiffness})
        return vm.simulate(system, SCHEME, START, macro_dt=H, num_steps=10, save=10).q_f[-1, -1]

    stiffness = np.array([30.0, 40.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(end)))(stiffness)
    np.testing.assert_allclose(values, [end(k) for k in stiffness], rtol=0, atol=1e-13)
    differences = [(end(k + 1e-3) - end(k - 1e-3)) / 2e-3 for k in stiffness]
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)


def soft(q_s, q_f, params):
    """Joins all variables."""
    return 0.3 * (jnp.sum(q_s) - jnp.sum(q_f)) ** 2 + jnp.sum(jnp.cos(q_s))


def hinge(q_s, q_f, params):
    """Joins slow and fast variables stiffly."""
    return 100 * jnp.sum((q_s - q_f) ** 2) + jnp.sum(q_f**3 * q_s)


def middle(q_s, q_f, params):
    """Of fast variables alone."""
    return 10 * (q_f[1] - q_f[0]) ** 2 + jnp.sum(q_f**3)


def stiff(q_f, params):
    """Of fast variables alone."""
    return 50 * jnp.sum(q_f**2 * (1 + q_f**2 / 10))


def quartic(q_s, q_f, params):
    """Of fast variables alone."""
    return jnp.sum(q_f**4)


def of_slow(q_s, q_f, params):
    """Of slow variables alone."""
    return jnp.sum(q_s**4)


def rod(q_s, q_f, params):
    """From the slow to the fast point."""
    return jnp.array([(q_f - q_s) @ (q_f - q_s) - 1.0]) / 2


def kinetic(q_s, q_f, v_s, v_f, params):
    """Masses that depend on the configuration."""
    return jnp.sum((2 + jnp.sin(q_s)) * v_s**2) / 2 + v_f @ v_f / 2 + 0.1 * v_s[0] * v_f[1] * jnp.cos(q_f[0])


MASSES = vm.ConstantMass([2.0, 2.0], [1.0, 1.0])
TWO = vm.System(MASSES, soft, stiff)
FREE = np.array([0.1, 0.2]), np.array([0.05, -0.02]), np.array([1.0, 0.0]), np.array([0.5, 1.0])
HELD = np.array([0.0, 0.0]), np.array([0.6, -0.8]), np.array([1.0, 0.0]), np.array([1.8, 0.6])
EXPLICIT, IMPLICIT, KICKS = vm.fully_explicit(6), vm.explicit_slow(6), vm.micro(trapezoidal)
HALF, EVERY_SECOND, MACRO = vm.micro(midpoint), vm.micro(trapezoidal, every=2), vm.macro(trapezoidal)
BOTH = vm.Scheme(6, kinetic=HALF, slow=EVERY_SECOND, fast=EVERY_SECOND)
PLACEMENTS = {
    "no chain of rates": (TWO.replace(potentials={2: middle, 3: hinge}), EXPLICIT, FREE),
    "another rule": (
        TWO.replace(potentials={"a": hinge}),
        IMPLICIT.with_potentials(a=vm.micro(simpson, every=3)),
        FREE,
    ),
    "slow and fast, on the micro grid": (TWO.replace(potentials={"fast": hinge}), IMPLICIT, FREE),
    "V between the grids": (TWO, vm.Scheme(6, kinetic=HALF, slow=EVERY_SECOND, fast=HALF), FREE),
    "W between the grids": (
        TWO.replace(potentials={"a": middle}),
        vm.Scheme(6, kinetic=HALF, slow=MACRO, fast=EVERY_SECOND).with_potentials(a=KICKS),
        FREE,
    ),
    "V, W and more of fast variables between the grids": (
        TWO.replace(slow_potential=middle, potentials={"slow": quartic, "V beside slow": middle}),
        BOTH.with_potentials(**dict.fromkeys(("slow", "V beside slow"), EVERY_SECOND)),
        FREE,
    ),
    "of slow variables alone": (
        TWO.replace(slow_potential=None, potentials={"a": of_slow, 3: middle}),
        IMPLICIT.with_potentials(a=vm.macro(midpoint)),
        FREE,
    ),
    "a constraint between slow and fast": (TWO.replace(constraint=rod, potentials={2: hinge}), EXPLICIT, HELD),
    "kinetic function": (
        vm.System(kinetic, soft, stiff, potentials={2: hinge, "a": middle}),
        EXPLICIT.with_potentials(a=vm.micro(midpoint)),
        FREE,
    ),
    "degree 2": (
        TWO.replace(potentials={"a": hinge}),
        vm.galerkin(4, 2).with_potentials(a=vm.micro(gauss(2), every=2)),
        FREE,
    ),
}


ALIKE = ("another rule", "degree 2", "kinetic function", "W between the grids", "slow and fast, on the micro grid")
"""For --full: rules and kinetic functions are in `tests/textbook`, W between the grids is beside V there, and `hinge`
is on other grids."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.full if n in ALIKE else ()) for n in PLACEMENTS])
def test_every_placement_is_that_of_the_textbook(name):
    system, scheme, start = PLACEMENTS[name]
    state = vm.initial_state(system, *start)
    if scheme.degree == 1:
        run = vm.simulate(system, scheme, state, macro_dt=0.04, num_steps=2, save=vm.Save(micro=True))
        assert residual(system, scheme, run, 0.04) < 1e-12
        return
    run = vm.simulate(system, scheme, state, macro_dt=0.04, num_steps=2)
    right = jax.jit(lambda state: textbook.simulate(system, scheme, state, 0.04, 2))(state)
    for part in NAMES:
        assert np.abs(getattr(run, part) - getattr(right, part)).max() < 2e-13  # measured 3e-14
