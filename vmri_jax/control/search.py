"""One iteration of sequential quadratic programming: an update, and how far along it to go."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.control import bounded, riccati
from vmri_jax.control.transcription import Transcription
from vmri_jax.mechanics.arrays import Numbers

SHORTEST = 2.0**-10
"""Part of an update below which the search gives up."""
ENOUGH = 1e-4
"""Part of the predicted decrease of the merit that is asked for (Armijo)."""


class Point(NamedTuple):
    """Nodes after the first one and controls, and what they miss: the nodes after each step, and the goal."""

    z: Float[Numbers, "N n"]
    u: Float[Numbers, "N parts m"]
    gaps: Float[Numbers, "N n"]
    goal: Float[Numbers, "e"]


linearised = eqx.filter_jit(Transcription.linearised)
limited = eqx.filter_jit(Transcription.limited)
steps = eqx.filter_jit(Transcription.steps)
by_sweep = jax.jit(riccati.solve)


@eqx.filter_jit
def measured(setup: Transcription, point: Point):
    """Cost, sum of all misses, sizes of nodes and controls, and the most that a limit is passed by."""
    over = setup.over(point.z, point.u)
    missed = sum(jnp.sum(jnp.abs(x)) for x in (point.gaps, point.goal, jnp.maximum(over, 0.0)))
    sizes = (jnp.maximum(jnp.max(jnp.abs(a)), 1e-12) for a in (point.z, point.u))
    return setup.total(point.z, point.u), missed, *sizes, jnp.max(over, initial=0.0)


@eqx.filter_jit
def slope(setup: Transcription, point: Point, dz, du):
    """Change of the cost along an update."""
    return jax.jvp(setup.total, (point.z, point.u), (dz, du))[1]


class Search:
    """Updates of nodes and controls, and the search along them."""

    def __init__(self, setup: Transcription):
        self.setup = setup

    def update(self, point: Point) -> tuple[riccati.Solution, float, riccati.Stages, riccati.Final]:
        """The solution of the linear-quadratic problem at a point, the largest multiplier of what is asked of it, and the problem."""
        stages, final = linearised(self.setup, point.z, point.u)
        if self.setup.bounded:
            change, steepest = bounded.solve(stages, final, limited(self.setup, point.z, point.u))
            return change, steepest, stages, final
        change = by_sweep(stages, final)
        return change, float(np.abs(change.nu).max(initial=0.0)), stages, final

    def line_search(self, point: Point, change: riccati.Solution, rho: float) -> tuple[Point, dict[str, float]]:
        """The first point along an update whose merit ``cost + rho (sum |gaps| + sum |goal| + sum of what is above the limits)``
        is small enough, and what there is to say of it.

        Halves of the update are tried, each in two ways: nodes and controls updated alike, which unstable motions need, and the
        motion of the updated controls, which has no gaps, and suits bodies that turn far.
        """
        dz, du = change.dz, jnp.reshape(change.du, point.u.shape)
        cost, missed, size_z, size_u, _ = measured(self.setup, point)
        before, expected = float(cost + rho * missed), float(slope(self.setup, point, dz, du) - rho * missed)
        part, found = 1.0, None
        while found is None and part >= SHORTEST:
            z, u = point.z + part * dz, point.u + part * du
            allowed = before + ENOUGH * part * min(expected, 0.0) + 1e-12 * (1 + abs(before))
            trials = [self.with_gaps(z, u), self.motion(u)]
            merits = [
                float(cost + rho * missed) for cost, missed, *_ in (measured(self.setup, trial) for trial in trials)
            ]
            best = int(np.nanargmin([*merits, np.inf]))
            if best < len(trials) and merits[best] <= allowed:
                found = trials[best]
            else:
                part /= 2
        if found is None:
            part, found = 0.0, point
        cost, _, size_z, size_u, over = measured(self.setup, found)
        update = max(np.abs(dz).max() / size_z, np.abs(du).max() / size_u)
        told = {
            "cost": cost,
            "gap": np.abs(found.gaps).max() / size_z,
            "miss": np.abs(found.goal).max(initial=0.0),
            "over": over,
            "update": update,
            "part": part,
        }
        return found, {name: float(value) for name, value in told.items()}

    def with_gaps(self, z, u) -> Point:
        """Nodes and controls with what they miss: NaN where a step fails."""
        ends, _ = steps(self.setup, z, u, jnp.asarray(False))
        return Point(z, u, ends - z, self._goal(z))

    def rolled(self, u):
        """Nodes of the motion with controls u, NaN from a step on that fails, and the `Status` of the steps."""
        return steps(self.setup, jnp.zeros((len(u), self.setup.z_start.size)), u, jnp.asarray(True))

    def motion(self, u) -> Point:
        """The motion of controls, without gaps."""
        z, _ = self.rolled(u)
        return Point(z, u, jnp.zeros_like(z), self._goal(z))

    def _goal(self, z):
        return self.setup.goal(self.setup.state(z[-1], len(z)))
