"""Our integrators against what people use instead: the time to reach an error."""

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.c_loops import NoCompiler
from benchmarks.measure import Ratio, Tell, exactly, interleaved, quartiles, ratio, silent
from benchmarks.peers import autodiff, cases, figures
from benchmarks.peers.cases import LEVELS, Case, NotRepresentable
from benchmarks.peers.scan import Point, candidates, scan
from benchmarks.report import Claim, Report, spread

OURS = "vmri_jax"
PEERS = {
    OURS: "ours",
    "heyoka": "heyoka",
    "diffrax": "diffrax",
    "diffrax, autodiff": "diffrax",
    "scipy": "scipy",
    "scipy, autodiff": "scipy",
    "OpenMM": "openmm",
    "Exudyn": "exudyn",
    "MuJoCo": "mujoco",
    "C by hand": "c",
}
"""Modules of this package by the name of the integrator; "autodiff" says where equations come from, see `load`."""
OF_RODS = ("Exudyn", "MuJoCo")
"""Multibody codes, which run points on rods and not the chain."""
RODS = ("TSP t=1", "TSP t=10", "SAM t=1", "SAM t=10")
TARGETS = (
    (("FPU l=3 t=1",), ("diffrax", "scipy", "OpenMM"), LEVELS, 3.0),
    (("FPU l=3 t=1",), ("heyoka",), (2e-4,), 1 / 3),
    (("FPU l=3 t=1",), ("heyoka",), (1e-8,), 1 / 5),
    (("FPU l=3 t=100",), ("diffrax", "scipy"), (1e-2, 2e-4), 5.0),
    (("FPU l=200 t=1",), ("heyoka",), (1e-2, 2e-4), 8.0),
    (("FPU l=200 t=1",), ("heyoka",), (2e-6,), 1.0),
    (RODS, ("OpenMM", "Exudyn", "MuJoCo", "diffrax", "scipy"), LEVELS, 1.0),
    (RODS, ("heyoka",), LEVELS, 1 / 5),
)
"""Some peers in some cases at some levels, and the least time over ours; below 1 it bounds how far we may be behind."""
SLOW = 0.2
"""Runs longer than this many seconds are timed among themselves and with ours, with fewer samples."""


@dataclass(frozen=True)
class Size:
    """How much is run.

    cases: names of problems.
    peers: names from `PEERS`; ours is always among them.
    seconds: the longest run of a ladder.
    repeats, slow_repeats: samples of fast and of slow runs.
    """

    cases: tuple[str, ...]
    peers: tuple[str, ...]
    seconds: float
    repeats: int
    slow_repeats: int


