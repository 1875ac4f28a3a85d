"""The mechanisms that are timed."""

import runpy
from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.mechanisms.plane import GROUND, Bar, Coil, Contact, Hinge, Mechanism, Slide, bar, turn

FILE = "notebooks/scenes/squeezer.py"
ANGLES = ("beta", "theta", "gamma", "phi", "delta", "omega", "epsilon")
PUBLISHED = np.array(
    [
        *(15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948),
        *(0.5244099658805304, 0.5347301163226948, 1.048080741042263),
    ]
)
"""Angles of the squeezer at t = 0.03 s, rad: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II,
VII.7."""


# --- a satellite with two booms --------------------------------------------------------------------------------------
def satellite(panels: int) -> Mechanism:
    """A hub that floats, slow, and a number of panels on springs in hinges on each side, fast."""
    hub, length, sides = 1.0, 0.8, ("left", "right")
    bars = {"hub": Bar(100.0, 100.0 * 2 * hub**2 / 12)}
    hinges, before = [], dict.fromkeys(sides, "hub")
    for side, sign in zip(sides, (-1.0, 1.0), strict=True):
        for k in range(panels):
            name = f"{side} {k}"
            bars[name] = bar(2.0, length, fast=True)
            hinges.append(Hinge(before[side], name, (sign * (hub / 2 + k * length), 0.0), 150.0))
            before[side] = name

    def poses(q):
        """x, y and angle of the hub, then the angles in the hinges."""
        found = [q[:3]]
        for side, sign in enumerate((-1.0, 1.0)):
            end, angle = q[:2] + turn(q[2], sign * hub / 2, 0.0), q[2]
            for k in range(panels):
                angle = angle + q[3 + side * panels + k]
                half = turn(angle, sign * length / 2, 0.0)
                found.append(jnp.concatenate([end + half, angle[None]]))
                end = end + 2 * half
        return jnp.stack(found)

    v = np.concatenate([[0.1, 0.0, 0.2], np.tile([1.0] + [0.0] * (panels - 1), 2)])
    words = f"satellite, 2 x {panels}"
    return Mechanism(words, bars, tuple(hinges), poses, np.zeros(v.size), v, 2.0, 1.0, 64)


# --- an engine -------------------------------------------------------------------------------------------------------
CRANK, ROD, START, SPEED = 0.05, 0.18, 1.0, 100.0  # m, m, rad, rad/s: 955 turns in a minute
COILS, SPACING, REST, STIFFNESS = 4, 0.012, 0.006, 1e5  # of the valve spring: masses, m, m, N/m of a piece
SURGE = 4.0  # m/s, of the middle of the valve spring at the start
VALVE, FOOT = 0.1, 0.1 - 0.03 - (COILS + 1) * SPACING  # m: heights of the closed valve, and of the end of its spring
BESIDE = 0.12  # m, from the cylinder to the valve
CONTACT = {
    "lift": 0.01,
    "sharpness": 4.0,
    "top": 3.0,
    "seat": VALVE + STIFFNESS * (SPACING - REST) / 3e5,  # at rest the spring presses the valve onto it
    "smoothing": 2e-4,
    "stiffness": 3e5,
}
"""Of the valve with its seat, which a lobe lifts that turns with the crank: m, -, rad, m, m, N/m."""


def contact(cosine, height, params):
    """``k/2 d^2``, d the depth; cosine that of the crank's angle from the top of the lobe."""
    lobe = params["lift"] * jnp.exp(params["sharpness"] * (cosine - 1))
    depth = params["smoothing"] * jax.nn.softplus((lobe - (height - params["seat"])) / params["smoothing"])
    return params["stiffness"] / 2 * depth**2


def cam_of_poses(crank, valve, params):
    """Of the poses of crank and valve."""
    return contact(jnp.cos(crank[2] - params["top"]), valve[1], params)


def cam(q, params):
    """Of the coordinates of crank and valve: the first director of the crank is at (cos, sin, 0) of its angle."""
    crank, valve = q
    return contact(crank[3] * jnp.cos(params["top"]) + crank[4] * jnp.sin(params["top"]), valve[1], params)


