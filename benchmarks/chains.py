"""Linear in the number of bodies: time of one step of hinged chains and stars, by directors (a band, the full matrix)
and in joint coordinates."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

import vmri_jax as vm
from benchmarks.cost import slope
from benchmarks.measure import Tell, exactly, silent
from benchmarks.report import Claim, Report
from vmri_jax.mechanics import constraint_pattern
from vmri_jax.running.engine import engine
from vmri_jax.running.timing import seconds_per_call, stopwatch
from vmri_jax.scene import Box, Gravity, JointSpring, Revolute, RigidBody, Scene

Coordinates = Literal["joint", "directors"]
SHORT, LONG = 50, 250
"""Steps of two runs; what a call costs besides its steps is in both."""
MACRO_DT = 1e-3
FROM = 20
"""Below so many bodies the band is not what `vm.simulate` takes, or what does not depend on their number counts as
well."""
JOINT_FROM = 10
"""The same in joint coordinates."""
LEVEL = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
"""The rotation that lays the long axis of a bar along x."""


@dataclass(frozen=True)
class Size:
    """Numbers of bodies with a band, those of them with the full matrix too, samples of a time.

    joint: chains that are timed in joint coordinates, too.
    stars: numbers of panels around a hub.
    """

    bodies: tuple[int, ...]
    full: tuple[int, ...]
    repeats: int
    joint: tuple[int, ...] = ()
    stars: tuple[int, ...] = ()


@dataclass(frozen=True)
class Measured:
    """Microseconds of a step, and seconds of the scene, its compilation and its first run."""

    us: float
    first: float


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size((10, 20, 40), (10, 20), 3, (10,), (3,))
    numbers = (1, 3, 10, 30, 100)
    beside_few = (7, 8)  # chains on both sides of the number of rows from which `vm.simulate` takes the band
    return Size(tuple(sorted((*numbers, *beside_few))), (1, *beside_few, 10, 30), 5, numbers, numbers)


def chain(bodies: int, coordinates: Coordinates = "directors") -> Scene:
    """Bars of 1 kg and 1 m in a row along x, the first hinged to the ground, at rest."""
    bars = [
        RigidBody(f"bar {i}", 1.0, Box((0.1, 0.1, 1.0)), [0.5 + i, 0.0, 0.0], LEVEL, pace="fast") for i in range(bodies)
    ]
    pairs = [("ground", "bar 0"), *((f"bar {i}", f"bar {i + 1}") for i in range(bodies - 1))]
    hinges = Revolute(pairs, [[float(i), 0.0, 0.0] for i in range(bodies)], [0.0, 1.0, 0.0], name="hinges")
    return Scene(bars, [Gravity(), hinges], coordinates=coordinates)


def star(panels: int, coordinates: Coordinates = "directors") -> Scene:
    """A hub of 100 kg that floats and turns, slow, and panels of 2 kg on springs in hinges along its rim, fast."""
    hub = RigidBody("hub", 100.0, Box((1.0, 1.0, 1.0)), [0.0, 0.0, 0.0], spin=[0.0, 0.0, 0.2], pace="slow")
    bodies, hinges, springs = [hub], [], []
    for i in range(panels):
        angle = 2 * np.pi * i / panels
        out, along = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        place, spin = 0.9 * out, np.array([0.0, 0.0, 0.2]) + 0.5 * along
        velocity = np.cross([0.0, 0.0, 0.2], place) + np.cross(0.5 * along, 0.4 * out)
        panel = Box((0.8, 0.6, 0.03))
        bodies.append(RigidBody(f"panel {i}", 2.0, panel, place, [0.0, 0.0, angle], velocity, spin, pace="fast"))
        hinges.append(Revolute(("hub", f"panel {i}"), 0.5 * out, along, name=f"hinge {i}"))
        springs.append(JointSpring(f"hinge {i}", 150.0, name=f"spring {i}"))
    return Scene(bodies, [*hinges, *springs], coordinates=coordinates)


SHAPES: dict[str, Callable[[int, Coordinates], Scene]] = {"chain": chain, "star": star}


def measure(shape: str, bodies: int, coordinates: Coordinates, few: int, repeats: int) -> Measured:
    """One step of kicks and RATTLE, or of kicks and free motion in joint coordinates; a band where there are more than
    `few` rows."""
    before, constraint_pattern.MOST_ROWS_OF_FULL_MATRIX = constraint_pattern.MOST_ROWS_OF_FULL_MATRIX, few
    engine.cache_clear()  # another limit is another program of the same scene
    try:
        elapsed, seconds = stopwatch(), {}
        scene = SHAPES[shape](bodies, coordinates)
        run = vm.prepare(
            scene, vm.fully_explicit(1), macro_dt=MACRO_DT, num_steps=1
        )  # compiled once, for any number of steps
        run()
        first = elapsed()
        for steps in (SHORT, LONG):
            run(num_steps=steps)
            seconds[steps] = min(seconds_per_call(partial(run, num_steps=steps), 1) for _ in range(repeats))
    finally:
        constraint_pattern.MOST_ROWS_OF_FULL_MATRIX = before
        engine.cache_clear()
    return Measured((seconds[LONG] - seconds[SHORT]) / (LONG - SHORT) * 1e6, first)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each number of bodies."""
    band: dict[int, float] = {}
    joint: dict[str, dict[int, float]] = {shape: {} for shape in SHAPES}
    report = Report("chains", name)
    for shape, number in [*(("chain", n) for n in size.bodies), *(("star", n) for n in size.stars)]:
        tell(f"{shape}, {number} bodies")
        is_chain = shape == "chain"
        rows = 11 * number + 6 * (not is_chain)  # five of each hinge, six of each body: those of the hub on top
        row: dict = {"shape": shape, "bodies": number, "rows": rows}
        with_joint = not is_chain or number in size.joint
        in_full = rows <= constraint_pattern.MOST_ROWS_OF_FULL_MATRIX  # the choice of `vm.simulate`
        by_directors: Measured | None = None
        if is_chain or not in_full:
            by_directors = measure(shape, number, "directors", 0, size.repeats)
            row |= {"band, us": by_directors.us, "band, us a body": by_directors.us / number}
        if (is_chain and number in size.full) or (with_joint and in_full):
            full = measure(shape, number, "directors", rows, size.repeats)
            row["full, us"] = full.us
            by_directors = full if in_full else by_directors
        if with_joint and by_directors is not None:
            tell(f"{shape}, {number} bodies, joint coordinates")
            found = measure(shape, number, "joint", 0, size.repeats)
            joint[shape][number] = found.us
            row |= {"directors, first s": by_directors.first, "joint, first s": found.first}
            row |= {"joint, us": found.us, "directors over joint": by_directors.us / found.us}
        if is_chain:
            band[number] = row["band, us"]
        report.rows.append(row)
        report.claims.extend(_slopes(shape, number, band if is_chain else {}, joint[shape], size))
        yield report


def _slopes(shape: str, number: int, band: dict[int, float], joint: dict[int, float], size: Size) -> list[Claim]:
    """Of log time against log bodies, after the largest number of a shape: with a target."""
    claims = []
    if number != (size.bodies if shape == "chain" else size.stars)[-1]:
        return claims
    for what, us, least, most in (("", band, FROM, 1.15), (", joint coordinates", joint, JOINT_FROM, 1.2)):
        many = [n for n in us if n >= least]
        if len(many) > 1:
            found = slope(np.array(many), np.array([us[n] for n in many]))
            words = f"{shape}{what}: slope of log time against log bodies, {many[0]} to {many[-1]}"
            claims.append(Claim(words, exactly(found), most))
    return claims
