"""The engine of all runs: a loop of macro steps inside a loop over saved nodes, compiled once per structure. It returns states and statuses alone.

Names: `save_every` macro steps lie between two saved nodes; `num_saves` saved intervals fit into the arrays of an engine; a call computes
the first `saves` of them.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from vmri_jax.mechanics.arrays import Numbers, options_of_runs
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.running.loops import MOST_STORED_STEPS, PLAIN, Loops, Recursive, Stored
from vmri_jax.running.observables import observables, with_tolerance
from vmri_jax.running.saved import Saved
from vmri_jax.running.trajectory import MicroNodes, RunInfo, Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.plan import Plan, plan
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver


class Motion(NamedTuple):
    """The numbers and functions that a motion follows from; the programs of an `Engine` get it as a list of leaves.

    A system is flattened once: to flatten it at every call would take longer than a short run. Two places in the list are fixed: first
    macro_dt and the five arrays of the state; last the leaves of the parameters, since `params` is the last of the fields of a `System` that have leaves.
    """

    macro_dt: Any
    state: State
    solver: Solver
    scheme: Scheme | Composition
    system: System

    def stepper(self, reverse_only: bool = False) -> Plan:
        """The `Plan` that takes the steps."""
        return plan(self.system, self.scheme, self.state, self.solver, reverse_only=reverse_only)


NUM_STATE = 6
"""Leaves of macro_dt and of the state in a list of leaves."""


class Cursor(NamedTuple):
    """Progress of a run: state and memory before macro step `step`, the worst `result` so far, the failed step or -1."""

    state: State
    memory: Any
    step: Int[Numbers, ""]
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]

    @classmethod
    def at_start(cls, state: State, memory) -> "Cursor":
        """The cursor of a run that begins."""
        return cls(state, memory, np.asarray(0), np.asarray(int(Result.CONVERGED)), np.asarray(-1))


@dataclass(frozen=True)
class Engine:
    """Compiled runs of all systems and schemes of one structure, as functions of the leaves of a `Motion` and of numbers of steps.

    Two kinds of loops: `whole` and `piece` use `jax.lax.while_loop`, which is fast, and the numbers of steps are traced arguments; `stored`
    and `checkpointed` use `jax.lax.scan`, which reverse mode can differentiate, but the numbers of steps are static.

    Attributes:
        structure: structure of the pytree `Motion`.
        num_saves: saved intervals that fit into the arrays of a run.
        save_micro: whether micro nodes are saved.
    """

    structure: Any
    num_saves: int
    save_micro: bool

    @cached_property
    def whole(self):
        """``whole(leaves, save_every, saves)``: the nodes of `run`, in each row its `Observables` beside, and (2,) result and failed step.

        Only the first `saves` of the saved intervals are computed. A call of a prepared run is short: observables of a program of their own would add
        a third to it, and each array that it returns some 20 microseconds.
        """

        def whole(leaves: list, save_every, saves):
            motion, (saved, *status) = self.motion(leaves), self.run(leaves, save_every, saves)
            steps = jnp.arange(self.num_saves + 1) * save_every
            states = saved.states(motion.state, motion.state.t + steps * motion.macro_dt)
            nodes = with_tolerance(states, motion.solver.tolerance)
            table = jax.vmap(partial(observables, motion.system))(nodes)
            return Saved(jnp.concatenate([saved.rows, table], axis=1), saved.micros), jnp.stack(status)

        return jax.jit(whole, compiler_options=options_of_runs())

    @cached_property
    def stored(self):
        """``stored(leaves, save_every)``: a run with `save_every` static, to be differentiated in any mode."""
        return jax.jit(partial(self._by_scan, loops=Stored()), static_argnums=1)

    @cached_property
    def checkpointed(self):
        """`stored` with derivatives in reverse mode only, whose memory grows like the logarithm of the number of steps."""

        def checkpointed(leaves: list, save_every):
            loops = Stored() if self.num_saves * save_every <= MOST_STORED_STEPS else Recursive(save_every)
            return self._by_scan(leaves, save_every, loops, reverse_only=True)

        return jax.jit(checkpointed, static_argnums=1)

    @cached_property
    def piece(self):
        """``piece(saved, leaves, cursor, is_first, save_every, saves)``: the next `saves` saved intervals of a run, and its cursor.

        If the piece `is_first`, the memory of a first step replaces the memory of the cursor. The nodes are written into the arrays `saved`, which are
        donated: the caller must not use them again.
        """

        def piece(saved: Saved, leaves: list, cursor: Cursor, is_first, save_every, saves):
            motion = self.motion(leaves)
            stepper = motion.stepper()
            first = stepper.init(cursor.state, motion.macro_dt)
            cursor = cursor._replace(memory=jax.tree.map(partial(jnp.where, is_first), first, cursor.memory))
            return self._by_while_loop(stepper, motion, cursor, saved, save_every, saves)

        return jax.jit(piece, donate_argnums=0, compiler_options=options_of_runs())

    def next_piece(
        self, leaves: list, cursor: Cursor, is_first: bool, save_every: int, saves: int
    ) -> tuple[Saved, Cursor]:
        """`piece` with its nodes in arrays of NumPy; nodes after a failure have old data."""
        free = self._room(leaves)[1]
        try:
            room = free.pop()
        except IndexError:  # the first piece, or all arrays are in use by other threads
            room = self._empty(self.motion(leaves))
        saved, cursor = self.piece(room, leaves, cursor, is_first, save_every, saves)
        nodes = saved.first(saves)
        free.append(saved)
        return nodes, cursor

    def blank_memory(self, leaves: list):
        """Zeros in the shapes of the memory of the stepper, for a first piece."""
        return self._room(leaves)[0]

    def _room(self, leaves: list) -> tuple[Any, list[Saved]]:
        """Blank memory, and arrays for saved nodes that no piece uses at present, for a motion of these shapes."""
        shapes = tuple((a.shape, a.dtype) for a in leaves)
        if shapes not in self._rooms:
            blank = jax.eval_shape(self._first_memory, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
            self._rooms[shapes] = jax.device_put(jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), blank)), []
        return self._rooms[shapes]

    @cached_property
    def _rooms(self) -> dict[tuple, tuple[Any, list[Saved]]]:
        return {}

    def _first_memory(self, leaves: list):
        motion = self.motion(leaves)
        return motion.stepper().init(motion.state, motion.macro_dt)

    def run(self, leaves: list, save_every, saves=None) -> tuple[Saved, Any, Any]:
        """The nodes of a run from its first step, its result, and the failed step, not jitted; of all saved intervals, or of the first `saves` of them."""
        motion = self.motion(leaves)
        stepper = motion.stepper()
        cursor = Cursor.at_start(motion.state, stepper.init(motion.state, motion.macro_dt))
        saved, cursor = self._by_while_loop(stepper, motion, cursor, self._empty(motion), save_every, saves)
        return saved, cursor.result, cursor.failed_at

    def motion(self, leaves: list) -> Motion:
        """The `Motion` with these leaves."""
        return jax.tree.unflatten(self.structure, leaves)

    def _by_while_loop(
        self, stepper: Plan, motion: Motion, cursor: Cursor, saved: Saved, save_every, saves
    ) -> tuple[Saved, Cursor]:
        """``saves * save_every`` macro steps, or fewer if one fails.

        With `saves` None all `num_saves` intervals, failed or not: the end of the loop then depends on no lane of a batch, and `jax.vmap` need
        not select between old and new values in every lane.
        """
        interval = self._interval(stepper, motion, PLAIN)

        def goes_on(loop):
            number, cursor, _ = loop
            return number <= self.num_saves if saves is None else (number <= saves) & (cursor.failed_at < 0)

        def save(loop):
            number, cursor, saved = loop
            is_later = number > 0  # turn 0 saves the start, so that the code for nodes is compiled once
            moved, info, micro = interval(cursor, jnp.where(is_later, save_every, 0))
            cursor = jax.tree.map(lambda a, b: a if a is b else jnp.where(is_later, a, b), moved, cursor)
            return number + 1, cursor, saved.write(number, cursor.state, info, micro)

        _, cursor, saved = jax.lax.while_loop(goes_on, save, (jnp.asarray(0), jax.tree.map(jnp.asarray, cursor), saved))
        return saved, cursor

    def _by_scan(self, leaves: list, save_every: int, loops: Loops, reverse_only: bool = False) -> Trajectory:
        """A whole run from its first step, by loops that reverse mode can differentiate."""
        motion = self.motion(leaves)
        stepper = motion.stepper(reverse_only)
        interval = self._interval(stepper, motion, loops)

        def save(cursor: Cursor, _):
            cursor, info, micro = interval(cursor, save_every)
            return cursor, (cursor.state, info, micro)

        cursor = Cursor.at_start(motion.state, stepper.init(motion.state, motion.macro_dt))
        cursor, (states, info, micros) = loops.scan(save, jax.tree.map(jnp.asarray, cursor), self.num_saves)
        states = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), motion.state, states)
        micro = None if micros is None else MicroNodes.of(states.t, motion.scheme, motion.macro_dt, micros)
        return Trajectory(states, None, None, info, cursor.result, cursor.failed_at, micro)

    def _interval(self, stepper: Plan, motion: Motion, loops: Loops):
        """``cursor, info, micro = interval(cursor, count)``: the `count` macro steps between two saved nodes."""
        no_info = RunInfo(np.asarray(0), np.asarray(0), np.zeros(()))
        no_micro = jnp.zeros((stepper.scheme.num_micro, motion.state.q_f.shape[0])) if self.save_micro else None
        take_step = _step_of(stepper, motion, self.save_micro)

        def interval(cursor: Cursor, count):
            cursor, info, micro = loops.repeat(count, take_step, (cursor, no_info, no_micro))
            if stepper.defers_projection:  # between saved nodes a projection would not change the motion
                state, memory = stepper.project(cursor.state, cursor.memory)
                cursor = cursor._replace(state=state, memory=memory)
            return cursor, info, micro

        return interval

    def _empty(self, motion: Motion) -> Saved:
        return Saved.none(motion.state, self.num_saves, motion.scheme.num_micro if self.save_micro else None)


engine = lru_cache(maxsize=32)(Engine)
"""``engine(structure, num_saves, save_micro)``: the `Engine` with these attributes, made once. The 33rd structure displaces the one used
least recently, which compiles again when it is needed: each program takes memory maps, of which a process has a limited number."""


def _step_of(stepper: Plan, motion: Motion, save_micro: bool):
    """A macro step as the body of a loop."""
    t_start, macro_dt = motion.state.t, motion.macro_dt

    def step(_, carry):
        cursor, worst, _ = carry
        alive = cursor.failed_at < 0
        state, info, memory = stepper.step(cursor.state, cursor.memory, macro_dt)
        ok = alive & (info.result <= Result.CONVERGED_AT_ROUNDOFF)
        info_of_step = RunInfo(info.method, info.iterations, info.residual)
        worst = jax.tree.map(lambda a, b: jnp.where(alive, jnp.maximum(a, b), a), worst, info_of_step)
        # NaN in the momenta alone: the next step carries it into all positions.
        p_s, p_f = (jnp.where(ok, p, jnp.nan) for p in (state.p_s, state.p_f))
        # t_k = t_0 + k H from the step number, since a sum of steps would accumulate round-off; the time of the stepper is ignored.
        state = State(t_start + (cursor.step + 1) * macro_dt, state.q_s, state.q_f, p_s, p_f)
        result = jnp.where(alive, jnp.maximum(cursor.result, info.result), cursor.result)
        failed_at = jnp.where(alive & ~ok, cursor.step, cursor.failed_at)
        micro = jnp.where(ok, info.q_f_micro, jnp.nan) if save_micro else None
        return Cursor(state, memory, cursor.step + 1, result, failed_at), worst, micro

    return step
