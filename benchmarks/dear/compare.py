"""Time to an error: single and micro steps of kicks, compositions, three rates, one interval of high degree, and other
programs."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.dear.figures import bound, draw_errors, ratio_at, time_to
from benchmarks.dear.peers import FIXED_STEPS, PEERS, chosen
from benchmarks.dear.spacecraft import spacecraft
from benchmarks.dear.systems import MIDDLE, molecules, teacher
from benchmarks.measure import Tell, exactly, interleaved, silent
from benchmarks.peers.cases import Ladder, doubled_steps
from benchmarks.peers.scan import Climb, Point
from benchmarks.report import Claim, Report
from vmri_jax import plots
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.row import joined

TARGET = 1e-5
"""Error of the positions at the end at which times are compared."""
COUNTS = 30
"""Numbers of macro steps, each twice the one before, that are tried at most."""
SLOWEST, SLOWEST_PEER = 60.0, 10.0
"""Seconds of a run of ours and of another program after which a ladder ends."""
LONG = 5.0
"""Seconds of a run above which it is not timed again, in turn with the others; a larger value makes the benchmark take
longer."""
LINE = "kicks, N = 1"
"""The scheme whose time the gain of every other one is measured by."""


@dataclass(frozen=True)
class Case:
    """A system whose slow force has a price, and the schemes that are tried on it.

    title: of its curves.
    problem: the system with its start; ``problem(three_rates=True)`` has the potential `MIDDLE`.
    num_micro: numbers of micro steps of kicks, the smallest first.
    composed: compositions of kicks, with one micro step and with the largest number of them but one.
    every: micro steps from one kick of `MIDDLE` to the next, with the largest number of micro steps; 0 for no three
        rates.
    degree: of one interval without micro steps; 0 for none, as where Newton's matrix is large.
    t_end: simulated time.
    errors: largest and smallest error of a ladder of steps.
    first: macro steps of the first run, of compositions a sixteenth of it.
    fine: macro steps of order 8, of 170 micro steps each, that errors are measured against.
    repeats: samples of each time.
    peers: whether other programs run it, too.
    """

    title: str
    problem: Callable[..., vm.Problem]
    num_micro: tuple[int, ...] = (1, 5, 20)
    composed: tuple[str, ...] = ("suzuki4",)
    every: int = 0
    degree: int = 0
    t_end: float = 1.0
    errors: tuple[float, float] = (1e-2, 1e-7)
    first: int = 8
    fine: int = 400
    repeats: int = 3
    peers: bool = True


def sizes(name: str, only: Sequence[str] = ()) -> list[Case]:
    """ "quick": 8 molecules, and the spacecraft in a field of degree 20; "full": 8 to 256 molecules, the teacher, and
    the spacecraft.

    Args:
        name: "quick" or "full".
        only: beginnings of titles; none for all.
    """
    return [case for case in _cases(name) if not only or case.title.startswith(tuple(only))]


def _cases(name: str) -> list[Case]:
    near = (1e-4, 5e-6)
    if name == "quick":
        flight = partial(spacecraft, degree=20)
        return [
            Case("8 molecules", partial(molecules, 8), (1, 10), every=5),
            Case("spacecraft", flight, (1, 40), (), every=10, t_end=10.0, errors=near),
        ]
    both = ("suzuki4", "kahan-li6")
    large: Any = {"num_micro": (1, 20, 40), "composed": (), "t_end": 0.25, "first": 16, "fine": 100, "peers": False}
    return [
        Case("64 molecules", partial(molecules, 64), (1, 20, 40), both, 10, errors=(1e-2, 3e-6), repeats=2),
        Case("network", teacher, (1, 5, 10, 20), both, 5, 6, errors=(1e-2, 1e-6)),
        Case("spacecraft", spacecraft, (1, 40, 100), both, 10, 6, 10.0, errors=(1e-2, 2e-6), first=64, repeats=2),
        Case("8 molecules", partial(molecules, 8), (1, 20, 40), (), errors=near, peers=False),
        Case("16 molecules", partial(molecules, 16), (1, 5, 20, 40), both, 10, 6, errors=(1e-2, 1e-6)),
        *(Case(f"{n} molecules", partial(molecules, n), errors=near, **large) for n in (32, 128, 256)),
    ]


Curve = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Numbers of macro steps or tolerances, errors and milliseconds."""


