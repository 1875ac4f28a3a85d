"""Systems that are driven or move: what is said about them is what a run does."""

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.small_systems import moving_constraints
from tests.stability.driven_systems import SYSTEMS, mathieu
from vmri_jax.hard_cases.cases import resolved
from vmri_jax.stability.drive import drive_period, driven_motion

QUICK = ("Paul trap, q = 0.25, 2 steps", "Mathieu, first tongue", "moon on its orbit")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in SYSTEMS]
)
def test_what_is_said_is_what_a_run_of_a_thousand_periods_does(name):
    driven = SYSTEMS[name]()
    advice = vm.advise(driven.problem, driven.scheme, macro_dt=driven.macro_dt)
    grown = driven.largest()  # 1.00 to 1.01 of stable runs, at least 5 of others
    assert grown < 1.1 if driven.stable_run else grown > 3
    said = str(advice)
    assert "by itself" not in said
    assert "frequency 0" not in said
    if driven.stable_run:
        assert advice.ok
        assert f"macro_dt = {driven.macro_dt:.6g} is stable" in said
    elif driven.stable:
        assert not advice.ok
        assert "is unstable over a period of the drive" in said
        assert advice.growth > 0
    else:
        assert "is as unstable as the motion itself over a period of the drive" in said
    assert ("no equilibrium" in said) == (name in ("moon on its orbit", "spinning top"))


@pytest.mark.parametrize(("steps", "kind"), [(32.0, "motion"), (0.5, "drive")])
def test_multipliers_of_the_motion_are_those_of_the_equation(steps, kind):
    """Mathieu's characteristic exponent at a = 1, q = 0.2, from an ODE solver: 0.3123 per period.

    Two periods in a step see no drive.
    """
    driven = mathieu(1.0, 0.2, steps=steps)
    advice = vm.advise(driven.problem, driven.scheme, macro_dt=driven.macro_dt)
    assert advice.findings[0].kind == kind
    assert advice.ok == (steps > 1)
    [motion] = [finding for finding in advice.findings if finding.kind == "motion"]
    assert motion.number * np.pi == pytest.approx(mathieu_exponent(1.0, 0.2), rel=0.05)


def mathieu_exponent(a: float, q: float) -> float:
    """Logarithm of the largest multiplier, by Runge and Kutta's classical method with 2000 steps."""
    z, h = np.eye(2), np.pi / 2000

    def rate(t, z):
        return np.stack([z[1], -(a - 2 * q * np.cos(2 * t)) * z[0]])

    for t in h * np.arange(2000):
        k1 = rate(t, z)
        k2 = rate(t + h / 2, z + h / 2 * k1)
        k3 = rate(t + h / 2, z + h / 2 * k2)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(t + h, z + h * k3))
    return float(np.log(np.abs(np.linalg.eigvals(z)).max()))


def drive(t, q_s, q_f, v_s, v_f, params):
    waves = jnp.sum(params["size"] * jnp.cos(params["omega"] * t))
    along_an_arm = jnp.cos(q_s) * (waves * jnp.sin(q_s)) - jnp.sin(q_s) * (waves * jnp.cos(q_s))  # round-off
    pulse = params["pulse"] * jnp.exp(-((t - 5) ** 2))
    return along_an_arm, -q_f + waves + pulse + params["chirp"] * jnp.cos(t * t)


def driven_by(size, omega, pulse=0.0, chirp=0.0) -> vm.Problem:
    params = {"size": np.array(size), "omega": np.array(omega), "pulse": pulse, "chirp": chirp}
    return vm.Problem(vm.System(vm.ConstantMass([1.0], [1.0]), force=drive, params=params), [0.0], [0.0])


@pytest.mark.parametrize(
    ("waves", "scale", "period"),
    [
        (([1.0, 0.0], [3.0, 0.0]), 0.1, 2 * np.pi / 3),
        (([1.0, 1.0], [2.0, 3.0]), 0.1, 2 * np.pi),
        (([1.0, 1.0], [2.0, 8**0.5]), 0.1, None),
        (([1.0, 0.0], [2000.0, 0.0]), 0.1, np.pi / 1000),
        (([1.0, 0.0], [0.05, 0.0]), 0.1, 40 * np.pi),
        (([0.0, 0.0], [0.0, 0.0], 1.0), 0.1, None),
        (([1.0, 0.0], [3.0, 0.0], 1.0), 0.1, None),
        (([0.0, 0.0], [0.0, 0.0], 0.0, 1.0), 0.1, None),
    ],
)
def test_the_period_of_a_drive(waves, scale, period):
    problem = driven_by(*waves)
    seen = drive_period(problem.system, problem.state(), scale)
    assert seen == (None if period is None else pytest.approx(period, rel=1e-10))


def test_a_drive_without_a_period_is_said_to_be_frozen():
    problem = driven_by([0.0, 0.0], [0.0, 0.0], pulse=1.0)
    advice = vm.advise(problem, vm.fully_explicit(1), macro_dt=0.1)
    assert "The force depends on time: the motion is linearised at t = 0 alone" in str(advice)
    assert "stable for small motions about this state, held at rest" in advice.verdict


def test_disturbances_of_a_linear_system_repeat_themselves():
    """The driven oscillator comes back elsewhere after a period, and its disturbances do the same in each: it is
    linear."""
    driven = mathieu(2.5, 0.0, 1.0)
    motion = driven_motion(driven.problem.system, driven.scheme, driven.problem.state(), 0.1, np.pi)
    assert motion.growth == 0
    assert motion.repeats


@pytest.mark.full
def test_a_motion_that_differs_from_period_to_period_is_not_called_unstable():
    """A rod that turns over on a swinging circle; 209.4 steps in a period."""
    advice = vm.advise(moving_constraints(), vm.fully_explicit(1), macro_dt=0.01)
    assert advice.ok
    assert "In the next one this is different: a run over many periods decides" in str(advice)
    assert "is as good as smaller ones over a period of the drive, 2.094" in advice.verdict


def test_hard_cases_resolve_the_drive():
    """A soft spring of frequency 0.1, and a drive of frequency 2."""
    assert resolved(mathieu(0.01, 0.0, 1.0).problem).omega == pytest.approx(2.0, rel=1e-9)


def shaken_pivot(t, q_s, q_f, v_s, v_f, params):
    """A pendulum of 0.5 m at the angle q_f from straight up, on a pivot that moves by ``0.05 cos(omega t)``."""
    omega = params["omega"]
    return q_s, (9.81 - 0.05 * omega**2 * jnp.cos(omega * t)) / 0.5 * jnp.sin(q_f)


@pytest.mark.parametrize(("omega", "growth"), [(61.0, 0.115), (62.4, 0.0506), (66.0, 0.0)])
def test_steps_that_do_not_divide_the_period(omega, growth):
    """Near the border of stability, 62.6 rad/s, the product of steps over nearly three periods would have other
    multipliers."""
    system = vm.System(vm.ConstantMass([], [1.0]), force=shaken_pivot, params={"omega": omega})
    advice = vm.advise(vm.Problem(system, [], [0.0]), vm.fully_explicit(10), macro_dt=0.01)
    assert [finding.kind for finding in advice.findings] == ["motion"]
    period = 2 * np.pi / omega
    assert np.expm1(advice.findings[0].number * period) == pytest.approx(growth, rel=0.01, abs=1e-4)  # by DOP853
