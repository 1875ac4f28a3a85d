"""One macro step: momenta in, momenta out, by the cheapest route that the rules and the system allow.

The route is chosen statically, by `split` and `is_explicit`:

* *kicks*: potentials at the ends of the interval only shift momenta, before and after everything else; a mollified one
  does so from averaged positions;
* *split*: if, kicks aside, the slow equations do not see the fast unknowns, the slow variables make one step over the
  macro interval and the fast ones num_micro steps over the micro intervals, each a problem of the same kind;
* *explicit*: an interval on which nothing but constant-mass kinetic energy is left is a straight drift, no Newton;
* *coupled*: everything else is solved at once by Newton's iteration; a drift along constraints for the multipliers alone.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.cpu import ELEMENTWISE
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.state import State, project_momentum
from vmri_jax.mechanics.system import ConstantMass, System
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.equations import StepEquations, physical_multipliers
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import (
    IntervalMatrix,
    Newton,
    drift,
    interval_matrix,
    is_collocation,
    is_constant,
    march,
    solve,
)
from vmri_jax.steppers.newton.interval import is_linear
from vmri_jax.steppers.results import Method, Result
from vmri_jax.steppers.split import fast_alone, is_drift, is_explicit, macro_kicks, split

LARGE = 200
"""From so many fast variables on it matters what goes through the vector registers and the caches."""
TOGETHER = 4
"""So many linear micro steps of a large system come at a time."""


class StepInfo(eqx.Module):
    """What a macro step did.

    result: status code, see `Result`.
    method: code of how its equations were solved, see `Method`; with "auto" ARROWHEAD says that it fell back.
    iterations: Newton iterations (the most that any of its solves took; 0 for explicit steps).
    residual: largest residual left, relative to the momentum, and of the constraints; 0 where equations are linear.
    q_f_micro: (num_micro, n_f) fast positions at the micro nodes, the start excluded.
    multiplier, slow_multiplier: (num_micro, r, n_g) and (r, n_gs) Lagrange multipliers at the control nodes; of the
        stages of a composition one after the other, (s r, n_gs).
    """

    result: Any
    method: Any
    iterations: Any
    residual: Any
    q_f_micro: Any
    multiplier: Any
    slow_multiplier: Any


class Memory(NamedTuple):
    """What a step hands to the next: gradients of the kicks at the node they share, and what Newton starts from.

    matrix: of the micro intervals, computed once per run where it is constant, else once per macro step or fewer.
    """

    kicks: Any
    velocity: Any
    multiplier: Any
    slow_multiplier: Any
    matrix: Any = None
    warm: Any = None
    parts: Any = None


def macro_step(
    system: System, scheme: Scheme | Composition, state: State, macro_dt, newton: Newton | None = None
) -> tuple[State, StepInfo]:
    """One macro step, ``(state, info) = macro_step(system, scheme, state, macro_dt)``; pure and not compiled.

    The momenta returned are projected onto the hidden constraints, ``G v + dg/dt = 0``. `simulate` takes many steps faster:
    it reuses gradients and starts Newton from the step before.

    Args:
        system, scheme: what moves, and how.
        state: a consistent state, from `initial_state` or a former step.
        macro_dt: length H of the macro step, positive.
        newton: how implicit equations are solved.
    """
    newton = newton or Newton()
    memory = start_memory(system, scheme, state, macro_dt, newton)
    state, info, _ = advance(system, scheme, state, macro_dt, newton, memory)
    return state, info


class Stages(NamedTuple):
    """Memory of a composition: what the last stage hands to the next one, and every stage's own (stacked)."""

    last: Memory
    own: Memory


