"""The engine of all runs: a loop of macro steps inside a loop over saved nodes, compiled once per structure. It returns states and statuses alone.

Names: `save_every` macro steps lie between two saved nodes; `num_saves` saved intervals fit into the arrays of an engine; a call computes
the first `saves` of them.
"""

from collections import defaultdict
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
from vmri_jax.running.trajectory import MicroNodes, Run, RunInfo
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.plan import Plan, plan
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver


class Model(NamedTuple):
    """Solver, scheme and system: everything but state and macro step that the motion depends on."""

    solver: Solver
    scheme: Scheme | Composition
    system: System


class Arrays(NamedTuple):
    """The numbers that a run is computed from, flattened once: to flatten a system at every call would take longer than a short run.

    model: leaves of a `Model`. `system` is its last field, and `params` is the last of the fields of a `System` that have leaves, so that the
        leaves of the parameters come last.
    state: the five arrays of the state at the start.
    macro_dt: macro step H.
    """

    model: list
    state: tuple
    macro_dt: Any

    def start(self) -> State:
        """The state at the start."""
        return State(*self.state)


class PieceStart(NamedTuple):
    """The place in a run where a piece begins.

    memory: memory of the stepper after the previous piece.
    is_first: whether the stepper has no memory of earlier steps; then the memory of a first step replaces `memory`.
    t_start: time of the start of the whole run.
    step: macro steps done before the piece.
    """

    memory: Any
    is_first: Any
    t_start: Any
    step: Any


