"""The choice of the curves that show slow and fast motion: coordinates of bodies and lengths of springs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vmri_jax.animation.motion import Motion
from vmri_jax.mechanics.names import AXES

MOST_RADIANS_PER_NODE = 1.5
"""Largest phase change from node to node, in radians, of a signal that is drawn. Above pi the drawn curve would have a
false, lower frequency; half of that leaves a margin, since frequencies are estimates."""
LEAST_RELATIVE_SIZE = 0.02
"""Smallest size of a signal, over the largest size of the signals of its kind; a smaller part would also draw motion
that nobody sees in the pictures."""
PERIODS = 8
"""Number of periods in the window of a fast signal; with more they run together."""


@dataclass(frozen=True)
class Signal:
    """A function `of` positions of bodies, from points (k, n_bodies, 3) to values (k,), with the title of its panel.

    size, speed: standard deviations along the motion of the values and of their rate.
    """

    label: str
    pace: str
    of: Callable[[np.ndarray], np.ndarray]
    size: float
    speed: float

    @property
    def frequency(self) -> float:
        """Mean angular frequency: of a sine, rate over size."""
        return self.speed / self.size


def slow_signal(motion: Motion) -> Signal | None:
    """The coordinate of a slow body with the largest size over frequency; of a fast body if no slow body moves."""
    signals = _seen(_coordinates(motion))
    signals = [signal for signal in signals if signal.pace == "slow"] or signals
    return max(signals, key=lambda signal: signal.size / signal.frequency, default=None)


def fast_signal(motion: Motion) -> Signal | None:
    """The length of a fast spring that moves most: of those whose frequency the nodes resolve, the largest speed times
    frequency.

    Without such a spring, a coordinate of a fast body, chosen likewise.
    """
    for signals in (_lengths(motion), _coordinates(motion)):
        step = float(np.median(np.diff(motion.t)))
        fast = [s for s in signals if s.pace == "fast" and s.frequency * step < MOST_RADIANS_PER_NODE]
        if fast:
            return max(_seen(fast), key=lambda signal: signal.speed * signal.frequency)
    return None


def window(motion: Motion, signal: Signal) -> tuple[float, float]:
    """First and last time of some periods of a signal, where it moves fastest."""
    first, last = float(motion.t[0]), float(motion.t[-1])
    rates = np.gradient(signal.of(motion.points), motion.t)
    frequency = np.std(np.gradient(rates, motion.t)) / np.std(rates)  # of the fastest part: a drift has no curvature
    length = min(last - first, PERIODS * 2 * np.pi / max(float(frequency), signal.frequency))
    start = float(np.clip(motion.t[int(np.argmax(np.abs(rates)))] - length / 2, first, last - length))
    return start, start + length


def _seen(signals: list[Signal]) -> list[Signal]:
    largest = max((signal.size for signal in signals), default=0.0)
    return [signal for signal in signals if signal.size >= LEAST_RELATIVE_SIZE * largest]


def _coordinates(motion: Motion) -> list[Signal]:
    """Signals of the moving coordinates of all bodies, in coordinates of the drawing."""
    drawing, signals = motion.drawing, []
    frame = drawing.frame()
    for i, body in enumerate(drawing.bodies):
        moved = [axis for axis, form in enumerate(body.forms) if form]
        for axis in moved:
            label = body.name if len(moved) == 1 else f"{body.name} {AXES[axis]}"
            signals += _signal(motion, label, body.pace, lambda points, i=i, axis=axis: points[:, i] @ frame[:, axis])
    return signals


def _lengths(motion: Motion) -> list[Signal]:
    """Signals of the lengths of all springs."""
    drawing, signals = motion.drawing, []
    for joint, connection in zip(drawing.joints, drawing.connections, strict=True):
        if joint.kind == "spring":
            label = f"length of spring {' to '.join(joint.bodies)}"
            signals += _signal(motion, label, connection.pace, connection.length)
    return signals


def _signal(motion: Motion, label: str, pace: str, of: Callable[[np.ndarray], np.ndarray]) -> list[Signal]:
    """A list of the signal, empty if it does not move."""
    values = of(motion.points)
    if len(values) < 3 or np.ptp(values) <= 1e-9 * np.abs(values).max():
        return []
    # differences from node to node: central differences would be zero for a signal that turns by pi between nodes
    rates = np.diff(values) / np.diff(motion.t)
    return [Signal(label, pace, of, float(np.std(values)), float(np.std(rates)))]
