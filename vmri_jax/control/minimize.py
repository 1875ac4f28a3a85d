"""Optimal control: the controls that bring a system to a goal at the least cost."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.accuracy.simulate import simulate
from vmri_jax.control import bounded
from vmri_jax.control.transcription import Point, Transcription, held, line_search, rolled, update
from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.mechanics.arrays import real_array, whole_number
from vmri_jax.mechanics.by_name import ByName
from vmri_jax.mechanics.checks import check_number, check_type, describe, traced
from vmri_jax.mechanics.functions import check_arguments, order_of, traced_once
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of, start_of
from vmri_jax.refusals import Refused
from vmri_jax.running.prepare import prepare
from vmri_jax.running.progress import ShowsProgress, progress_to
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike, stage_lengths, stage_scheme
from vmri_jax.schemes.quadrature import NODE_TOLERANCE
from vmri_jax.steppers.plan import plan
from vmri_jax.steppers.results import SimulationError
from vmri_jax.steppers.solver import Solver

NO_AIMS: dict[str, Callable] = {"final_cost": lambda state: jnp.zeros(()), "goal": lambda state: jnp.zeros(0)}
"""The final cost and the goal of a problem without them."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Controls at the end of the search, and the motion that they make.

    Attributes:
        controls: (N, m), or (N, num_micro, m) for controls on the micro grid.
        t: (N,) or (N, num_micro) starts of the intervals over which each control is constant.
        labels: names of the m controls.
        bounds: (m,) lower and upper bounds of the controls.
        trajectory: the motion at all macro nodes.
        cost: of the motion.
        multipliers: (e,) minus the derivatives of the least cost with respect to the values that the goal is set to.
        miss: largest absolute value of the goal equations.
        over: largest violation of a limit, 0 for none.
        gap: largest distance between the end of a step and the next node, relative to the largest node.
        iterations: number of linear-quadratic problems that were solved.
        success: whether update, gap, miss and over are all below the tolerance.
        problem: the problem with the forces of these controls: ``vm.simulate(optimum.problem, ...)`` runs it again.
        history: of every iteration cost, gap, miss, over, the largest update, and the part of it that was taken.
    """

    controls: Float[np.ndarray, "N ..."]
    t: Float[np.ndarray, "N ..."]
    labels: tuple[str, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    trajectory: Trajectory
    cost: float
    multipliers: Float[np.ndarray, "e"]
    miss: float
    over: float
    gap: float
    iterations: int
    success: bool
    problem: Problem
    history: list[dict] = field(repr=False, default_factory=list)

    def __repr__(self) -> str:
        status = "converged" if self.success else "not converged: the best that was found"
        over = f", limits by {self.over:.1e}" if self.over > 0 else ""
        missed = f"goal missed by {self.miss:.1e}{over}, steps by {self.gap:.1e}"
        return f"cost {self.cost:.8g} after {self.iterations} iterations, {status}; {missed}"


def minimize(
    problem: Problem | HasProblem,
    cost: Callable,
    *,
    scheme: SchemeLike,
    macro_dt: float,
    num_steps: int,
    actuate: Callable | None = None,
    num_controls: int | None = None,
    final_cost: Callable | None = None,
    goal: Callable | None = None,
    bounds: Any = None,
    limits: Callable | None = None,
    start: Any = None,
    grid: Literal["macro", "micro"] = "macro",
    tolerance: float = 1e-8,
    max_iterations: int = 50,
    solver: Solver | None = None,
    progress: ShowsProgress = False,
) -> Optimum:
    """Minimise ``sum_k H (C(z_k, u_k) + C(z_{k+1}, u_k)) / 2 + final_cost(z_N)`` subject to the steps of the scheme and
    ``goal = 0``.

        scene = Scene([Body("cart", 1.0, [0.0])], [Controlled("cart", "force")])

        optimum = vm.control.minimize(
            scene, lambda state, u: u @ u / 2, goal=lambda state: jnp.concatenate([state.q_s - 1.0, state.p_s]),
            bounds=(-5.0, 5.0), scheme=scheme, macro_dt=0.01, num_steps=100,
        )

    Sequential quadratic programming with the nodes among the unknowns: all steps are linearised side by side, and the
    linear-quadratic problem is solved by a Riccati sweep (`vmri_jax.control.riccati`), or by the interior-point method
    of PIQP where there are bounds or limits (extra ``control``), so that time grows with the number of steps.
    Costs enter with their second derivatives, without negative curvature; steps and limits with first ones.

    Args:
        problem: system and start, a scene with `vmri_jax.scene.Controlled` effects or a problem with a dict of params.
        cost: C, cost per time, ``cost(state, u) -> ()``, with a positive second derivative in u.
        scheme, macro_dt, num_steps, solver: as in `simulate`. Forces act on the grid of the scheme for forces.
        actuate: generalised forces of the controls, ``actuate(q_s, q_f, u, params) -> (f_s, f_f)``, of dictionaries if
            the problem has dictionaries; None for a scene.
        num_controls: m, length of u; a scene knows its number.
        final_cost: cost of the last state, ``final_cost(state) -> ()``.
        goal: equations for the last state, ``goal(state) -> (e,)``, zero where the goal is reached.
        bounds: the least and the largest controls, numbers or (m,); None and infinite ones do not bound.
        limits: inequalities, ``limits(state, u) -> (c,)``, not above zero at the end of every interval.
        start: controls of the first iteration, of the shape of `Optimum.controls`, or an `Optimum` of the same
            duration, perhaps on a coarser grid; zero if None.
        grid: controls for every macro interval, or for every micro interval; then no composition.
        tolerance: largest update, gap, miss of the goal and violation of a limit of a converged optimum; updates and
            gaps are relative to the largest node and the largest control.
        max_iterations: largest number of linear-quadratic problems that are solved.
        progress: show cost and misses of each iteration as a bar; without it a long search prints lines.

    Returns:
        The `Optimum`. If the iteration does not converge, its last point, with ``success`` false.

    Raises:
        ImportError: bounds or limits without the package piqp.
        RuntimeError: the first linear-quadratic problem has no solution: the cost is not finite, or not convex in u.
        ValueError, TypeError: bad arguments, functions that return other shapes.
    """
    whole_number("minimize: max_iterations", max_iterations)
    if not check_number("minimize: tolerance", tolerance) > 0:
        raise Refused(f"minimize: tolerance is {tolerance}; it must be positive.")
    actuate, labels = actuation_of(problem, actuate, num_controls)
    opened_problem = problem_of("minimize", problem)
    aims = {"cost": cost, "final_cost": final_cost, "goal": goal, "limits": limits}
    aims = {name: function for name, function in aims.items() if function is not None}
    steps = scheme, macro_dt, num_steps, grid, solver
    setup = transcribed(opened_problem, actuate, len(labels), aims, bounds, *steps)
    point = started(setup, start, num_steps, len(labels), grid)
    rho, history, nu = 1.0, [], np.zeros(0)
    with progress_to("minimize", progress) as tell:
        tell("compiling the steps and their derivatives", 0, max_iterations)
        for count in range(1, max_iterations + 1):
            try:
                change, steepest, point = update(setup, point)
            except bounded.Unsolved:  # the points of earlier iterations are still worth returning
                if not history:
                    raise
                break
            # The merit  cost + rho sum |misses|  is exact for rho above the largest multiplier; twice that leaves a
            # margin.
            nu, rho = change.nu, max(rho, 2 * steepest)
            point, record = line_search(setup, point, change, rho)
            history.append(record)
            words = f"cost {record['cost']:.6g}, goal {record['miss']:.1e}, steps {record['gap']:.1e}"
            tell(words, count, max_iterations)
            if max(record["update"], record["gap"]) <= tolerance or record["part"] == 0.0:
                break
    last = history[-1]
    success = all(last[name] <= tolerance for name in ("update", "gap", "miss", "over"))
    driven = replace(opened_problem, system=setup.driven(point.u, setup.start.t))
    # The last nodes may have gaps; the trajectory is the motion that the controls make.
    try:
        trajectory = simulate(driven, scheme, macro_dt=macro_dt, num_steps=num_steps, solver=setup.solver)
    except SimulationError as failure:
        trajectory = failure.trajectory
    controls, times = np.asarray(point.u), setup.times(num_steps)
    if grid == "macro":
        controls, times = controls[:, 0], times[:, 0]
    reached = {name: last[name] for name in ("cost", "miss", "over", "gap")} | {"multipliers": np.asarray(nu)}
    ended = {"iterations": len(history), "success": success, "problem": driven, "history": history}
    return Optimum(controls, times, labels, setup.bounds, trajectory, **reached, **ended)


def actuation_of(problem, actuate, num_controls) -> tuple[Callable, tuple[str, ...]]:
    """The function that turns controls into generalised forces, and the names of the controls."""
    scene_actuation = getattr(problem, "actuation", None)
    if actuate is None:
        if scene_actuation is None:
            effects = 'Controlled effects, e.g. Controlled("hub", "torque")'
            raise Refused(f"minimize: nothing is controlled; give a scene with {effects}, or actuate and num_controls.")
        count = len(scene_actuation.labels)
        if num_controls not in (None, count):
            raise Refused(f"minimize: num_controls is {num_controls}; the scene has {count} controls.")
        return scene_actuation, scene_actuation.labels
    if scene_actuation is not None:
        raise Refused("minimize: actuate is given, and the scene has Controlled effects; leave one of them out.")
    whole_number("minimize: num_controls", num_controls)
    check_arguments("minimize: actuate", actuate, "q_s, q_f, u, params")
    return actuate, tuple(f"u {i}" for i in range(num_controls)) if num_controls > 1 else ("u",)


def transcribed(
    problem, actuate, num_controls: int, aims: dict, bounds, scheme, macro_dt, num_steps, grid, solver
) -> Transcription:
    """The optimal control problem on the grid of the scheme, from the arguments of `minimize`, which are checked.

    `aims` has the functions cost, final_cost, goal and limits by name, as far as they are given.
    """
    whole_number("minimize: num_steps", num_steps)
    if grid not in ("macro", "micro"):
        raise Refused(f"minimize: grid is {grid!r}; it must be 'macro' or 'micro'.")
    system, state = start_of("minimize", problem, None)
    params = {} if system.params is None else system.params
    check_type("minimize: system.params", params, Mapping, "a dict, or None")
    prepare(problem, scheme, macro_dt=macro_dt, num_steps=1, solver=solver)  # makes the checks of a run
    parts = scheme.num_micro if grid == "micro" else 1
    _check_durations(scheme, grid, parts)
    u = np.zeros(num_controls)
    names = problem.names or Names()
    slots = (names.arrays("s", state.q_s.size), names.arrays("f", state.q_f.size))
    actuate = traced_once(ByName(actuate, ("q_s", "q_f", "u", "params"), *slots), order_of(params))
    with traced("minimize: actuate"):
        forces = jax.eval_shape(actuate, state.q_s, state.q_f, u, params)
    expected = (state.q_s.shape, state.q_f.shape)
    if not isinstance(forces, tuple) or tuple(getattr(f, "shape", None) for f in forces) != expected:
        raise Refused(f"minimize: actuate returns {forces}; it must return slow and fast forces of shapes {expected}.")
    for name, function in aims.items():
        arguments = {"state": state, "u": u} if name in ("cost", "limits") else {"state": state}
        check_arguments(f"minimize: {name}", function, ", ".join(arguments))
        with traced(f"minimize: {name}"):
            value = jax.eval_shape(function, *arguments.values())
        dimensions, words = (0, "a number") if name in ("cost", "final_cost") else (1, "a vector, (n,)")
        if getattr(value, "ndim", None) != dimensions:
            raise Refused(f"minimize: {name} has {describe(value)}; it must be {words}.")
    setup = Transcription(
        system.replace(params=params),
        state,
        scheme,
        solver or Solver(),
        np.asarray(float(macro_dt)),
        traced_once(actuate),
        **{name: traced_once(function) for name, function in (NO_AIMS | aims).items()},
        bounds=_bounds(bounds, num_controls),
        parts=parts,
    )
    # The system of the plan has forces. A fallback is a branch of the compiled step: `jax.vmap` over all steps would
    # compute both of its sides.
    driven = setup.driven(np.zeros((1, parts, num_controls)), state.t)
    return replace(setup, solver=solver or plan(driven, scheme, state).first)


def _check_durations(scheme: SchemeLike, grid: str, parts: int) -> None:
    """Refuse a scheme whose steps weigh a control by another time than its duration, or see controls of other steps.

    The optimisation has steps with the `parts` controls of their own macro interval, the run has controls by time.
    """
    stage, lengths = stage_scheme(scheme), np.asarray(stage_lengths(scheme))
    rule, starts = stage.force.composite(stage.num_micro), np.cumsum(lengths) - lengths
    times = (starts[:, None] + lengths[:, None] * np.asarray(rule.nodes)).ravel()
    weights = (lengths[:, None] * np.asarray(rule.weights)).ravel()
    shares = weights @ np.stack([held(t, np.eye(parts), 0.0, 1.0 / parts) for t in times]) * parts
    # A run has the mean of two controls at a macro node: as the steps have if their rule weighs both ends alike.
    first, last = (weights[np.abs(times - end) <= NODE_TOLERANCE].sum() for end in (0, 1))
    is_inside = np.all((times >= -NODE_TOLERANCE) & (times <= 1 + NODE_TOLERANCE))
    if not (is_inside and np.allclose([*shares, 1 + first - last], 1, rtol=0, atol=NODE_TOLERANCE)):
        raise Refused(
            f"minimize: scheme is {scheme!r} with grid={grid!r}: the nodes of its force rule do not weigh each control "
            "by its duration, or lie in intervals of other controls. Take a scheme that is no composition, with its "
            "force rule on the micro grid; or grid='macro' and the composition 'suzuki4', whose nodes stay inside."
        )


def _bounds(bounds, num_controls: int) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest controls, (m,) each."""
    bounds = (None, None) if bounds is None else bounds
    if not isinstance(bounds, tuple) or len(bounds) != 2:
        raise Refused(f"minimize: bounds is {bounds!r}; give (least, largest), each a number or ({num_controls},).")
    ends = [unbounded if side is None else side for side, unbounded in zip(bounds, (-np.inf, np.inf), strict=True)]
    sides = [np.asarray(real_array("minimize: bounds", end)) for end in ends]
    if any(side.shape not in ((), (num_controls,)) for side in sides):
        shapes = " and ".join(str(side.shape) for side in sides)
        raise Refused(f"minimize: bounds have shapes {shapes}; each is a number or ({num_controls},).")
    lower, upper = (np.broadcast_to(side, (num_controls,)) for side in sides)
    if not np.all(lower < upper):
        raise Refused(f"minimize: bounds are {lower} and {upper}; the least controls must be below the largest.")
    return lower, upper