@dataclass(frozen=True)
class Engine:
    """Compiled runs of all systems and schemes of one structure, as functions of `Arrays` and of numbers of steps.

    Two kinds of loops: `whole` and `piece` use `jax.lax.while_loop`, which is fast, and the numbers of steps are traced arguments; `stored`
    and `checkpointed` use `jax.lax.scan`, which reverse mode can differentiate, but the numbers of steps are static.

    Attributes:
        structure: structure of the pytree `Model`.
        num_saves: saved intervals that fit into the arrays of a run.
        save_micro: whether micro nodes are saved.
    """

    structure: Any
    num_saves: int
    save_micro: bool

    @cached_property
    def whole(self):
        """``whole(arrays, save_every, saves)``: a run from its first step, as the arrays of its `Run`, and its `Observables` (k, 9).

        Only the first `saves` of the saved intervals are computed. A call of a prepared run is short: observables of a program of their own would add
        a third to it.
        """

        def whole(arrays: Arrays, *counts):
            run = self.run(arrays, *counts)
            nodes = with_tolerance(run.states, self.model(arrays.model).solver.tolerance)
            return jax.tree.leaves(run), jax.vmap(partial(observables, self.model(arrays.model).system))(nodes)

        return jax.jit(whole, compiler_options=options_of_runs())

    @cached_property
    def stored(self):
        """``stored(arrays, save_every)``: `run` with `save_every` static, to be differentiated in any mode."""

        def stored(arrays: Arrays, save_every):
            return self.run(arrays, save_every, loops=Stored())

        return jax.jit(stored, static_argnums=1)

    @cached_property
    def checkpointed(self):
        """`stored` with derivatives in reverse mode only, whose memory grows like the logarithm of the number of steps."""

        def checkpointed(arrays: Arrays, save_every):
            loops = Stored() if self.num_saves * save_every <= MOST_STORED_STEPS else Recursive(save_every)
            return self.run(arrays, save_every, loops=loops, reverse_only=True)

        return jax.jit(checkpointed, static_argnums=1)

    @cached_property
    def piece(self):
        """``piece(saved, arrays, begin, save_every, saves)``: the next `saves` saved intervals of a run, as a `_Loop`.

        The nodes are written into the arrays `saved`, which are donated: the caller must not use them again.
        """

        def piece(saved: Saved, arrays: Arrays, begin: PieceStart, save_every, saves):
            start, macro_dt = arrays.start(), arrays.macro_dt
            stepper = self.stepper(arrays.model, start)
            memory = jax.tree.map(partial(jnp.where, begin.is_first), stepper.init(start, macro_dt), begin.memory)
            times = _Times(begin.t_start, macro_dt, save_every)
            return self._by_while_loop(stepper, _Cursor.before(start, memory, begin.step), saved, times, saves)

        return jax.jit(piece, donate_argnums=0, compiler_options=options_of_runs())

    def next_piece(
        self, arrays: Arrays, begin: PieceStart, save_every: int, saves: int, is_alive: bool = True
    ) -> tuple[Run, State, Any]:
        """`piece` as a `Run` in arrays of NumPy, and the state and memory at its end; without steps, NaN, unless the run is alive."""
        scheme = self.model(arrays.model).scheme
        free = self._free[tuple(a.shape for a in arrays.state)]
        try:
            room = free.pop()
        except IndexError:  # the first piece, or all arrays are in use by other threads
            room = self._empty(arrays.start(), scheme.num_micro)
        loop = self.piece(room, arrays, begin, save_every, saves if is_alive else -1)
        saved = loop.saved.first(saves, int(loop.number))
        free.append(loop.saved)
        macro_dt = np.asarray(arrays.macro_dt)
        times = np.asarray(begin.t_start) + (begin.step + np.arange(saves + 1) * save_every) * macro_dt
        run = self._run(scheme, loop._replace(saved=saved), times, macro_dt)
        return run, loop.cursor.state, loop.cursor.memory

    @cached_property
    def _free(self) -> defaultdict[tuple, list[Saved]]:
        """Arrays for saved nodes that no piece uses at present, by the shapes of states."""
        return defaultdict(list)

    def blank_memory(self, arrays: Arrays):
        """Zeros in the shapes of the memory of the stepper, for a `PieceStart` that is the first."""
        return _blank_memory(self, tuple((a.shape, a.dtype) for a in (*arrays.model, *arrays.state)))

    def run(
        self, arrays: Arrays, save_every, saves=None, loops: Loops | None = None, reverse_only: bool = False
    ) -> Run:
        """A run from its first step, not jitted; of all saved intervals, or of the first `saves` of them.

        Args:
            loops: loops that reverse mode can differentiate; None for the while-loop.
            reverse_only: as of `plan`.
        """
        start, macro_dt = arrays.start(), arrays.macro_dt
        stepper, times = self.stepper(arrays.model, start, reverse_only), _Times(start.t, macro_dt, save_every)
        cursor = _Cursor.before(start, stepper.init(start, macro_dt), 0)
        if loops is not None:
            return self._by_scan(stepper, cursor, times, loops)
        empty = self._empty(start, stepper.scheme.num_micro)
        loop = self._by_while_loop(stepper, cursor, empty, times, saves)
        if saves is not None:  # else all nodes are written
            loop = loop._replace(saved=loop.saved.ended(saves, loop.number))
        nodes = start.t + jnp.arange(self.num_saves + 1) * save_every * macro_dt
        return self._run(stepper.scheme, loop, nodes, macro_dt)

    def model(self, leaves: list) -> Model:
        """The `Model` with these leaves."""
        return jax.tree.unflatten(self.structure, leaves)

    def stepper(self, leaves: list, state: State, reverse_only: bool = False) -> Plan:
        """The `Plan` that takes the steps of the model with these leaves."""
        solver, scheme, system = self.model(leaves)
        return plan(system, scheme, state, solver, reverse_only=reverse_only)

    def _by_while_loop(self, stepper: Plan, cursor: "_Cursor", saved: Saved, times: "_Times", saves) -> "_Loop":
        """``saves * save_every`` macro steps, or fewer if one fails.

        With `saves` None all `num_saves` intervals, failed or not: the end of the loop then depends on no lane of a batch, and `jax.vmap` need
        not select between old and new values in every lane.
        """
        interval = self._interval(stepper, cursor.state, times, PLAIN)

        def goes_on(loop: _Loop):
            if saves is None:
                return loop.number <= self.num_saves
            return (loop.number <= saves) & (loop.cursor.failed_at < 0)

        def save(loop: _Loop) -> _Loop:
            number, cursor, saved = loop
            is_later = number > 0  # turn 0 saves the start, so that the code for nodes is compiled once
            moved, info, micro = interval(cursor, jnp.where(is_later, times.save_every, 0))
            cursor = jax.tree.map(lambda a, b: a if a is b else jnp.where(is_later, a, b), moved, cursor)
            return _Loop(number + 1, cursor, saved.write(number, cursor.state, info, micro))

        return jax.lax.while_loop(goes_on, save, _Loop(jnp.asarray(0), cursor, saved))

    def _by_scan(self, stepper: Plan, cursor: "_Cursor", times: "_Times", loops: Loops) -> Run:
        """A whole run from its first step, by loops that reverse mode can differentiate."""
        interval = self._interval(stepper, cursor.state, times, loops)

        def save(cursor: _Cursor, _):
            cursor, info, micro = interval(cursor, times.save_every)
            return cursor, (cursor.state, info, micro)

        first = cursor.state
        cursor, (states, info, micros) = loops.scan(save, cursor, self.num_saves)
        states = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first, states)
        before_end = _before_end(stepper.scheme, times.macro_dt)
        micro = None if micros is None else MicroNodes(states.t[1:, None] - before_end, micros)
        return Run(states, info, cursor.result, cursor.failed_at, micro)

    def _interval(self, stepper: Plan, state: State, times: "_Times", loops: Loops):
        """``cursor, info, micro = interval(cursor, count)``: the `count` macro steps between two saved nodes."""
        no_info = RunInfo(np.asarray(0), np.asarray(0), np.zeros(()))
        no_micro = jnp.zeros((stepper.scheme.num_micro, state.q_f.shape[0])) if self.save_micro else None
        take_step = _step_of(stepper, times, self.save_micro)

        def interval(cursor: _Cursor, count):
            cursor, info, micro = loops.repeat(count, take_step, (cursor, no_info, no_micro))
            if stepper.defers_projection:  # between saved nodes a projection would not change the motion
                state, memory = stepper.project(cursor.state, cursor.memory)
                cursor = cursor._replace(state=state, memory=memory)
            return cursor, info, micro

        return interval

    def _empty(self, state: State, num_micro: int) -> Saved:
        return Saved.none(state, self.num_saves, num_micro if self.save_micro else None)

    def _run(self, scheme, loop: "_Loop", times, macro_dt) -> Run:
        status = {"result": loop.cursor.result, "failed_at": loop.cursor.failed_at}
        before_end = _before_end(scheme, macro_dt) if self.save_micro else None
        return loop.saved.run(loop.cursor.state.q_s.shape[0], times, status, before_end)


