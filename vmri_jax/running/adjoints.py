"""Derivatives of runs: what is kept of the steps, and what is computed again.

The derivative of a step is that of the root of its equations (`vmri_jax.steppers.newton.implicit`). Reverse mode goes through the
steps from the last one to the first, and needs where each of them started:

* *stored*: it was kept, with the solution of the step; in all modes and orders that JAX has;
* *checkpoint*: the starts of some steps were kept, those between are computed again, see `Recursive`;
* *reversible*: the step with -H of a symmetric scheme leads back to it, from one saved node to the one before;
* *forward*: not needed, since forward mode is taken instead: one run beside the run for each number that is differentiated by.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree

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
SHORT = 10_000
"""Steps up to which "auto" stores them all."""
GAP = 1e-6
"""What the reversed run may miss a saved node by, relative to the largest position or momentum, without a warning."""
MANY = 100
"""Numbers to differentiate by, from which on "forward" warns."""


def check_adjoint(adjoint: str, scheme: Scheme | Composition) -> None:
    """Refuse an adjoint that there is none of, or that the scheme does not allow."""
    if adjoint not in ADJOINTS:
        raise ValueError(f"simulate: adjoint is {adjoint!r}; it must be one of {', '.join(map(repr, ADJOINTS))}.")
    if adjoint == "reversible" and is_concrete(scheme) and not scheme.is_symmetric:
        raise ValueError(
            "simulate: adjoint='reversible' needs a symmetric scheme, whose step of -H undoes the step of H; "
            "scheme.describe() says which is. Take 'checkpoint'."
        )


def chosen(adjoint: str, scheme: Scheme | Composition, num_steps: int, has_force: bool) -> str:
    """What "auto" stands for: short runs are stored, long ones reversed if they are symmetric and without forces.

    Friction, run backwards, blows errors up.
    """
    if adjoint != "auto":
        return adjoint
    if num_steps <= SHORT:
        return "stored"
    return "reversible" if is_concrete(scheme) and scheme.is_symmetric and not has_force else "checkpoint"


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def telling(kind: str, num_steps: int, arrays):
    """Return the arrays, and warn once which adjoint was chosen if somebody differentiates by them."""
    return arrays


@telling.defjvp
def _told(kind: str, num_steps: int, primals, tangents):
    warnings.warn(
        f"simulate: derivatives of these {num_steps} steps are taken by adjoint={kind!r}, in reverse mode and once. Name one to "
        "choose it: 'stored' for other modes and second derivatives, 'checkpoint', 'reversible', or 'forward' for few parameters.",
        stacklevel=2,
    )
    return primals[0], tangents[0]


def one_or_other(first: Callable, other: Callable, arrays) -> Trajectory:
    """``first(arrays)``, or ``other(arrays)`` if that fails; their derivatives are in reverse mode only."""
    of_real, real = _apart(arrays)
    return _one_or_other(of_real(first), of_real(other), real)


def _apart(arrays) -> tuple[Callable, dict]:
    """The real ones among the leaves by their number, and what makes a function of the arrays one of those."""
    leaves, structure = jax.tree.flatten(arrays)

    def of_real(run):
        return lambda real: run(jax.tree.unflatten(structure, [real.get(i, leaf) for i, leaf in enumerate(leaves)]))

    return of_real, {i: leaf for i, leaf in enumerate(leaves) if _is_real(leaf)}


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _one_or_other(first: Callable, other: Callable, real) -> Trajectory:
    found = first(real)
    return jax.lax.cond(found.failed_at < 0, lambda: found, lambda: other(real))


def _the_one_that_worked(first: Callable, other: Callable, real):
    found, pull = jax.vjp(first, real)
    works = found.failed_at < 0
    return jax.lax.cond(works, lambda: found, lambda: other(real)), (works, pull, real)


def _its_derivative(first: Callable, other: Callable, kept, cotangent: Trajectory):
    works, pull, real = kept
    return (jax.lax.cond(works, lambda: pull(cotangent), lambda: jax.vjp(other, real)[1](cotangent))[0],)


_one_or_other.defvjp(_the_one_that_worked, _its_derivative)


def by_the_other(first: Callable, other: Callable, arrays) -> Trajectory:
    """``first(arrays)``, with the derivative of ``other(arrays)``, which finds the same; in reverse mode only."""
    of_real, real = _apart(arrays)
    return _by_the_other(of_real(first), of_real(other), real)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _by_the_other(first: Callable, other: Callable, real) -> Trajectory:
    return first(real)


def _other_run(first: Callable, other: Callable, real):
    return jax.vjp(other, real)


def _other_derivative(first: Callable, other: Callable, pull, cotangent: Trajectory):
    return pull(cotangent)


_by_the_other.defvjp(_other_run, _other_derivative)


class _Interval(NamedTuple):
    """From one saved node to the next: the states there, and cotangents of the node at its end and of its micro nodes."""

    start: State
    end: State
    at_end: tuple
    q_f_micro: jax.Array


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def reversible(run, engine: Engine, save_every: int, arrays) -> Trajectory:
    """``run(arrays)``, whose derivative in reverse mode steps back with -H from saved node to saved node.

    Args:
        run: a run of `engine` from (leaves, start, macro_dt).
        engine: its `stepper` goes back.
    """
    return run(arrays)


def _run_and_nodes(run, engine: Engine, save_every: int, arrays):
    trajectory = run(arrays)
    return trajectory, (arrays, trajectory.states)


def _stepped_back(run, engine: Engine, save_every: int, kept, cotangent: Trajectory):
    """Cotangents of (leaves, start, macro_dt)."""
    (leaves, _, macro_dt), nodes = only_once(kept)
    at_nodes = (*vars(cotangent.states).values(), cotangent.energy, cotangent.constraint_residual)
    by_real, by_state, by_dt = _back(engine, save_every, leaves, macro_dt, nodes, at_nodes, cotangent.micro)
    by_leaves = [by_real[i] if i in by_real else _no_cotangent(leaf) for i, leaf in enumerate(leaves)]
    return (Arrays(by_leaves, tuple(vars(by_state).values()), by_dt),)


@partial(jax.jit, static_argnums=(0, 1))
def _back(engine: Engine, save_every: int, leaves, macro_dt, nodes: State, at_nodes, at_micro):
    """All steps back: cotangents of the real ones among the leaves by their number, of the start, and of the step.

    A program of its own, so that gradients that are not compiled as a whole do not compile it each time.
    """
    real = {i: jnp.asarray(leaf) for i, leaf in enumerate(leaves) if _is_real(leaf)}

    def complete(real: dict) -> list:
        return [real.get(i, leaf) for i, leaf in enumerate(leaves)]

    def step(real, state: State, macro_dt):
        stepper = engine.stepper(complete(real), state, reverse_only=True)
        state, info, memory = stepper.step(state, stepper.init(state, macro_dt), macro_dt)
        return stepper.project(state, memory)[0], info.q_f_micro

    def node(real, state: State):
        system = engine.stepper(complete(real), state).system
        phase = state.q_s, state.q_f, state.p_s, state.p_f
        return state.t, *phase, invariants.energy(system, *phase), invariants.constraint_residual(system, state)

    back = engine.stepper(leaves, jax.tree.map(lambda a: a[0], nodes))

    def interval(carry, at: _Interval):
        by_real, by_state, by_dt = carry
        by_real, by_state = _plus((by_real, by_state), jax.vjp(node, real, at.end)[1](at.at_end))

        def one(number, carry):
            (state, memory), by_real, by_state, by_dt = carry
            if save_every == 1:
                state = at.start
            else:
                state, info, memory = back.step(state, memory, -macro_dt)
                state, memory = back.project(state, memory)
                state = _where_solved(info.result, state)
            by_micro = jnp.where(number == 0, at.q_f_micro, 0.0)
            more, by_state, more_dt = jax.vjp(step, real, state, macro_dt)[1]((by_state, by_micro))
            return (state, memory), *_plus((by_real,), (more,)), by_state, by_dt + more_dt

        carry = (at.end, back.init(at.end, -macro_dt)), by_real, by_state, by_dt
        (state, _), *carry = jax.lax.fori_loop(0, save_every, one, carry)
        return tuple(carry), _distance(state, at.start)

    times = back.scheme.micro_times
    by_micro = jnp.zeros((engine.num_saves, len(times), nodes.q_f.shape[1]))
    by_dt = jnp.zeros(())
    if at_micro is not None:
        t_micro, by_micro = at_micro
        at_nodes = (at_nodes[0].at[1:].add(t_micro.sum(1)), *at_nodes[1:])
        by_dt -= jnp.sum(t_micro * (1 - times))
    before, after = (jax.tree.map(lambda a, part=part: a[part], nodes) for part in (slice(-1), slice(1, None)))
    xs = _Interval(before, after, tuple(a[1:] for a in at_nodes), by_micro)
    first = jax.tree.map(lambda a: a[0], nodes)
    carry = jax.tree.map(jnp.zeros_like, (real, first)), by_dt
    (by_real, by_state, by_dt), gaps = jax.lax.scan(interval, (*carry[0], by_dt), xs, reverse=True)
    _say_gap(jnp.max(gaps), jnp.argmax(gaps), engine.num_saves)
    by_real, by_state = _plus((by_real, by_state), jax.vjp(node, real, first)[1](tuple(a[0] for a in at_nodes)))
    return by_real, by_state, by_dt


reversible.defvjp(_run_and_nodes, _stepped_back)


def _plus(a, b):
    return jax.tree.map(jnp.add, a, b)


def _where_solved(result, state: State) -> State:
    """A state, or NaN after a step that failed."""
    return jax.tree.map(lambda a: jnp.where(result <= Result.CONVERGED_AT_ROUNDOFF, a, jnp.nan), state)


def _distance(a: State, b: State):
    """Largest difference of positions, and of momenta, relative to the largest of them."""

    def relative(a, b):
        scale = jnp.max(jnp.abs(b), initial=0.0)
        return jnp.max(jnp.abs(a - b), initial=0.0) / jnp.where(scale > 0, scale, 1.0)

    positions, momenta = ([jnp.concatenate(pair(s)) for s in (a, b)] for pair in (_positions, _momenta))
    return jnp.maximum(relative(*positions), relative(*momenta))


def _positions(state: State):
    return state.q_s, state.q_f


def _momenta(state: State):
    return state.p_s, state.p_f


def _say_gap(gap, interval, intervals: int) -> None:
    """Warn where a run that was reversed did not come back to where it had been."""

    def say(gap, interval):
        if not gap <= GAP:
            warnings.warn(
                f"adjoint='reversible': the steps back from saved node {int(interval) + 1} of {intervals} missed the one before "
                f"by {float(gap):.1e} (relative), so that the derivative is as inexact. Save more nodes (a smaller save_every), "
                "make Newton's tolerance smaller, or take adjoint='checkpoint'.",
                stacklevel=2,
            )

    jax.debug.callback(say, gap, interval)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def forward(run, arrays) -> Trajectory:
    """``run(arrays)``, whose derivative in reverse mode is made by forward mode, for all numbers that are differentiated by."""
    return run(arrays)


def _run_and_jacobian(run, arrays):
    """The trajectory; the arrays, and for each that is differentiated by the derivatives of all real outputs by its numbers."""
    marked, structure = jax.tree.flatten(arrays, is_leaf=lambda leaf: hasattr(leaf, "perturbed"))
    values = [leaf.value for leaf in marked]
    wanted = {i: jnp.asarray(leaf.value) for i, leaf in enumerate(marked) if leaf.perturbed and _is_real(leaf.value)}
    flat, apart = ravel_pytree(wanted)
    if flat.size > MANY:
        warnings.warn(
            f"adjoint='forward' runs beside the run for each of the {flat.size} numbers that are differentiated by; "
            "'checkpoint' and 'reversible' cost the same for any number of them.",
            stacklevel=2,
        )

    def real_outputs(wanted: dict):
        trajectory = run(jax.tree.unflatten(structure, [wanted.get(i, value) for i, value in enumerate(values)]))
        return list(filter(_is_real, jax.tree.leaves(trajectory))), trajectory

    def directional_derivative(direction):
        _, tangents, trajectory = jax.jvp(real_outputs, (wanted,), (apart(direction),), has_aux=True)
        return tangents, trajectory

    derivatives, trajectory = jax.vmap(directional_derivative, out_axes=(0, None))(jnp.eye(flat.size))
    by_leaf = apart(jnp.arange(flat.size, dtype=float))
    places = [by_leaf[i].astype(int) if i in by_leaf else None for i in range(len(values))]
    return trajectory, (jax.tree.unflatten(structure, values), places, derivatives)


def _contracted(run, kept, cotangent: Trajectory):
    arrays, places, derivatives = kept
    real = [
        jnp.zeros(d.shape[1:]) if isinstance(c, SymbolicZero) else c
        for c, d in zip(filter(_is_real, jax.tree.leaves(cotangent)), derivatives, strict=True)
    ]
    flat = jnp.sum(jnp.stack([jnp.tensordot(d, c, c.ndim) for c, d in zip(real, derivatives, strict=True)]), axis=0)
    values, structure = jax.tree.flatten(arrays)
    by_values = [_no_cotangent(v) if at is None else flat[at] for v, at in zip(values, places, strict=True)]
    return (jax.tree.unflatten(structure, by_values),)


forward.defvjp(_run_and_jacobian, _contracted, symbolic_zeros=True)


def _is_real(leaf) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


def _no_cotangent(leaf):
    return jnp.zeros_like(leaf) if _is_real(leaf) else np.zeros(leaf.shape, jax.dtypes.float0)