def started(setup: Transcription, start, num_steps: int, num_controls: int, grid: str) -> Point:
    """Nodes and controls of the first iteration, without gaps; `start` as of `minimize`."""
    nodes, shape = None, (num_steps, setup.parts, num_controls)
    if isinstance(start, Optimum):
        nodes, controls = _resampled(setup, start, num_steps)
    elif start is None:
        controls = np.zeros(shape)
    else:
        controls = np.asarray(real_array("minimize: start", start))
        expected = shape if grid == "micro" else (shape[0], shape[2])
        if controls.shape != expected:
            raise Refused(f"minimize: start has shape {controls.shape}; the controls have {expected}.")
        controls = controls.reshape(shape)
    u = np.clip(controls, *setup.bounds)
    if nodes is None:  # controls start from the motion that they make, without gaps
        nodes = rolled(setup, u)
        if not np.isfinite(nodes).all():
            raise Refused("minimize: the motion with the first controls fails; give another start, or shorter steps.")
    return Point(nodes, u, np.zeros(0))


def _resampled(setup: Transcription, start: Optimum, num_steps: int):
    """Nodes (N, n) and controls (N, parts, m) of an optimum, interpolated to another grid of the same duration."""
    run, m = start.trajectory, start.controls.shape[-1]
    old_nodes = phase_vector(run.states)
    duration, expected = float(run.t[-1] - run.t[0]), num_steps * setup.macro_dt
    if abs(duration - expected) > 1e-9 * expected:
        raise Refused(
            f"minimize: start is an Optimum of duration {duration:g}; num_steps macro steps last {expected:g}."
        )
    if m != len(setup.bounds[0]) or old_nodes.shape[1] != phase_vector(setup.start).size:
        raise Refused("minimize: start is an Optimum of another system or other controls; give one of this problem.")
    t = float(setup.start.t) + setup.macro_dt * np.arange(1, num_steps + 1)
    nodes = np.stack([np.interp(t, np.asarray(run.t), column) for column in old_nodes.T], axis=1)
    # A control is constant over its interval: both grids are compared at the middles of the intervals.
    old_times, times = start.t.ravel(), setup.times(num_steps)
    old_half, half = (duration / old_times.size) / 2, setup.macro_dt / setup.parts / 2
    columns = start.controls.reshape(-1, m).T
    controls = [np.interp(times.ravel() + half, old_times + old_half, column) for column in columns]
    return nodes, np.stack(controls, axis=1).reshape(*times.shape, m)
