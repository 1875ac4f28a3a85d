"""Systems that are driven in time: the period T of the drive, and the growth of disturbances over a period.

Disturbances of a motion under a periodic drive are multiplied by the monodromy matrix M in every period (Floquet): they
stay bounded if all multipliers of M lie on the unit circle or inside. A run with macro steps H has a matrix of its own,
the product of N steps with ``N H = m T``.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

import numpy as np

from vmri_jax.mechanics.driving import driven, generic, round_off, sampled_with_rates
from vmri_jax.mechanics.linearisation import Linearisation
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.composition import SchemeLike, stage_scheme
from vmri_jax.schemes.scheme import fully_implicit
from vmri_jax.stability.multipliers import monodromy

SAMPLES = 1024
"""Times at which the drive is compared with itself, a period apart; with fewer of them narrow pulses are missed."""
SPANS = 8.0 ** np.arange(-1, 5)
"""Lengths of the sampled intervals, in macro steps: periods of 1/500 to 2000 steps are seen; more take longer."""
CANDIDATES = 8
"""Lags that are tried as the period in an interval; more of them find drives with many harmonics."""
SAME = 1e-7
"""Difference of the drive from itself a period later, as a part of its amplitude. A larger value takes drives for
periodic that change slowly."""
STEPS_FOLLOWED = 64
"""Most macro steps that are followed where they are no part of the period: N steps are nearly m periods."""
LEAST_GROWTH = 1e-4
"""Growth per period that counts: round-off of thousands of steps is below; a larger value overlooks growth."""
LEAST_STEPS = 4
"""Least micro steps in a period of the drive: fewer pass over it. A larger value warns of right steps."""
CONVERGED_STEPS, MOST_STEPS = 32, 20_000
"""Micro steps in a period from which halved steps confirm the growth, and macro steps at which halving ends."""


@dataclass(frozen=True)
class DrivenMotion:
    """The growth of disturbances of a driven motion over a period of the drive.

    period: T.
    growth: of disturbances per period, 0 if they do not grow; NaN if smaller and smaller steps do not agree about it.
    repeats: whether disturbances grow as much in the next period.
    steps: steps T/n that were tried and are stable as far as the motion is, the largest first.
    """

    period: float
    growth: float
    repeats: bool
    steps: tuple[float, ...]

    def agrees(self, growth: float) -> bool:
        """Whether disturbances of a run with this growth per period grow about as fast as those of the motion."""
        return self.growth / 3 <= growth <= 3 * self.growth

    def __str__(self) -> str:
        grows = in_words(self.growth) if np.isfinite(self.growth) else "are not resolved by any step that was tried"
        once = "" if self.repeats else " In the next one this is different: a run over many periods decides."
        return f"Over a period of the drive, {self.period:.4g}, disturbances of the motion {grows}.{once}"


def in_words(growth: float) -> str:
    """The growth of disturbances per period as the end of a sentence."""
    return f"grow {1 + growth:.4g}-fold" if growth > 0 else "do not grow"


def drive_period(system: System, state: State, scale: float) -> float | None:
    """The smallest period of all terms that depend on time, at a generic configuration near a state.

    Periods of 1/500 to 2000 times `scale`, such as the macro step, are seen. None if nothing depends on time, or no
    period is seen, as for pulses, chirps, and drives with jumps.
    """
    names = driven(system, state)
    if not names or not 0 < scale < np.inf:
        return None
    configuration = generic(state, scale * SPANS[-1])
    entries = partial(sampled_with_rates, system, names)
    start, random = float(state.t), np.random.default_rng(0)
    for span in scale * SPANS:
        step, times = span / SAMPLES, start + np.arange(SAMPLES) * span / SAMPLES
        signal = _signal(entries, configuration, times)
        before, anywhere = signal(times)[0], start + 16 * span * random.random(SAMPLES)
        windows = np.lib.stride_tricks.sliding_window_view(before, SAMPLES // 2)
        apart = np.square(windows - windows[0]).mean(axis=1)
        lowest = (apart[1:-1] <= apart[:-2]) & (apart[1:-1] < apart[2:]) & (apart[1:-1] < 0.1 * apart.max())
        for lag in step * (1 + np.flatnonzero(lowest)[:CANDIDATES]):
            for _ in range(6):  # Gauss and Newton: the lag with the least sum of squares
                after, rate = signal(times + lag)
                lag -= (after - before) @ rate / max(rate @ rate, 1e-300)
            later = anywhere + lag * random.integers(1, 1000, (5, SAMPLES)) / np.array([[6], [4], [3], [2], [1]])
            apart = [np.abs(signal(t)[0] - signal(anywhere)[0]).max() for t in later]
            if lag > step and apart[-1] < SAME:
                return float(next(lag / n for n, most in zip((6, 4, 3, 2, 1), apart, strict=True) if most < SAME))
    return None


def _signal(entries: Callable, configuration: tuple, times: np.ndarray) -> Callable[[np.ndarray], tuple]:
    """One function of times (k,) for all entries, each in units of its amplitude, and its rate of change, (k,) both."""
    amplitude = np.ptp(entries(configuration, times)[0], axis=0)
    # An entry counts if a period later its round-off keeps it the same.
    moves = amplitude > round_off(lambda *at: entries(*at)[0], configuration, times) / SAME
    # weights by which no two entries cancel
    weights = np.where(moves, np.cos(1.0 + np.arange(moves.size)), 0.0) / np.where(moves, amplitude, 1.0)
    return lambda times: tuple(np.nan_to_num(part) @ weights for part in entries(configuration, times))


def periods_of_run(macro_dt: float, period: float) -> int:
    """The number m of periods after which a run is compared with the motion: nearly a whole number of steps."""
    return Fraction(period / macro_dt).limit_denominator(max(1, int(STEPS_FOLLOWED * macro_dt / period))).denominator


def growth_of_run(system: System, scheme, state: State, macro_dt: float, period: float, periods: int) -> tuple:
    """Growth of disturbances of a run per period, over a number of periods, 0 if they do not grow, infinite if a step
    fails; and the last state."""
    # the nearest step of which a whole number takes these periods: the product of steps over another time is no
    # monodromy matrix
    steps = max(1, round(periods * period / macro_dt))
    try:
        product = monodromy(system, scheme, state, macro_dt=periods * period / steps, num_steps=steps)
    except RuntimeError:
        return np.inf, state
    if not np.isfinite(product.matrix).all():
        return np.inf, state
    growth = float(np.abs(product.multipliers).max(initial=0.0) ** (1 / periods) - 1)
    return growth if growth > LEAST_GROWTH else 0.0, product.end


def growth_over_period(moving: Movable, linear: Linearisation) -> DrivenMotion | None:
    """The growth of disturbances over a period of the drive, from `fully_implicit` steps; None without a period."""
    system, state = start_of("growth_over_period", moving, linear.state)
    step = 1 / max(np.abs(linear.rates).max(initial=0.0), 1e-300)
    period = drive_period(system, state, step)
    return None if period is None else driven_motion(system, fully_implicit(1), state, step, period)


def driven_motion(system: System, scheme: SchemeLike, state: State, macro_dt: float, period: float) -> DrivenMotion:
    """The mean growth over a period of the drive, from steps of T/n, which are halved until two of them agree."""
    n, micro, tried = max(1, int(np.ceil(period / macro_dt - 1e-6))), stage_scheme(scheme).num_micro, {}
    followed = period, periods_of_run(macro_dt, period)
    while True:
        dt = period / n
        growth, end = growth_of_run(system, scheme, state, dt, *followed)
        tried[dt] = growth
        if n * micro >= CONVERGED_STEPS and abs(growth - tried.get(2 * dt, np.inf)) <= 0.1 * growth < np.inf:
            break
        n *= 2
        if n > MOST_STEPS:
            return DrivenMotion(period, np.nan, True, ())
    again, _ = growth_of_run(system, scheme, end, dt, *followed)
    motion = DrivenMotion(period, growth, abs(again - growth) <= 0.1 * growth, ())
    steps = [dt for dt, growth in tried.items() if motion.agrees(growth) and period / dt * micro >= LEAST_STEPS]
    return replace(motion, steps=tuple(steps))
