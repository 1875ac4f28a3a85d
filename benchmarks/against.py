"""Before and after: two checkouts interleaved in one run, each in a process of its own."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.measure import Tell, quartiles, ratio, silent
from benchmarks.report import Claim, Report
from benchmarks.seats import Outcome, Seat, Worker, first_results, take_turns
from benchmarks.worker import Case

BEFORE, AFTER = "before", "after"
TWO = ("fully_explicit 10", "explicit_slow 10", "fully_implicit 10")
"""Schemes of order 2."""
COMPOSED = ("kahan-li6 of fully_explicit 2", "kahan-li8 of fully_explicit 2")
LANES = 256


def _single() -> list[Case]:
    cases = [Case("single", f"FPU l={n}", scheme, 0.01) for n in (3, 50, 200) for scheme in TWO]
    cases += [Case("single", "FPU l=3", scheme, 0.01) for scheme in ("mollified_impulse 10", "takahashi_imada 4")]
    cases += [Case("single", "FPU l=3", scheme, 0.02) for scheme in COMPOSED]
    for system in ("TSP", "SAM"):
        cases += [Case("single", system, scheme, 0.002) for scheme in (*TWO, "mollified_impulse 10")]
        cases += [Case("single", system, "takahashi_imada 4", 0.004)]
        cases += [Case("single", system, f"galerkin 1 {degree} lobatto", 0.004 * degree) for degree in (4, 8, 12)]
        cases += [Case("single", system, scheme, 0.01) for scheme in COMPOSED]
    return cases


def _batch() -> list[Case]:
    of_chain, of_rods = (TWO[0], COMPOSED[1]), (TWO[0], TWO[2], COMPOSED[1], "galerkin 1 8 lobatto")
    steps = [*zip(of_chain, (0.01, 0.02), strict=True)], [*zip(of_rods, (0.002, 0.002, 0.01, 0.032), strict=True)]
    systems = (("FPU l=3", steps[0]), ("TSP", steps[1]), ("SAM", steps[1]))
    return [Case("batch", system, *step, lanes=LANES) for system, some in systems for step in some]


def _calls(kind: str) -> list[Case]:
    steps = (
        ("FPU l=3", TWO[0], 0.01),
        ("TSP", TWO[2], 0.002),
        ("SAM", TWO[0], 0.002),
        ("TSP", "galerkin 1 8 lobatto", 0.032),
    )
    return [Case(kind, *step, num_steps=100) for step in steps]


def at_most(case: Case) -> tuple[float | None, float | None]:
    """The most that `after` may take: as a ratio to `before`, and in seconds."""
    if case.kind == "batch" and case.system == "TSP" and "lobatto" in case.scheme:
        return 0.5, None
    if case.kind == "batch" and case.system != "FPU l=3" and case.scheme in TWO:
        return 1.6, None
    seconds = {"call": 250e-6, "prepared": 25e-6, "first": 4.0, "gradient": 8.0}.get(case.kind)
    return 1.1 if seconds is None else None, seconds


GROUPS = {
    "single": _single(),
    "batch": _batch(),
    "call": _calls("call") + _calls("prepared"),
    "first": [
        Case("first", system, scheme, macro_dt, num_steps=2)
        for system, macro_dt in (("FPU l=3", 0.01), ("TSP", 0.002), ("SAM", 0.002))
        for scheme in TWO
    ],
    "gradient": [Case("gradient", "TSP", TWO[2], 0.002, num_steps=20)],
}
FRESH = ("first", "gradient")
"""Groups in which every sample is a new process."""
QUICK = {
    "single": slice(None, None, 4),
    "batch": slice(0, 5, 4),
    "call": slice(None, None, 3),
    "first": slice(0, None, 4),
}
"""Cases of the quick set."""


@dataclass(frozen=True)
class Size:
    """The two sides, cases by group, samples of a run and of a new process, and seconds of a run."""

    before: Seat
    after: Seat
    groups: dict[str, list[Case]]
    repeats: int
    fresh: int
    seconds: float


def sizes(name: str, before: Path, python: Path | None = None, only: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` some of `GROUPS`."""
    if not (before / "vmri_jax").is_dir():
        raise ValueError(f"against: {before} has no folder vmri_jax; give a checkout of this repository.")
    if unknown := [group for group in only if group not in GROUPS]:
        raise ValueError(f"against: there is no group {', '.join(unknown)}; there are {', '.join(GROUPS)}.")
    groups = {group: cases for group, cases in GROUPS.items() if not only or group in only}
    own = before / ".venv" / "bin" / "python"
    python = python or (own if own.exists() else Seat().python)
    new = Seat()
    old = replace(new, checkout=before.absolute(), python=python.absolute())
    if name == "full":
        return Size(old, new, groups, 15, 3, 0.1)
    return Size(old, new, {g: some[QUICK.get(g, slice(None))] for g, some in groups.items()}, 5, 2, 0.03)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Compare all of it, a report after each case."""
    seats = {BEFORE: size.before, AFTER: size.after}
    about: dict = {side: {"commit": seat.commit, "checkout": str(seat.checkout)} for side, seat in seats.items()}
    report = Report("against", name, about=about)
    report.note(", ".join(f"{side}: {about[side]['commit']}" for side in seats))
    for group, case, outcome in _outcomes(size, seats, tell):
        _add(report, group, case, outcome)
        yield report


def _outcomes(size: Size, seats: dict[str, Seat], tell: Tell) -> Iterator[tuple[str, Case, Outcome]]:
    """Group, case and measurement, one after the other."""
    for group, cases in size.groups.items():
        if group in FRESH:
            for case in cases:
                tell(f"{group}, {case.label}")
                yield f"{group}, cold", case, first_results(seats, case, size.fresh)
        if group == "first":
            continue
        with ExitStack() as stack:
            workers = {name: stack.enter_context(Worker(seat)) for name, seat in seats.items()}
            for case in cases:
                tell(f"{group}, {case.label}")
                yield case.kind, case, take_turns(workers, replace(case, seconds=size.seconds), size.repeats)


def _add(report: Report, group: str, case: Case, outcome: Outcome) -> None:
    """The row of a case, its claims, and why a side was left out."""
    samples, made, what = outcome.samples, outcome.made.values(), f"{group}, {case.label}"
    row: dict = {"group": group, "case": case.label, "steps": max((m["num_steps"] for m in made), default=None)}
    for side in (BEFORE, AFTER):
        row[f"{side}, ms"] = 1e3 * float(np.median(samples[side])) if side in samples else None
    most, seconds = at_most(case)
    if {BEFORE, AFTER} <= set(samples):
        found = ratio(samples[AFTER], samples[BEFORE])
        row |= {"after/before": found.value, "quartiles": f"{found.low:.3g} to {found.high:.3g}"}
        if most is not None:
            report.claims.append(Claim(f"{what}: after over before", found, at_most=most))
    if seconds is not None and AFTER in samples and group != "gradient":  # further calls of a gradient have no target
        report.claims.append(Claim(f"{what}: after, seconds", quartiles(samples[AFTER]), at_most=seconds))
    row |= {"differs": outcome.difference(AFTER, BEFORE), "result": ", ".join(sorted({m["result"] for m in made}))}
    report.rows.append(row)
    for side, why in outcome.refused.items():
        report.note(f"{what}: {side} was left out: {why}.")
