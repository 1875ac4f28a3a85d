"""The benchmark of dear slow forces on two molecules: its systems, its rows, and the price of the forces."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import lpmv

import vmri_jax as vm
from benchmarks import c_loops, dear
from benchmarks.dear import compare, figures, peers, spacecraft, systems
from vmri_jax.mechanics.invariants import potential_energy
from vmri_jax.study.row import joined


def test_two_molecules(monkeypatch):
    monkeypatch.setattr(compare, "TARGET", 1e-4)
    case = compare.Case("2 molecules", partial(systems.molecules, 2), (1, 4), every=2, degree=2, errors=(1e-2, 1e-5))
    *_, report = dear.run([case], "quick")
    schemes = {row["scheme"] for row in report.rows}
    ours = {"kicks, N = 1", "kicks, N = 4", "suzuki4, N = 1", "suzuki4, N = 4", "one interval, degree 2"}
    assert {*ours, "three rates, N = 4 and 2"} <= schemes
    assert all(row["error"] <= case.errors[0] for row in report.rows)
    for scheme in ours:
        errors = [row["error"] for row in report.rows if row["scheme"] == scheme]
        assert errors[-1] < 1e-5 < errors[0]
    (gain,) = report.about["gains"]
    assert gain["bound"] == pytest.approx(4 * (gain["price"] + 1) / (gain["price"] + 4)) or gain["num_micro"] == 1
    for draw in report.figures.values():
        draw()


def test_gains_are_taken_at_the_same_error():
    single = np.array([1e-2, 1e-4]), np.array([1.0, 100.0])
    assert figures.ratio_at(single, 1e-3, 5.0) == pytest.approx(2.0)
    assert figures.ratio_at(single, 1e-5, 5.0) is None


def test_sizes():
    quick, full = dear.sizes("quick"), dear.sizes("full", ("256", "network"))
    assert len(quick) == 2
    assert [case.title for case in full] == ["network", "256 molecules"]
    for case in dear.sizes("full"):
        assert not case.every or max(case.num_micro) % case.every == 0


@pytest.mark.parametrize(
    "problem", [partial(systems.molecules, 8), systems.teacher, partial(spacecraft.spacecraft, degree=12)]
)
def test_three_rates_are_the_same_system(problem):
    one, split = problem(), problem(three_rates=True)
    q = jnp.asarray(one.q_f)

    def force(system):
        return jax.grad(lambda q: potential_energy(system, jnp.zeros(0), q))(q)

    ours, theirs = force(split.system), force(one.system)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-13 * float(jnp.abs(theirs).max()) + 1e-12)
    assert [*split.system.potentials] == [systems.MIDDLE]


# --- molecules and network -------------------------------------------------------------------------------------------
def test_bonds_are_at_rest():
    problem = systems.molecules(8)
    assert float(systems.bonds(problem.q_f, None)) == pytest.approx(0.0, abs=1e-20)
    q = np.asarray(problem.q_f).reshape(8, 2, 3)
    distances = np.linalg.norm(q[:, 0] - q[:, 1], axis=1)
    np.testing.assert_allclose(distances, systems.BOND)


def test_the_teacher_has_a_hundred_thousand_weights():
    params = systems.teacher().system.params
    count = sum(matrix.size + bias.size for matrix, bias in params["teacher"])
    assert 9e4 < count < 1.1e5
    assert jnp.isfinite(systems.network(params["teacher"], systems.teacher().q_f))


# --- the spacecraft --------------------------------------------------------------------------------------------------
def legendre(n: int, m: int, u: float) -> float:
    """Fully normalised function of Legendre, without the phase of Condon and Shortley."""
    ratio = math.exp(math.lgamma(n - m + 1) - math.lgamma(n + m + 1))
    return (-1) ** m * lpmv(m, n, u) * math.sqrt((2 - (m == 0)) * (2 * n + 1) * ratio)


@pytest.mark.parametrize("degree", [2, 8, 50])
def test_field_is_the_sum_of_spherical_harmonics(degree):
    x = np.random.default_rng(0).normal(size=(4, 3))
    x *= (spacecraft.RADIUS + 4e5) / np.linalg.norm(x, axis=1)[:, None]
    c, s = spacecraft.coefficients(degree)
    for place, ours in zip(x, spacecraft.disturbance(jnp.asarray(x), degree), strict=True):
        r, longitude = np.linalg.norm(place), np.arctan2(place[1], place[0])
        total = sum(
            (spacecraft.RADIUS / r) ** n
            * (c[n, m] * np.cos(m * longitude) + s[n, m] * np.sin(m * longitude))
            * legendre(n, m, place[2] / r)
            for n in range(2, degree + 1)
            for m in range(n + 1)
        )
        assert float(ours) == pytest.approx(-spacecraft.MU / r * total, rel=1e-10)


def test_field_at_the_pole_has_a_gradient():
    x = jnp.array([[0.0, 0.0, spacecraft.RADIUS + 4e5]])
    assert jnp.isfinite(jax.grad(lambda x: spacecraft.disturbance(x, 50)[0])(x)).all()


def test_booms_are_at_rest():
    assert float(spacecraft.booms(spacecraft.spacecraft(degree=2).q_f, None)) == pytest.approx(0.0, abs=1e-20)


# --- other programs --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("peer", peers.PEERS)
def test_peers_have_the_same_motion(peer):
    problem, t_end, num_micro = systems.molecules(2), 0.2, 4
    ready, missing = peers.chosen(problem)
    if peer not in ready:
        assert any(note.startswith(f"{peer} is not installed") for note in missing)
        pytest.skip(f"{peer} is not installed")
    exact = joined(vm.simulate(problem, vm.galerkin(1, 4, "gauss"), macro_dt=t_end / 200, num_steps=200))[0][-1]
    errors = []
    ladder = peers.PEERS[peer](problem, t_end, num_micro)
    for setting in ladder.settings:
        errors.append(float(np.abs(ladder.build(setting)() - exact).max()))
        if errors[-1] < 1e-6:
            break
    assert errors[-1] < 1e-6


@pytest.mark.skipif(c_loops.compiler() is None, reason="no C compiler (cc, gcc or clang) on the PATH")
@pytest.mark.parametrize(("count", "num_micro"), [(2, 3), (3, 1), (9, 5)])
def test_the_c_loop_computes_kicks(count, num_micro):
    problem = systems.molecules(count)
    micro_dt, num_steps = 1e-3, 50
    loop = c_loops.molecules(problem, systems.BOND, systems.STIFFNESS, num_micro, micro_dt, num_steps)
    q, p = joined(
        vm.simulate(problem, vm.fully_explicit(num_micro), macro_dt=num_micro * micro_dt, num_steps=num_steps)
    )
    (_, q_f, _, p_f), _ = loop.run()
    np.testing.assert_allclose(q_f, q[-1], rtol=0, atol=2e-11)
    np.testing.assert_allclose(p_f, p[-1], rtol=0, atol=5e-9)
    with pytest.raises(ValueError, match="at least 1"):
        c_loops.molecules(problem, systems.BOND, systems.STIFFNESS, num_micro, micro_dt, 0)