engine = lru_cache(maxsize=32)(Engine)
"""``engine(structure, num_saves, save_micro)``: the `Engine` with these attributes, made once. The 33rd structure displaces the one used
least recently, which compiles again when it is needed: each program takes memory maps, of which a process has a limited number."""


def _before_end(scheme, macro_dt):
    """(num_micro,) times from the micro nodes of a macro step to its end, ``H (1 - c_i)``."""
    return macro_dt * (1 - scheme.micro_times)


@lru_cache(maxsize=256)
def _blank_memory(engine: Engine, shapes: tuple):
    """Zeros in the shapes of the memory of a stepper.

    Args:
        engine: makes the stepper.
        shapes: (shape, dtype) of the leaves of the model and, last, of the five arrays of the state.
    """

    def memory(*arrays):
        start = State(*arrays[-5:])
        return engine.stepper(list(arrays[:-5]), start).init(start, 1.0)

    blank = jax.eval_shape(memory, *(jax.ShapeDtypeStruct(*shape) for shape in shapes))
    return jax.device_put(jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), blank))


class _Times(NamedTuple):
    """Time of the start of a run, macro step H, and macro steps from one saved node to the next."""

    t_start: Any
    macro_dt: Any
    save_every: Any


class _Cursor(NamedTuple):
    """Progress of a run: state and memory before macro step `step`, the worst `result` so far, the failed step or -1."""

    state: State
    memory: Any
    step: Int[Numbers, ""]
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]

    @classmethod
    def before(cls, state: State, memory, step) -> "_Cursor":
        """The cursor before macro step `step`, without failures so far."""
        return cls(state, memory, jnp.asarray(step), np.asarray(int(Result.CONVERGED)), np.asarray(-1))


class _Loop(NamedTuple):
    """Carry of the while-loop: number of the next node to be saved, cursor of the run, and the nodes saved so far."""

    number: Int[Numbers, ""]
    cursor: _Cursor
    saved: Saved


def _step_of(stepper: Plan, times: _Times, save_micro: bool):
    """A macro step as the body of a loop."""
    t_start, macro_dt, _ = times

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
        return _Cursor(state, memory, cursor.step + 1, result, failed_at), worst, micro

    return step
