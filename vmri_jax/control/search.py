"""One iteration of sequential quadratic programming: the update, and the line search along it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.control import bounded, riccati
from vmri_jax.control.transcription import Transcription
from vmri_jax.mechanics.arrays import Numbers

SHORTEST_PART = 2.0**-10
"""Smallest part of an update that the line search tries, after ten halvings; a larger one gives up earlier."""
SUFFICIENT_DECREASE = 1e-4
"""Armijo's constant: the merit decreases by at least this part of the prediction; a larger one refuses more."""

ELSEWHERE = "Start from other controls, or change these functions there: no root or logarithm of zero or less."
"""End of the message about functions that are not finite."""


class Point(NamedTuple):
    """A point of the search.

    z, u: nodes after the first one, and controls.
    gaps: end of each step minus the next node.
    goal: values of the goal, zero where it is reached.
    """

    z: Float[Numbers, "N n"]
    u: Float[Numbers, "N parts m"]
    gaps: Float[Numbers, "N n"]
    goal: Float[Numbers, "e"]


@eqx.filter_jit
def measured(setup: Transcription, point: Point):
    """Cost, sum of all violations, largest node and control, and largest value of a limit."""
    over = setup.over(point.z, point.u)
    violation = sum(jnp.sum(jnp.abs(x)) for x in (point.gaps, point.goal, jnp.maximum(over, 0.0)))
    sizes = (jnp.maximum(jnp.max(jnp.abs(a)), jnp.finfo(float).tiny) for a in (point.z, point.u))
    return setup.total(point.z, point.u), violation, *sizes, jnp.max(over, initial=0.0)


@eqx.filter_jit
def slope(setup: Transcription, point: Point, dz, du):
    """Change of the cost along an update."""
    return jax.jvp(setup.total, (point.z, point.u), (dz, du))[1]


def update(setup: Transcription, point: Point) -> tuple[riccati.Solution, float, riccati.Stages, riccati.Final]:
    """The solution of the linear-quadratic problem at a point, the largest absolute multiplier, and the problem."""
    stages, final = setup.linearised(point.z, point.u)
    limits = setup.limited(point.z, point.u) if setup.bounded else None
    for name, part in (("cost, the steps or the goal", (stages, final)), ("limits", limits and limits[:3])):
        if not all(np.isfinite(a).all() for a in jax.tree.leaves(part)):
            raise bounded.Unsolved(f"minimize: values or derivatives of {name} are not finite. {ELSEWHERE}")
    if limits is not None:
        change, steepest = bounded.solve(stages, final, limits)
        return change, steepest, stages, final
    change = riccati.solve(stages, final)
    if not all(np.isfinite(a).all() for a in change):
        lacking = "the second derivative of cost in u is not positive: without it controls have no least cost"
        raise bounded.Unsolved(f"minimize: {lacking}. Add a small multiple of u @ u, or give bounds.")
    return change, float(np.abs(change.nu).max(initial=0.0)), stages, final


def line_search(setup: Transcription, point: Point, change: riccati.Solution, rho: float) -> tuple[Point, dict]:
    """The first point along an update with a sufficient decrease of the merit, and its entry in the history.

    The merit is ``cost + rho (sum |gaps| + sum |goal| + sum max(limits, 0))``. The update is halved until one of two
    trials is accepted: nodes and controls updated alike, which unstable motions need; and the motion of the updated
    controls, without gaps, which suits bodies that turn far. The point stays, ``part`` 0, if no part is accepted.
    """
    dz, du = change.dz, jnp.reshape(change.du, point.u.shape)
    cost, violation, size_z, size_u, _ = measured(setup, point)
    before = float(cost + rho * violation)
    # The whole update fulfils the linearised conditions: along it the violation decreases at the rate of its size.
    expected = float(slope(setup, point, dz, du) - rho * violation)
    part, accepted = 1.0, None
    while accepted is None and part >= SHORTEST_PART:
        z, u = point.z + part * dz, point.u + part * du
        # the last term allows for round-off: near the optimum the merit changes by less
        allowed = before + SUFFICIENT_DECREASE * part * min(expected, 0.0) + 1e-12 * (abs(cost) + rho * violation)
        ends, _ = setup.steps(z, u, jnp.asarray(False))  # NaN where a step fails
        trials = [_with_goal(setup, z, u, ends - z)]
        motion, _ = rolled(setup, u)
        trials.append(_with_goal(setup, motion, u, jnp.zeros_like(motion)))
        measures = [measured(setup, trial) for trial in trials]
        merits = [float(cost + rho * violation) for cost, violation, *_ in measures]
        best = int(np.nanargmin([*merits, np.inf]))  # a motion that fails has the merit NaN
        if best < len(trials) and merits[best] <= allowed:
            accepted = trials[best]
        else:
            part /= 2
    if accepted is None:
        part, accepted = 0.0, point
    cost, _, size_z, size_u, over = measured(setup, accepted)
    record = {
        "cost": cost,
        "gap": np.abs(accepted.gaps).max() / size_z,
        "miss": np.abs(accepted.goal).max(initial=0.0),
        "over": over,
        "update": max(np.abs(dz).max() / size_z, np.abs(du).max() / size_u),
        "part": part,
    }
    return accepted, {name: float(value) for name, value in record.items()}


def rolled(setup: Transcription, u):
    """Nodes of the motion with controls u, NaN from the first failed step on, and the `StepStatus` of the steps."""
    return setup.steps(jnp.zeros((len(u), setup.z_start.size)), u, jnp.asarray(True))


def _with_goal(setup: Transcription, z, u, gaps) -> Point:
    return Point(z, u, gaps, setup.goal(setup.state(z[-1], len(z))))
