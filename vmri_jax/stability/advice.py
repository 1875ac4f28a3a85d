"""Advice before a long run: is a macro step stable at this state, why is it not, and which step is stable."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vmri_jax.mechanics.checks import check_type
from vmri_jax.mechanics.linearisation import Linearisation, linearise
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.terms import label
from vmri_jax.running.arguments import check_step_size
from vmri_jax.schemes.composition import Composition, SchemeLike, stage_lengths, stage_scheme
from vmri_jax.stability.drive import LEAST_STEPS, drive_period, driven_motion, growth_of_run, in_words, periods_of_run
from vmri_jax.stability.map import Window, measure
from vmri_jax.stability.multipliers import TOLERANCE, multipliers
from vmri_jax.stability.oscillator import fast_limit, kick_limit, phase, slow_limit
from vmri_jax.study.table import Column, ResultTable

SCANNED_STEPS = (0.5, 1.25)
"""Least and largest macro step of the first scan, in units of the step in question; a wider scan takes longer."""
RADIANS_PER_POINT = 0.15
"""Spacing of the scanned macro steps: the angle by which the fastest vibration turns more from one to the next. With a
larger value two multipliers may pass each other twice between points, which hides a window."""
POINTS = (48, 384)
"""Fewest and most points of a scan; more points take longer."""
RESOLUTION = 1e-5
"""Accuracy of the ends of windows, as a part of the scan; narrower windows are left out."""
NEAR_STEP = 0.05
"""Largest distance of a near window of unstable steps, as a part of the step: along a trajectory frequencies change,
and windows move. A larger value warns of more windows."""
NEAR_WIDTHS = 3.0
"""Largest distance of a near window, in its widths: width and displacement of a window both grow with the coupling. A
larger value warns of more windows. A window is near if it is within both distances."""
LONGER_FOR_CAUSE = 0.01
"""Part by which the step is lengthened to find the cause: V and W together become unstable at a slightly shorter step
than each alone. A larger value may blame a limit that is not yet reached."""
RADIANS_IN_PHASE = 0.2
"""Distance of the turn of a vibration in a macro step from a multiple of 2 pi, below which kicks of a constant force
are said to be in phase: then it is 10 times as large as at odd multiples of pi. A larger value warns of more steps."""
LEAST_FORCE = 1e-6
"""Smallest part of the constant slow force in a vibration that is judged; a smaller value warns of round-off."""
MOST_SCANS = 5
"""Most scans, each over smaller steps than the previous one, until one of them contains a safe step."""


@dataclass(frozen=True)
class Finding:
    """One result of `advise`.

    severity: "error" if the step is unstable, "warning" if an unstable step is near or slow and fast are swapped, or
        "note".
    kind: "impulse resonance", "combination resonance", "stability limit", "kicks in phase", "labels", "stages", "drive"
        or "motion".
    sentence: the result in words.
    number: its measure: growth per step of an error, relative distance of a window, ratio of frequencies, amplitude,
        longest stage, micro steps in a period of the drive, growth rate of the motion (NaN if it changes).
    """

    severity: str
    kind: str
    sentence: str
    number: float


@dataclass(frozen=True, repr=False)
class Advice(ResultTable):
    """Result of `advise`.

    macro_dt: the step in question.
    growth: measured growth of disturbances per macro step, 0 if the step is stable.
    findings: results in words, the most severe first.
    windows: unstable intervals of macro_dt in the range `scanned`.
    scanned: least and largest macro step of all scans.
    safe_macro_dt: the stable step nearest to macro_dt without a near window, macro_dt itself if it is such a step; NaN
        if no scan has one. Of a periodic drive a part of the period.
    fast_frequencies, slow_frequencies: (d,) frequencies of the fast and the slow potential, the largest first.
    about: the motions that are judged, in words.
    """

    columns = (
        Column("", lambda finding: finding.severity),
        Column("", lambda finding: finding.kind),
        Column("finding", lambda finding: finding.sentence),
    )
    macro_dt: float
    growth: float
    findings: tuple[Finding, ...]
    windows: tuple[Window, ...]
    scanned: tuple[float, float]
    safe_macro_dt: float
    fast_frequencies: np.ndarray
    slow_frequencies: np.ndarray
    about: str

    @property
    def ok(self) -> bool:
        """Whether there are no errors and no warnings."""
        return all(finding.severity == "note" for finding in self.findings)

    @property
    def verdict(self) -> str:
        """Whether the step is stable, and the nearest safe step, in a sentence."""
        if self.safe_macro_dt == self.macro_dt:
            growth = sum(finding.number for finding in self.findings if finding.kind == "motion")
            grows = "as good as smaller ones" if np.isnan(growth) else "as unstable as the motion itself"
            state = grows if growth else "stable"
            return f"macro_dt = {self.macro_dt:.6g} is {state} {self.about}."
        driven = any(finding.kind == "drive" for finding in self.findings)
        state = "unstable" if self.growth else "too long for the drive" if driven else "close to an instability"
        wanted = "step that follows the motion" if driven and not self.growth else "safe step"
        nearest = f"the nearest {wanted} is {self.safe_macro_dt:.6g}"
        nearest = "no safe step was found, take another scheme" if np.isnan(self.safe_macro_dt) else nearest
        return f"macro_dt = {self.macro_dt:.6g} is {state}{f' {self.about}' if self.growth else ''}; {nearest}."

    rows = property(lambda self: self.findings, doc="The findings.")

    caption = verdict

    def __str__(self) -> str:
        return "\n".join([*(f"{f.severity}: {f.kind}: {f.sentence}" for f in self.findings), self.verdict])


def advise(
    system: Movable,
    scheme: SchemeLike,
    state: State | None = None,
    *,
    macro_dt: float,
) -> Advice:
    """Judge a macro step before a long run, from the multipliers of the step of small motions about the state.

    Under a periodic drive: from the multipliers of the run and of the motion over a period. Elsewhere instability is
    measured, too: the derivative of the step of the frozen problem (see `linearise`) has a multiplier outside the unit
    circle, at macro_dt or in a window of steps near it. Formulas only name the cause:

    * stability limit: the step is unstable for the fast or the slow potential alone; ``omega h`` or ``omega H`` exceeds
      the limit of its quadrature rule (2 for kicks at the ends);
    * impulse resonance: the slow potential is on the macro grid, and the phases of two vibrations (or twice the phase
      of one) add up to a multiple of 2 pi per macro step, counted as the micro steps turn them (midpoint rule: 2
      atan(omega h / 2) per micro step);
    * combination resonance: the same with V on the micro grid, where the slow path, one polynomial per macro step,
      couples the vibrations;
    * kicks in phase: a constant part of the slow force, such as a weight, meets a vibration that turns by a multiple of
      2 pi per macro step; no disturbance grows, but the vibration becomes large;
    * labels: the fastest vibration is one of the slow variables;
    * stages, motion (notes): a composition with backward steps; a motion that is itself unstable, or that the frozen
      problem does not judge.

    It takes one compilation and some hundred eigenvalue problems. All motions are small here. Large motions, such as in
    a hot molecule, change the frequencies along a trajectory and meet resonances that a single state does not show:
    call `advise` at several states of a run, and plot the energy of a long run.

    Args:
        system, scheme, state, macro_dt: as of the run; state None for the start of the problem or scene.

    Raises:
        ValueError: a macro step that is not positive; second derivatives that are not finite at the state.
        TypeError: scheme is not a scheme.
    """
    names = getattr(system, "names", None)  # of a problem or a scene
    system, state = start_of("advise", system, state)
    check_type("advise: scheme", scheme, SchemeLike, "a Scheme, e.g. fully_implicit(num_micro=10)")
    check_step_size(macro_dt, "advise")
    macro_dt, linear = float(macro_dt), linearise(system, state, names)
    period = drive_period(system, state, macro_dt)
    if period is None:
        judged = _judged_at_rest(linear, scheme, macro_dt)
    else:
        judged = _judged_over_a_period(system, scheme, state, macro_dt, period)
    findings = [*judged.pop("findings"), *_stages(scheme)]
    judged["findings"] = tuple(sorted(findings, key=lambda f: ("error", "warning", "note").index(f.severity)))
    fast, slow = linear.frequencies_of("fast"), linear.frequencies_of("slow")
    return Advice(macro_dt=macro_dt, fast_frequencies=fast, slow_frequencies=slow, **judged)


def _judged_over_a_period(system, scheme, state: State, macro_dt: float, period: float) -> dict[str, Any]:
    """Fields of the `Advice` about a system with a periodic drive: the run and the motion over a period of it."""
    motion = driven_motion(system, scheme, state, macro_dt, period)
    growth, _ = growth_of_run(system, scheme, state, macro_dt, period, periods_of_run(macro_dt, period))
    per_step = float(np.expm1(np.log1p(growth) * macro_dt / period))
    fits, steps = motion.agrees(growth), stage_scheme(scheme).num_micro * period / macro_dt
    rate = np.log1p(motion.growth) / period if motion.repeats or not motion.growth else np.nan
    findings = [Finding("note", "motion", str(motion), rate)]
    if not fits:
        sentence = f"In a run with this step disturbances {in_words(growth)} in a period of the drive."
        findings.append(Finding("error" if growth > motion.growth else "warning", "drive", sentence, per_step))
    if steps < LEAST_STEPS:
        sentence = f"A period of the drive, {period:.4g}, has {steps:.2g} micro steps; take at least {LEAST_STEPS}."
        findings.append(Finding("warning", "drive", sentence, steps))
    return {
        "growth": 0.0 if fits else per_step,
        "findings": findings,
        "windows": (),
        "scanned": (min((macro_dt, *motion.steps)), macro_dt),
        "safe_macro_dt": macro_dt if fits and steps >= LEAST_STEPS else next(iter(motion.steps), np.nan),
        "about": f"over a period of the drive, {period:.4g}",
    }


def _judged_at_rest(linear: Linearisation, scheme, macro_dt: float) -> dict[str, Any]:
    """Fields of the `Advice` from the multipliers of a step of small motions, at macro_dt and at steps near it."""
    lower, upper = SCANNED_STEPS[0] * macro_dt, SCANNED_STEPS[1] * macro_dt
    radius, windows = _scan(linear, scheme, lower, upper, macro_dt)
    growth = radius - 1 if radius > 1 + TOLERANCE else 0.0
    step_findings = list(_step_findings(linear, scheme, macro_dt, growth, windows))
    safe = macro_dt
    for _ in range(MOST_SCANS if step_findings else 0):
        safe = _nearest_safe(macro_dt, windows, lower, upper)
        if not np.isnan(safe):
            break
        upper, lower = lower, lower / 3
        windows = _scan(linear, scheme, lower, upper, upper)[1] + windows
    findings = [*step_findings, *_kicks_in_phase(linear, scheme, macro_dt)]
    if (swap := linear.swapped()) is not None:
        findings.append(Finding("warning", "labels", *swap))
    rate = float(np.real(linear.growing).max(initial=0.0))
    if linear.frozen and (rate or step_findings or linear.driven):
        findings.append(Finding("note", "motion", linear.frozen, 0.0))
    elif rate:
        growth_of_motion = f"Motion about this state grows by itself, like exp({rate:.3g} t)"
        sentence = f"{growth_of_motion}; that is left out of the growth that is measured."
        findings.append(Finding("note", "motion", sentence, rate))
    return {
        "growth": growth,
        "findings": findings,
        "windows": tuple(windows),
        "scanned": (lower, SCANNED_STEPS[1] * macro_dt),
        "safe_macro_dt": safe,
        "about": "for small motions about this state" + (", held at rest" if linear.frozen else ""),
    }


def _step_findings(linear: Linearisation, scheme, macro_dt: float, growth: float, windows) -> Iterator[Finding]:
    """An error if the step is unstable, else a warning for every near window."""
    if growth:
        kind, cause = _cause(linear, scheme, macro_dt)
        tenfold = max(1, round(np.log(10) / np.log1p(growth)))
        grows = f"Disturbances grow by {growth:.2g} per macro step, tenfold in {tenfold}."
        yield Finding("error", kind, f"{cause} {grows}", growth)
        return
    for a, b, _ in windows:
        distance = max(a - macro_dt, macro_dt - b) / macro_dt
        if distance * macro_dt <= _margin(a, b, macro_dt):
            kind, cause = _cause(linear, scheme, (a + b) / 2)
            where = f"Steps from {a:.6g} to {b:.6g} are unstable, {100 * distance:.1f} % from this one."
            yield Finding("warning", kind, f"{where} There: {cause}", distance)


def _scan(linear: Linearisation, scheme, lower: float, upper: float, point: float) -> tuple[float, list[Window]]:
    """Spectral radius at the macro step `point`, and unstable windows between lower and upper, on a grid with this
    point."""
    turn = linear.frequencies.max(initial=0.0) * (upper - lower)
    grid = np.linspace(lower, upper, int(np.clip(turn / RADIANS_PER_POINT, *POINTS)))
    grid = np.union1d(grid, [point])
    radius, windows = measure(linear, scheme, grid, RESOLUTION)
    return float(radius[np.searchsorted(grid, point)]), windows


def _margin(a: float, b: float, macro_dt: float) -> float:
    """Distance from the window (a, b) up to which a step is near it."""
    return min(NEAR_STEP * macro_dt, NEAR_WIDTHS * (b - a))


def _nearest_safe(macro_dt: float, windows, lower: float, upper: float) -> float:
    """The step nearest to macro_dt that is not near a window; NaN if there is none in the range."""
    # 1.01: the safe step itself must not lie within the margin when it is judged again.
    unsafe = [(a - 1.01 * _margin(a, b, macro_dt), b + 1.01 * _margin(a, b, macro_dt)) for a, b, _ in windows]
    ends = [end for window in unsafe for end in window if lower <= end <= upper]
    free = [end for end in ends if not any(a < end < b for a, b in unsafe)]
    return min(free, key=lambda end: abs(end - macro_dt), default=np.nan)


def _cause(linear: Linearisation, scheme: SchemeLike, macro_dt: float) -> tuple[str, str]:
    """Kind and description of an instability at this step."""
    limit = _stability_limit(linear, scheme, macro_dt)
    return ("stability limit", limit) if limit else _resonance(linear, scheme, macro_dt)


def _stability_limit(linear: Linearisation, scheme: SchemeLike, macro_dt: float) -> str:
    """A sentence about a potential for which alone the step is unstable; empty if there is none."""
    stage = stage_scheme(scheme)
    longest = macro_dt * np.abs(stage_lengths(scheme)).max()
    of_stage = " of the longest stage" if isinstance(scheme, Composition) else ""
    micro_dt = longest / stage.num_micro
    cases = [
        ("fast", "fast potential", "the micro step", micro_dt, fast_limit(stage)),
        ("slow", "slow potential", "the macro step", longest, slow_limit(stage)),
    ]
    if linear.hessians["force"].any():
        cases.append(("force", "force", "the micro step", micro_dt, np.inf))
    for name in linear.system.potentials:
        placed, words = stage.rule_of(name), f"further {name}" if name in ("fast", "slow") else label(name)
        span = stage.num_micro if placed.grid == "macro" else placed.every
        step_name = f"the step of {span} micro intervals"
        cases.append((f"potential {name}", f"{words} potential", step_name, span * micro_dt, kick_limit(placed)))
    for key, words, step_name, step, limit in cases:
        frequency = linear.frequencies_of(key)[0]
        alone = multipliers(linear.only(key), scheme, [macro_dt * (1 + LONGER_FOR_CAUSE)])
        if alone.radius[0] > 1 + TOLERANCE and frequency > 0:
            bound = f"; its quadrature rule is stable below {limit:.4g}" if np.isfinite(limit) else ""
            return (
                f"The step is unstable for the {words} alone: its frequency {frequency:.4g} times "
                f"{step_name}{of_stage} is {frequency * step:.4g}{bound}."
            )
    return ""


def _resonance(linear: Linearisation, scheme: SchemeLike, macro_dt: float) -> tuple[str, str]:
    """Kind of resonance, and the vibrations with the most energy in the eigenvector of the largest multiplier."""
    spectrum = multipliers(linear, scheme, [macro_dt])
    worst = np.argmax(np.where(spectrum.growing[0], 0.0, np.abs(spectrum.values[0])))
    eta, pi = np.split(spectrum.vectors[0][:, worst], 2)
    frequencies, modes = linear.frequencies, linear.modes
    energy = np.abs(modes.T @ eta) ** 2 * frequencies**2 + np.abs(modes.T @ pi) ** 2
    pair = np.argsort(-energy)[:2]

    if not frequencies[pair[0]] > 0:
        return "stability limit", "The step is unstable for all terms together, and for none of them alone."
    kind = "impulse resonance" if stage_scheme(scheme).slow.grid == "macro" else "combination resonance"
    a, b = pair[0], pair[-1]
    turns = [_turn(linear, scheme, macro_dt, i) / np.pi for i in (a, b)]
    if abs(spectrum.values[0, worst].imag) < 1e-6:  # a multiplier at 1 or -1: a vibration that resonates with itself
        return kind, (
            f"The vibration of frequency {frequencies[a]:.4g} turns by {turns[0]:.4g} pi in a macro step, close to a "
            "multiple of pi, and the slow potential feeds it."
        )
    return kind, (
        f"The vibrations of frequencies {frequencies[a]:.4g} and {frequencies[b]:.4g} turn by {turns[0]:.4g} pi and "
        f"{turns[1]:.4g} pi in a macro step, together close to a multiple of 2 pi, and the slow potential couples them."
    )


def _kicks_in_phase(linear: Linearisation, scheme: SchemeLike, macro_dt: float) -> Iterator[Finding]:
    """A warning for each vibration that kicks of the constant slow force f meet in phase.

    Between kicks H f the vibration turns by phi. The periodic motion has ``p = H f / 2`` after a kick and the amplitude

        A = H f / (2 omega |sin(phi / 2)|),    where a constant force holds it at f / omega^2.
    """
    if isinstance(scheme, Composition) or not scheme.slow.only_kicks or scheme.slow.mollified:
        return
    frequencies, modes = linear.frequencies, linear.modes
    forces = modes.T @ linear.slow_force
    for i in np.flatnonzero(np.abs(forces) > LEAST_FORCE * np.linalg.norm(forces)):
        if not frequencies[i] or not _is_fast(linear, i):
            continue
        turn = _turn(linear, scheme, macro_dt, i)
        times = round(turn / (2 * np.pi))
        if times < 1 or abs(turn - 2 * np.pi * times) > RADIANS_IN_PHASE:
            continue
        largest = np.abs(linear.shapes @ modes[:, i]).max()
        held = largest * abs(forces[i]) / frequencies[i] ** 2
        with np.errstate(divide="ignore"):
            amplitude = held * frequencies[i] * macro_dt / 2 / abs(np.sin(turn / 2))
        yield Finding(
            "warning",
            "kicks in phase",
            f"The vibration of frequency {frequencies[i]:.4g} turns by {turn / np.pi:.4g} pi in a macro step, close to "
            "a multiple of 2 pi, and the slow force has a constant part along it: its kicks add up to an amplitude of "
            f"{amplitude:.2g}, where the force itself moves it by {held:.2g}. Take another step.",
            float(amplitude),
        )


def _is_fast(linear: Linearisation, i) -> bool:
    """Whether W has more than half of the stiffness of vibration i."""
    frequencies, modes = linear.frequencies, linear.modes
    return bool(modes[:, i] @ linear.hessians["fast"] @ modes[:, i] >= frequencies[i] ** 2 / 2)


def _turn(linear: Linearisation, scheme: SchemeLike, macro_dt: float, i) -> float:
    """Angle that vibration i turns in a macro step: the phase of the micro steps if W carries it, else ``omega H``."""
    exact = float(linear.frequencies[i] * macro_dt)
    if not _is_fast(linear, i):
        return exact
    stage = stage_scheme(scheme)
    phases = [phase(stage, exact * part / stage.num_micro) for part in np.asarray(stage_lengths(scheme))]
    turn = stage.num_micro * sum(phases)
    return turn if np.isfinite(turn) else exact


def _stages(scheme: SchemeLike) -> Iterator[Finding]:
    """A note on backward steps of a composition."""
    parts = np.asarray(stage_lengths(scheme))
    if not (parts > 0).all():
        longest = float(np.abs(parts).max())
        sentence = (
            f"The {len(parts)} stages of the composition make steps of {parts.min():.3g} to {parts.max():.3g} macro "
            "steps, some backwards: the largest stable macro step of the composition is about that of its scheme "
            f"divided by {longest:.3g}."
        )
        yield Finding("note", "stages", sentence, longest)