@dataclass(frozen=True)
class Gain:
    """How much faster kicks with micro steps reach the target than single steps.

    price: time of a gradient of V over that of W.
    num_micro: micro steps of the fastest kicks.
    gain, bound: of times to the target, and what prices allow.
    """

    title: str
    price: float
    num_micro: int
    gain: float
    bound: float


def run(cases: list[Case], name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each system."""
    curves, gains = {}, []
    report = Report("dear", name, about={"gains": []})
    for suffix, theme in (("", plots.LIGHT), ("_dark", plots.DARK)):
        report.figures[f"dear{suffix}"] = partial(draw_errors, curves, gains, TARGET, theme)
    for case in cases:
        problem = case.problem()
        slow, fast = _prices(problem)
        price = slow / fast
        peers, missing = chosen(problem) if case.peers else ([], [])
        of_case = measured(case, problem, peers, tell)
        for scheme, (steps, *_) in of_case.items():
            report.rows.extend(_row(case, of_case, scheme, i, price) for i in range(len(steps)))
        to_target = {scheme: time_to(TARGET, *curve) for scheme, curve in of_case.items()}
        report.claims.extend(_claims(case, to_target, peers))
        gains += _gain(case, to_target, price)
        report.about["gains"] = [vars(gain) for gain in gains]
        if case.composed:
            curves[case.title] = of_case
        taken = f"{1e6 * slow:.3g} µs, {price:.3g} times as long as one of W"
        for note in (f"{case.title}: a gradient of V takes {taken}.", *missing):
            report.note(note)
        yield report


def _row(case: Case, curves: dict[str, Curve], scheme: str, i: int, price: float) -> dict:
    """A run, with its gain over single steps of kicks."""
    steps, errors, ms = (part[i] for part in curves[scheme])
    has_steps = scheme.split(",")[0] not in PEERS or scheme.split(",")[0] in FIXED_STEPS
    gain = ratio_at(curves[LINE][1:], errors, ms) if LINE in curves else None
    row = {"system": case.title, "scheme": scheme, "H": case.t_end / steps if has_steps else None, "error": errors}
    kicks = scheme.startswith("kicks, N = ")
    return row | {"ms": ms, "gain": gain, "bound": bound(int(scheme.split()[-1]), price) if kicks else None}


def _claims(case: Case, to_target: dict[str, float], peers: list[str]) -> list[Claim]:
    """Single steps over micro steps of each family, and every other program over the best of ours."""
    claims = []
    for family in ("kicks", *case.composed):
        ours = {scheme: ms for scheme, ms in to_target.items() if scheme.startswith(f"{family}, N = ")}
        fastest = min(ours, key=ours.__getitem__)
        claims.append(_claim(f"{case.title}: {family}, N = 1 over {fastest}", ours[f"{family}, N = 1"], ours[fastest]))
    others = {scheme: ms for scheme, ms in to_target.items() if scheme.split(",")[0] in peers}
    best = min(to_target.keys() - others.keys(), key=to_target.__getitem__)
    extra = [scheme for scheme in to_target if scheme.startswith(("three rates", "one interval"))]
    kicks = min((s for s in to_target if s.startswith("kicks")), key=to_target.__getitem__)
    claims += [_claim(f"{case.title}: {kicks} over {scheme}", to_target[kicks], to_target[scheme]) for scheme in extra]
    return claims + [
        _claim(f"{case.title}: {scheme} over {best}", ms, to_target[best]) for scheme, ms in others.items()
    ]


def _claim(name: str, ms: float, best: float) -> Claim:
    """Times to the target, one over the other."""
    return Claim(f"{name} at {TARGET:g}", exactly(ms / best if np.isfinite(best) else np.nan))


def _gain(case: Case, to_target: dict[str, float], price: float) -> list[Gain]:
    """Of kicks, where single steps and micro steps reach the target."""
    ms = {n: to_target[f"kicks, N = {n}"] for n in case.num_micro}
    best = min(ms, key=ms.__getitem__)
    if not np.isfinite(ms[1] + ms[best]):
        return []
    return [Gain(case.title, price, best, ms[1] / ms[best], bound(best, price))]


def measured(case: Case, problem: vm.Problem, peers: Iterable[str], tell: Tell) -> dict[str, Curve]:
    """Numbers of macro steps, errors of the positions at the end and milliseconds, by scheme."""
    tell(f"{case.title}, fine steps")
    length = {"macro_dt": case.t_end / case.fine, "num_steps": case.fine, "save": case.fine}
    exact, _ = joined(vm.simulate(problem, vm.compose(vm.fully_explicit(10), "kahan-li8"), **length))
    points: dict[str, dict[float, Point]] = {}
    clocks: dict[str, Callable[[], object]] = {}

    def climb(scheme: str, ladder: Ladder, slowest: float, timed: Callable = lambda point, _: point.run) -> None:
        """Runs of more and more steps, within the errors that are looked at; `timed` of them for the clock."""
        rungs = Climb(scheme, ladder, lambda end: float(np.abs(end - exact[-1]).max()))
        for setting in ladder.settings:
            tell(f"{case.title}, {scheme}, {setting:g}")
            point = rungs.add(setting)
            if point.error < case.errors[1] or point.seconds > slowest:
                break
        points[scheme] = {setting: point for setting, point in rungs.rungs.items() if point.error <= case.errors[0]}
        short = {setting: point for setting, point in points[scheme].items() if point.seconds <= LONG}
        clocks.update({f"{scheme}: {setting}": timed(point, setting) for setting, point in short.items()})

    for scheme, (of_scheme, integrator) in schemes(case, problem).items():
        run = vm.prepare(of_scheme, integrator, macro_dt=case.t_end, num_steps=1)
        first = max(1, case.first // 16) if isinstance(integrator, vm.Composition) else case.first
        ladder = doubled_steps(scheme, first, COUNTS, partial(_end, run))
        climb(scheme, ladder, SLOWEST, lambda _, n, run=run: run.timed(**_steps(run, n)))
    fastest = max(case.num_micro)
    for peer in peers:
        name = f"{peer}, N = {fastest}" if peer in FIXED_STEPS else peer
        climb(name, PEERS[peer](problem, case.t_end, fastest), SLOWEST_PEER)
    tell(f"{case.title}, measuring times")
    seconds = interleaved(clocks, case.repeats)
    return {
        scheme: (
            np.array(list(ladder)),
            np.array([point.error for point in ladder.values()]),
            np.array([1e3 * np.median(seconds.get(f"{scheme}: {n}", point.seconds)) for n, point in ladder.items()]),
        )
        for scheme, ladder in points.items()
    }


def _steps(run: Simulation, num_steps: int) -> dict[str, Any]:
    """Arguments of a run of `num_steps` steps, as long as the prepared run of one step."""
    return {"macro_dt": run.macro_dt / num_steps, "num_steps": num_steps}


def _end(run: Simulation, num_steps: int) -> Callable[[], np.ndarray]:
    """The positions at the end of a run of `num_steps` steps."""
    return lambda: joined(run(**_steps(run, num_steps), throw=False))[0][-1]


def schemes(case: Case, problem: vm.Problem) -> dict[str, tuple[vm.Problem, Any]]:
    """Problem and scheme by name."""
    kicks = {f"kicks, N = {n}": vm.fully_explicit(n) for n in case.num_micro}
    few = sorted(case.num_micro)[-2 if len(case.num_micro) > 2 else -1]
    for name in case.composed:
        kicks |= {f"{name}, N = {n}": vm.compose(vm.fully_explicit(n), name) for n in sorted({1, few})}
    found: dict[str, tuple[vm.Problem, Any]] = {name: (problem, scheme) for name, scheme in kicks.items()}
    if case.degree:
        found[f"one interval, degree {case.degree}"] = problem, vm.galerkin(1, case.degree, "lobatto")
    if case.every:
        n = max(case.num_micro)
        placed = {MIDDLE: vm.micro(vm.quadrature.trapezoidal, every=case.every)}
        scheme = vm.fully_explicit(n).with_potentials(**placed)
        found[f"three rates, N = {n} and {n // case.every}"] = case.problem(three_rates=True), scheme
    return found


def _prices(problem: vm.Problem) -> tuple[float, float]:
    """Seconds of a gradient of V and of W."""
    q = jnp.asarray(problem.q_f)
    slow, fast = (
        jax.grad(lambda q, name=name: problem.system.all_potentials(jnp.zeros(0), q)[name]) for name in ("slow", "fast")
    )
    return seconds_each(slow, q, 100), seconds_each(fast, q, 1000)
