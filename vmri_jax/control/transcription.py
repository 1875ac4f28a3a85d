"""Discrete mechanics and optimal control: stages of a controlled motion, their derivatives, an iteration of the search.

A stage is a macro step of the scheme, ``z_{k+1} = Phi(z_k, u_k)`` with ``z = (q_s, q_f, p_s, p_f)``; its discrete
forced equations are the constraints of the optimisation. Controls are constant over macro or micro intervals.

Source: S. Ober-Bloebaum, O. Junge, J. E. Marsden, Discrete mechanics and optimal control, ESAIM: COCV 17 (2011); S.
Leyendecker, S. Ober-Bloebaum, J. E. Marsden, M. Ortiz, Optim. Control Appl. Meth. 31 (2010), with constraints; T.
Lishkova, S. Ober-Bloebaum, M. Cannon, S. Leyendecker, IFAC-PapersOnLine 53 (2020), on two grids.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.control import bounded, riccati
from vmri_jax.control.bounded import Limits
from vmri_jax.diagnostics.linear import phase_step, phase_vector, state_of, with_slopes
from vmri_jax.mechanics.arrays import Numbers, library
from vmri_jax.mechanics.by_name import ByName
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver

CONTROL = "vmri_jax.control"
"""Entry of ``system.params`` with the controls: u, the time when the first one starts, and the duration of each."""

BORDER_WIDTH = 1e-6
"""Half the width of the border between two controls, relative to the duration of a control: within it a time counts as
the border, so that round-off of a node's time does not choose a control. A larger one mixes controls at micro nodes."""

SHORTEST_PART = 2.0**-10
"""Smallest part of an update that the line search tries, after ten halvings; a larger one gives up earlier."""
SUFFICIENT_DECREASE = 1e-4
"""Armijo's constant: the merit decreases by at least this part of the prediction; a larger one refuses more."""


