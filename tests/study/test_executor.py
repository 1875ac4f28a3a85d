"""Studies on workers give what they give here."""

from functools import partial

import numpy as np
import pytest

import vmri_jax as vm
from tests.user_systems import two_oscillators
from vmri_jax.stability import stability_map
from vmri_jax.study import convergence_study

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("default")  # of Dask, about ports and slow loops


@pytest.fixture(scope="module")
def client():
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
    with cluster, distributed.Client(cluster) as client:
        yield client


def test_convergence_study(client):
    schemes = {"implicit": vm.fully_implicit(2), "explicit": vm.explicit_slow(2)}
    study = partial(convergence_study, two_oscillators(), schemes, [0.02, 0.01], 0.2, num_saves=2)
    assert study().to_pandas().equals(study(executor=client).to_pandas())
    assert all(row.seconds > 0 for row in study(executor=client, repeats=1).rows)


def test_stability_map(client):
    schemes = {n: vm.explicit_slow(n) for n in (2, 5)}
    grid = np.linspace(0.5, 2.0, 12) * np.pi
    problem = two_oscillators()
    here, there = (stability_map(problem, schemes, grid, executor=executor) for executor in (None, client))
    assert np.allclose(here.radius, there.radius, rtol=0, atol=1e-12)
    assert here.rows == there.rows
    assert len(here.windows(5)) == len(there.windows(5))
