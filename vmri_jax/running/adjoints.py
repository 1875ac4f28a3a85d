"""Derivatives of runs: which states are stored for reverse mode, and which are computed again.

The derivative of a step is the derivative of the root of its equations (`vmri_jax.steppers.newton.implicit`). Reverse mode visits
the steps from the last to the first and needs the state at which each step started. Four adjoints provide this state:

* *stored*: the run keeps the start of every step and the solution of its equations; works in forward and reverse mode, up to second
  derivatives; third derivatives are NaN where equations are solved by iteration;
* *checkpoint*: the run keeps the starts of some steps and computes the steps between them again, see `Recursive`;
* *reversible*: a step of length -macro_dt of a symmetric scheme undoes the step before it, so that the run is stepped back from each saved
  node to the one before;
* *forward*: no start is needed: forward mode computes one tangent run for each number in which the run is differentiated.
"""

import warnings
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.state import State
from vmri_jax.running.engine import Arrays, Engine
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton.implicit import only_once
from vmri_jax.steppers.results import Result

ADJOINTS = ("auto", "stored", "checkpoint", "reversible", "forward")
LONGEST_STORED_RUN = 10_000
"""Macro steps of the longest run for which "auto" stores the start of every step; a larger value takes more memory."""
REPORTED_GAP = 1e-6
"""Distance between the reversed run and a saved node, relative to the largest position or momentum, above which the user is warned;
with a larger value inexact gradients pass in silence."""
MOST_TANGENTS = 100
"""Numbers to differentiate by, above which "forward" warns: it computes a tangent run for each. A larger value warns later."""


def check_adjoint(adjoint: str, scheme: Scheme | Composition) -> None:
    """Refuse an unknown adjoint, and "reversible" with a scheme that is not symmetric."""
    if adjoint not in ADJOINTS:
        raise ValueError(f"simulate: adjoint is {adjoint!r}; it must be one of {', '.join(map(repr, ADJOINTS))}.")
    if adjoint == "reversible" and is_concrete(scheme) and not scheme.is_symmetric:
        raise ValueError(
            "simulate: adjoint='reversible' needs a symmetric scheme, whose step of -macro_dt undoes the step of macro_dt; "
            "scheme.describe() says whether a scheme is symmetric. Take 'checkpoint'."
        )


def chosen_adjoint(adjoint: str, scheme: Scheme | Composition, num_steps: int, has_force: bool) -> str:
    """The adjoint that "auto" stands for: "stored" for short runs, "reversible" for long runs of symmetric schemes without forces.

    All other long runs get "checkpoint". Runs with forces are not reversed: friction, run backwards, amplifies errors.
    """
    if adjoint != "auto":
        return adjoint
    if num_steps <= LONGEST_STORED_RUN:
        return "stored"
    return "reversible" if is_concrete(scheme) and scheme.is_symmetric and not has_force else "checkpoint"


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def announced(kind: str, num_steps: int, arrays):
    """Return the arrays; whoever differentiates in them is warned once which adjoint was chosen."""
    return arrays


@announced.defjvp
def _announce(kind: str, num_steps: int, primals, tangents):
    warnings.warn(
        f"simulate: derivatives of these {num_steps} steps use adjoint={kind!r}, which gives first derivatives in reverse mode only. "
        "To choose, give adjoint='stored' (all modes, second derivatives), 'checkpoint', 'reversible', or 'forward' (few parameters).",
        stacklevel=2,
    )
    return primals[0], tangents[0]


def with_fallback(first: Callable, fallback: Callable, arrays) -> Trajectory:
    """``first(arrays)``, or ``fallback(arrays)`` if the first run fails; with derivatives in reverse mode only."""
    of_real, real = _real_leaves(arrays)
    return _with_fallback(of_real(first), of_real(fallback), real)


def _real_leaves(arrays) -> tuple[Callable, dict]:
    """``of_real, real``: `real` has the floating-point leaves by number, ``of_real(run)`` is the run as a function of `real`."""
    leaves, structure = jax.tree.flatten(arrays)

    def of_real(run):
        return lambda real: run(jax.tree.unflatten(structure, [real.get(i, leaf) for i, leaf in enumerate(leaves)]))

    return of_real, {i: jnp.asarray(leaf) for i, leaf in enumerate(leaves) if _is_real(leaf)}


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _with_fallback(first: Callable, fallback: Callable, real) -> Trajectory:
    trajectory = first(real)
    return jax.lax.cond(trajectory.failed_at < 0, lambda: trajectory, lambda: fallback(real))


def _fallback_forward(first: Callable, fallback: Callable, real):
    trajectory, pull = jax.vjp(first, real)
    works = trajectory.failed_at < 0
    return jax.lax.cond(works, lambda: trajectory, lambda: fallback(real)), (works, pull, real)


