"""Studies on executors and in this process have the same results; `tests/ensembles/test_workers.py` has a cluster."""

import pickle
from concurrent.futures import Executor, Future
from functools import partial

import numpy as np
import pytest

import vmri_jax as vm
from tests.user_systems import two_oscillators
from vmri_jax.executors.executor import in_worker
from vmri_jax.stability import stability_map
from vmri_jax.study import convergence_study


class Travelling(Executor):
    """Tasks and results travel as bytes, as to a worker and back, but the worker is this process: programs are compiled once."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        fn, args, kwargs = pickle.loads(pickle.dumps((fn, args, kwargs)))
        future: Future = Future()
        future.set_result(pickle.loads(pickle.dumps(fn(*args, **kwargs))))
        return future


@pytest.fixture(autouse=True)
def set_up(monkeypatch):
    """This process has its settings already."""
    monkeypatch.setattr(f"{in_worker.__module__}._prepare", lambda process: None)


def test_convergence_study():
    schemes = {"implicit": vm.fully_implicit(2), "explicit": vm.explicit_slow(2)}
    study = partial(convergence_study, two_oscillators(), schemes, [0.02, 0.01], 0.2, num_saves=2)
    assert study().to_pandas().equals(study(executor=Travelling()).to_pandas())
    assert all(row.seconds > 0 for row in study(executor=Travelling(), repeats=1).rows)


def test_stability_map():
    schemes = {n: vm.fully_explicit(n) for n in (2, 5)}
    grid = np.linspace(0.5, 2.0, 12) * np.pi
    here, there = (stability_map(two_oscillators(), schemes, grid, executor=e) for e in (None, Travelling()))
    assert np.allclose(here.radius, there.radius, rtol=0, atol=1e-12)
    assert here.rows == there.rows
    assert here.unstable == there.unstable
    assert here.unstable[0]
