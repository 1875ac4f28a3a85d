"""Measurements, with their standard deviations, and unknown parameters, with the start of the search and bounds."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

from vmri_jax.mechanics.arrays import library, real_array
from vmri_jax.mechanics.checks import describe, shape_of
from vmri_jax.mechanics.functions import check_arguments
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
        if not np.isfinite(t).all() or np.isinf(values).any() or np.isnan(values).all():
            raise Refused("Measured: t and values must be finite, but for NaN in place of missing values, not of all.")
        check_arguments("Measured: observe", self.observe, "state")
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

    def check(self, nodes: State) -> None:
        """Refuse an `observe` that does not predict the values from the states (k,) at the times of measurement."""
        state, missing = jax.tree.map(lambda a: a[0], nodes), ~np.isfinite(self.values)
        value = shape_of("Measured: observe", lambda state, params: self.observe(state), state, {})
        count = self.values.shape[1]
        if getattr(value, "size", None) != count or not np.issubdtype(value.dtype, np.floating):
            expected = f"it must return {count} real numbers, since values has {count} for each time"
            raise Refused(f"Measured: observe returns {describe(value)}; {expected}.")
        predicted = np.asarray(jax.jit(jax.vmap(self.observe))(nodes)).reshape(self.values.shape)
        off = np.flatnonzero((~np.isfinite(predicted) & ~missing).any(axis=1))
        if off.size:
            raise Refused(
                f"fit: observe returns {predicted[off[0]]} at t = {self.t[off[0]]:g} with the first parameters; start "
                "elsewhere, or leave these values out as NaN."
            )

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


@dataclass(frozen=True)
class Unknown:
    """An unknown parameter x, a number or an array.

    The search variable u is without bounds, 0 at the start:

        x = start + scale u                                  no bounds
        x = lower + (start - lower) e^u                      a lower bound
        x = upper - (upper - start) e^u                      an upper bound
        x = lower + (upper - lower) / (1 + e^-(c + u))       both, with c such that u = 0 is the start

    Attributes:
        start: where the search starts, inside of the bounds.
        lower, upper: bounds, None for none; ``lower=0`` for a positive parameter.
        scale: change of x for u = 1, if there are no bounds; None for the size of the start, or 1 where that is zero.

    Raises:
        TypeError, ValueError: arrays that are not real; a start that is not between its bounds.
    """

    start: Any
    lower: Any = None
    upper: Any = None
    scale: Any = None

    def __post_init__(self):
        if isinstance(self.start, Mapping):
            raise Refused('Unknown: start is a dict; name its numbers one by one, {"bonds.stiffness": Unknown(...)}.')
        start = np.asarray(real_array("Unknown: start", self.start))
        object.__setattr__(self, "start", start)
        if not np.isfinite(start).all():
            raise Refused(f"Unknown: start is {self.start}; it must be finite.")
        for name in ("lower", "upper", "scale"):
            value = getattr(self, name)
            if value is not None:
                value = np.asarray(real_array(f"Unknown: {name}", value))
                if value.shape not in ((), start.shape):
                    raise Refused(f"Unknown: {name} has shape {value.shape}; give a number, or {start.shape}.")
                if not np.isfinite(value).all():
                    raise Refused(f"Unknown: {name} is {value}; it must be finite, or None.")
                object.__setattr__(self, name, np.broadcast_to(value, start.shape))
        too_small = self.lower is not None and not np.all(self.lower < start)
        too_large = self.upper is not None and not np.all(start < self.upper)
        if too_small or too_large:
            raise Refused(f"Unknown: start is {start}; it must lie between lower={self.lower} and upper={self.upper}.")
        if self.scale is not None and not np.all(self.scale > 0):
            raise Refused(f"Unknown: scale is {self.scale}; it must be positive.")

    def at(self, u):
        """The parameter for a search variable of the same shape; 0 is the start."""
        xp = library(u, vars(self))
        if self.lower is None and self.upper is None:
            size = xp.where(self.start == 0, 1.0, abs(self.start))
            return self.start + (size if self.scale is None else self.scale) * u
        if self.upper is None:
            return self.lower + (self.start - self.lower) * xp.exp(u)
        if self.lower is None:
            return self.upper - (self.upper - self.start) * xp.exp(u)
        part, sigmoid = (self.start - self.lower) / (self.upper - self.lower), expit if xp is np else jax.nn.sigmoid
        return self.lower + (self.upper - self.lower) * sigmoid(xp.log(part / (1 - part)) + u)


class Unknowns:
    """Several unknowns as one vector: their search variables, one after the other."""

    def __init__(self, unknowns: Mapping[str, Unknown]):
        self.unknowns = dict(unknowns)
        self._ends = np.cumsum([unknown.start.size for unknown in self.unknowns.values()])
        self.size = int(self._ends[-1])

    def at(self, u) -> dict:
        """The parameters by name."""
        parts = zip(self.unknowns.items(), library(u).split(u, self._ends[:-1]), strict=True)
        return {name: unknown.at(part.reshape(unknown.start.shape)) for (name, unknown), part in parts}

    def vector(self, parameters: Mapping):
        """All numbers in a row."""
        return library(parameters).concatenate([parameters[name].reshape(-1) for name in self.unknowns])

    @property
    def labels(self) -> list[str]:
        """A name for every number: ``stiffness``, ``masses[1]``."""
        return [
            name + (f"[{', '.join(map(str, index))}]" if index else "")
            for name, unknown in self.unknowns.items()
            for index in np.ndindex(unknown.start.shape)
        ]