def engine() -> Mechanism:
    """Crank, rod and piston, slow; a valve that a cam of the crank opens against a spring with masses, fast."""
    names = [f"coil {k}" for k in range(COILS)]
    heights = VALVE - 0.03 - SPACING * np.arange(1, COILS + 1)

    def poses(q):
        """The angle of the crank, heights of valve and coils."""
        pin = turn(q[0], CRANK, 0.0)
        wrist = jnp.stack([jnp.zeros(()), pin[1] + jnp.sqrt(ROD**2 - pin[0] ** 2)])
        rod = wrist - pin
        turning = [
            jnp.stack([jnp.zeros(()), jnp.zeros(()), q[0]]),
            jnp.concatenate([(pin + wrist) / 2, jnp.arctan2(rod[1], rod[0])[None]]),
            jnp.concatenate([wrist, jnp.zeros(1)]),
        ]
        return jnp.stack(turning + [jnp.stack([jnp.full((), BESIDE), y, jnp.zeros(())]) for y in q[1:]])

    q = np.concatenate([[START, VALVE], heights])
    v = np.concatenate([[SPEED, 0.0], SURGE * np.sin(np.pi * np.arange(1, COILS + 1) / (COILS + 1))])
    at = np.asarray(poses(q))
    pin = (CRANK * np.cos(START), CRANK * np.sin(START))
    bars = {"crank": Bar(2.0, 5e-3), "rod": bar(0.4, ROD), "piston": Bar(0.5, 4e-4), "valve": Bar(0.08, 3e-5, True)}
    bars |= {name: Bar(0.01, None, True) for name in names}
    hinges = (
        Hinge(GROUND, "crank", (0.0, 0.0)),
        Hinge("crank", "rod", pin),
        Hinge("rod", "piston", (0.0, float(at[2, 1]))),
    )
    ends = [
        ("valve", VALVE - 0.03),
        *zip(names, heights.tolist(), strict=True),
        (GROUND, FOOT),
    ]
    coils = tuple(Coil(a, (BESIDE, y_a), b, (BESIDE, y_b), STIFFNESS, REST) for (a, y_a), (b, y_b) in pairwise(ends))
    slides = (Slide("piston", (0.0, 1.0)), Slide("valve", (0.0, 1.0)))
    acts = Contact(("crank", "valve"), cam_of_poses, cam, CONTACT)
    return Mechanism("engine", bars, hinges, poses, q, v, 0.02, CRANK, 40, slides, coils, acts)


# --- Andrews' squeezer -----------------------------------------------------------------------------------------------
@cache
def squeezer_data() -> dict:
    """All that is in the file of the scene."""
    return runpy.run_path(FILE)


def squeezer() -> Mechanism:
    """Seven bodies in three loops, by a motor; seven angles with six loops, as the source states it."""
    c = squeezer_data()
    a, b = jnp.asarray(c["A"]), jnp.asarray(c["B"])

    def poses(q):
        beta, theta, gamma, phi, delta, omega, epsilon = q
        centres = [
            turn(beta, c["RA"], 0.0),
            turn(beta, c["RR"], 0.0) - turn(beta + theta, c["DA"], 0.0),
            b + turn(gamma, c["SB"], -c["SA"]),
            a + turn(delta, c["ZT"], 0.0) + turn(phi + delta, 0.0, c["EA"] - c["E"]),
            a + turn(delta, c["TA"], c["TB"]),
            a + turn(epsilon, 0.0, -c["U"]) + turn(omega + epsilon, c["ZF"] - c["FA"], 0.0),
            a + turn(epsilon, -c["UB"], -c["UA"]),
        ]
        angles = jnp.stack([beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon])
        return jnp.concatenate([jnp.stack(centres), angles[:, None]], axis=1)

    def loops(q):
        """(6,) three bars meet the second one at its tip."""
        beta, theta, gamma, phi, delta, omega, epsilon = q
        tip = turn(beta, c["RR"], 0.0) - turn(beta + theta, c["D"], 0.0)
        third = b + turn(gamma, 0.0, -c["SS"])
        fourth = a + turn(delta, c["ZT"], 0.0) + turn(phi + delta, 0.0, -c["E"])
        sixth = a + turn(epsilon, 0.0, -c["U"]) + turn(omega + epsilon, c["ZF"], 0.0)
        return jnp.concatenate([tip - third, tip - fourth, tip - sixth])

    q = np.array([c["START"][name] for name in ANGLES])
    bars = {f"K{k + 1}": Bar(*numbers) for k, numbers in enumerate(zip(c["MASSES"], c["MOMENTS"], strict=True))}
    hinges = tuple(Hinge(inner, outer, (float(x), float(y))) for (inner, outer), (x, y) in c["JOINTS"].items())
    third = np.asarray(poses(q))[2]
    end = third[:2] + np.asarray(turn(third[2], c["SD"] - c["SB"], c["SA"] - c["SC"]))
    ends = ((float(end[0]), float(end[1])), (float(c["C"][0]), float(c["C"][1])))
    coil = Coil("K3", ends[0], GROUND, ends[1], c["STIFFNESS"], c["LENGTH"])
    more = {"coils": (coil,), "loops": loops, "torque": c["TORQUE"]}
    return Mechanism("squeezer", bars, hinges, poses, q, np.zeros(7), 0.03, 0.04, 75, **more)


