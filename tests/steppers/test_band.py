"""Long chains: constraints that share no coordinates leave zeros, and a band takes the same steps as the full matrix."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.kernels.band import Band, Full
from vmri_jax.mechanics import constraint_pattern
from vmri_jax.running.engine import engine

LINKS = 16


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


@pytest.mark.parametrize(
    "scheme", [vm.fully_explicit(2), vm.fully_implicit(2), vm.galerkin(1, 2)], ids=["rattle", "nested", "degree 2"]
)
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


def test_a_chain_is_a_band_of_its_neighbours():
    problem = chain(200)
    rows = constraint_pattern.all_rows(problem.system, problem.q_s, problem.q_f)
    assert isinstance(rows, Band)
    assert rows.width == 1


def test_a_dense_mass_leaves_no_zeros():
    problem = chain(200)
    mass = np.eye(400) + 0.001
    system = problem.system.replace(kinetic=vm.ConstantMass(np.zeros(0), mass))
    assert isinstance(constraint_pattern.all_rows(system, problem.q_s, problem.q_f), Full)
