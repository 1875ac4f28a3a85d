"""Linear in the number of bodies: time of one step of a hinged chain, a band against the full matrix."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import vmri_jax as vm
from benchmarks.linear import slope
from benchmarks.measure import Ratio, Tell, silent
from benchmarks.report import Claim, Report, growing
from vmri_jax.mechanics import constraint_pattern
from vmri_jax.running.engine import engine
from vmri_jax.scene import Box, Gravity, Revolute, RigidBody, Scene
from vmri_jax.study.timing import seconds_per_call

COLUMNS = ("bodies", "rows", "band, us", "full, us", "band, us a body")
SHORT, LONG = 50, 250
"""Steps of two runs; what a call costs besides its steps is in both."""
MACRO_DT = 1e-3
FROM = 20
"""Below so many bodies the band is not what `vm.simulate` takes, or what does not depend on their number counts as well."""
LEVEL = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
"""The rotation that lays the long axis of a bar along x."""


@dataclass(frozen=True)
class Size:
    """Numbers of bodies with a band, those of them with the full matrix too, samples of a time."""

    bodies: tuple[int, ...]
    full: tuple[int, ...]
    repeats: int


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    quick = Size((10, 20, 40), (10, 20), 3)
    return quick if name == "quick" else Size((1, 5, 10, 20, 40, 70, 100), (1, 5, 10, 20, 40), 5)


def chain(bodies: int) -> Scene:
    """Bars of 1 kg and 1 m in a row along x, the first hinged to the ground, at rest."""
    bars = [
        RigidBody(f"bar {i}", 1.0, Box((0.1, 0.1, 1.0)), [0.5 + i, 0.0, 0.0], LEVEL, pace="fast") for i in range(bodies)
    ]
    pairs = [("ground", "bar 0"), *((f"bar {i}", f"bar {i + 1}") for i in range(bodies - 1))]
    hinges = Revolute(pairs, [[float(i), 0.0, 0.0] for i in range(bodies)], [0.0, 1.0, 0.0], name="hinges")
    return Scene(bars, [Gravity(), hinges])


def microseconds(bodies: int, few: int, repeats: int) -> float:
    """Of one RATTLE step; a band where there are more than `few` rows."""
    before, constraint_pattern.FEW = constraint_pattern.FEW, few
    engine.cache_clear()  # another limit is another program of the same scene
    try:
        scene = chain(bodies)
        seconds = {}
        for steps in (SHORT, LONG):
            run = vm.prepare(scene, vm.fully_explicit(1), macro_dt=MACRO_DT, num_steps=steps, save_every=steps)
            run()
            seconds[steps] = min(seconds_per_call(run, 1) for _ in range(repeats))
    finally:
        constraint_pattern.FEW = before
        engine.cache_clear()
    return (seconds[LONG] - seconds[SHORT]) / (LONG - SHORT) * 1e6


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Measure all of it, a report after each number of bodies."""
    band: dict[int, float] = {}

    def measured(bodies: int) -> tuple[list[dict], list[Claim]]:
        tell(f"{bodies} bodies")
        rows = 11 * bodies
        band[bodies] = microseconds(bodies, 0, size.repeats)
        full = microseconds(bodies, rows, size.repeats) if bodies in size.full else None
        row = {"bodies": bodies, "rows": rows, "band, us": band[bodies], "full, us": full}
        claims = []
        many = [k for k in band if k >= FROM]
        if bodies == size.bodies[-1] and len(many) > 1:
            found = slope(np.array(many), np.array([band[k] for k in many]))
            claims.append(
                Claim(f"slope of log time against log bodies, {FROM} to {bodies}", Ratio(found, found, found), 1.15)
            )
        return [row | {"band, us a body": band[bodies] / bodies}], claims

    return growing("chains", name, (measured(bodies) for bodies in size.bodies))
