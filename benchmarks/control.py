"""Optimal control: a satellite with booms turned from rest to rest, error of the cost against time, and one turned by
wheels."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.measure import Tell, exactly, silent
from benchmarks.report import Claim, Report
from vmri_jax import plots
from vmri_jax.control import Optimum
from vmri_jax.running.timing import stopwatch
from vmri_jax.scene import (
    Bending,
    Body,
    Box,
    Controlled,
    Cylinder,
    Revolute,
    RigidBody,
    RigidLink,
    Scene,
    Spring,
    angular_momentum,
)

HUB = Box((1.0, 1.0, 1.0))
ANGLE, DURATION = 0.6, 6.0
"""rad, s: how far the hub turns, and in which time."""
TURN = np.array([0.4, -0.3, 0.8])
"""rad: the rotation vector by which wheels turn a hub."""
MOMENTUM = 1e-12
"""Of the total angular momentum over that of the hub."""


def effort(state, u):
    """``u^2 / 2``."""
    return u @ u / 2


@cache
def satellite() -> Scene:
    """A rigid hub, slow, that a torque turns, and two booms of two masses: their mounts bend slowly, and stretch fast
    (100 rad/s)."""
    bodies, effects = [], []
    for side, name in ((-1.0, "left"), (1.0, "right")):
        middle, tip, root = f"{name} middle", f"{name} tip", ("hub", [side / 2, 0.0, 0.0])
        bodies += [Body(part, 2.0, [side * x, 0.0, 0.0], pace="fast") for part, x in ((middle, 1.5), (tip, 2.5))]
        corners = [[side / 2, y, z] for y, z in ((-0.4, 0.0), (0.4, 0.0), (0.0, -0.4), (0.0, 0.4))]
        effects += [
            RigidLink((root, middle), name=f"{name} mount"),
            Spring([(("hub", corner), middle) for corner in corners], 40.0, name=f"{name} stays"),
            Spring((middle, tip), 2e4, 1.0, name=f"{name} boom"),
            Bending((root, middle, tip), 6.0, name=f"{name} bending"),
        ]
    hub = RigidBody("hub", 100.0, HUB, [0.0, 0.0, 0.0], pace="slow")
    return Scene([hub, *bodies], [*effects, Controlled("hub", "torque", along=[0.0, 0.0, 1.0])])


def turned(state):
    """Hub and one boom at the angle, at rest; the other boom is its image."""
    across = jnp.array([-np.sin(ANGLE), np.cos(ANGLE), 0.0])
    d_1, spin = state.q_s[3:6], state.p_s[3:6]
    right, rates = state.q_f.reshape(4, 3)[2:] - state.q_s[:3], state.p_f.reshape(4, 3)[2:]
    return jnp.concatenate([jnp.stack([d_1, spin]) @ across, right @ across, rates @ across])


def slew(num_micro: int, steps: int, scheme: Callable = vm.explicit_slow) -> Optimum:
    """The booms at rest again after the turn."""
    return vm.control.minimize(
        satellite(), effort, goal=turned, scheme=scheme(num_micro), macro_dt=DURATION / steps, num_steps=steps
    )


@cache
def wheels() -> Scene:
    """A hub and three momentum wheels; nothing acts from outside."""
    bodies = [RigidBody("hub", 50.0, Box((1.0, 0.8, 0.6)), [0.0, 0.0, 0.0], pace="fast")]
    effects = []
    for axis, rotation in zip("xyz", ([0.0, np.pi / 2, 0.0], [-np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0]), strict=True):
        e = np.eye(3)["xyz".index(axis)]
        bodies.append(
            RigidBody(f"wheel {axis}", 20.0, Cylinder(radius=0.35, length=0.1), 0.1 * e, rotation, pace="fast")
        )
        effects.append(Revolute(("hub", f"wheel {axis}"), 0.1 * e, axis=e, name=f"bearing {axis}"))
        effects.append(Controlled(f"bearing {axis}", "torque"))
    return Scene(bodies, effects, coordinates="directors")


def reoriented(state):
    """The hub turned by `TURN`, without spin."""
    aim = RigidBody("aim", 1.0, HUB, [0.0, 0.0, 0.0], TURN).rotation
    inertia = np.asarray(wheels().by_name["hub"].masses)[3:12].reshape(3, 3)
    d, rates = state.q_f[3:12].reshape(3, 3), state.p_f[3:12].reshape(3, 3) / inertia
    off = jnp.stack([d[i] @ aim[:, (i + 1) % 3] for i in range(3)])
    return jnp.concatenate([off, jnp.sum(jnp.cross(d, rates), axis=0) / 2])


def reorientation(steps: int) -> Optimum:
    """The torques of the wheels, at most 0.25 N m."""
    return vm.control.minimize(
        wheels(),
        effort,
        goal=reoriented,
        bounds=(-0.25, 0.25),
        scheme=vm.fully_explicit(1),
        macro_dt=10.0 / steps,
        num_steps=steps,
    )


def momentum_lost(found: Optimum) -> float:
    """Largest total angular momentum along a run, over that of its hub."""
    each = [
        angular_momentum(found.trajectory.position(body.name), found.trajectory.momentum(body.name))
        for body in wheels().bodies
    ]
    return float(np.abs(sum(each)).max() / np.abs(each[0]).max())


@dataclass(frozen=True)
class Size:
    """Steps of the slew by scheme and num_micro, of the one that is taken as exact, and of the wheels."""

    slews: dict[tuple[str, int], tuple[int, ...]]
    fine: int
    wheels: int | None


SCHEMES = {"explicit slow": vm.explicit_slow, "implicit": vm.fully_implicit}


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size({("explicit slow", 5): (30, 60), ("explicit slow", 1): (60, 300)}, 600, None)
    coarse = (30, 60, 120, 240)
    return Size(
        {
            ("explicit slow", 1): (60, 120, 300, 600),
            ("explicit slow", 5): (60, 120, 240),
            ("explicit slow", 10): coarse,
            ("explicit slow", 20): coarse,
            ("implicit", 1): coarse,
            ("implicit", 5): coarse[:3],
        },
        1200,
        60,
    )


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each scheme, and one of the wheels."""
    curves: dict[tuple[str, int], np.ndarray] = {}
    report = Report("control", name, figures={"slew": partial(_draw, curves)})
    tell("the exact cost")
    fine, half = (slew(1, steps).cost for steps in (size.fine, size.fine // 2))
    exact = fine + (fine - half) / 3  # of order 2
    report.note(f"J of the slew: {exact:.6f}, from single steps, {size.fine // 2} and {size.fine}.")
    for (scheme, num_micro), counts in size.slews.items():
        found = []
        for steps in counts:
            tell(f"slew, {scheme}, num_micro = {num_micro}, {steps} steps")
            (_, first), (again, seconds) = (timed(partial(slew, num_micro, steps, SCHEMES[scheme])) for _ in range(2))
            found.append((abs(again.cost - exact) / exact, seconds))
            row = {"case": f"slew, {scheme}", "num_micro": num_micro, "steps": steps, "J": again.cost}
            report.rows.append(row | {"error": found[-1][0], "s": seconds, "first s": first})
        curves[scheme, num_micro] = np.array(found).T
        yield report
    if size.wheels is not None:
        tell("wheels")
        found, seconds = timed(partial(reorientation, size.wheels))
        row = {"case": "wheels", "num_micro": 1, "steps": size.wheels, "J": found.cost}
        report.rows.append(row | {"error": found.miss, "s": seconds, "first s": seconds})
        lost = exactly(momentum_lost(found))
        report.claims.append(Claim("wheels: total angular momentum over that of the hub", lost, MOMENTUM))
        report.note(f"wheels: {found}")
        report.figures["wheels"] = partial(plots.plot_control, found, title="A hub turned by its wheels")
        yield report


def timed(call: Callable[[], Optimum]) -> tuple[Optimum, float]:
    """What it finds, and the seconds that it takes."""
    elapsed = stopwatch()
    return call(), elapsed()


def _draw(curves: dict[tuple[str, int], np.ndarray]):
    """Error of the cost against time."""
    with plots.new_figure(6.2, 3.8, "", plots.LIGHT) as figure:
        axes = figure.subplots()
        for marker, ((scheme, num_micro), (error, seconds)) in zip(plots.MARKERS, curves.items(), strict=False):
            axes.loglog(seconds, error, marker=marker, markersize=4, label=f"{scheme}, num_micro = {num_micro}")
        axes.set(title="a slew from rest to rest", xlabel="s, without compiling", ylabel="relative error of J")
        plots.log_ticks(axes.xaxis, np.concatenate([seconds for _, seconds in curves.values()]))
        axes.legend(fontsize=8)
    return figure
