"""Unknown parameters: the start of the search, and bounds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.refusals import Refused


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
                object.__setattr__(self, name, np.broadcast_to(value, start.shape))
        too_small = self.lower is not None and not np.all(self.lower < start)
        too_large = self.upper is not None and not np.all(start < self.upper)
        if too_small or too_large:
            raise Refused(f"Unknown: start is {start}; it must lie between lower={self.lower} and upper={self.upper}.")
        if self.scale is not None and not np.all(self.scale > 0):
            raise Refused(f"Unknown: scale is {self.scale}; it must be positive.")

    def at(self, u):
        """The parameter for a search variable of the same shape; 0 is the start."""
        if self.lower is None and self.upper is None:
            size = np.where(self.start == 0, 1.0, np.abs(self.start))
            return self.start + (size if self.scale is None else self.scale) * u
        if self.upper is None:
            return self.lower + (self.start - self.lower) * jnp.exp(u)
        if self.lower is None:
            return self.upper - (self.upper - self.start) * jnp.exp(u)
        part = (self.start - self.lower) / (self.upper - self.lower)
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(np.log(part / (1 - part)) + u)


class Unknowns:
    """Several unknowns as one vector: their search variables, one after the other."""

    def __init__(self, unknowns: Mapping[str, Unknown]):
        self.unknowns = dict(unknowns)
        numbers, self._parts = ravel_pytree([unknown.start for unknown in self.unknowns.values()])
        self.size = numbers.size

    def at(self, u) -> dict:
        """The parameters by name."""
        parts = zip(self.unknowns.items(), self._parts(jnp.asarray(u)), strict=True)
        return {name: unknown.at(part) for (name, unknown), part in parts}

    def vector(self, parameters: Mapping) -> jax.Array:
        """All numbers in a row."""
        return ravel_pytree([parameters[name] for name in self.unknowns])[0]

    @property
    def labels(self) -> list[str]:
        """A name for every number: ``stiffness``, ``masses[1]``."""
        return [
            name + (f"[{', '.join(map(str, index))}]" if index else "")
            for name, unknown in self.unknowns.items()
            for index in np.ndindex(unknown.start.shape)
        ]
