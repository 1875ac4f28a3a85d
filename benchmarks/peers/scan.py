"""One run of every setting: its error and a rough time, so that only those that count are timed with care."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from benchmarks.peers.cases import LEVELS, Ladder
from vmri_jax.running.timing import seconds_per_call, stopwatch

FINE = 0.1
"""A ladder ends at the first error below so many times the finest level."""
CLOSE = 1.5
"""Settings that are at most so many times slower than the cheapest are timed too."""
MOST = 12
"""Candidates per peer and level."""
HALVINGS = 2
"""How often the gap between two settings is halved."""
ENOUGH = 0.01
"""Seconds that the calls for a rough time take together, at least."""


Error = Callable[[Any], float]
"""The error of the end of a run; infinite or no number for a run that failed."""


@dataclass(frozen=True)
class Point:
    """One setting of one peer that was run.

    settled: the largest error of it and of all finer settings of its ladder.
    seconds, build, compile: of the fastest of a few calls, of what is made once, of what the first call took longer.
    """

    peer: str
    label: str
    error: float
    settled: float
    seconds: float
    build: float
    compile: float
    run: Callable[[], Any]


def scan(
    peer: str,
    ladders: Sequence[Ladder],
    error: Error,
    seconds: float,
    levels: Sequence[float] = LEVELS,
) -> list[Point]:
    """Climb every ladder until it is fine enough, a run takes longer than `seconds`, or another ladder was faster.

    Those that are among the cheapest at a level are refined there.
    """
    climbed: list[Climb] = []
    for ladder in ladders:
        climb = Climb(peer, ladder, error)
        enough = min((p.seconds for c in climbed for p in c.points() if p.settled <= min(levels)), default=np.inf)
        for setting in ladder.settings:
            rung = climb.add(setting)
            if rung.error < FINE * min(levels) or rung.seconds > min(seconds, CLOSE * enough):
                break
        climbed.append(climb)
    for level in levels:
        first = {i: p.seconds for i, c in enumerate(climbed) if (p := c.first(level)) is not None}
        for i in sorted(first, key=lambda i: first[i])[:MOST]:
            if first[i] <= CLOSE * min(first.values()):
                climbed[i].refine(level)
    return [p for c in climbed for p in c.points()]


class Climb:
    """The settings of a ladder that were run, from coarse to fine."""

    def __init__(self, peer: str, ladder: Ladder, error: Error):
        self.peer, self.ladder, self.error = peer, ladder, error
        self.rungs: dict[float, Point] = {}

    def add(self, setting) -> Point:
        """Run one more."""
        elapsed = stopwatch()
        run = self.ladder.build(setting)
        built, elapsed = elapsed(), stopwatch()
        try:
            end = jax.block_until_ready(run())
        except (RuntimeError, ArithmeticError):  # an integrator that gives up, where others return NaN
            end = None
        first, error, seconds = elapsed(), np.nan if end is None else self.error(end), 0.0
        compiled = next((point.compile for point in self.rungs.values()), None)
        if np.isfinite(error):
            seconds = _rough(run, None if compiled is None else first)
        compiled = max(0.0, first - seconds) if compiled is None else compiled
        error = error if np.isfinite(error) else np.inf
        point = Point(self.peer, self.ladder.label(setting), error, error, seconds, built, compiled, run)
        self.rungs[setting] = point
        return point

    @property
    def settings(self) -> list[float]:
        """What was run, coarse first."""
        return sorted(self.rungs, reverse=self.ladder.kind == "tol")

    def points(self) -> list[Point]:
        """The runs, with the largest error of each and of all finer ones."""
        points = [self.rungs[setting] for setting in self.settings]
        settled = np.maximum.accumulate([p.error for p in reversed(points)])[::-1]
        return [replace(p, settled=float(error)) for p, error in zip(points, settled, strict=True)]

    def first(self, level: float) -> Point | None:
        """The coarsest one that reaches a level."""
        return next((p for p in self.points() if p.settled <= level), None)

    def refine(self, level: float) -> None:
        """Halve the gap before it, `HALVINGS` times."""
        for _ in range(HALVINGS):
            reached = [p.settled <= level for p in self.points()].index(True)
            if reached == 0:
                return
            middle = self.ladder.between(*self.settings[reached - 1 : reached + 1])
            if middle in self.rungs:
                return
            self.add(middle)


def candidates(points: Sequence[Point], level: float) -> list[Point]:
    """The cheapest settings that reach a level, the first one and those close to it."""
    good = sorted((p for p in points if p.settled <= level), key=lambda p: p.seconds)
    return [p for p in good if p.seconds <= CLOSE * good[0].seconds][:MOST]


def front(points: Sequence[Point]) -> list[Point]:
    """Those that no other beats in both time and settled error, fastest first."""
    best, kept = np.inf, []
    for p in sorted(points, key=lambda p: (p.seconds, p.settled)):
        if p.settled < best:
            best = p.settled
            kept.append(p)
    return kept


def _rough(run: Callable[[], Any], first: float | None) -> float:
    """Seconds of the fastest of up to five calls; the first one counts if nothing was compiled in it."""
    taken = [] if first is None else [first]
    while not taken or (len(taken) < 5 and sum(taken) < ENOUGH):
        taken.append(seconds_per_call(run, 1))
    return min(taken)
