"""The benchmark of dear slow forces on two molecules: its systems, its rows, and the price of the forces."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import dear


def test_two_molecules(monkeypatch):
    monkeypatch.setattr(dear, "SMALLEST", 1e-5)
    monkeypatch.setattr(dear, "TARGET", 1e-3)
    *_, report = dear.run([dear.Case("2 molecules", partial(dear.molecules, 2), (1, 4))], "quick")
    schemes = {row["scheme"] for row in report.rows}
    assert {"kicks, N = 1", "kicks, N = 4", "suzuki4, N = 1", "suzuki4, N = 4"} <= schemes
    assert all(row["error"] <= dear.LARGEST for row in report.rows)
    for scheme in schemes:
        errors = [row["error"] for row in report.rows if row["scheme"] == scheme]
        assert errors[-1] < 1e-5 < errors[0]
    report.figures["dear"]()


def test_bonds_are_at_rest():
    problem = dear.molecules(8)
    assert float(dear.bonds(problem.q_f, None)) == pytest.approx(0.0, abs=1e-20)
    q = np.asarray(problem.q_f).reshape(8, 2, 3)
    distances = np.linalg.norm(q[:, 0] - q[:, 1], axis=1)
    np.testing.assert_allclose(distances, dear.BOND)


def test_the_teacher_has_a_hundred_thousand_weights():
    params = dear.teacher().system.params
    count = sum(matrix.size + bias.size for matrix, bias in params["teacher"])
    assert 9e4 < count < 1.1e5
    assert jnp.isfinite(dear.network(params["teacher"], dear.teacher().q_f))