def start_memory(
    system: System, scheme: Scheme | Composition, state: State, macro_dt, newton: Newton
) -> Memory | Stages:
    """Memory of a first step: gradients evaluated, velocity from the momentum, multipliers zero."""
    if isinstance(scheme, Composition):
        own = jax.vmap(lambda c: start_memory(system, scheme.scheme, state, c * macro_dt, newton))(
            jnp.asarray(scheme.coefficients)
        )
        return Stages(jax.tree.map(lambda a: a[0], own), own)  # pyright: ignore[reportArgumentType]
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    if isinstance(system.kinetic, ConstantMass):  # the velocity is at hand, with the momentum
        velocity, kept = system.kinetic.velocity(state.p_s, state.p_f), None
    else:
        velocity = kept = project_momentum(system, state)[2:]
    parts = split(system, scheme, state.q_s, state.q_f)
    memories = None
    if parts is not None:
        slow, fast = _slow_and_fast(state)
        memories = (
            start_memory(parts.slow, parts.slow_scheme, slow, macro_dt, newton),
            start_memory(parts.fast, parts.fast_scheme, fast, macro_dt / scheme.num_micro, newton),
        )
    average = averaging(system, scheme, macro_dt, newton)
    kicks = _kick_gradients(macro_kicks(system, scheme, parts), state.q_s, state.q_f, average)
    matrix = warm = None
    solved = parts is None and not is_explicit(system, scheme) and newton.marches(system, scheme)
    if solved and is_drift(system, scheme):
        warm = drift.Warm.none(n_g + n_gs)
    elif solved and not is_collocation(system, scheme, state.q_s, state.q_f):
        equations = _equations(system, scheme, state, macro_dt)
        if is_constant(system, scheme, state.q_s, state.q_f):
            matrix = interval_matrix(equations)
        else:  # renewed by every macro step
            matrix = IntervalMatrix.none(system, scheme, state.q_f)
        warm = march.Warm.straight(equations, velocity[0])
    return Memory(kicks, kept, jnp.zeros(n_g), jnp.zeros(n_gs), matrix, warm, memories)


def _renew_matrix(system, scheme, state, macro_dt, newton, memory: Memory) -> Memory:
    """The matrix of the micro intervals at the start of this macro step, unless it is constant.

    A large one is kept for as long as it costs no passes; a number of passes that is fixed needs a new one.
    """
    parts = split(system, scheme, state.q_s, state.q_f)
    if parts is not None:
        slow, fast = _slow_and_fast(state)
        slow_memory, fast_memory = memory.parts
        slow_memory = _renew_matrix(parts.slow, parts.slow_scheme, slow, macro_dt, newton, slow_memory)
        micro_dt = macro_dt / scheme.num_micro
        fast_memory = _renew_matrix(parts.fast, parts.fast_scheme, fast, micro_dt, newton, fast_memory)
        return memory._replace(parts=(slow_memory, fast_memory))
    if memory.matrix is None or is_constant(system, scheme, state.q_s, state.q_f):
        return memory
    equations = _equations(system, scheme, state, macro_dt)
    if memory.matrix.inverse.ndim == 3 or len(memory.matrix.inverse) <= ELEMENTWISE or newton.fixed_iterations:
        return memory._replace(matrix=interval_matrix(equations))
    stale = memory.warm.is_stale
    matrix = jax.lax.cond(stale, lambda: interval_matrix(equations), lambda: memory.matrix)
    return memory._replace(matrix=matrix, warm=memory.warm.renewed(stale))


def _equations(system, scheme, state, macro_dt) -> StepEquations:
    return StepEquations(system, scheme, state.t, state.q_s, state.q_f, state.p_s, state.p_f, macro_dt)


def projected(system: System, state: State, memory):
    """State and memory with momenta on the hidden constraints."""

    def is_warm(part):
        return isinstance(part, drift.Warm)

    at_hand = isinstance(system.kinetic, ConstantMass)  # the velocity, with the momentum
    p_s, p_f, *velocity = project_momentum(system, state, None if at_hand else memory.velocity)
    memory = jax.tree.map(lambda part: part.projected() if is_warm(part) else part, memory, is_leaf=is_warm)
    memory = memory if at_hand else memory._replace(velocity=tuple(velocity))
    return State(state.t, state.q_s, state.q_f, p_s, p_f), memory