def _fallback_backward(first: Callable, fallback: Callable, residuals, cotangent: Trajectory):
    works, pull, real = residuals
    # The fallback runs again here: to keep its residuals would make every run pay for them.
    return (jax.lax.cond(works, lambda: pull(cotangent), lambda: jax.vjp(fallback, real)[1](cotangent))[0],)


_with_fallback.defvjp(_fallback_forward, _fallback_backward)


def differentiated_by(exact: Callable, run: Callable, arrays) -> Trajectory:
    """``run(arrays)``. Under differentiation (reverse mode only) `exact` replaces `run`, for the value, too.

    Both runs solve the same equations to the tolerance of the solver.
    """
    of_real, real = _real_leaves(arrays)
    return _differentiated_by(of_real(exact), of_real(run), real)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _differentiated_by(exact: Callable, run: Callable, real) -> Trajectory:
    return run(real)


_differentiated_by.defvjp(
    lambda exact, run, real: jax.vjp(exact, real), lambda exact, run, pull, cotangent: pull(cotangent)
)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def reversible(run, engine: Engine, save_every: int, arrays) -> Trajectory:
    """``run(arrays)``, whose derivative in reverse mode steps back with -macro_dt from saved node to saved node.

    Args:
        run: function of `Arrays`, a run of `engine`.
        engine: its `stepper` takes the steps of -H.
        save_every: macro steps from one saved node to the next.
    """
    return run(arrays)


def _run_and_nodes(run, engine: Engine, save_every: int, arrays):
    trajectory = run(arrays)
    return trajectory, (arrays, trajectory.states)


def _stepped_back(run, engine: Engine, save_every: int, residuals, cotangent: Trajectory):
    """Cotangents of `Arrays`."""
    (leaves, _, macro_dt), nodes = only_once(residuals)
    at_nodes = (*vars(cotangent.states).values(), cotangent.energy, cotangent.constraint_residual)
    by_real, by_state, by_dt = _back(engine, save_every, leaves, macro_dt, nodes, (at_nodes, cotangent.micro))
    by_leaves = [by_real[i] if i in by_real else _no_cotangent(leaf) for i, leaf in enumerate(leaves)]
    return (Arrays(by_leaves, tuple(vars(by_state).values()), by_dt),)


@partial(jax.jit, static_argnums=(0, 1))
def _back(engine: Engine, save_every: int, leaves, macro_dt, nodes: State, cotangents):
    """All steps back: cotangents of the floating-point leaves by number, of the start, and of the macro step.

    Jitted for itself: a gradient outside of `jax.jit` would compile these loops at every call.
    """
    at_nodes, at_micro = cotangents
    of_real, real = _real_leaves(leaves)
    complete = of_real(list)

    def step(real, state: State, macro_dt):
        stepper = engine.stepper(complete(real), state, reverse_only=True)
        state, info, memory = stepper.step(state, stepper.init(state, macro_dt), macro_dt)
        return stepper.project(state, memory)[0], info.q_f_micro

    def node(real, state: State):
        system = engine.stepper(complete(real), state).system
        phase = state.q_s, state.q_f, state.p_s, state.p_f
        return state.t, *phase, *invariants.energy_and_constraint_residual(system, state)

    back = engine.stepper(leaves, jax.tree.map(lambda a: a[0], nodes))

    def interval_back(carry, interval):
        by_real, by_state, by_dt = carry
        # saved nodes, and cotangents of the node at the end and of its micro nodes
        start, end, by_end, by_micro = interval
        # The saved node at the end contributes its own cotangent before the steps that lead to it.
        by_real, by_state = _plus((by_real, by_state), jax.vjp(node, real, end)[1](by_end))

        def step_back(number, carry):
            (state, memory), by_real, by_state, by_dt = carry
            if save_every == 1:  # the start of the step is a saved node: nothing has to be reversed
                state = start
            else:
                state, info, memory = back.step(state, memory, -macro_dt)
                state, memory = back.project(state, memory)
                solved = info.result <= Result.CONVERGED_AT_ROUNDOFF
                state = jax.tree.map(lambda a: jnp.where(solved, a, jnp.nan), state)
            # Only the last step of the interval saves micro nodes.
            by_end_of_step = by_state, jnp.where(number == 0, by_micro, 0.0)
            by_real_of_step, by_state, by_dt_of_step = jax.vjp(step, real, state, macro_dt)[1](by_end_of_step)
            return (state, memory), *_plus((by_real,), (by_real_of_step,)), by_state, by_dt + by_dt_of_step

        carry = (end, back.init(end, -macro_dt)), by_real, by_state, by_dt
        (state, _), *carry = jax.lax.fori_loop(0, save_every, step_back, carry)
        return tuple(carry), _distance(state, start)

    times = back.scheme.micro_times
    by_micro = jnp.zeros((engine.num_saves, len(times), nodes.q_f.shape[1]))
    by_dt = jnp.zeros(())
    if at_micro is not None:
        # t_micro = t_end - macro_dt (1 - c) with the micro times c: its cotangent goes to the node's time and to macro_dt.
        t_micro, by_micro = at_micro
        at_nodes = (at_nodes[0].at[1:].add(t_micro.sum(1)), *at_nodes[1:])
        by_dt -= jnp.sum(t_micro * (1 - times))
    before, after = (jax.tree.map(lambda a, part=part: a[part], nodes) for part in (slice(-1), slice(1, None)))
    xs = before, after, tuple(a[1:] for a in at_nodes), by_micro
    first = jax.tree.map(lambda a: a[0], nodes)
    carry = jax.tree.map(jnp.zeros_like, (real, first)), by_dt
    (by_real, by_state, by_dt), gaps = jax.lax.scan(interval_back, (*carry[0], by_dt), xs, reverse=True)
    _warn_of_gap(jnp.max(gaps), jnp.argmax(gaps), engine.num_saves)
    by_real, by_state = _plus((by_real, by_state), jax.vjp(node, real, first)[1](tuple(a[0] for a in at_nodes)))
    return by_real, by_state, by_dt