def sizes(name: str, only: Sequence[str] = (), peers: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` these cases, e.g. "TSP t=1" or "TSP", and `peers`."""
    chosen = [case for case in cases.NAMES if not only or case in only or case.startswith(tuple(f"{x} " for x in only))]
    if not chosen:
        raise ValueError(f"peers: there is no case {' or '.join(only)}; there are {', '.join(cases.NAMES)}.")
    known = {peer.partition(",")[0] for peer in PEERS}
    if unknown := [peer for peer in peers if peer not in known]:
        raise ValueError(f"peers: there is no {', '.join(unknown)}; there are {', '.join(sorted(known))}.")
    named = tuple(peer for peer in PEERS if not peers or peer.partition(",")[0] in (OURS, *peers))
    seconds, repeats, slow = (1.0, 7, 2) if name == "quick" else (30.0, 15, 3)
    return Size(tuple(chosen), named, seconds, repeats, slow)


def load(peer: str) -> Any:
    """The module of a peer, if its package is installed, with equations by automatic differentiation where its name
    says so."""
    module = importlib.import_module(f"benchmarks.peers.{PEERS[peer]}")
    if not peer.endswith("autodiff"):
        return module
    return SimpleNamespace(energy=autodiff.energy, ladders=partial(module.ladders, equations=autodiff))


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Scan and time all of it, a report after each case."""
    report = Report("peers", name)
    found: dict[str, list[Point]] = {}
    for title in size.cases:
        found[title] = _one(cases.case(title), size, report, tell)
        report.figures.update(figures.by_family(found, tuple(PEERS)))
        yield report


def target(case: str, peer: str, level: float) -> float | None:
    """The least ratio aimed at, None where there is none."""
    return next(
        (least for cases, peers, levels, least in TARGETS if case in cases and peer in peers and level in levels), None
    )


def energy_difference(module, case: Case) -> float:
    """Energy of the start as the peer evaluates it, relative to ours."""
    return abs(module.energy(case) - case.energy) / abs(case.energy)


def _one(case: Case, size: Size, report: Report, tell: Tell) -> list[Point]:
    """Adds rows, claims and notes of one case to the report; returns all points."""
    title = case.name
    points: dict[str, list[Point]] = {}
    differs: dict[str, float] = {}
    for peer in [peer for peer in size.peers if not (case.is_chain and peer in OF_RODS)]:
        tell(f"{title}, {peer}")
        try:
            module = load(peer)
            ladders = module.ladders(case)
            differs[peer] = energy_difference(module, case)
        except ModuleNotFoundError as error:
            report.note(f"{peer} was left out: there is no {error.name}; pip install -e '.[peers]' installs it.")
        except (NotRepresentable, NoCompiler) as error:
            report.note(f"{title}: {peer} was left out: {error}.")
        else:
            points[peer] = scan(peer, ladders, case.error, size.seconds)
    tell(f"{title}, timing")
    timed = _time(points, size)
    for peer, mine in points.items():
        report.rows.append(_row(title, peer, mine, timed) | {"energy differs": differs[peer]})
        if missed := [level for level in LEVELS if (peer, level) not in timed]:
            report.note(f"{title}: {peer} does not reach {_why(mine, missed)}.")
        for level in LEVELS:
            least = target(title, peer, level)
            if least is not None and (peer, level) in timed:
                what = f"{title}, {level:.0e}: {peer} over ours"
                report.claims.append(Claim(what, timed[peer, level].to_ours, at_least=least))
    return [p for mine in points.values() for p in mine]


@dataclass(frozen=True)
class Timed:
    """The fastest setting of one peer at one level; `to_ours` is 0 where ours never gets there."""

    point: Point
    samples: list[float]
    to_ours: Ratio


def _time(points: Mapping[str, Sequence[Point]], size: Size) -> dict[tuple[str, float], Timed]:
    """Times of all candidates in turn: the fast ones together, the slow ones together, each with ours."""
    chosen = {(peer, level): candidates(mine, level) for peer, mine in points.items() for level in LEVELS}
    fastest = {key: some[0].seconds for key, some in chosen.items() if some}
    found: dict[tuple[str, float], Timed] = {}
    for slow, repeats in ((False, size.repeats), (True, size.slow_repeats)):
        keys = [key for key, seconds in fastest.items() if (seconds > SLOW) == slow]
        if not keys:
            continue
        ours = [key for key in fastest if key[0] == OURS]
        named = {f"{p.peer}: {p.label}": p for key in [*keys, *ours] for p in chosen[key]}
        timed = interleaved({name: p.run for name, p in named.items()}, repeats)

        def best(key, named=named, timed=timed) -> tuple[Point, list[float]]:
            """Of all that were timed: a setting chosen for a finer level may turn out to be faster."""
            peer, level = key
            some = [(p, timed[name]) for name, p in named.items() if p.peer == peer and p.settled <= level]
            return min(some, key=lambda pair: float(np.median(pair[1])))

        for key in keys:
            point, samples = best(key)
            mine = (OURS, key[1])
            to_ours = ratio(samples, best(mine)[1]) if mine in fastest else exactly(0.0)
            found[key] = Timed(point, samples, to_ours)
    return found


def _row(title, peer, points: Sequence[Point], timed) -> dict:
    row: dict = {"case": title, "peer": peer}
    details = []
    for level in LEVELS:
        key = f"{level:.0e}"
        if (peer, level) not in timed:
            row[key] = "not reached"
            continue
        at = timed[peer, level]
        ms = quartiles(at.samples, 1e3)
        row[key] = f"{ms.value:.3g} ms" + ("" if peer == OURS else f" ({at.to_ours.value:.2g}x)")
        detail = {"level": level, "setting": at.point.label, "error": at.point.error, **spread("ms", ms)}
        details.append(detail | {"to ours": at.to_ours.value, "build, s": at.point.build + at.point.compile})
    row["best error"] = min((p.settled for p in points), default=np.inf)
    row["build, s"] = max((d["build, s"] for d in details), default=None)
    return row | {"levels": details}


def _why(points: Sequence[Point], missed: Sequence[float]) -> str:
    """These levels were missed, and by how much."""
    words = " or ".join(f"{level:.0e}" for level in missed)
    best = min(points, key=lambda p: (p.settled, p.seconds), default=None)
    if best is None or not np.isfinite(best.settled):
        return f"{words}: no run of it succeeded"
    return f"{words}: its best is {best.settled:.1e} in {1e3 * best.seconds:.3g} ms ({best.label})"
