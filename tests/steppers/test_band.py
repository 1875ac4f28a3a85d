"""Long chains: constraints that share no coordinates leave zeros, as do springs; a band takes the same steps as the
full matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.kernels.band import Band, Full
from vmri_jax.mechanics import constraint_pattern
from vmri_jax.running.engine import engine
from vmri_jax.steppers import interval

LINKS = 8


def chain(links: int = LINKS) -> vm.Problem:
    """Points in a plane, hung from the origin one below the other, all fast."""

    def lengths(q_s, q_f, params):
        points = jnp.concatenate([jnp.zeros((1, 2)), q_f.reshape(-1, 2)])
        return (jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1) - 1) / 2

    def weight(q_f, params):
        return 9.81 * jnp.sum(q_f.reshape(-1, 2)[:, 1])

    place = np.stack([np.arange(1, links + 1), np.zeros(links)], axis=1)
    system = vm.System(vm.ConstantMass(np.zeros(0), np.ones(2 * links)), fast_potential=weight, constraint=lengths)
    return vm.Problem(system, q_s=np.zeros(0), q_f=place.reshape(-1))


NESTED = pytest.param(vm.fully_implicit(2), marks=pytest.mark.full, id="nested")
"""For --full: its rows are those of RATTLE."""


@pytest.mark.parametrize("scheme", [vm.fully_explicit(2), NESTED, vm.galerkin(1, 2)])
def test_a_band_takes_the_same_steps(scheme, monkeypatch):
    runs = []
    for few in (LINKS, LINKS - 1):
        monkeypatch.setattr(constraint_pattern, "MOST_ROWS_OF_FULL_MATRIX", few)
        engine.cache_clear()  # functions of equal surroundings share their programs
        problem = chain()
        rows = constraint_pattern.all_rows(problem.system, problem.q_s, problem.q_f)
        assert isinstance(rows, Full if few == LINKS else Band)
        runs.append(vm.simulate(problem, scheme, macro_dt=0.02, num_steps=20))
    full, band = (np.asarray(run.q_f) for run in runs)
    assert 0 < np.abs(full - band).max() < 1e-12  # other programs differ by round-off


def test_a_chain_is_a_band_of_its_neighbours_and_a_dense_mass_leaves_no_zeros():
    problem = chain(200)
    rows = constraint_pattern.all_rows(problem.system, problem.q_s, problem.q_f)
    assert isinstance(rows, Band)
    assert rows.width == 1
    system = problem.system.replace(kinetic=vm.ConstantMass(np.zeros(0), np.eye(400) + 0.001))
    assert isinstance(constraint_pattern.all_rows(system, problem.q_s, problem.q_f), Full)


def linear_springs(q_f, params):
    """A ring: each mass is tied to its neighbours, the last one to the first; one pair across the ring by a very weak
    spring."""
    return 50.0 * jnp.sum((q_f - jnp.roll(q_f, 1)) ** 2) + 1e-9 * (q_f[0] - q_f[3]) ** 2


def springs(q_f, params):
    return linear_springs(q_f, params) + jnp.sum((q_f - jnp.roll(q_f, 1)) ** 4)


def ring(n: int, potential=springs) -> vm.Problem:
    system = vm.System(vm.ConstantMass([], np.ones(n)), fast_potential=potential)
    return vm.Problem(system, [], np.zeros(n), [], np.random.default_rng(0).normal(size=n))


def test_springs_are_a_band(monkeypatch):
    """In one micro interval of degree 1: `test_memory_of_long_chains`."""
    runs = []
    for few in (36, 35):
        monkeypatch.setattr(interval, "MOST_ROWS_OF_FULL_MATRIX", few)
        engine.cache_clear()
        runs.append(vm.prepare(ring(36), vm.galerkin(2, 2), macro_dt=0.05, num_steps=10)())
    full, band = (np.asarray(run.q_f) for run in runs)
    assert 0 < np.abs(full - band).max() < 1e-12  # other programs differ by round-off


def test_linear_equations_of_a_band_are_exact(monkeypatch):
    """The weak spring counts, too: a matrix without it would be wrong by 1e-11 a step."""
    monkeypatch.setattr(interval, "MOST_ROWS_OF_FULL_MATRIX", 0)
    problem = ring(36, linear_springs)
    run = vm.simulate(problem, vm.fully_implicit(1), macro_dt=0.05, num_steps=200)
    assert run.info.method.max() == vm.Method.LINEAR
    matrix = np.asarray(jax.jit(jax.hessian(linear_springs))(problem.q_f, None))
    left, right = np.eye(36) + 0.05**2 / 4 * matrix, np.eye(36) - 0.05**2 / 4 * matrix
    q = [problem.q_f, np.asarray(run.q_f[1])]
    for _ in range(199):  # (1 + h^2 K / 4) (q_2 + q_0) = 2 (1 - h^2 K / 4) q_1, the midpoint rule
        q.append(np.linalg.solve(left, 2 * right @ q[-1]) - q[-2])
    assert np.abs(q - np.asarray(run.q_f)).max() < 1e-12


def test_memory_of_long_chains():
    """In proportion to the number of springs: a full matrix of a thousand coordinates alone has 8 MB."""
    run = vm.prepare(ring(1000), vm.fully_implicit(1), macro_dt=0.01, num_steps=4, save=4)
    memory = run.compiled().memory_analysis()
    assert memory is not None
    assert memory.temp_size_in_bytes < 1e6
    energy = run().energy
    assert abs(energy[-1] / energy[0] - 1) < 1e-4