def advance(
    system: System, scheme: Scheme | Composition, state: State, macro_dt, newton: Newton, memory, project: bool = True
):
    """`macro_step` that takes and hands on a memory: (state, info, memory).

    Args:
        project: whether the momenta are projected.
    """
    if isinstance(scheme, Composition):
        return _advance_stages(system, scheme, state, macro_dt, newton, memory, project)
    memory = _renew_matrix(system, scheme, state, macro_dt, newton, memory)
    state, info, memory = _interval(system, scheme, state, macro_dt, newton, memory)
    if project:
        state, memory = projected(system, state, memory)
    finite = jnp.all(jnp.isfinite(state.p_s)) & jnp.all(jnp.isfinite(state.p_f))  # positions become infinite by these
    return state, dataclasses.replace(info, result=jnp.where(finite, info.result, Result.NON_FINITE)), memory


def _advance_stages(system, scheme, state, macro_dt, newton, memory: Stages, project: bool):
    """The stages of a composition, one after the other."""

    def stage(carry, at):
        (state, last), (c, own) = carry, at
        memory = _at_same_point(own, last)
        if scheme.scheme.slow.mollified:  # the average depends on the length of the stage
            average = averaging(system, scheme.scheme, c * macro_dt, newton)
            parts = split(system, scheme.scheme, state.q_s, state.q_f)
            terms = macro_kicks(system, scheme.scheme, parts)
            memory = memory._replace(kicks=_kick_gradients(terms, state.q_s, state.q_f, average))
        state, info, memory = advance(system, scheme.scheme, state, c * macro_dt, newton, memory, project)
        return (state, memory), (memory, info)

    stages = jnp.asarray(scheme.coefficients), memory.own
    (state, last), (own, infos) = jax.lax.scan(stage, (state, memory.last), stages)
    worst = {name: jnp.max(getattr(infos, name)) for name in ("result", "method", "iterations", "residual")}
    along = {name: jnp.concatenate(getattr(infos, name)) for name in ("q_f_micro", "multiplier", "slow_multiplier")}
    return state, StepInfo(**worst, **along), Stages(last, own)


def _at_same_point(own: Memory, last: Memory) -> Memory:
    """What a stage learned in the macro step before, with what belongs to its starting point from the stage before."""
    parts = None if own.parts is None else tuple(map(_at_same_point, own.parts, last.parts))
    warm = None if own.warm is None else own.warm.after(last.warm)
    return last._replace(matrix=own.matrix, warm=warm, parts=parts)


def _interval(system, scheme, state, macro_dt, newton, memory):
    """Kick, move, kick; momenta are not projected."""
    terms = macro_kicks(system, scheme, split(system, scheme, state.q_s, state.q_f))
    state = _kick(terms, state, macro_dt, memory.kicks, ("start",))
    state, info, memory = _move(system, scheme, state, macro_dt, newton, memory)
    kicks = _kick_gradients(terms, state.q_s, state.q_f, averaging(system, scheme, macro_dt, newton))
    state = _kick(terms, state, macro_dt, kicks, ("end",))
    return state, info, memory._replace(kicks=kicks)


def _move(system, scheme, state, macro_dt, newton, memory):
    """What happens between the kicks."""
    parts = split(system, scheme, state.q_s, state.q_f)
    if parts is not None:
        return _move_parts(parts, scheme.num_micro, state, macro_dt, newton, memory)
    if is_explicit(system, scheme):
        return *_drift(system, state, macro_dt), memory
    return _move_coupled(system, scheme, state, macro_dt, newton, memory)


def _kick_gradients(terms, q_s, q_f, average=None):
    """``(d/dq_s, d/dq_f)`` of every term, of mollified ones at averaged fast positions."""

    def gradient(term):
        if average is None or not term.mollified:
            return term.gradient(q_s, q_f)
        a, pull = jax.vjp(average, q_s, q_f)
        d_s, d_f = term.gradient(q_s, a)
        more_s, d_f = pull(d_f)
        return d_s + more_s, d_f

    return tuple(map(gradient, terms))


