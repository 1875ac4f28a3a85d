"""Which terms of a system depend explicitly on time, and what happens in them."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.driving import driven, events
from vmri_jax.mechanics.state import State


def spring(q_s, q_f, params):
    return jnp.sum(q_s**2) / 2


def kicked(t, q_s, q_f, v_s, v_f, params):
    return jnp.where(t > 1e9, 1.0, 0.0) - v_s, -v_f


def switched_on(t, q_s, q_f, v_s, v_f, params):
    return jnp.where(t > 0.2, jnp.exp(-t / 10), 0.0) - v_s, -v_f


def frozen(t, q_s, q_f, v_s, v_f, params):
    return jax.lax.cond(jax.lax.stop_gradient(t) > 3, lambda q: q, lambda q: -q, q_s), q_f


def on_a_disc(t, q_s, q_f, params):
    return q_f[:1] - jnp.cos(t)


@pytest.mark.parametrize(
    ("terms", "names"),
    [
        ({}, ()),
        ({"force": lambda t, q_s, q_f, v_s, v_f, params: (-v_s, -v_f)}, ()),
        ({"force": kicked}, ("force",)),
        ({"force": frozen}, ("force",)),
        ({"slow_constraint": vm.Rheonomic(lambda t, q_s, params: q_s[:1])}, ()),
        ({"force": kicked, "constraint": vm.Rheonomic(on_a_disc)}, ("constraint", "force")),
    ],
)
def test_terms_that_depend_on_time(terms, names):
    system = vm.System(vm.ConstantMass(slow=[1.0, 1.0], fast=[1.0]), spring, **terms)
    assert driven(system, SimpleNamespace(q_s=jnp.ones(2), q_f=jnp.ones(1))) == names


def parametric(t, q_s, q_f, v_s, v_f, params):
    """A sine wave, a rectangle, a Gauss pulse, and a step, on springs whose positions are zero at the start."""
    center, width = params
    s = (t - center) / width
    drives = jnp.sin(jnp.pi * s), (s > 0) & (s < 1), jnp.exp(-jnp.minimum(s**2, 600.0) / 2), s > 0
    return q_s * jnp.stack([jnp.asarray(drive, float) for drive in drives]), q_f


def state_at(t: float) -> State:
    return State(np.asarray(t), np.zeros(4), np.zeros(1), np.zeros(4), np.zeros(1))


@pytest.mark.parametrize(("center", "width", "t_0", "t_end"), [(3.3, 1e-3, 0.0, 10.0), (1.03, 0.03, 1.0, 6.0)])
def test_events_of_each_kind(center, width, t_0, t_end):
    """Lengths: half a period, the rectangle, and the width of the Gauss pulse at half its height."""
    system = vm.System(vm.ConstantMass(np.ones(4), [1.0]), force=parametric, params=(center, width))
    drives = events(system, state_at(t_0), t_end)
    assert drives.names == ("force",)
    waves = np.sum((drives.times > t_0) & (drives.times < t_end)) - 2
    assert waves == pytest.approx((t_end - t_0) / width, abs=2)
    lengths = np.sort(drives.lengths)
    assert lengths[0] == pytest.approx(width, rel=0.02)
    assert lengths[-1] == pytest.approx(2 * np.sqrt(2 * np.log(2)) * width, rel=0.02)
    assert float(drives.times[np.argmax(drives.lengths)]) == pytest.approx(center, abs=0.1 * width)
    assert drives.shortest == lengths[0]


def along_an_arm(t, q_s, q_f, v_s, v_f, params):
    """The moment of a force along an arm, whose terms cancel, alone and beside a moment of 1e-9 of the terms."""
    size, arm = 3e3 * (1 + 0.3 * jnp.sin(2 * t)), jnp.stack([jnp.cos(q_s[0]), jnp.sin(q_s[0])])
    moment = arm[0] * (size * arm[1]) - arm[1] * (size * arm[0])
    return jnp.stack([moment, moment + 3e-6 * jnp.sin(2 * t), jnp.sin(2 * t), 0.0]), q_f


def test_round_off_is_no_event_and_no_jump():
    """Two half waves and no events of the 1e5 turns of the round-off of the first two entries."""
    drives = events(vm.System(vm.ConstantMass(np.ones(4), [1.0]), force=along_an_arm), state_at(0.0), 5.0)
    assert not drives.jump
    assert drives.shortest == pytest.approx(np.pi / 2, rel=1e-3)
    assert len(drives.times) == 2 * 3  # of the turns of the sine waves in the second and the third entry


def test_a_jump_is_no_event():
    system = vm.System(vm.ConstantMass(np.ones(4), [1.0]), force=kicked)
    assert events(system.replace(force=None), state_at(0.0), 1.0).names == ()
    drives = events(system, state_at(1e9 - 1.0), 1e9 + 1.0)
    assert drives.names == ("force",)
    assert drives.shortest == np.inf
    decays = vm.System(vm.ConstantMass(np.ones(4), [1.0]), force=switched_on)
    assert events(decays, state_at(0.0), 1.0).shortest > 0.8  # it acts until the end


def test_a_constraint_that_moves_has_events():
    """A foot goes up and down within 20 ms: twice as short in its velocity."""
    system = vm.System(vm.ConstantMass([1.0], [1.0]), constraint=vm.Rheonomic(foot))
    state = State(np.zeros(()), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1))
    drives = events(system, state, 4.0)
    assert drives.names == ("constraint",)
    np.testing.assert_allclose(drives.times, 2.0, atol=0.02)
    assert drives.shortest == pytest.approx(0.01, rel=1e-3)


def foot(t, q_s, q_f, params):
    s = (t - 2.0) / 0.02
    return q_f - 0.1 * jnp.where(jnp.abs(s) < 0.5, jnp.cos(jnp.pi * s) ** 2, 0.0)
