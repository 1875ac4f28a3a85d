"""Optimal control: the controls that bring a system to a goal at the least cost."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vmri_jax.control.riccati import solve
from vmri_jax.control.transcription import Transcription
from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.arrays import real_array, whole_number
from vmri_jax.mechanics.checks import check_number
from vmri_jax.mechanics.state import Movable, opened, start_of
from vmri_jax.running.origin import Origin, names_of
from vmri_jax.running.progress import progress_shown, silent
from vmri_jax.running.simulate import prepare
from vmri_jax.running.trajectory import RunInfo, Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.plan import plan
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.stepper import Status

SHORTEST = 2.0**-10
"""Part of an update below which the line search gives up."""
ENOUGH = 1e-4
"""Part of the predicted decrease of the merit that is asked for (Armijo)."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Controls that were found, and the motion that they make.

    Attributes:
        controls: (N, m), or (N, num_micro, m) for controls on the micro grid.
        t: (N,) or (N, num_micro) times from which on they are held.
        trajectory: the motion, all macro nodes saved.
        cost: its cost.
        multipliers: (e,) change of the cost with the goal.
        miss: the most that the goal is missed by.
        gap: the most that a step misses the next node by.
        iterations: linear-quadratic problems that were solved.
        converged: whether updates, gaps and the goal ended below the tolerance.
        history: cost, gap, miss, update and the part of it that was taken, of every iteration.
    """

    controls: Float[np.ndarray, "N ..."]
    t: Float[np.ndarray, "N ..."]
    trajectory: Trajectory
    cost: float
    multipliers: Float[np.ndarray, "e"]
    miss: float
    gap: float
    iterations: int
    converged: bool
    history: list[dict] = field(repr=False, default_factory=list)

    def __str__(self) -> str:
        how = "converged" if self.converged else "not converged: the best that was found"
        return f"cost {self.cost:.8g} after {self.iterations} iterations, {how}; goal missed by {self.miss:.1e}, steps by {self.gap:.1e}"


def minimize(
    problem: Movable,
    actuate: Callable,
    cost: Callable,
    *,
    num_controls: int,
    scheme: Scheme | Composition,
    macro_dt: float,
    num_steps: int,
    final_cost: Callable | None = None,
    goal: Callable | None = None,
    start: Any = None,
    grid: Literal["macro", "micro"] = "macro",
    tolerance: float = 1e-8,
    max_iterations: int = 50,
    newton: Newton | None = None,
    progress: bool = False,
) -> Optimum:
    """Minimise ``sum_k H (C(z_k, u_k) + C(z_{k+1}, u_k)) / 2 + final_cost(z_N)`` subject to the steps of the scheme and ``goal = 0``.

        def push(q_s, q_f, u, params):
            return u, 0 * q_f

        found = vm.control.minimize(
            cart, push, lambda state, u: u @ u / 2, num_controls=1, goal=lambda state: state.q_s - 1.0,
            scheme=scheme, macro_dt=0.01, num_steps=100,
        )

    Sequential quadratic programming with the nodes among the unknowns: all steps are linearised side by side, and the
    linear-quadratic problem is solved by a Riccati sweep (`vmri_jax.control.riccati`), so that time grows with the number of steps.
    Costs enter with their second derivatives, without negative parts; steps with their first ones.

    Args:
        problem: what moves and where it starts; its ``system.params`` is a dict or None.
        actuate: generalised forces of the controls, ``actuate(q_s, q_f, u, params) -> (f_s, f_f)``.
        cost: per time, ``cost(state, u) -> ()``; with a positive second derivative by u.
        num_controls: m, length of u.
        scheme, macro_dt, num_steps, newton: as of `simulate`. Forces act on the grid that the scheme holds them on.
        final_cost: of the last state, ``final_cost(state) -> ()``.
        goal: of the last state, ``goal(state) -> (e,)``.
        start: controls to start from, of the shape of `Optimum.controls`; zero if None.
        grid: controls for every macro interval, or for every micro interval.
        tolerance: of updates, gaps and the goal, relative to the motion and to the controls.
        max_iterations: at most so many linear-quadratic problems.
        progress: show cost and misses of each iteration.

    Returns:
        The `Optimum`; where the goal was not reached, the best that was found, which says so.

    Raises:
        ValueError, TypeError: bad arguments, functions of other shapes.
    """
    whole_number("minimize: max_iterations", max_iterations)
    if not check_number("minimize: tolerance", tolerance) > 0:
        raise ValueError(f"minimize: tolerance is {tolerance}; it must be positive.")
    setup = _setup(problem, actuate, cost, num_controls, scheme, macro_dt, num_steps, final_cost, goal, grid, newton)
    shape = (num_steps, setup.parts, num_controls)
    u = _start(start, shape, grid)
    motion = jax.jit(lambda u: _along(setup, u))
    z, _ = motion(u)
    if not np.isfinite(z).all():
        raise ValueError(
            "minimize: the motion with the controls to start from fails; give others, start=..., or a smaller macro_dt."
        )
    iterate = jax.jit(lambda z, u, rho: _iterate(setup, z, u, rho))
    rho, history, converged, nu = 1.0, [], False, np.zeros(0)
    with progress_shown() if progress else nullcontext(silent) as tell:
        for count in range(1, max_iterations + 1):
            z, u, nu, rho, told = iterate(z, u, rho)
            told = {name: float(value) for name, value in told.items()}
            history.append(told)
            tell(f"cost {told['cost']:.6g}, goal {told['miss']:.1e}, steps {told['gap']:.1e}", count, max_iterations)
            converged = max(told["update"], told["gap"], told["miss"]) <= tolerance
            if converged or told["part"] == 0.0:
                break
    trajectory = _trajectory(setup, *motion(u)).of(Origin(names_of(opened(problem)), setup.system, setup.system.params))
    controls = np.asarray(u)
    held = np.asarray(trajectory.t)[:-1, None] + np.arange(setup.parts) * (setup.macro_dt / setup.parts)
    if grid == "macro":
        controls, held = controls[:, 0], held[:, 0]
    least, miss, gap = (history[-1][name] for name in ("cost", "miss", "gap"))
    return Optimum(controls, held, trajectory, least, np.asarray(nu), miss, gap, len(history), converged, history)


def _setup(
    problem, actuate, cost, num_controls, scheme, macro_dt, num_steps, final_cost, goal, grid, newton
) -> Transcription:
    whole_number("minimize: num_controls", num_controls)
    whole_number("minimize: num_steps", num_steps)
    if grid not in ("macro", "micro"):
        raise ValueError(f"minimize: grid is {grid!r}; it must be 'macro' or 'micro'.")
    system, state = start_of("minimize", problem, None)
    params = {} if system.params is None else system.params
    if not isinstance(params, Mapping):
        raise TypeError(
            f"minimize: system.params is {type(params).__name__}; the controls need it to be a dict, or None."
        )
    prepare(problem, scheme, macro_dt=macro_dt, num_steps=1, newton=newton)  # the checks of a run
    if newton is None and plan(system, scheme, state).has_fallback:
        newton = Newton("nested")
    u = np.zeros(num_controls)
    forces = jax.eval_shape(lambda: actuate(state.q_s, state.q_f, u, params))
    expected = (state.q_s.shape, state.q_f.shape)
    if not isinstance(forces, tuple) or tuple(getattr(f, "shape", None) for f in forces) != expected:
        raise ValueError(
            f"minimize: actuate returns {forces}; it must return forces on the slow and on the fast variables, of shapes "
            f"{expected[0]} and {expected[1]}."
        )
    for name, function, given in (("cost", cost, (state, u)), ("final_cost", final_cost, (state,))):
        shape = () if function is None else jax.eval_shape(lambda f=function, g=given: f(*g)).shape
        if shape != ():
            raise ValueError(f"minimize: {name} has shape {shape}; it must be a number.")
    if goal is not None and len(jax.eval_shape(lambda: goal(state)).shape) != 1:
        raise ValueError("minimize: goal must return a vector (e,), zero where it is reached.")
    return Transcription(
        system.replace(params=params),
        state,
        scheme,
        newton or Newton(),
        float(macro_dt),
        actuate,
        cost,
        final_cost or (lambda state: jnp.zeros(())),
        goal or (lambda state: jnp.zeros(0)),
        scheme.num_micro if grid == "micro" else 1,
    )


def _start(start, shape, grid: str):
    if start is None:
        return jnp.zeros(shape)
    u = np.asarray(real_array("minimize: start", start))
    expected = shape if grid == "micro" else (shape[0], shape[2])
    if u.shape != expected:
        raise ValueError(f"minimize: start has shape {u.shape}; the controls have {expected}.")
    return jnp.asarray(u.reshape(shape))


def _along(setup: Transcription, u):
    """Nodes of the motion with controls u after the first one, NaN from a failure on, and the status of its steps."""

    def step(z, at):
        z, status = setup.step(z, *at)
        z = jnp.where(status.result <= Result.CONVERGED_AT_ROUNDOFF, z, jnp.nan)
        return z, (z, status)

    return jax.lax.scan(step, setup.z_start, (u, jnp.arange(len(u))))[1]


class _Trial(NamedTuple):
    """A part of an update that was tried, what it leaves of the constraints, and whether the merit is small enough."""

    part: Float[Array, ""]
    gaps: Float[Array, "N n"]
    goal: Float[Array, "e"]
    good: Bool[Array, ""]


def _iterate(setup: Transcription, z, u, rho):
    """One linear-quadratic problem and a search along its solution, by the merit ``cost + rho (sum |gaps| + sum |goal|)``."""
    stages, final = setup.linearised(z, u)
    change = solve(stages, final)
    du = change.du.reshape(u.shape)
    rho = jnp.maximum(rho, 2 * jnp.max(jnp.abs(change.nu), initial=0.0))
    slope = jax.jvp(setup.total, (z, u), (change.dz, du))[1]

    def merit(z, u, gaps, goal):
        return setup.total(z, u) + rho * (jnp.sum(jnp.abs(gaps)) + jnp.sum(jnp.abs(goal)))

    before = merit(z, u, stages.c, final.g)
    expected = slope - rho * (jnp.sum(jnp.abs(stages.c)) + jnp.sum(jnp.abs(final.g)))

    def shorter(last: _Trial) -> _Trial:
        part = last.part / 2
        at = z + part * change.dz, u + part * du
        misses = setup.misses(*at)
        allowed = before + ENOUGH * part * jnp.minimum(expected, 0.0) + 1e-12 * (1 + jnp.abs(before))
        return _Trial(part, *misses, merit(*at, *misses) <= allowed)

    none = _Trial(jnp.zeros(()), stages.c, final.g, jnp.asarray(False))
    tried = jax.lax.while_loop(
        lambda last: ~last.good & (last.part > SHORTEST), shorter, none._replace(part=2 * jnp.ones(()))
    )
    part, gaps, goal, _ = jax.tree.map(lambda a, b: jnp.where(tried.good, a, b), tried, none)
    z, u = z + part * change.dz, u + part * du
    size_z, size_u = (jnp.maximum(jnp.max(jnp.abs(a)), 1e-12) for a in (z, u))
    told = {
        "cost": setup.total(z, u),
        "gap": jnp.max(jnp.abs(gaps)) / size_z,
        "miss": jnp.max(jnp.abs(goal), initial=0.0),
        "update": jnp.maximum(jnp.max(jnp.abs(change.dz)) / size_z, jnp.max(jnp.abs(du)) / size_u),
        "part": part,
    }
    return z, u, change.nu, rho, told


def _trajectory(setup: Transcription, z, status: Status) -> Trajectory:
    """The run with these nodes after the first one."""
    count = len(z)
    nodes = jax.vmap(setup.state)(jnp.concatenate([setup.z_start[None], z]), jnp.arange(count + 1))
    phases = nodes.q_s, nodes.q_f, nodes.p_s, nodes.p_f
    failed = np.flatnonzero(np.asarray(status.result) > Result.CONVERGED_AT_ROUNDOFF)
    return Trajectory(
        nodes.t,
        *phases,
        energy=jax.vmap(lambda *z: invariants.energy(setup.system, *z))(*phases),
        constraint_residual=jax.vmap(lambda s: invariants.constraint_residual(setup.system, s))(nodes),
        info=RunInfo(status.method, status.iterations, status.residual),
        result=status.result[failed[0]] if failed.size else jnp.max(status.result),
        failed_at=np.asarray(failed[0] if failed.size else -1),
    )