def averaging(system: System, scheme: Scheme, macro_dt, newton: Newton):
    """The filter of a mollified slow potential, ``(q_s, q_f) -> a(q_s, q_f)``, or None.

    ``a = (x_0 / 2 + x_1 + ... + x_{num_micro - 1} + x_num_micro / 2) / num_micro`` over the micro nodes of the fast motion
    from rest at q_f, slow variables at rest: the trapezoidal rule on the micro grid. A fast vibration whose phase advances by
    k pi over the macro step, as the scheme resolves it, has the average zero, so that V cannot excite it.
    """
    if not scheme.slow.mollified:
        return None
    if not isinstance(system.kinetic, ConstantMass) or system.is_rheonomic:
        raise ValueError(
            "Scheme: a mollified slow potential needs a System whose kinetic is a ConstantMass, without Rheonomic constraints."
        )

    def average(q_s, q_f):
        fast, fast_scheme = fast_alone(system, scheme, q_s)
        micro_dt, none = macro_dt / scheme.num_micro, jnp.zeros(0)
        start = State(jnp.zeros(()), none, q_f, none, jnp.zeros_like(q_f))
        memory = start_memory(fast, fast_scheme, start, micro_dt, newton)
        # One matrix for all micro steps, as in a macro step; `start_memory` leaves it to be filled.
        memory = _renew_matrix(fast, fast_scheme, start, micro_dt, newton, memory)  # pyright: ignore[reportArgumentType]
        _, _, (result, *_), q, _ = _march_fast(fast, fast_scheme, scheme.num_micro, start, micro_dt, newton, memory)
        a = (q_f / 2 + jnp.sum(q[:-1], axis=0) + q[-1] / 2) / scheme.num_micro
        return jnp.where(result <= Result.CONVERGED_AT_ROUNDOFF, a, jnp.nan)

    return average


def _kick(terms, state, macro_dt, gradients, ends: tuple[str, ...]) -> State:
    """``p + H w dL/dq`` for the weight w that each term has at these ends of the interval."""
    p_s, p_f = state.p_s, state.p_f
    for term, (d_s, d_f) in zip(terms, gradients, strict=True):
        weights = [w for w in (getattr(term, end) for end in ends) if w is not None]
        if weights:
            impulse = term.times_step(macro_dt) * sum(weights)
            p_s, p_f = p_s + impulse * d_s, p_f + impulse * d_f
    return State(state.t, state.q_s, state.q_f, p_s, p_f)


def _drift(system, state, macro_dt):
    """Straight motion at constant momentum."""
    v_s, v_f = system.kinetic.velocity(state.p_s, state.p_f)
    q_s, q_f = state.q_s + macro_dt * v_s, state.q_f + macro_dt * v_f
    status = (np.asarray(int(Result.CONVERGED)), np.asarray(int(Method.EXPLICIT)), np.asarray(0), np.zeros(()))
    info = StepInfo(*status, q_f[None], jnp.zeros((1, 1, 0)), jnp.zeros((1, 0)))
    return State(state.t + macro_dt, q_s, q_f, state.p_s, state.p_f), info


def _slow_and_fast(state: State) -> tuple[State, State]:
    """The slow and the fast variables as states of fast variables alone."""
    none = jnp.zeros(0)
    return State(state.t, none, state.q_s, none, state.p_s), State(state.t, none, state.q_f, none, state.p_f)


def _move_parts(parts, num_micro, state, macro_dt, newton, memory):
    """The slow variables make one step, the fast ones num_micro steps."""
    slow, fast = _slow_and_fast(state)
    slow_memory, fast_memory = memory.parts
    slow, slow_info, slow_memory = _interval(parts.slow, parts.slow_scheme, slow, macro_dt, newton, slow_memory)

    fast, fast_memory, status, q_f, multiplier = _march_fast(
        parts.fast, parts.fast_scheme, num_micro, fast, macro_dt / num_micro, newton, fast_memory
    )
    info = StepInfo(*_worse(_status(slow_info), status), q_f, multiplier, slow_info.multiplier[0])  # pyright: ignore[reportCallIssue]
    end = State(state.t + macro_dt, slow.q_f, fast.q_f, slow.p_f, fast.p_f)
    return end, info, memory._replace(parts=(slow_memory, fast_memory))


