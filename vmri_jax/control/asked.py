"""Arguments of `minimize`: their checks, the `Transcription` that they make, and the first point."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.control.optimum import Optimum
from vmri_jax.control.search import Point, rolled
from vmri_jax.control.transcription import Transcription, held
from vmri_jax.diagnostics.linear import phase_vector
from vmri_jax.mechanics.arrays import real_array, whole_number
from vmri_jax.mechanics.by_name import ByName
from vmri_jax.mechanics.checks import check_type, describe
from vmri_jax.mechanics.functions import check_arguments, traced_once
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.order import order_of
from vmri_jax.mechanics.state import start_of
from vmri_jax.refusals import Refused
from vmri_jax.running.prepare import prepare
from vmri_jax.schemes.composition import SchemeLike, stage_lengths, stage_scheme
from vmri_jax.schemes.quadrature import NODE_TOLERANCE
from vmri_jax.steppers.plan import plan


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
    problem, actuate, num_controls: int, aims: Mapping, bounds, scheme, macro_dt, num_steps, grid, solver
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
    # A fallback is a branch of the compiled step: `jax.vmap` over all steps would compute both of its sides.
    solver = solver or plan(system, scheme, state).first
    u = np.zeros(num_controls)
    names = problem.names or Names()
    slots = (names.arrays("s", state.q_s.size), names.arrays("f", state.q_f.size))
    actuate = traced_once(ByName(actuate, ("q_s", "q_f", "u", "params"), *slots), order_of(params))
    forces = jax.eval_shape(lambda: actuate(state.q_s, state.q_f, u, params))
    expected = (state.q_s.shape, state.q_f.shape)
    if not isinstance(forces, tuple) or tuple(getattr(f, "shape", None) for f in forces) != expected:
        raise Refused(f"minimize: actuate returns {forces}; it must return slow and fast forces of shapes {expected}.")
    for name, function in aims.items():
        arguments = {"state": state, "u": u} if name in ("cost", "limits") else {"state": state}
        check_arguments(f"minimize: {name}", function, ", ".join(arguments))
        value = jax.eval_shape(lambda f=function, g=arguments: f(*g.values()))
        dimensions, words = (0, "a number") if name in ("cost", "final_cost") else (1, "a vector, (n,)")
        if getattr(value, "ndim", None) != dimensions:
            raise Refused(f"minimize: {name} has {describe(value)}; it must be {words}.")
    functions = {"final_cost": free, "goal": unaimed, **aims}
    return Transcription(
        system.replace(params=params),
        state,
        scheme,
        solver,
        np.asarray(float(macro_dt)),
        traced_once(actuate),
        **{name: traced_once(function) for name, function in functions.items()},
        bounds=_bounds(bounds, num_controls),
        parts=parts,
    )


def _check_durations(scheme: SchemeLike, grid: str, parts: int) -> None:
    """Refuse a scheme whose steps weigh a control by another time than its duration, or see controls of other steps.

    The optimisation has steps with the `parts` controls of their own macro interval, the run has controls by time.
    """
    stage, lengths = stage_scheme(scheme), np.asarray(stage_lengths(scheme))
    rule, starts = stage.force.composite(stage.num_micro), np.cumsum(lengths) - lengths
    times = (starts[:, None] + lengths[:, None] * np.asarray(rule.nodes)).ravel()
    weights = (lengths[:, None] * np.asarray(rule.weights)).ravel()
    shares = weights @ jax.vmap(lambda t: held(t, jnp.eye(parts), 0.0, 1.0 / parts))(times) * parts
    # A run has the mean of two controls at a macro node: as the steps have if their rule weighs both ends alike.
    first, last = (weights[np.abs(times - end) <= NODE_TOLERANCE].sum() for end in (0, 1))
    is_inside = np.all((times >= -NODE_TOLERANCE) & (times <= 1 + NODE_TOLERANCE))
    if not (is_inside and np.allclose([*shares, 1 + first - last], 1, rtol=0, atol=NODE_TOLERANCE)):
        raise Refused(
            f"minimize: scheme is {scheme!r} with grid={grid!r}: the nodes of its force rule do not weigh each control "
            "by its duration, or lie in intervals of other controls. Take a scheme that is no composition, with its "
            "force rule on the micro grid; or grid='macro' and the composition 'suzuki4', whose nodes stay inside."
        )


def free(state):
    """The final cost of a problem without one."""
    return jnp.zeros(())


def unaimed(state):
    """The goal of a problem without one: no equations."""
    return jnp.zeros(0)


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
    """Nodes and controls of the first iteration, without gaps and miss; `start` as of `minimize`."""
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
    u = jnp.asarray(np.clip(controls, *setup.bounds))
    if nodes is None:  # controls start from the motion that they make, without gaps
        nodes, _ = rolled(setup, u)
        if not np.isfinite(nodes).all():
            raise Refused("minimize: the motion with the first controls fails; give another start, or shorter steps.")
    return Point(nodes, u, np.zeros(0), np.zeros(0))


def _resampled(setup: Transcription, start: Optimum, num_steps: int):
    """Nodes (N, n) and controls (N, parts, m) of an optimum, interpolated to another grid of the same duration."""
    run, m = start.trajectory, start.controls.shape[-1]
    old_nodes = np.asarray(phase_vector(run.states))
    duration, expected = float(run.t[-1] - run.t[0]), num_steps * setup.macro_dt
    if abs(duration - expected) > 1e-9 * expected:
        raise Refused(
            f"minimize: start is an Optimum of duration {duration:g}; num_steps macro steps last {expected:g}."
        )
    if m != len(setup.bounds[0]) or old_nodes.shape[1] != setup.z_start.size:
        raise Refused("minimize: start is an Optimum of another system or other controls; give one of this problem.")
    t = float(setup.start.t) + setup.macro_dt * np.arange(1, num_steps + 1)
    nodes = np.stack([np.interp(t, np.asarray(run.t), column) for column in old_nodes.T], axis=1)
    # A control is constant over its interval: both grids are compared at the middles of the intervals.
    old_times, times = start.t.ravel(), setup.times(num_steps)
    old_half, half = (duration / old_times.size) / 2, setup.macro_dt / setup.parts / 2
    columns = start.controls.reshape(-1, m).T
    controls = [np.interp(times.ravel() + half, old_times + old_half, column) for column in columns]
    return jnp.asarray(nodes), np.stack(controls, axis=1).reshape(*times.shape, m)