class Transcription(eqx.Module):
    """An optimal control problem on a macro grid.

    Attributes:
        system: the system without forces of controls; its params are a dict.
        start: first state of the motion.
        actuate: generalised forces of the controls, ``actuate(q_s, q_f, u, params) -> (f_s, f_f)``.
        cost: cost per time, ``cost(state, u) -> ()``.
        final_cost: cost of the last state, ``final_cost(state) -> ()``.
        goal: equations for the last state, ``goal(state) -> (e,)``.
        bounds: least and largest controls, (m,) each.
        parts: number of controls that follow each other in a macro interval: 1, or num_micro.
        limits: ``limits(state, u) -> (c,)``, not above zero at the end of macro intervals, for each control; or None.
    """

    system: System
    start: State
    scheme: SchemeLike
    solver: Solver
    macro_dt: Float[Numbers, ""]
    actuate: TracedOnce
    cost: TracedOnce
    final_cost: TracedOnce
    goal: TracedOnce
    bounds: tuple[np.ndarray, np.ndarray]
    parts: int = eqx.field(static=True)
    limits: TracedOnce | None = None

    @property
    def bounded(self) -> bool:
        """Whether there are inequalities."""
        return self.limits is not None or bool(np.isfinite(self.bounds).any())

    def times(self, count: int) -> np.ndarray:
        """(count, parts) starts of the intervals over which each control is constant."""
        start = float(self.start.t) + float(self.macro_dt) * np.arange(count)
        return start[:, None] + np.arange(self.parts) * (float(self.macro_dt) / self.parts)

    def driven(self, u, t) -> System:
        """The system with the forces of controls u (..., parts, m) from time t on."""
        held = library(u).reshape(u, (-1, u.shape[-1])), t, self.macro_dt / self.parts
        forces = _forces(self.system.force, self.actuate)
        return self.system.replace(force=forces, params={**self.system.params, CONTROL: held})

    def state(self, z, k) -> State:
        """The state at node k."""
        return state_of(z, self.start.t + k * self.macro_dt, self.start)

    def before(self, z):
        """Starts of the steps that end at the nodes z (N, n)."""
        return jnp.concatenate([phase_vector(self.start)[None], z[:-1]])

    def step(self, z, u, k):
        """The end of the step from node k at z (n,) with controls u (parts, m), and the `StepStatus` of the step."""
        t = self.start.t + k * self.macro_dt
        driven, fixed = self.driven(u, t), {"macro_dt": self.macro_dt, "solver": self.solver}
        return phase_step(driven, self.scheme, self.start, t, z, **fixed)

    @eqx.filter_jit
    def steps(self, z, u, follow):
        """Ends (N, n) of all steps, NaN where a step fails.

        Each step starts from its node in z, or from the end of the step before if `follow` is true. One program
        computes both, since a step takes long to compile.
        """

        def step(end, stage):
            node, u, k = stage
            end, status = self.step(jnp.where(follow, end, node), u, k)
            end = jnp.where(status.result <= Result.CONVERGED_AT_ROUNDOFF, end, jnp.nan)
            return end, end

        return jax.lax.scan(step, phase_vector(self.start), (self.before(z), u, jnp.arange(len(u))))[1]

    def stage_cost(self, z, u, z_next, k):
        """Trapezoidal rule: ``H (C(z_k, u) + C(z_{k+1}, u)) / 2``, its mean over the controls of the interval."""
        ends = self.state(z, k), self.state(z_next, k + 1)
        return self.macro_dt * sum(jnp.mean(jax.vmap(lambda u, s=s: self.cost(s, u))(u)) for s in ends) / 2

    def total(self, z, u):
        """The cost of nodes z (N, n) after the first one, and controls u (N, parts, m)."""
        stages = jax.vmap(self.stage_cost)(self.before(z), u, z, jnp.arange(len(u)))
        return jnp.sum(stages) + self.final_cost(self.state(z[-1], len(u)))

    def over(self, z, u):
        """Values (N, parts c) of the limits at nodes z (N, n) after the first one."""

        def stage(z, u, k):
            state, limits = self.state(z, k + 1), self.limits
            return jnp.zeros(0) if limits is None else jnp.ravel(jax.vmap(lambda u: limits(state, u))(u))

        return jax.vmap(stage)(z, u, jnp.arange(len(u)))

    @eqx.filter_jit
    def limited(self, z, u) -> Limits:
        """The inequalities, linearised at nodes z and controls u."""

        def stage(z, u):
            return self.over(z[None], u[None])[0]

        C, D = jax.vmap(jax.jacfwd(stage, (0, 1)))(z, u)
        lower, upper = (jnp.tile(bound, self.parts) - u.reshape(len(u), -1) for bound in self.bounds)
        return Limits(C, D.reshape(*D.shape[:2], u[0].size), self.over(z, u), lower, upper)

    @eqx.filter_jit
    def linearised(self, z, u) -> tuple[riccati.Stages, riccati.Final]:
        """The linear-quadratic problem at nodes z (N, n) and controls u (N, parts, m)."""
        count, n = len(u), z.shape[1]
        flat = u.reshape(count, -1)

        def stage(z, v, z_next, k):
            def end(x):
                return self.step(x[:n], x[n:].reshape(u.shape[1:]), k)

            def cost(y):
                x, z_next = y[: n + v.size], y[n + v.size :]
                return self.stage_cost(x[:n], x[n:].reshape(u.shape[1:]), z_next, k)

            x = jnp.concatenate([z, v])
            reached, _, slopes = with_slopes(end, x, jnp.eye(x.size))
            y = jnp.concatenate([x, z_next])
            gradient, hessian = jax.grad(cost)(y), convex(jax.hessian(cost)(y))
            # The cost depends on y = (z, u, z_next). To first order  dy = along (dz, du) + shift,  since the step gives
            # dz_next = slopes^T (dz, du) + c;  this turns gradient and hessian by y into those by (z, u).
            along = jnp.concatenate([jnp.eye(x.size), slopes], axis=1)
            c = reached - z_next
            shift = jnp.concatenate([jnp.zeros(x.size), c])
            A, B = slopes[:n].T, slopes[n:].T
            return riccati.Stages(along @ hessian @ along.T, along @ (gradient + hessian @ shift), A, B, c)

        stages = jax.vmap(stage)(self.before(z), flat, z, jnp.arange(count))

        def of_end(function):
            return lambda z: function(self.state(z, count))

        goal, final_cost = of_end(self.goal), of_end(self.final_cost)
        S, s = convex(jax.hessian(final_cost)(z[-1])), jax.grad(final_cost)(z[-1])
        return stages, riccati.Final(S, s, jax.jacfwd(goal)(z[-1]), goal(z[-1]))


def _forces(system_force: Callable | None, actuate: Callable) -> Callable:
    """The sum of the forces of a system and of its controls."""

    def force(t, q_s, q_f, v_s, v_f, params: Mapping[str, Any]):
        f_s, f_f = actuate(q_s, q_f, held(t, *params[CONTROL]), params)
        if system_force is None:
            return f_s, f_f
        system_s, system_f = system_force(t, q_s, q_f, v_s, v_f, params)
        return f_s + system_s, f_f + system_f

    # A problem with dictionaries leaves a `ByName` as it is: here a function of vectors.
    return ByName(force, ("t", "q_s", "q_f", "v_s", "v_f", "params"), None, None)


def held(t, u, t_start, length):
    """The control (m,) at time t.

    At the border of two intervals it is the mean of both controls, so that quadrature rules with nodes at the ends of
    intervals weight each control by its duration. The controls u (k, m) follow each other, each of duration `length`,
    the first from t_start on.
    """
    xp = library(t, u, t_start, length)
    sides = (t - t_start) / length + np.array([-BORDER_WIDTH, BORDER_WIDTH])
    return xp.mean(xp.asarray(u)[xp.clip(xp.floor(sides).astype(int), 0, len(u) - 1)], axis=0)


def convex(hessian):
    """A symmetric matrix with its negative eigenvalues set to zero: the quadratic problem then has a minimum."""
    values, vectors = jnp.linalg.eigh(hessian)
    return (vectors * jnp.maximum(values, 0.0)) @ vectors.T


