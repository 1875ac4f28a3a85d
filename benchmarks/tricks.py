"""What each tuned function of the kernels, and each thing that steppers remember or know, buys against its plain
form."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace

from benchmarks.measure import Ratio, Tell, ratio, silent
from benchmarks.report import Report
from benchmarks.seats import Seat, Worker, take_turns
from benchmarks.worker import Case

TUNED, ALL_PLAIN = "cpu", "all plain"
KEEP = 1.3
"""A trick that buys less on every run is to be deleted."""
SCHEMES = {
    "FPU l=3": (0.01, ("fully_explicit 10", "fully_implicit 10")),
    "FPU l=50": (0.01, ("fully_explicit 10", "fully_implicit 10")),
    "TSP": (0.002, ("fully_explicit 10", "fully_implicit 10", "galerkin 1 8 lobatto")),
    "SAM": (0.002, ("fully_explicit 10", "fully_implicit 10", "galerkin 1 8 lobatto")),
}
"""Macro steps and schemes of order 2; high degrees take steps of LONG."""
LONG = 0.032
CASES = [
    Case(kind, system, scheme, LONG if scheme.startswith("galerkin") else macro_dt, lanes=256 if kind == "batch" else 1)
    for kind in ("single", "batch")
    for system, (macro_dt, schemes) in SCHEMES.items()
    for scheme in schemes
    if kind == "single" or scheme != "fully_implicit 10"
]
CASES += [
    Case("single", "FPU l=3", "fully_implicit 10", 0.2),  # slow forces change much within a step
    *(Case("single", system, "fully_explicit 1", 0.0002) for system in ("TSP", "SAM")),  # drifts along constraints
    *(
        Case("single", *of, method="exact")
        for of in (("TSP", "fully_implicit 5", 0.002), ("SAM", "fully_implicit 5", 0.01))
    ),
    Case("single", "satellite", "fully_implicit 5", 0.02),  # its kinetic energy is a function
]
BATCH = ", batch"
SYSTEMS = (*SCHEMES, "satellite", *(f"{system}{BATCH}" for system in SCHEMES))


@dataclass(frozen=True)
class Size:
    """Names of functions, cases, samples, and seconds of a run."""

    tricks: tuple[str, ...]
    cases: tuple[Case, ...]
    repeats: int
    seconds: float


def names() -> tuple[str, ...]:
    """Public names that both forms of the kernels define, as functions or constants."""
    from vmri_jax.kernels import cpu, plain  # pyright: ignore[reportAttributeAccessIssue]

    def own(module) -> set[str]:
        return {key for key, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__}

    constants = {key for key in vars(cpu) if key.isupper() and key in vars(plain)}
    return tuple(sorted(name for name in (own(cpu) & own(plain)) | constants if not name.startswith("_")))


def sizes(name: str, only: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` these functions."""
    known = names()
    if unknown := [trick for trick in only if trick not in known]:
        raise ValueError(f"tricks: the kernels do not share {', '.join(unknown)}; they share {', '.join(known)}.")
    repeats, seconds = (5, 0.03) if name == "quick" else (15, 0.1)
    return Size(tuple(only) or known, tuple(CASES), repeats, seconds)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """Time all of it without each trick, over the tuned kernels; a report after each case."""
    tuned = Seat(environment={"VMRI_KERNELS": "cpu"})
    seats = {TUNED: tuned, ALL_PLAIN: Seat(environment={"VMRI_KERNELS": "plain"})}
    seats |= {trick: replace(tuned, options=("--plain", trick)) for trick in size.tricks}
    found: dict[str, dict[Case, Ratio]] = {seat: {} for seat in seats if seat != TUNED}
    report = Report("tricks", name)
    report.note(
        f"commit {tuned.commit}; time without the trick over time with it, the median of samples taken in turns"
    )
    with ExitStack() as stack:
        workers = {seat: stack.enter_context(Worker(of)) for seat, of in seats.items()}
        for case in size.cases:
            tell(case.label)
            outcome = take_turns(workers, replace(case, seconds=size.seconds), size.repeats)
            for seat, why in outcome.refused.items():
                report.note(f"{case.label}: {seat} was left out: {why}.")
            for seat, samples in outcome.samples.items():
                if seat != TUNED:
                    found[seat][case] = ratio(samples, outcome.samples[TUNED])
            report.rows[:] = [_row(seat, ratios) for seat, ratios in found.items()]
            yield report


def _row(trick: str, ratios: dict[Case, Ratio]) -> dict:
    """The most that a trick buys on each system; by its lower quartile it stays or goes."""
    row: dict = {"trick": trick}
    for column in SYSTEMS:
        of_column = [found.value for case, found in ratios.items() if _column(case) == column]
        row[column] = max(of_column, default=None)
    row["most"] = max((found.value for found in ratios.values()), default=None)
    surely = max((found.low for found in ratios.values()), default=0.0)
    row["keep"] = "" if trick == ALL_PLAIN else "yes" if surely >= KEEP else "no"
    row["ratios"] = [{"column": _column(c), "scheme": c.scheme} | asdict(found) for c, found in ratios.items()]
    return row


def _column(case: Case) -> str:
    return case.system + (BATCH if case.lanes > 1 else "")