reversible.defvjp(_run_and_nodes, _stepped_back)


def _plus(a, b):
    return jax.tree.map(jnp.add, a, b)


def _distance(a: State, b: State):
    """Larger of two differences: of positions relative to the largest position, and of momenta relative to the largest momentum."""

    def relative(a, b):
        scale = jnp.max(jnp.abs(b), initial=0.0)
        return jnp.max(jnp.abs(a - b), initial=0.0) / jnp.where(scale > 0, scale, 1.0)

    positions = [jnp.concatenate([state.q_s, state.q_f]) for state in (a, b)]
    momenta = [jnp.concatenate([state.p_s, state.p_f]) for state in (a, b)]
    return jnp.maximum(relative(*positions), relative(*momenta))


def _warn_of_gap(gap, interval, intervals: int) -> None:
    """Warn where the reversed run missed a saved node of the run."""

    def warn(gap, interval):
        if not gap <= REPORTED_GAP:
            warnings.warn(
                f"adjoint='reversible': the steps back from saved node {int(interval) + 1} of {intervals} missed the one before "
                f"by {float(gap):.1e} (relative), so that the derivative is as inexact. Save more nodes (a smaller save_every), "
                "make Newton's tolerance smaller, or take adjoint='checkpoint'.",
                stacklevel=2,
            )

    jax.debug.callback(warn, gap, interval)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def forward(run, arrays) -> Trajectory:
    """``run(arrays)``, whose derivative in reverse mode is the Jacobian of forward mode, transposed."""
    return run(arrays)


def _run_and_jacobian(run, arrays):
    """The trajectory, and for reverse mode: the arrays, and the Jacobian of all real outputs by the wanted leaves, by number."""
    marked, structure = jax.tree.flatten(arrays, is_leaf=lambda leaf: hasattr(leaf, "perturbed"))
    values = [leaf.value for leaf in marked]
    wanted = {i: jnp.asarray(leaf.value) for i, leaf in enumerate(marked) if leaf.perturbed and _is_real(leaf.value)}
    numbers = sum(leaf.size for leaf in wanted.values())
    if numbers > MOST_TANGENTS:
        warnings.warn(
            f"adjoint='forward' computes one tangent run for each of the {numbers} numbers that you differentiate by; "
            "the cost of 'checkpoint' and 'reversible' does not depend on their number.",
            stacklevel=2,
        )

    def real_outputs(wanted: dict):
        trajectory = run(jax.tree.unflatten(structure, [wanted.get(i, value) for i, value in enumerate(values)]))
        return list(filter(_is_real, jax.tree.leaves(trajectory))), trajectory

    derivatives, trajectory = jax.jacfwd(real_outputs, has_aux=True)(wanted)
    return trajectory, (jax.tree.unflatten(structure, values), derivatives)


def _contracted(run, residuals, cotangent: Trajectory):
    arrays, derivatives = residuals
    by_outputs = zip(filter(_is_real, jax.tree.leaves(cotangent)), derivatives, strict=True)
    known = [(c, by_leaf) for c, by_leaf in by_outputs if not isinstance(c, SymbolicZero)]

    def cotangent_of(i: int, value):
        by_value = [jnp.tensordot(c, by_leaf[i], c.ndim) for c, by_leaf in known if i in by_leaf]
        return sum(by_value) if by_value else _no_cotangent(value)

    values, structure = jax.tree.flatten(arrays)
    return (jax.tree.unflatten(structure, [cotangent_of(i, value) for i, value in enumerate(values)]),)


forward.defvjp(_run_and_jacobian, _contracted, symbolic_zeros=True)


def _is_real(leaf) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


def _no_cotangent(leaf):
    return jnp.zeros_like(leaf) if _is_real(leaf) else np.zeros(leaf.shape, jax.dtypes.float0)