class Point(NamedTuple):
    """A point of the search.

    z, u: nodes after the first one, and controls.
    gaps: end of each step minus the next node.
    """

    z: Float[Numbers, "N n"]
    u: Float[Numbers, "N parts m"]
    gaps: Float[Numbers, "N n"]


@eqx.filter_jit
def measured(setup: Transcription, point: Point):
    """Cost, sum of all violations, largest node and control, and largest values of the goal and of a limit."""
    over, goal = setup.over(point.z, point.u), jnp.abs(setup.goal(setup.state(point.z[-1], len(point.z))))
    violation = jnp.sum(jnp.abs(point.gaps)) + jnp.sum(goal) + jnp.sum(jnp.maximum(over, 0.0))
    sizes = (jnp.maximum(jnp.max(jnp.abs(a)), jnp.finfo(float).tiny) for a in (point.z, point.u))
    return setup.total(point.z, point.u), violation, *sizes, jnp.max(goal, initial=0.0), jnp.max(over, initial=0.0)


@eqx.filter_jit
def slope(setup: Transcription, point: Point, dz, du):
    """Change of the cost along an update."""
    return jax.jvp(setup.total, (point.z, point.u), (dz, du))[1]


def update(setup: Transcription, point: Point) -> tuple[riccati.Solution, float, Point]:
    """The solution of the linear-quadratic problem at a point, its largest absolute multiplier, the point with gaps."""
    stages, final = setup.linearised(point.z, point.u)
    point = point._replace(gaps=np.asarray(stages.c))
    limits = setup.limited(point.z, point.u) if setup.bounded else None
    for name, part in (("cost, the steps or the goal", (stages, final)), ("limits", limits and limits[:3])):
        if not all(np.isfinite(a).all() for a in jax.tree.leaves(part)):
            elsewhere = (
                "Start from other controls, or change these functions there: no root or logarithm of zero or less."
            )
            raise bounded.Unsolved(f"minimize: values or derivatives of {name} are not finite. {elsewhere}")
    if limits is not None:
        return *bounded.solve(stages, final, limits), point
    change = riccati.solve(stages, final)
    if not all(np.isfinite(a).all() for a in change):
        lacking = "the second derivative of cost in u is not positive: without it controls have no least cost"
        raise bounded.Unsolved(f"minimize: {lacking}. Add a small multiple of u @ u, or give bounds.")
    return change, float(np.abs(change.nu).max(initial=0.0)), point


def line_search(setup: Transcription, point: Point, change: riccati.Solution, rho: float) -> tuple[Point, dict]:
    """The first point along an update with a sufficient decrease of the merit, and its entry in the history.

    The merit is ``cost + rho (sum |gaps| + sum |goal| + sum max(limits, 0))``. The update is halved until one of two
    trials is accepted: nodes and controls updated alike, which unstable motions need; and the motion of the updated
    controls, without gaps, which suits bodies that turn far. The point stays, ``part`` 0, if no part is accepted.
    """
    dz, du = np.asarray(change.dz), np.asarray(change.du).reshape(point.u.shape)
    cost, violation, *_ = map(float, measured(setup, point))
    before = cost + rho * violation
    # The whole update fulfils the linearised conditions: along it the violation decreases at the rate of its size.
    expected = float(slope(setup, point, dz, du)) - rho * violation
    part, accepted = 1.0, None
    while accepted is None and part >= SHORTEST_PART:
        z, u = point.z + part * dz, point.u + part * du
        # the last term allows for round-off: near the optimum the merit changes by less
        allowed = before + SUFFICIENT_DECREASE * part * min(expected, 0.0) + 1e-12 * (abs(cost) + rho * violation)
        ends, motion = np.asarray(setup.steps(z, u, np.asarray(False))), rolled(setup, u)  # NaN where a step fails
        trials = Point(z, u, ends - z), Point(motion, u, np.zeros_like(motion))
        measures = [map(float, measured(setup, trial)) for trial in trials]
        merits = [cost + rho * violation for cost, violation, *_ in measures]
        best = int(np.nanargmin([*merits, np.inf]))  # a motion that fails has the merit NaN
        if best < len(trials) and merits[best] <= allowed:
            accepted = trials[best]
        else:
            part /= 2
    if accepted is None:
        part, accepted = 0.0, point
    cost, _, size_z, size_u, miss, over = map(float, measured(setup, accepted))
    gap, largest = np.abs(accepted.gaps).max() / size_z, max(np.abs(dz).max() / size_z, np.abs(du).max() / size_u)
    record = {"cost": cost, "gap": gap, "miss": miss, "over": over, "update": largest, "part": part}
    return accepted, {name: float(value) for name, value in record.items()}


def rolled(setup: Transcription, u):
    """Nodes of the motion with controls u, NaN from the first failed step on."""
    return np.asarray(setup.steps(np.zeros((len(u), phase_vector(setup.start).size)), u, np.asarray(True)))