def _march_fast(system, scheme, num_micro, fast, micro_dt, newton, memory):
    """num_micro steps of the fast variables; kicks of two steps at the node they share are merged into one."""

    terms = lagrangian(system, scheme).kicks

    def micro_step(fast, memory, ends):
        fast, info, memory = _move(system, scheme, fast, micro_dt, newton, memory)
        kicks = _kick_gradients(terms, fast.q_s, fast.q_f)
        return _kick(terms, fast, micro_dt, kicks, ends), info, memory, kicks

    large = fast.q_f.size >= LARGE and not is_explicit(system, scheme) and is_linear(system, scheme, fast.q_s, fast.q_f)
    pack, unpack, together = (_packed, _unpacked, TOGETHER) if large else (lambda fast: fast, lambda fast: fast, 1)

    def inside(carry, _):
        fast, memory, worst = carry
        fast, info, memory, _ = micro_step(unpack(fast), memory, ("end", "start"))
        return (pack(fast), memory, _worse(worst, _status(info))), (info.q_f_micro[0], info.multiplier[0])

    fast = _kick(terms, fast, micro_dt, memory.kicks, ("start",))
    memory = memory._replace(kicks=None)  # needed again only at the last node
    start = pack(fast), memory, (jnp.asarray(0), jnp.asarray(0), jnp.asarray(0), jnp.zeros(()))
    (fast, memory, worst), (q_f, multiplier) = jax.lax.scan(inside, start, length=num_micro - 1, unroll=together)
    fast, last, memory, kicks = micro_step(unpack(fast), memory, ("end",))
    status = _status(last)
    if not is_concrete(status):  # known beforehand it is that of all
        status = _worse(worst, status)
    q_f, multiplier = jnp.concatenate([q_f, last.q_f_micro]), jnp.concatenate([multiplier, last.multiplier])
    return fast, memory._replace(kicks=kicks), status, q_f, multiplier


def _packed(fast: State):
    """Position and momentum side by side as one complex number: one loop over the coordinates then makes both."""
    return fast.t, jax.lax.complex(fast.q_f, fast.p_f)


def _unpacked(packed) -> State:
    (t, z), none = packed, jnp.zeros(0)
    return State(t, none, jnp.real(z), none, jnp.imag(z))


def _status(info: StepInfo) -> tuple:
    return info.result, info.method, info.iterations, info.residual


def _worse(a: tuple, b: tuple) -> tuple:
    return tuple(jnp.maximum(x, y) for x, y in zip(a, b, strict=True))


def _move_coupled(system, scheme, state, macro_dt, newton, memory):
    """All unknowns of the macro step at once, by Newton's iteration."""
    equations = _equations(system, scheme, state, macro_dt)
    if isinstance(system.kinetic, ConstantMass):  # the momentum is at hand, kicks included
        v_s, v_f = system.kinetic.velocity(state.p_s, state.p_f)
    else:
        v_s, v_f = memory.velocity
    guess = equations.guess(v_s, v_f, memory.multiplier, memory.slow_multiplier)
    found, warm = solve(equations, guess, newton, memory.matrix, memory.warm)
    x = found.x
    multiplier, slow_multiplier = physical_multipliers(scheme, macro_dt, x.multiplier, x.slow_multiplier)
    memory = memory._replace(multiplier=multiplier[-1, -1], slow_multiplier=slow_multiplier[-1], warm=warm)
    info = StepInfo(
        found.result,
        found.method,
        found.iterations,
        found.residual,
        q_f_micro=jnp.concatenate([equations.path(x).fast_start[1:], found.q_f[None]]),
        multiplier=multiplier,
        slow_multiplier=slow_multiplier,
    )
    end = State(state.t + macro_dt, state.q_s + x.slow[-1], found.q_f, found.p_s, found.p_f)
    return end, info, memory
