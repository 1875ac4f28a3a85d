"""Which signals a strip shows, and during which time."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.animation.support import trajectory
from vmri_jax import plots
from vmri_jax.animation import Drawing, bars, motion, plot_strip
from vmri_jax.animation.frames import PERIODS, fast_signal, slow_signal, window
from vmri_jax.animation.html import _data
from vmri_jax.animation.layout import layout
from vmri_jax.mechanics.names import Names
from vmri_jax.running.origin import Origin

OMEGA = 60.0
DRAWING = {
    "bodies": [
        {"name": "cart", "coordinates": [["s", 0], ["s", 1]]},
        {"name": "hook", "coordinates": [["f", 0], ["f", 1]]},
        {"name": "load", "coordinates": [["f", 2], ["f", 3]]},
    ],
    "springs": [["hook", "load"]],
}


def crane(step: float = 0.01, end: float = 10.0):
    """A cart that goes to and fro slowly along x; below it a load on a spring that vibrates, most at t = 7."""
    t = np.arange(0.0, end + step / 2, step)
    cart = np.stack([np.sin(t), 0.1 * np.sin(2 * t)], axis=1)
    stretch = 0.01 * np.exp(-((t - 7.0) ** 2)) * np.sin(OMEGA * t)
    down = np.array([0.0, -1.0])
    return trajectory(t, cart, np.concatenate([cart + down, cart + down * (2 + stretch)[:, None]], axis=1))


def moved(drawing=DRAWING, **options):
    return motion(crane(**options), Drawing.from_dict(drawing))


def test_the_slow_signal_moves_most_and_the_fast_one_fastest():
    slow, fast = slow_signal(moved()), fast_signal(moved())
    assert slow is not None
    assert fast is not None
    assert (slow.label, slow.pace) == ("cart x", "slow")
    assert (fast.label, fast.pace) == ("length of spring hook to load", "fast")
    assert fast.frequency == pytest.approx(OMEGA, rel=0.1)
    start, end = window(moved(), fast)  # some periods where most happens
    assert end - start == pytest.approx(PERIODS * 2 * np.pi / OMEGA, rel=0.15)
    assert (start + end) / 2 == pytest.approx(7.0, abs=0.1)


@pytest.mark.parametrize(("radius", "label"), [(0.1, "wheel x"), (0.0, "point on axis 1 of wheel, x")])
def test_a_solid_is_shown_by_its_centre_if_that_moves(radius, label):
    """The point on the axis, at half the width of the wheel, moves further."""
    t = np.arange(0.0, 10.0, 0.01)
    turning = np.stack([np.cos(t), np.sin(t)], axis=1)
    run = trajectory(
        t, np.concatenate([radius * turning, turning, turning[:, ::-1] * [-1, 1]], axis=1), np.zeros((t.size, 0))
    )
    places = [["s", 0], ["s", 1], [], ["s", 2], ["s", 3], [], ["s", 4], ["s", 5], []]
    corners = [[x, y] for x in (-2.0, 2.0) for y in (-2.0, 2.0)]
    wheel = {"name": "wheel", "coordinates": places, "corners": corners, "faces": [[0, 1, 3, 2]]}
    slow = slow_signal(motion(run, Drawing.from_dict({"solids": [wheel]})))
    assert slow is not None
    assert slow.label == label


def test_what_the_nodes_do_not_resolve_is_not_shown():
    coarse = moved(step=0.04)  # 2.4 rad from node to node
    fast = fast_signal(coarse)
    assert fast is None or fast.label != "length of spring hook to load"


def test_bodies_at_rest_have_no_curves():
    run = crane()
    still = motion(run.with_arrays(q_s=0 * run.q_s, q_f=0 * run.q_f), Drawing.from_dict(DRAWING))
    assert slow_signal(still) is None
    assert fast_signal(still) is None
    assert not [panel for panel in plot_strip(still, 2).axes if panel.lines]
    failed = run.with_arrays(q_s=np.where(run.t[:, None] > run.t[0], np.nan, run.q_s))  # in its first step
    assert fast_signal(motion(failed, Drawing.from_dict(DRAWING))) is None


@pytest.mark.parametrize("theme", [plots.LIGHT, plots.DARK])
def test_curves_are_the_signals(theme):
    shown = moved()
    left, right = [panel for panel in plot_strip(shown, [1.0, 4.0], theme=theme).axes if panel.lines]
    assert [panel.get_title(loc="left") for panel in (left, right)] == ["cart x", "length of spring hook to load"]
    line, moments = left.lines
    np.testing.assert_allclose(np.asarray(line.get_ydata()), np.sin(np.asarray(line.get_xdata())), atol=1e-3)
    np.testing.assert_allclose(np.asarray(moments.get_ydata()), np.sin([1.0, 4.0]), atol=1e-3)
    assert [panel.lines[0].get_color() for panel in (left, right)] == list(theme.curves[:2])
    [close] = right.lines
    times = np.asarray(close.get_xdata())
    expected = 1 + 0.01 * np.exp(-((times - 7.0) ** 2)) * np.sin(OMEGA * times)
    np.testing.assert_allclose(np.asarray(close.get_ydata()), expected, atol=1e-3)


def test_coordinates_without_a_drawing_have_the_names_of_the_run():
    run = replace(crane(), origin=Origin(Names(slow={"cart": 2}, fast={"hook": 2, "load": 2})))
    shown = motion(run, Drawing.from_dict(bars(run)))
    assert [body.name for body in shown.drawing.bodies][:3] == ["cart x", "cart y", "hook x"]
    small = run.with_arrays(q_s=0.013 * np.asarray(run.q_s))  # its bars are drawn larger than the coordinate
    shown = motion(small, Drawing.from_dict(bars(small)))
    slow = slow_signal(shown)
    assert slow is not None
    np.testing.assert_allclose(slow.of(shown.points), small.states.q_s[:, 0], atol=1e-12)


def test_micro_nodes_without_the_system_move_as_they_do():
    """Differences between macro nodes would kick the curve at every one of them."""
    t = np.linspace(0.0, 2.0, 21)
    micro = t[:-1, None] + np.linspace(0.0, 0.1, 11)[1:]
    run = trajectory(
        t, np.sin(t)[:, None], np.sin(OMEGA * t)[:, None], t_micro=micro, q_f_micro=np.sin(OMEGA * micro)[..., None]
    )
    shown = motion(run, Drawing.from_dict({"bodies": [{"name": "fast", "coordinates": [["f", 0]]}]}))
    times = np.linspace(0.0, 2.0, 999)
    np.testing.assert_allclose(shown.at(times)[:, 0, 0], np.sin(OMEGA * times), atol=2e-2)


def test_the_page_calls_the_energy_an_error_only_if_it_should_be_constant():
    """Of a damped mass it shows energy and work, and what is left of their balance."""
    damped = vm.System(vm.ConstantMass([1.0], [1.0]), None, lambda q, params: 50 * jnp.sum(q**2), force=damping)
    run = vm.simulate(
        vm.Problem(damped, [0.0], [0.1], [1.0], [0.0]), vm.fully_implicit(num_micro=4), macro_dt=0.1, num_steps=50
    )
    drawing = Drawing.from_dict({"bodies": [{"name": "mass", "coordinates": [["f", 0]]}]})
    shown = motion(run, drawing)
    assert shown.energy_names == ("energy", "work of forces", "balance")
    assert not shown.relative
    np.testing.assert_allclose(shown.energy[:, 0], run.energy - run.energy[0])
    assert shown.energy[-1, 1] < -0.5
    np.testing.assert_allclose(shown.energy[:, 2], shown.energy[:, 0] - shown.energy[:, 1], atol=1e-12)
    data = _data(shown, layout(shown))
    assert data["energy_title"] == "since the start:"
    assert len(data["energy"]) == len(data["energy_names"]) == 3
    assert shown.thinned(10).energy.shape == (len(shown.thinned(10).t), 3)

    kept = motion(run, drawing, damped.replace(force=None))
    assert kept.energy_names == ("energy error",)
    assert "error" in _data(kept, layout(kept))["energy_title"]


def damping(t, q_s, q_f, v_s, v_f, params):
    return -0.5 * v_s, -0.5 * v_f
