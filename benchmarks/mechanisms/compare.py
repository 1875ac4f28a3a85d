"""Mechanisms by directors, in joint coordinates and by other integrators: the time to reach an error."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.measure import Tell, interleaved, quartiles, silent
from benchmarks.mechanisms.cases import CASES
from benchmarks.mechanisms.plane import Mechanism
from benchmarks.mechanisms.ways import ways
from benchmarks.peers import figures
from benchmarks.peers.cases import NotRepresentable
from benchmarks.peers.scan import Point, candidates, scan
from benchmarks.report import Report

LEVELS = (1e-3, 1e-5)
"""Largest errors of the centres of bars at the end, over the size of the mechanism."""
FINEST = 1e-8
"""The smallest error asked for in full runs."""
OURS = ("joint", "directors", "functions")
"""How the names of this toolkit's ways begin."""


@dataclass(frozen=True)
class Size:
    """Mechanisms, numbers of micro steps in joint coordinates and by directors, errors, longest run (s), samples of a
    time.

    ways: beginnings of names, of which one is asked for; all by default.
    """

    mechanisms: tuple[str, ...]
    num_micro: tuple[int, ...]
    by_directors: tuple[int, ...]
    levels: tuple[float, ...]
    seconds: float
    repeats: int
    ways: tuple[str, ...] = ()


def sizes(name: str, only: Sequence[str] = (), way: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` these mechanisms, or all of a kind, e.g. "chain"; by `way`s that begin like these."""
    names = ("satellite 1",) if name == "quick" and not only else tuple(CASES)
    chosen = [one for one in names if not only or one in only or one.partition(" ")[0] in only]
    if not chosen:
        raise ValueError(f"mechanisms: there is no {' or '.join(only)}; there are {', '.join(CASES)}.")
    if name == "quick":
        return Size(tuple(chosen), (10,), (10,), LEVELS[:1], 0.5, 3, tuple(way))
    return Size(tuple(chosen), (1, 5, 10, 50), (10,), (*LEVELS, FINEST), 2.0, 5, tuple(way))


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each mechanism."""
    found: dict[str, dict[str, list[Point]]] = {}
    report = Report("mechanisms", name, figures={"mechanisms": partial(draw, found)})
    for title in size.mechanisms:
        mechanism = CASES[title]()
        found[title] = scanned(mechanism, title, size, report, tell)
        tell(f"{title}, timing")
        report.rows.extend(timed(mechanism, title, found[title], size))
        yield report


def scanned(mechanism: Mechanism, title: str, size: Size, report: Report, tell: Tell) -> dict[str, list[Point]]:
    """The runs of every way; ours, MuJoCo and Exudyn against DOP853, scipy and diffrax against Adams' methods."""
    tell(f"{title}, reference")
    end, other = mechanism.end("DOP853"), mechanism.end("LSODA")
    apart = float(np.abs(end - other).max()) / mechanism.size
    report.note(f"{title}: the two references differ by {apart:.0e}.")
    found = {}
    for way, make in ways(mechanism, size.num_micro, size.by_directors).items():
        if size.ways and not way.startswith(size.ways):
            continue
        tell(f"{title}, {way}")
        try:
            ladder, centres = make()
        except ModuleNotFoundError as error:
            report.note(f"{way} was left out: there is no {error.name}; pip install -e '.[peers]' installs it.")
        except NotRepresentable as error:
            report.note(f"{title}: {way.partition(' ')[0]} was left out: {error}.")
        else:
            judge = other if way.startswith(("scipy", "diffrax")) else end
            error_of = partial(_error, mechanism, centres, judge)
            found[way] = scan(way, [ladder], error_of, size.seconds, size.levels)
    return found


def _error(mechanism: Mechanism, centres, judge: np.ndarray, end) -> float:
    """The largest distance of a coordinate over the size; `centres` are of what a run returns."""
    return float(np.abs(centres(end) - judge).max()) / mechanism.size


def timed(mechanism: Mechanism, title: str, found: dict[str, list[Point]], size: Size) -> list[dict]:
    """A row for each level and way: the cheapest setting that reaches the level, timed in turns with those of the other
    ways."""
    rows = []
    for level in size.levels:
        best = {way: some[0] for way, points in found.items() if (some := candidates(points, level))}
        seconds = interleaved({way: point.run for way, point in best.items()}, size.repeats)
        least = min((float(np.median(samples)) for samples in seconds.values()), default=np.nan)
        for way, points in found.items():
            row: dict = {"mechanism": title, "level": level, "way": way}
            if way in best:
                us = quartiles(seconds[way], 1e6 / mechanism.t_end)
                first = max(p.build + p.compile for p in points) + best[way].seconds
                row |= {"setting": best[way].label.partition(", ")[2], "error": best[way].error, "first, s": first}
                row |= {"µs per s": us.value, "quartiles": f"{us.low:.3g} to {us.high:.3g}"}
                row |= {"to best": us.value * mechanism.t_end / 1e6 / least, "step, s": _step(best[way], mechanism)}
            else:
                finest = min(points, key=lambda p: p.settled)
                row |= {"setting": "not reached", "error": finest.settled}
            rows.append(row)
    return rows


def _step(point: Point, mechanism: Mechanism) -> float | None:
    """The step of a run with steps of one length; macro steps of ours."""
    words = point.label.partition(", ")[2]
    return mechanism.t_end / float(words.removesuffix(" steps")) if words.endswith(" steps") else None


def draw(found: dict[str, dict[str, list[Point]]]):
    """Error against time, a panel for each mechanism."""
    names = list(dict.fromkeys(way for points in found.values() for way in points))
    points = {title: [point for some in of_title.values() for point in some] for title, of_title in found.items()}
    return figures.draw(points, names, "Mechanisms: time to an error", OURS)
