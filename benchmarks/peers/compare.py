"""Our integrators against what people use instead: the time to reach an error, in one interleaved run per problem."""

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import vmri_jax as vm
from benchmarks.c_loops import NoCompiler
from benchmarks.measure import Ratio, Tell, interleaved, quartiles, ratio, silent
from benchmarks.peers import cases, figures
from benchmarks.peers.cases import BATCH_LEVEL, LEVELS, Case, Ladder, NotRepresentable
from benchmarks.peers.scan import Point, candidates, scan
from benchmarks.peers.targets import target
from benchmarks.report import Claim, Report
from benchmarks.worker import starts

OURS = "vmri_jax"
PEERS = {
    OURS: "ours",
    "heyoka": "heyoka",
    "diffrax": "diffrax",
    "diffrax, autodiff": "diffrax_autodiff",
    "scipy": "scipy",
    "scipy, autodiff": "scipy_autodiff",
    "OpenMM": "openmm",
    "Exudyn": "exudyn",
    "MuJoCo": "mujoco",
    "JAX MD": "jax_md",
    "JAX by hand": "jax_loops",
    "C by hand": "c",
}
"""Modules of this package by the name of the integrator."""
BATCHED = (OURS, "heyoka", "diffrax", "diffrax, autodiff")
BATCH = 1024
FINE_STEPS = 1000
"""Of the reference of a batch, whose error is then 1e-7, far below the level that is asked for."""
BATCH_CASES = ("FPU l=3 t=1", "TSP t=1")
SLOW = 0.2
"""Runs longer than this many seconds are timed among themselves and with ours, with fewer samples."""
COLUMNS = (
    "case",
    "peer",
    *(f"{level:.0e}" for level in LEVELS),
    "trajectories/s",
    "best error",
    "energy differs",
    "build, s",
)


@dataclass(frozen=True)
class Size:
    """How much is run.

    cases, batches: problems, single runs and batches of `BATCH`.
    peers: names from `PEERS`; ours is always among them.
    seconds: the longest run of a ladder.
    repeats, slow_repeats: samples of fast and of slow runs.
    """

    cases: tuple[str, ...]
    batches: tuple[str, ...]
    peers: tuple[str, ...]
    seconds: float
    repeats: int
    slow_repeats: int
    batch: int = BATCH


