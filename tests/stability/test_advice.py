"""Advice: what is unstable is named, measured, and cured by the step it proposes."""

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import vmri_jax as vm
from vmri_jax import Names, Problem, State, System, compose, fully_explicit, fully_implicit
from vmri_jax.diagnostics import linearise
from vmri_jax.stability import advise, linear_model, stability_map
from vmri_jax.stability.advice import _kicks_in_phase
from vmri_jax.stability.multipliers import TOLERANCE
from vmri_jax.systems.fermi_pasta_ulam import soft_springs


def kinds(advice, severity="error"):
    return [finding.kind for finding in advice.findings if finding.severity == severity]


def test_impulse_resonance_of_the_chain(fpu):
    """FPU at omega H = pi."""
    scheme, state = fully_explicit(30), fpu.state()
    advice = advise(fpu.system, scheme, state, macro_dt=0.0627)
    assert kinds(advice) == ["impulse resonance"]
    assert not advice.ok
    assert advice.growth == pytest.approx(5.0e-3, rel=0.1)
    assert "pi in a macro step" in str(advice)
    assert "tenfold in 45" in str(advice)
    assert 0.06 < advice.safe_macro_dt < 0.066
    assert advice.safe_macro_dt != 0.0627
    again = advise(fpu.system, scheme, state, macro_dt=advice.safe_macro_dt)
    assert again.ok
    assert again.findings == ()
    assert again.safe_macro_dt == again.macro_dt == advice.safe_macro_dt
    near = advise(fpu.system, scheme, state, macro_dt=0.063)
    assert near.growth == 0
    assert kinds(near, "warning") == ["impulse resonance"]
    assert not near.ok


def test_combination_resonance():
    """Linear model, kappa 25, omega h = 0.1, num_micro 57, fully implicit: in advice and in a map; `test_linear` has
    the derivative of a step itself."""
    problem = linear_model()
    advice = advise(problem, fully_implicit(57), macro_dt=0.114)
    assert kinds(advice) == ["combination resonance"]
    assert advice.growth == pytest.approx(8.4e-4, abs=2e-5)
    assert "frequencies 50.25 and 4.975" in str(advice)
    assert advice.safe_macro_dt == pytest.approx(0.114, rel=0.01)
    assert any(a < 0.114 < b for a, b, _ in advice.windows)
    x = 57 * 0.1  # omega H
    for inside in ([x], []):  # a window between two stable points of the grid is found, too
        mapped = stability_map(problem, fully_implicit(57), [x - 0.02, *inside, x + 0.02])
        assert max(mapped.radius[0, 0], mapped.radius[0, -1]) <= 1 + TOLERANCE
        [(start, stop, peak)] = mapped.windows()
        assert peak == pytest.approx(8.44e-4, rel=0.02)
        assert start < x < stop < start + 0.01


@pytest.mark.parametrize(("x", "severity"), [(1.6, None), (1.98, "warning"), (2.1, "error")])
def test_stability_limit_of_the_chain(fpu, x, severity):
    advice = advise(fpu, fully_explicit(1), macro_dt=x / 50)
    assert advice.ok == (severity is None)
    assert (advice.growth > 0) == (severity == "error")
    if severity:
        assert kinds(advice, severity) == ["stability limit"]
        assert "stable below 2" in str(advice)
        assert 1.7 / 50 < advice.safe_macro_dt < 2.0 / 50


def test_stages_of_a_composition(fpu):
    advice = advise(fpu, compose(fully_explicit(1), "yoshida4"), macro_dt=1.6 / 50)
    assert kinds(advice) == ["stability limit"]
    assert "longest stage" in str(advice)
    assert kinds(advice, "note") == ["motion", "stages"]  # the chain starts in motion
    [note] = [finding for finding in advice.findings if finding.kind == "stages"]
    assert note.number == pytest.approx(1.7024, abs=1e-4)
    assert 1.3 / 50 < advice.safe_macro_dt < 1.573 / 50


def all_in_the_slow_potential(q_s, q_f, params):
    return soft_springs(q_f, q_s, params) + params["omega"] ** 2 / 2 * jnp.sum(q_s**2)


def test_swapped_labels(fpu):
    state = fpu.state()
    swapped = System(fpu.system.kinetic, all_in_the_slow_potential, params=fpu.system.params)
    start = State(0.0, state.q_f, state.q_s, state.p_f, state.p_s)
    advice = advise(swapped, fully_explicit(1), start, macro_dt=0.005)
    assert kinds(advice, "warning") == ["labels"]
    assert not advice.ok
    assert "q_s[0], q_s[1], q_s[2]" in str(advice)
    assert "Swap the labels" in str(advice)
    assert advice.findings[0].number > 10
    assert advice.safe_macro_dt == advice.macro_dt  # the step itself is stable


