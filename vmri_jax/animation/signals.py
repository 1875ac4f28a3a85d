"""Which numbers of a motion show what moves slowly and what fast: coordinates of bodies and lengths of springs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vmri_jax.animation.motion import Motion
from vmri_jax.mechanics.names import AXES

RESOLVED = 1.5
"""Radians from node to node: what turns faster is not resolved by the nodes, and would be drawn as something else."""
SEEN = 0.02
"""Part of the largest motion of its kind below which a signal is left out."""
PERIODS = 8
"""In the window of a fast signal."""


@dataclass(frozen=True)
class Signal:
    """A number that follows from where the bodies are.

    Attributes:
        label: what it is.
        pace: "slow" or "fast".
        of: from (k, n_bodies, 3) points to (k,) values.
        size: standard deviation along the motion.
        speed: standard deviation of its rate.
    """

    label: str
    pace: str
    of: Callable[[np.ndarray], np.ndarray]
    size: float
    speed: float

    @property
    def frequency(self) -> float:
        """Mean angular frequency."""
        return self.speed / self.size


def slow_signal(motion: Motion) -> Signal | None:
    """The coordinate of a slow body that moves slowest and most; of a fast one if no slow body moves.

    Args:
        motion: from `vmri_jax.animation.motion`.
    """
    found = _seen(_coordinates(motion))
    found = [signal for signal in found if signal.pace == "slow"] or found
    return max(found, key=lambda signal: signal.size / signal.frequency, default=None)


def fast_signal(motion: Motion) -> Signal | None:
    """The length of a fast spring, else the coordinate of a fast body, that moves fastest and most, if nodes resolve it.

    Args:
        motion: from `vmri_jax.animation.motion`.
    """
    for kind in (_lengths(motion), _coordinates(motion)):
        fast = [s for s in kind if s.pace == "fast" and s.frequency * _step(motion) < RESOLVED]
        if fast:
            return max(_seen(fast), key=lambda signal: signal.speed * signal.frequency)
    return None


def window(motion: Motion, signal: Signal) -> tuple[float, float]:
    """First and last time of some periods of a signal, where it moves fastest.

    Args:
        motion: from `vmri_jax.animation.motion`.
        signal: of it.
    """
    first, last = float(motion.t[0]), float(motion.t[-1])
    rates = np.gradient(signal.of(motion.points), motion.t)
    frequency = np.std(np.gradient(rates, motion.t)) / np.std(rates)  # of the fastest part: a drift has no curvature
    length = min(last - first, PERIODS * 2 * np.pi / max(float(frequency), signal.frequency))
    start = float(np.clip(motion.t[int(np.argmax(np.abs(rates)))] - length / 2, first, last - length))
    return start, start + length


def _step(motion: Motion) -> float:
    return float(np.median(np.diff(motion.t)))


def _seen(signals: list[Signal]) -> list[Signal]:
    largest = max((signal.size for signal in signals), default=0.0)
    return [signal for signal in signals if signal.size >= SEEN * largest]


def _coordinates(motion: Motion) -> list[Signal]:
    """Those of all bodies, in the coordinates of the drawing."""
    drawing, found = motion.drawing, []
    frame = drawing.frame()
    for i, body in enumerate(drawing.bodies):
        moved = [axis for axis, form in enumerate(body.forms) if form]
        for axis in moved:
            label = body.name if len(moved) == 1 else f"{body.name} {AXES[axis]}"
            found += _signal(motion, label, body.pace, _along(i, frame[:, axis]))
    return found


def _lengths(motion: Motion) -> list[Signal]:
    """Those of all springs."""
    drawing, found = motion.drawing, []
    index = {body.name: i for i, body in enumerate(drawing.bodies)}
    for joint in drawing.joints:
        if joint.kind != "spring":
            continue
        end = index[joint.bodies[-1]] if joint.point is None else drawing.place([joint.point])[0]
        of = _distance(index[joint.bodies[0]], end)
        found += _signal(motion, f"length of spring {' to '.join(joint.bodies)}", drawing.pace(joint), of)
    return found


def _along(body: int, direction: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: points[:, body] @ direction


def _distance(body: int, end: int | np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: np.linalg.norm(points[:, body] - (points[:, end] if isinstance(end, int) else end), axis=1)


def _signal(motion: Motion, label: str, pace: str, of: Callable[[np.ndarray], np.ndarray]) -> list[Signal]:
    """The signal, unless it is at rest."""
    values = of(motion.points)
    if len(values) < 3 or np.ptp(values) <= 1e-9 * np.abs(values).max():
        return []
    return [Signal(label, pace, of, float(np.std(values)), _speed(motion.t, values))]


def _speed(t: np.ndarray, values: np.ndarray) -> float:
    """Standard deviation of the rate, from node to node: central differences would miss what turns by pi between nodes."""
    return float(np.std(np.diff(values) / np.diff(t)))
