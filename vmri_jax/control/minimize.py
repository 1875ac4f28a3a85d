"""Optimal control: the controls that bring a system to a goal at the least cost."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from vmri_jax.accuracy.simulate import simulate
from vmri_jax.control import bounded
from vmri_jax.control.asked import actuation_of, started, transcribed
from vmri_jax.control.optimum import Optimum
from vmri_jax.control.search import line_search, update
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.checks import check_number
from vmri_jax.mechanics.state import HasProblem, Problem, problem_of
from vmri_jax.refusals import Refused
from vmri_jax.running.progress import ShowsProgress, progress_to
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import SimulationError
from vmri_jax.steppers.solver import Solver


def minimize(
    problem: Problem | HasProblem,
    cost: Callable,
    *,
    scheme: Scheme | Composition,
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
        RuntimeError: PIQP solves none of the linear-quadratic problems.
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
                change, steepest, stages, final = update(setup, point)
            except bounded.Unsolved:  # the points of earlier iterations are still worth returning
                if not history:
                    raise
                break
            # The merit  cost + rho sum |misses|  is exact for rho above the largest multiplier; twice that leaves a
            # margin.
            nu, rho = change.nu, max(rho, 2 * steepest)
            point, record = line_search(setup, point._replace(gaps=stages.c, goal=final.g), change, rho)
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