def test_swapped_labels_are_named_where_a_run_diverges(fpu):
    """In the words of the bodies, without a question to `advise`."""
    swapped = System(fpu.system.kinetic, all_in_the_slow_potential, params=fpu.system.params)
    names = Names(slow={"cart": 2, "bell": 1}, fast={"clapper": 3})
    start = fpu.q_f, fpu.q_s, fpu.v_f, fpu.v_s
    problem = Problem(swapped, *start, names=names)
    with pytest.raises(vm.SimulationError) as stopped:
        vm.simulate(problem, fully_explicit(2), macro_dt=0.5, num_steps=2000)
    assert "is one of the slow variables cart x, cart y, bell; vibrations" in stopped.value.labels
    assert stopped.value.labels in stopped.value.__notes__
    with pytest.raises(vm.SimulationError) as stopped:
        vm.simulate(fpu, fully_explicit(2), macro_dt=0.5, num_steps=2000)
    assert stopped.value.labels == ""


def test_a_state_that_is_unstable_by_itself():
    """Coupling of the wrong sign: the growth is the motion's, not the scheme's."""
    problem, zero = linear_model(kappa=-25.0), np.zeros(1)
    moving = advise(problem, fully_explicit(1), macro_dt=0.01)
    assert "no equilibrium" in moving.findings[0].sentence
    assert "is stable for small motions about this state, held at rest" in moving.verdict
    advice = advise(problem.system, fully_explicit(1), State(0.0, zero, zero, zero, zero), macro_dt=0.01)
    assert "as unstable as the motion itself" in advice.verdict
    assert advice.ok
    assert advice.growth == 0
    assert kinds(advice, "note") == ["motion"]
    assert advice.findings[0].number == pytest.approx(np.sqrt(-np.linalg.eigvalsh([[-25, 25], [25, 2475]])[0]))


def test_table_and_bad_input(fpu):
    advice = advise(fpu, fully_explicit(1), macro_dt=2.1 / 50)
    console = Console(width=300, record=True, file=None, quiet=False)
    with console.capture() as captured:
        console.print(advice)
    assert "stability limit" in captured.get()
    assert advice.verdict in captured.get()
    with pytest.raises(TypeError, match="scheme is int"):
        advise(fpu, 3, macro_dt=0.1)  # pyright: ignore[reportArgumentType]
    for macro_dt in (0.0, np.nan, [0.1]):
        with pytest.raises(ValueError, match="macro_dt"):
            advise(fpu, fully_explicit(1), macro_dt=macro_dt)  # pyright: ignore[reportArgumentType]


def test_a_further_potential_that_its_rate_does_not_resolve_is_named():
    """Frequency 50, kicked every 0.08: Verlet's limit is 2."""
    system = vm.System(vm.ConstantMass([1.0], [1.0]), potentials={"bends": lambda q_s, q_f, params: 1250 * q_f @ q_f})
    scheme = vm.fully_explicit(16).with_potentials(bends=vm.micro(vm.quadrature.trapezoidal, every=8))
    zero = np.zeros(1)
    advice = advise(system, scheme, vm.State(0.0, zero, zero, zero, zero + 0.1), macro_dt=0.16)
    assert "the bends potential alone: its frequency 50 times the step of 8 micro intervals is 4" in str(advice)
    assert "stable below 2" in str(advice)


@pytest.mark.parametrize(("turn", "warned"), [(6.2, True), (2 * 6.25, True), (5.0, False), (0.1, False)])
def test_kicks_of_a_weight_that_meet_its_spring_in_phase(turn, warned):
    """A weight on a spring: the finding has the amplitude with which the run swings about a displaced place."""
    macro_dt = 0.1

    def weight(q_s, q_f, params):
        return 9.81 * q_f[0]

    def spring(q_f, params):
        return params["k"] / 2 * q_f[0] ** 2

    masses = vm.ConstantMass(np.zeros(0), np.ones(1))
    system = vm.System(masses, weight, spring, params={"k": np.asarray((turn / macro_dt) ** 2)})
    problem, scheme = vm.Problem(system, [], [0.0]), vm.fully_explicit(200)
    findings = [f for f in vm.advise(problem, scheme, macro_dt=macro_dt).findings if f.kind == "kicks in phase"]
    assert bool(findings) == warned
    if findings:
        run = vm.simulate(problem, scheme, macro_dt=macro_dt, num_steps=200)
        assert findings[0].number == pytest.approx(float(jnp.abs(run.q_f).max()) / 2, rel=0.02)
    assert not list(_kicks_in_phase(linearise(problem), vm.fully_implicit(200), macro_dt))
