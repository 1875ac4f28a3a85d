"""The engine of all runs: a loop of macro steps inside a scan over saved nodes, compiled once per structure."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from vmri_jax.kernels import max_abs
from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.checks import CONSTRAINT_TOLERANCE
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.running.loops import PLAIN, WHOLE, Loops, Recursive, Stored
from vmri_jax.running.trajectory import RunInfo, Trajectory
from vmri_jax.steppers.plan import Plan, plan
from vmri_jax.steppers.results import Result


@dataclass(frozen=True)
class Engine:
    """Compiled runs of all systems and schemes of one structure; what they compute with is handed over as bare arrays.

    The programs take `leaves`, the arrays of (newton, scheme, system), the five arrays of a `State`, and numbers.

    Attributes:
        structure: of the pytree (newton, scheme, system).
        num_saves: saved intervals that there is room for.
        save_micro: whether micro nodes are saved.
    """

    structure: Any
    num_saves: int
    save_micro: bool

    @cached_property
    def whole(self):
        """``whole(leaves, state, macro_dt, save_every, saves)``: a run from its first step, as the arrays of its `Trajectory`.

        Only the first `saves` of the saved intervals are computed, so that one program does for many lengths.
        """
        return jax.jit(lambda *run: jax.tree.leaves(self.trajectory(*run)))

    @cached_property
    def stored(self):
        """``stored(leaves, state, macro_dt, save_every)``: `trajectory` with `save_every` static, to be differentiated in any mode."""

        def stored(leaves, state, macro_dt, save_every):
            return self.trajectory(leaves, state, macro_dt, save_every, loops=Stored())

        return jax.jit(stored, static_argnums=3)

    @cached_property
    def checkpointed(self):
        """The same with derivatives in reverse mode only, that need memory like the logarithm of the number of steps."""

        def checkpointed(leaves, state, macro_dt, save_every):
            loops = Stored() if self.num_saves * save_every <= WHOLE else Recursive(save_every)
            return self.trajectory(leaves, state, macro_dt, save_every, loops=loops, once=True)

        return jax.jit(checkpointed, static_argnums=3)

    @cached_property
    def start(self):
        """``start(leaves, state, macro_dt)``: what the stepper takes along into the first step."""
        return jax.jit(
            lambda leaves, state, macro_dt: self.stepper(leaves, State(*state)).init(State(*state), macro_dt)
        )

    @cached_property
    def onwards(self):
        """``onwards(leaves, state, own, t_start, macro_dt, step, save_every, saves)``: the next part of a run.

        The arrays of its trajectory, of which the first `saves` saved intervals are computed, and state and own at its end.
        """

        def onwards(leaves, state, own, t_start, macro_dt, step, save_every, saves):
            stepper = self.stepper(leaves, State(*state))
            piece, *end = self._run(stepper, State(*state), own, t_start, macro_dt, step, save_every, saves)
            return jax.tree.leaves(piece), *end

        return jax.jit(onwards)

    def trajectory(
        self, leaves, state, macro_dt, save_every, saves=None, loops: Loops = PLAIN, once: bool = False
    ) -> Trajectory:
        """A run from its first step, not compiled; of all saved intervals, or of the first `saves` of them.

        Args:
            once: as of `plan`.
        """
        start = State(*state)
        stepper = self.stepper(leaves, start, once)
        own = stepper.init(start, macro_dt)
        return self._run(stepper, start, own, start.t, macro_dt, 0, save_every, saves, loops)[0]

    def stepper(self, leaves, state: State, once: bool = False) -> Plan:
        """How its steps are taken."""
        newton, scheme, system = jax.tree.unflatten(self.structure, leaves)
        return plan(system, scheme, state, newton, fallback=False, once=once)

    def _run(
        self, stepper: Plan, state: State, own, t_start, macro_dt, step, save_every, saves=None, loops: Loops = PLAIN
    ):
        """`num_saves * save_every` macro steps from step number `step`, or `saves * save_every` of them."""
        system, tolerance, num_micro = stepper.system, stepper.newton.tolerance, stepper.scheme.num_micro
        no_info = RunInfo(np.asarray(0), np.asarray(0), np.zeros(()))
        no_micro = jnp.zeros((num_micro, state.q_f.shape[0])) if self.save_micro else None
        first = step
        take = _step_of(stepper, t_start, macro_dt, self.save_micro)

        def interval(at: _At):
            at, worst, micro = loops.repeat(save_every, take, (at, no_info, no_micro))
            if stepper.projects_rarely:
                state, own = stepper.project(at.state, at.own)
                at = at._replace(state=state, own=own)
            return at, worst, micro

        def nothing(at: _At):
            micro = None if no_micro is None else jnp.where(at.failed_at < 0, no_micro, jnp.nan)
            return at, no_info, micro

        def save(at: _At, number):
            if number is None:
                at, worst, micro = interval(at)
            else:
                moves = number > 0
                if saves is not None:  # one run: after a failure no step is tried, only the clock goes on
                    moves &= (number <= saves) & (at.failed_at < 0)
                at, worst, micro = jax.lax.cond(moves, interval, nothing, at)
                t = t_start + (first + number * save_every) * macro_dt
                at = at._replace(state=replace(at.state, t=jnp.where(at.failed_at < 0, at.state.t, t)))
            node, at = _node(system, tolerance, at)
            return at, (node, worst, micro)

        at = _At(state, own, jnp.asarray(step), np.asarray(int(Result.CONVERGED)), np.asarray(-1))
        if loops is PLAIN:  # one place for the first node and all others: compiled once
            at, (nodes, *between) = jax.lax.scan(save, at, np.arange(self.num_saves + 1))
            worst, micro = jax.tree.map(lambda a: a[1:], between)
        else:  # derivatives of that would take twice as long to compile
            first, at = _node(system, tolerance, at)
            at, (nodes, worst, micro) = loops.scan(save, at, self.num_saves)
            nodes = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first, nodes)
        t_micro = None if micro is None else nodes[0][1:, None] - macro_dt * (1 - stepper.scheme.micro_times)
        status = {"result": at.result, "failed_at": at.failed_at}
        trajectory = Trajectory(*nodes, info=worst, **status, t_micro=t_micro, q_f_micro=micro)
        return trajectory, at.state, at.own


def room_for(saves: int) -> int:
    """The next number with at most four leading binary digits, so that many lengths of runs share few programs."""
    unit = 2 ** max(saves.bit_length() - 4, 0)
    return -(-saves // unit) * unit


engine = lru_cache(maxsize=32)(Engine)
"""The engine with these attributes. Thousands of programs would exhaust the memory maps that a process may have."""


class _At(NamedTuple):
    """Where a run is: before macro step `step`, with the worst `result` so far and the step that failed, -1 if none did."""

    state: State
    own: Any
    step: Int[Numbers, ""]
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]


def _step_of(stepper: Plan, t_start, macro_dt, save_micro: bool):
    """A macro step as the body of a loop. From a failure on momenta are NaN, and by them all positions after it."""

    def step(_, carry):
        at, worst, _ = carry
        alive = at.failed_at < 0
        state, info, own = stepper.step(at.state, at.own, macro_dt)
        ok = alive & (info.result <= Result.CONVERGED_AT_ROUNDOFF)
        now = RunInfo(info.method, info.iterations, info.residual)
        worst = jax.tree.map(lambda a, b: jnp.where(alive, jnp.maximum(a, b), a), worst, now)
        p_s, p_f = (jnp.where(ok, p, jnp.nan) for p in (state.p_s, state.p_f))
        state = State(t_start + (at.step + 1) * macro_dt, state.q_s, state.q_f, p_s, p_f)
        result = jnp.where(alive, jnp.maximum(at.result, info.result), at.result)
        failed_at = jnp.where(alive & ~ok, at.step, at.failed_at)
        micro = jnp.where(ok, info.q_f_micro, jnp.nan) if save_micro else None
        return _At(state, own, at.step + 1, result, failed_at), worst, micro

    return step


def _node(system: System, tolerance, at: _At):
    """What is saved of a node, the first seven fields of a `Trajectory`; and the status after a look at it.

    A potential may be NaN where its gradient is not (a logarithm beyond its pole), a lane of a batch may start off its
    constraints, and rows that were left out may not follow from them: such nodes are no result either.
    """
    state = at.state
    phase = state.q_s, state.q_f, state.p_s, state.p_f
    energy, residual = invariants.energy(system, *phase), invariants.constraint_residual(system, state)
    allowed = jnp.maximum(CONSTRAINT_TOLERANCE, 100 * tolerance)
    finite, kept = jnp.isfinite(energy), residual[0] <= allowed
    breaks = (at.failed_at < 0) & ~(finite & kept)
    violated = Result.CONSTRAINT_VIOLATED
    if system.implied is not None:  # the residual has rows that are not solved for, too
        solved = max_abs(system.constraints(state.t, state.q_s, state.q_f))
        violated = jnp.where(solved <= allowed, Result.NOT_IMPLIED, violated)
    cause = jnp.where(finite, violated, Result.NON_FINITE)
    result = jnp.where(breaks, cause, at.result)
    failed_at = jnp.where(breaks, jnp.maximum(at.step - 1, 0), at.failed_at)
    values = (jnp.where(failed_at < 0, a, jnp.nan) for a in (*phase, energy, residual))
    return (jnp.asarray(state.t), *values), at._replace(result=result, failed_at=failed_at)