def sizes(name: str, only: Sequence[str] = (), peers: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` these cases, e.g. "TSP t=1" or "TSP", and `peers`.

    Raises:
        ValueError: there is no such case or peer.
    """
    chosen = _chosen(cases.NAMES, only)
    batches = _chosen([f"{case}, batch" for case in BATCH_CASES], only)
    if not chosen and not batches:
        raise ValueError(f"peers: there is no case {' or '.join(only)}; there are {', '.join(cases.NAMES)}.")
    known = {peer.partition(",")[0] for peer in PEERS}
    if unknown := [peer for peer in peers if peer not in known]:
        raise ValueError(f"peers: there is no {', '.join(unknown)}; there are {', '.join(sorted(known))}.")
    named = tuple(peer for peer in PEERS if not peers or peer.partition(",")[0] in (OURS, *peers))
    seconds, repeats, slow = (1.0, 7, 2) if name == "quick" else (30.0, 15, 3)
    return Size(tuple(chosen), tuple(batches), named, seconds, repeats, slow)


def _chosen(names: Sequence[str], only: Sequence[str]) -> list[str]:
    """Those asked for: by the whole name, else by its beginning."""
    return [name for name in names if not only or name in only or any(name.startswith(f"{x} ") for x in only)]


def load(peer: str):
    """The module of a peer.

    Raises:
        ModuleNotFoundError: its package is not installed.
    """
    return importlib.import_module(f"benchmarks.peers.{PEERS[peer]}")


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Scan and time all of it, a report after each case."""
    rows: list[dict] = []
    claims: list[Claim] = []
    notes: list[str] = []
    found: dict[str, list[Point]] = {}

    def report() -> Report:
        return Report("peers", name, rows, claims, list(dict.fromkeys(notes)), figures.by_family(found, tuple(PEERS)))

    for title in size.cases:
        case = cases.case(title)
        ladders = _ladders(title, case, size.peers, notes, partial(_single, case=case))
        found[title] = _one(title, case, ladders, LEVELS, size, tell, rows, claims, notes)
        yield report()
    for title in size.batches:
        case, lanes = batch_case(title.removesuffix(", batch"), size.batch)
        peers = [peer for peer in size.peers if peer in BATCHED]
        ladders = _ladders(
            title, case, peers, notes, lambda m, case=case, lanes=lanes: (m.batch_ladders(case, *lanes), None)
        )
        found[title] = _one(title, case, ladders, (BATCH_LEVEL,), size, tell, rows, claims, notes)
        yield report()


def batch_case(name: str, lanes: int) -> tuple[Case, tuple]:
    """A case with `lanes` starts, and these: ``(states, q, v)``; the reference is a Gauss scheme of order 4."""
    case = cases.case(name)
    states = starts(case.problem, lanes)
    steps = {"macro_dt": case.t_end / FINE_STEPS, "num_steps": FINE_STEPS, "save_every": FINE_STEPS}
    end = vm.simulate_batch(case.problem.system, vm.galerkin(1, 2, "gauss"), states, **steps)
    q_end = np.concatenate([end.q_s[:, -1], end.q_f[:, -1]], axis=1)
    q = np.concatenate([states.q_s, states.q_f], axis=1)
    v = np.concatenate([states.p_s, states.p_f], axis=1) / case.masses
    return replace(case, name=f"{name}, batch", q_end=q_end), (states, q, v)


def energy_difference(module, case: Case) -> float:
    """Energy of the start as the peer evaluates it, relative to ours."""
    return abs(module.energy(case) - case.energy) / abs(case.energy)


def _single(module, case: Case) -> tuple[list[Ladder], float]:
    return module.ladders(case), energy_difference(module, case)


def _ladders(
    title: str, case: Case, peers, notes: list[str], get
) -> dict[str, tuple[list[Ladder], float | None] | None]:
    """By peer: its ladders and the difference of its energy, None where it is left out."""
    found = {}
    for peer in peers:
        found[peer] = None
        try:
            found[peer] = get(load(peer))
        except ModuleNotFoundError as error:
            notes.append(f"{peer} was left out: there is no {error.name}; pip install -e '.[peers]' installs it.")
        except (NotRepresentable, NoCompiler) as error:
            notes.append(f"{title}: {peer} was left out: {error}.")
    return found


def _one(title, case: Case, ladders, levels, size: Size, tell: Tell, rows, claims, notes) -> list[Point]:
    """One case: rows, claims and notes are appended; returns all points."""
    points: dict[str, list[Point]] = {}
    for peer, given in ladders.items():
        tell(f"{title}, {peer}")
        if given is not None:
            points[peer] = scan(peer, given[0], case, size.seconds, levels)
    tell(f"{title}, timing")
    timed = _time(points, levels, size)
    for peer, mine in points.items():
        differs = None if (given := ladders[peer]) is None else given[1]
        rows.append(_row(title, peer, mine, levels, timed, differs))
        if case.q_end.ndim == 2 and rows[-1]["levels"]:
            rows[-1]["trajectories/s"] = len(case.q_end) / (1e-3 * rows[-1]["levels"][0]["ms"])
        notes += _not_reached(title, peer, mine, levels)
        for level in levels:
            least = target(title, peer, level)
            if least is not None and (peer, level) in timed:
                claims.append(
                    Claim(f"{title}, {level:.0e}: {peer} over ours", timed[peer, level].to_ours, at_least=least)
                )
    return [p for mine in points.values() for p in mine]


@dataclass(frozen=True)
class Timed:
    """The fastest setting of one peer at one level: samples, and the ratio of its time to ours (0 where ours never gets there)."""

    point: Point
    samples: list[float]
    to_ours: Ratio


def _time(points: Mapping[str, Sequence[Point]], levels, size: Size) -> dict[tuple[str, float], Timed]:
    """Interleaved times of all candidates: the fast ones together, the slow ones together, each with ours."""
    chosen = {(peer, level): candidates(mine, level) for peer, mine in points.items() for level in levels}
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
            to_ours = ratio(samples, best(mine)[1]) if mine in fastest else Ratio(0.0, 0.0, 0.0)
            found[key] = Timed(point, samples, to_ours)
    return found


def _row(title, peer, points: Sequence[Point], levels, timed, differs) -> dict:
    row = {"case": title, "peer": peer}
    details = []
    for level in levels:
        key = f"{level:.0e}"
        if (peer, level) not in timed:
            row[key] = "not reached"
            continue
        at = timed[peer, level]
        ms = quartiles(at.samples, 1e3)
        row[key] = f"{ms.value:.3g} ms" + ("" if peer == OURS else f" ({at.to_ours.value:.2g}x)")
        details.append(
            {
                "level": level,
                "setting": at.point.label,
                "error": at.point.error,
                "ms": ms.value,
                "low": ms.low,
                "high": ms.high,
            }
        )
        details[-1] |= {"to ours": at.to_ours.value, "build, s": at.point.build + at.point.compile}
    row["best error"] = min((p.settled for p in points), default=np.inf)
    row["energy differs"] = differs
    row["build, s"] = max((d["build, s"] for d in details), default=None)
    scanned = [{"setting": p.label, "error": p.error, "seconds": p.seconds} for p in points]
    return row | {"levels": details, "scan": scanned}


def _not_reached(title, peer, points: Sequence[Point], levels) -> list[str]:
    missed = [level for level in levels if not candidates(points, level)]
    if not missed:
        return []
    words = " or ".join(f"{level:.0e}" for level in missed)
    best = min(points, key=lambda p: (p.settled, p.seconds), default=None)
    if best is None or not np.isfinite(best.settled):
        return [f"{title}: {peer} does not reach {words}: no run of it succeeded."]
    return [
        f"{title}: {peer} does not reach {words}: its best is {best.settled:.1e} in {1e3 * best.seconds:.3g} ms ({best.label})."
    ]
