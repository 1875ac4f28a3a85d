"""Measurements: times, values, their standard deviations, and the measured quantity as a function of the state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.mechanics.state import State
from vmri_jax.refusals import Refused

NODE_TOLERANCE = 1e-6
"""Largest distance of a time of measurement from a macro node, in macro steps: round-off of the time, no more. A larger
one would take values between nodes for values at nodes."""


def positions(state: State):
    """All positions of a state, slow ones first."""
    return jnp.concatenate([state.q_s, state.q_f])


@dataclass(frozen=True)
class Measured:
    """Measured values along a motion.

        vm.fitting.Measured(t, values, sigma=0.01, observe=lambda state: state.q_f[:2])

    Attributes:
        t: (k,) times, nodes of the macro grid of the fit.
        values: (k, m) or (k,), NaN for a missing one.
        sigma: standard deviation of the errors of the values, positive: a number, (m,) where k is not m, (1, m),
            (k, 1), or the shape of values. None if it is not known: the fit estimates it from its residuals; then sigma
            is None for all sets of measurements.
        observe: the measured quantity, ``observe(state) -> (m,)`` or ``()``; all positions by default.

    Raises:
        TypeError, ValueError: arrays that are not real, wrong shapes, a sigma that is not positive.
    """

    t: Any
    values: Any
    sigma: Any = None
    observe: Callable[[State], Any] = positions

    def __post_init__(self):
        t = np.asarray(real_array("Measured: t", self.t, ndim=1))
        values = np.asarray(real_array("Measured: values", self.values))
        if values.ndim not in (1, 2) or len(values) != len(t) or not len(t):
            raise Refused(f"Measured: values have shape {values.shape}, t has {t.shape}; give one row for each time.")
        shape, values = values.shape, values.reshape(len(t), -1)
        if not np.isfinite(t).all() or not np.isfinite(values).any():
            raise Refused("Measured: t must be finite, and at least one value must be a number.")
        if self.sigma is not None:
            sigma = np.asarray(real_array("Measured: sigma", self.sigma))
            if not (np.isfinite(sigma).all() and np.all(sigma > 0)):
                raise Refused(f"Measured: sigma is {self.sigma}; it must be positive, or None if it is unknown.")
            k, m = values.shape
            # (m,) of as many times as quantities could be one for each time
            if sigma.shape not in ((), shape, (1, m), (k, 1)) and (sigma.shape != (m,) or k == m):
                shapes = f"one for each quantity, {(1, m)}, one for each time, {(k, 1)}, or one for each value"
                raise Refused(f"Measured: sigma has shape {sigma.shape}; values have {shape}. Give a number, {shapes}.")
            sigma = sigma.reshape(k, m) if sigma.shape == shape else np.broadcast_to(sigma, (k, m))
            object.__setattr__(self, "sigma", sigma)
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "values", values)

    def steps(self, t_start: float, macro_dt: float) -> np.ndarray:
        """Numbers of the macro nodes at the times of measurement.

        Raises:
            ValueError: a time before the start, or off the grid.
        """
        exact = (self.t - t_start) / macro_dt
        steps = np.rint(exact).astype(int)
        off = np.flatnonzero(np.abs(exact - steps) > NODE_TOLERANCE)
        if off.size:
            before, after = (t_start + (int(exact[off[0]]) + i) * macro_dt for i in (0, 1))
            between = f"the time {self.t[off[0]]:g} lies between its nodes {before:g} and {after:g}"
            raise Refused(
                f"fit: macro_dt is {macro_dt:g}, and {between}. Values are not interpolated: take a step that divides "
                "the times, or interpolate the measurements to the nodes."
            )
        if steps.min() < 0:
            raise Refused(f"fit: the time {self.t.min():g} lies before the start of the problem, {t_start:g}.")
        return steps
