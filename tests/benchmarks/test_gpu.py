"""The parts of the benchmark of GPUs, on the CPU: its runs, comparisons and tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import gpu
from benchmarks.instructions import double_pendulum


def test_accelerations_by_hand_are_those_of_the_lagrangian():
    """``d/dt dT/dv = d(T - W)/dq``."""
    system = double_pendulum().system
    assert system.fast_potential is not None
    potential = system.fast_potential
    none = jnp.zeros(0)
    q, v = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2)))

    def kinetic(q, v):
        return system.kinetic_energy(none, q, none, v)

    mass = jax.hessian(kinetic, 1)(q, v)
    mixed = jax.jacfwd(jax.grad(kinetic, 1), 0)(q, v)
    force = jax.grad(lambda q: kinetic(q, v) - potential(q, system.params))(q)
    expected = jnp.linalg.solve(mass, force - mixed @ v)
    np.testing.assert_allclose(gpu.by_angles(q, v), expected, rtol=1e-13)


@pytest.mark.parametrize(
    "name", ["double pendulum", *(pytest.param(n, marks=pytest.mark.full) for n in ("FPU", "TSP"))]
)
def test_all_of_a_system(name, monkeypatch):
    monkeypatch.setattr(gpu, "COMPARED", 4)
    monkeypatch.setattr(gpu, "GRADIENT_LANES", 4)
    (report,) = gpu.run(gpu.Size((name,), (4, 8), 1), "quick")
    assert [(row["program"], row["lanes"]) for row in report.rows[:4]] == [
        ("run", 4),
        ("run", 8),
        ("gradient", 4),
        ("simulate_batch", 4),
    ]
    assert all(row["lanes/s"] > 0 for row in report.rows)
    assert 1e-9 < report.rows[0]["error"] < 1e-2
    assert [claim.holds for claim in report.claims] == [True]
    assert any("no accelerator" in note for note in report.notes) == (jax.default_backend() == "cpu")
