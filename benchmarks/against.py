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

COLUMNS = ("group", "case", "steps", "before, ms", "after, ms", "after/before", "quartiles", "differs", "result")
BEFORE, AFTER = "before", "after"
TWO = ("fully_explicit 10", "explicit_slow 10", "fully_implicit 10")
"""Schemes of order 2 that the first results are measured with."""
COMPOSED = ("kahan-li6 of fully_explicit 2", "kahan-li8 of fully_explicit 2")
LANES = 256
SINGLE, CALL, PREPARED, COLD, GRADIENT = 1.1, 250e-6, 25e-6, 4.0, 8.0
"""Targets: ratio of single runs; seconds of calls, of first results and gradients."""


@dataclass(frozen=True)
class Entry:
    """A case and the most that `after` may take: as a ratio to `before`, and in seconds."""

    case: Case
    ratio: float | None = None
    seconds: float | None = None

    @property
    def label(self) -> str:
        """In tables."""
        lanes = f", {self.case.lanes} lanes" if self.case.kind == "batch" else ""
        return f"{self.case.system}, {self.case.scheme}{lanes}"


def _single() -> list[Entry]:
    simple = ("fully_explicit 10", "fully_implicit 10", "explicit_slow 10")
    cases = [Case("single", f"FPU l={n}", scheme, 0.01) for n in (3, 50, 200) for scheme in simple]
    cases += [Case("single", "FPU l=3", scheme, 0.01) for scheme in ("mollified_impulse 10", "takahashi_imada 4")]
    cases += [Case("single", "FPU l=3", scheme, 0.02) for scheme in COMPOSED]
    for system in ("TSP", "SAM"):
        cases += [Case("single", system, scheme, 0.002) for scheme in (*simple, "mollified_impulse 10")]
        cases += [Case("single", system, "takahashi_imada 4", 0.004)]
        cases += [Case("single", system, f"galerkin 1 {degree} lobatto", 0.004 * degree) for degree in (4, 8, 12)]
        cases += [Case("single", system, scheme, 0.01) for scheme in COMPOSED]
    return [Entry(case, ratio=SINGLE) for case in cases]


def _batch() -> list[Entry]:
    def entry(system: str, scheme: str, macro_dt: float, most: float) -> Entry:
        return Entry(Case("batch", system, scheme, macro_dt, lanes=LANES), ratio=most)

    found = [entry("FPU l=3", "fully_explicit 10", 0.01, SINGLE), entry("FPU l=3", COMPOSED[1], 0.02, SINGLE)]
    for system, of_lobatto in (("TSP", 0.5), ("SAM", SINGLE)):
        found += [entry(system, scheme, 0.002, 1.6) for scheme in ("fully_explicit 10", "fully_implicit 10")]
        found += [entry(system, COMPOSED[1], 0.01, SINGLE), entry(system, "galerkin 1 8 lobatto", 0.032, of_lobatto)]
    return found


def _calls(kind: str, seconds: float) -> list[Entry]:
    cases = (
        Case(kind, "FPU l=3", "fully_explicit 10", 0.01, num_steps=100),
        Case(kind, "TSP", "fully_implicit 10", 0.002, num_steps=100),
        Case(kind, "SAM", "fully_explicit 10", 0.002, num_steps=100),
        Case(kind, "TSP", "galerkin 1 8 lobatto", 0.032, num_steps=100),
    )
    return [Entry(case, seconds=seconds) for case in cases]


FIRST = [
    Entry(Case("first", system, scheme, macro_dt, num_steps=2), seconds=COLD)
    for system, macro_dt in (("FPU l=3", 0.01), ("TSP", 0.002), ("SAM", 0.002))
    for scheme in TWO
]
GRADIENTS = [Entry(Case("gradient", "TSP", "fully_implicit 10", 0.002, num_steps=20), seconds=GRADIENT)]
GROUPS = {
    "single": _single(),
    "batch": _batch(),
    "call": _calls("call", CALL) + _calls("prepared", PREPARED),
    "first": FIRST,
    "gradient": GRADIENTS,
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
    """The two sides, entries by group, samples of a run and of a new process, and seconds of a run."""

    before: Seat
    after: Seat
    groups: dict[str, list[Entry]]
    repeats: int
    fresh: int
    seconds: float


def sizes(name: str, before: Path, python: Path | None = None, only: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` some of `GROUPS`."""
    if not (before / "vmri_jax").is_dir():
        raise ValueError(f"against: {before} has no folder vmri_jax; give a checkout of this repository.")
    if unknown := [group for group in only if group not in GROUPS]:
        raise ValueError(f"against: there is no group {', '.join(unknown)}; there are {', '.join(GROUPS)}.")
    groups = {group: entries for group, entries in GROUPS.items() if not only or group in only}
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
    rows, claims = [], []
    notes = [", ".join(f"{side}: {about[side]['commit']}" for side in seats)]
    for group, entry, outcome in _outcomes(size, seats, tell):
        rows.append(_row(group, entry, outcome))
        claims += _claims(group, entry, outcome)
        notes += [f"{group}, {entry.label}: {side} was left out: {why}." for side, why in outcome.refused.items()]
        yield Report("against", name, rows, claims, notes, about=about)


def _outcomes(size: Size, seats: dict[str, Seat], tell: Tell) -> Iterator[tuple[str, Entry, Outcome]]:
    """Group, entry and what it gave, one after the other."""
    for group, entries in size.groups.items():
        if group in FRESH:
            for entry in entries:
                tell(f"{group}, {entry.label}")
                yield f"{group}, cold", entry, first_results(seats, entry.case, size.fresh)
        if group == "first":
            continue
        with ExitStack() as stack:
            workers = {name: stack.enter_context(Worker(seat)) for name, seat in seats.items()}
            for entry in entries:
                tell(f"{group}, {entry.label}")
                case = replace(entry.case, seconds=size.seconds)
                unbound = replace(entry, seconds=None) if group == "gradient" else entry
                yield entry.case.kind, unbound, take_turns(workers, case, size.repeats)


def _row(group: str, entry: Entry, outcome: Outcome) -> dict:
    samples, made = outcome.samples, outcome.made.values()
    row: dict = {"group": group, "case": entry.label}
    for side in (BEFORE, AFTER):
        row[f"{side}, ms"] = 1e3 * float(np.median(samples[side])) if side in samples else None
    if {BEFORE, AFTER} <= set(samples):
        found = ratio(samples[AFTER], samples[BEFORE])
        row |= {"after/before": found.value, "quartiles": f"{found.low:.3g} to {found.high:.3g}"}
    row["steps"] = max((m["num_steps"] for m in made), default=None)
    row["differs"] = outcome.difference(AFTER, BEFORE)
    row["result"] = ", ".join(sorted({m["result"] for m in made}))
    return row


def _claims(group: str, entry: Entry, outcome: Outcome) -> list[Claim]:
    samples, claims = outcome.samples, []
    what = f"{group}, {entry.label}: after"
    if entry.ratio is not None and {BEFORE, AFTER} <= set(samples):
        claims.append(Claim(f"{what} over before", ratio(samples[AFTER], samples[BEFORE]), at_most=entry.ratio))
    if entry.seconds is not None and AFTER in samples:
        claims.append(Claim(f"{what}, seconds", quartiles(samples[AFTER]), at_most=entry.seconds))
    return claims