# --- a four-bar linkage and chains -----------------------------------------------------------------------------------
def four_bar() -> Mechanism:
    """A crank that turns about, a rocker and a rod between them, under gravity."""
    crank, rod, rocker, apart = 0.3, 1.0, 0.8, 1.0

    def poses(q):
        """The angle of the crank; the rod ends where two circles meet."""
        pin = turn(q[0], crank, 0.0)
        across = jnp.array([apart, 0.0]) - pin
        distance = jnp.sqrt(jnp.sum(across**2))
        along = (distance**2 + rod**2 - rocker**2) / (2 * distance)
        high = jnp.sqrt(rod**2 - along**2)
        end = pin + (along * across + high * jnp.stack([-across[1], across[0]])) / distance
        rods, rockers = end - pin, end - jnp.array([apart, 0.0])
        return jnp.stack(
            [
                jnp.concatenate([pin / 2, q[:1]]),
                jnp.concatenate([(pin + end) / 2, jnp.arctan2(rods[1], rods[0])[None]]),
                jnp.concatenate([end - rockers / 2, jnp.arctan2(rockers[1], rockers[0])[None]]),
            ]
        )

    q = np.array([1.0])
    pin = np.asarray(turn(q[0], crank, 0.0))
    end = 2 * np.asarray(poses(q))[1, :2] - pin
    bars = {"crank": bar(1.0, crank), "rod": bar(1.0, rod), "rocker": bar(1.0, rocker)}
    hinges = (
        Hinge(GROUND, "crank", (0.0, 0.0)),
        Hinge("crank", "rod", (float(pin[0]), float(pin[1]))),
        Hinge("rod", "rocker", (float(end[0]), float(end[1]))),
        Hinge(GROUND, "rocker", (apart, 0.0)),
    )
    return Mechanism("four-bar", bars, hinges, poses, q, np.array([8.0]), 2.0, 1.0, 64, gravity=9.81)


def four_bars(loops: int) -> Mechanism:
    """Cranks of 1 kg and 1 m in a row, joined by rods, fall from upright: case A02 of the IFToMM library of benchmarks.

    Where all bars lie in a line, each loop could fold another way: the rows of its joints depend on each other there.
    """

    def poses(q):
        """The angle of all cranks; rods do not turn."""
        x, tip = jnp.arange(loops + 1.0), turn(q[0], 1.0, 0.0)
        cranks = jnp.stack([x + tip[0] / 2, jnp.full_like(x, tip[1] / 2), jnp.full_like(x, q[0])], axis=1)
        rods = jnp.stack([x + 0.5 + tip[0], jnp.full_like(x, tip[1]), jnp.zeros_like(x)], axis=1)[:-1]
        return jnp.concatenate([cranks, rods])

    bars = {f"crank {i}": bar(1.0, 1.0) for i in range(loops + 1)} | {f"rod {i}": bar(1.0, 1.0) for i in range(loops)}
    hinges = [Hinge(GROUND, f"crank {i}", (float(i), 0.0)) for i in range(loops + 1)]
    for i in range(loops):
        hinges += [Hinge(a, f"rod {i}", (float(x), 1.0)) for a, x in ((f"crank {i}", i), (f"crank {i + 1}", i + 1))]
    q, v = np.array([np.pi / 2]), np.array([-1.0])  # the tip of the first crank moves with 1 m/s
    return Mechanism(f"{loops} four-bars", bars, tuple(hinges), poses, q, v, 2.0, 1.0, 64, gravity=9.81)


def chain(bodies: int) -> Mechanism:
    """Bars of 1 kg and 1 m in a row, the first hinged to the ground, at rest under gravity."""

    def poses(q):
        """Angles of the bars against the horizontal."""
        ends = jnp.cumsum(turn(q, 1.0, 0.0).T, axis=0)
        return jnp.concatenate([ends - turn(q, 0.5, 0.0).T, q[:, None]], axis=1)

    names = [f"bar {i}" for i in range(bodies)]
    pairs = zip([GROUND, *names], names, strict=False)
    hinges = tuple(Hinge(a, b, (float(i), 0.0)) for i, (a, b) in enumerate(pairs))
    bars = {name: bar(1.0, 1.0) for name in names}
    none = np.zeros(bodies)
    return Mechanism(f"chain of {bodies}", bars, hinges, poses, none, none, 1.0, 1.0, 16, gravity=9.81)


CASES: dict[str, Callable[[], Mechanism]] = {
    **{f"satellite {n}": partial(satellite, n) for n in (1, 3, 10)},
    "engine": engine,
    "squeezer": squeezer,
    "four-bar": four_bar,
    **{f"four-bars {n}": partial(four_bars, n) for n in (1, 10, 40)},
    **{f"chain {n}": partial(chain, n) for n in (1, 3, 10, 30, 100)},
}
