"""The engine of all runs: a loop of macro steps inside a loop over saved nodes, compiled once per structure."""

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
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
from vmri_jax.running.saved import Node, Saved
from vmri_jax.running.trajectory import MicroNodes, RunInfo, Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.plan import Plan, plan
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solvers import Newton


class Model(NamedTuple):
    """All that decides how a run goes on from a state: how equations are solved, the scheme, the system."""

    solver: Newton
    scheme: Scheme | Composition
    system: System


class Arrays(NamedTuple):
    """The numbers that a run is computed from, as bare arrays: JAX flattens a system in Python, which would take longer than a short run.

    model: leaves of a `Model`, those of the parameters of the system last.
    state: of the start, its five arrays.
    macro_dt: H.
    """

    model: list
    state: tuple
    macro_dt: Any

    def start(self) -> State:
        """The state at the start."""
        return State(*self.state)


class Place(NamedTuple):
    """Where a piece of a run begins.

    memory: of the stepper, from the piece before.
    starts: whether no step is remembered; then the memory of a first step takes the place of `memory`.
    t_start: time of the start of the whole run.
    step: macro steps before.
    """

    memory: Any
    starts: Any
    t_start: Any
    step: Any


@dataclass(frozen=True)
class Engine:
    """Compiled runs of all systems and schemes of one structure, as functions of `Arrays` and of numbers of steps.

    Attributes:
        structure: of the pytree `Model`.
        num_saves: saved intervals that there is room for.
        save_micro: whether micro nodes are saved.
    """

    structure: Any
    num_saves: int
    save_micro: bool

    @cached_property
    def whole(self):
        """``whole(arrays, save_every, saves)``: a run from its first step, as the arrays of its `Trajectory`.

        Only the first `saves` of the saved intervals are computed.
        """
        return jax.jit(lambda *run: jax.tree.leaves(self.trajectory(*run)))

    @cached_property
    def stored(self):
        """``stored(arrays, save_every)``: `trajectory` with `save_every` static, to be differentiated in any mode."""

        def stored(arrays: Arrays, save_every):
            return self.trajectory(arrays, save_every, loops=Stored())

        return jax.jit(stored, static_argnums=1)

    @cached_property
    def checkpointed(self):
        """The same with derivatives in reverse mode only, that need memory like the logarithm of the number of steps."""

        def checkpointed(arrays: Arrays, save_every):
            loops = Stored() if self.num_saves * save_every <= WHOLE else Recursive(save_every)
            return self.trajectory(arrays, save_every, loops=loops, reverse_only=True)

        return jax.jit(checkpointed, static_argnums=1)

    @cached_property
    def piece(self):
        """``piece(saved, arrays, place, save_every, saves)``: a run of any length, by pieces.

        Computes the first `saves` saved intervals into the arrays `saved`, whose memory it takes over, and returns `_Counted`.
        """

        def piece(saved: Saved, arrays: Arrays, place: Place, save_every, saves):
            start, macro_dt = arrays.start(), arrays.macro_dt
            stepper = self.stepper(arrays.model, start)
            memory = jax.tree.map(partial(jnp.where, place.starts), stepper.init(start, macro_dt), place.memory)
            times = _Times(place.t_start, macro_dt, save_every)
            return self._counted(stepper, _At.before(start, memory, place.step), saved, times, saves)

        return jax.jit(piece, donate_argnums=0)

    def next_piece(self, arrays: Arrays, place: Place, save_every: int, saves: int) -> tuple[Trajectory, State, Any]:
        """`piece` with its trajectory in arrays of NumPy, and the state and memory at its end."""
        scheme = self.model(arrays.model).scheme
        free = self._free[tuple(a.shape for a in arrays.state)]
        try:
            room = free.pop()
        except IndexError:  # the first piece, or all arrays are in use by other threads
            room = self._nothing(arrays.start(), scheme.num_micro)
        done = self.piece(room, arrays, place, save_every, saves)
        saved = done.saved.first(saves, int(done.number))
        free.append(done.saved)
        macro_dt = np.asarray(arrays.macro_dt)
        times = np.asarray(place.t_start) + (place.step + np.arange(saves + 1) * save_every) * macro_dt
        return self._trajectory(scheme, done._replace(saved=saved), times, macro_dt), done.at.state, done.at.memory

    @cached_property
    def _free(self) -> defaultdict[tuple, list[Saved]]:
        """Arrays for saved nodes that no piece uses at present, by the shapes of states."""
        return defaultdict(list)

    def blank_memory(self, arrays: Arrays):
        """The memory that `piece` is given where it starts: zeros."""
        return _blank_memory(self, tuple((a.shape, a.dtype) for a in (*arrays.model, *arrays.state)))

    def trajectory(
        self, arrays: Arrays, save_every, saves=None, loops: Loops | None = None, reverse_only: bool = False
    ) -> Trajectory:
        """A run from its first step, not compiled; of all saved intervals, or of the first `saves` of them.

        Args:
            loops: to be differentiated; None for the fastest.
            reverse_only: as of `plan`.
        """
        start, macro_dt = arrays.start(), arrays.macro_dt
        stepper, times = self.stepper(arrays.model, start, reverse_only), _Times(start.t, macro_dt, save_every)
        at = _At.before(start, stepper.init(start, macro_dt), 0)
        if loops is not None:
            return self._scanned(stepper, at, times, loops)
        done = self._counted(stepper, at, self._nothing(start, stepper.scheme.num_micro), times, saves)
        nodes = start.t + jnp.arange(self.num_saves + 1) * save_every * macro_dt
        return self._trajectory(stepper.scheme, done, nodes, macro_dt)

    def model(self, leaves: list) -> Model:
        """The `Model` with these leaves."""
        return jax.tree.unflatten(self.structure, leaves)

    def stepper(self, leaves: list, state: State, reverse_only: bool = False) -> Plan:
        """How its steps are taken."""
        solver, scheme, system = self.model(leaves)
        return plan(system, scheme, state, solver, fallback=False, reverse_only=reverse_only)

    def _counted(self, stepper: Plan, at: "_At", saved: Saved, times: "_Times", saves) -> "_Counted":
        """`saves * save_every` macro steps; with `saves` None all that there is room for, whether or not steps fail: lanes go on together."""
        interval = self._interval(stepper, at.state, times, PLAIN)

        def goes_on(done: _Counted):
            return done.number <= self.num_saves if saves is None else (done.number <= saves) & (done.at.failed_at < 0)

        def save(done: _Counted) -> _Counted:
            number, at, saved = done
            is_later = number > 0  # turn 0 saves the start, so that the code for nodes is compiled once
            moved, info, micro = interval(at, jnp.where(is_later, times.save_every, 0))
            at = jax.tree.map(lambda a, b: a if a is b else jnp.where(is_later, a, b), moved, at)
            node, at = _node(stepper.system, stepper.solver.tolerance, at)
            return _Counted(number + 1, at, saved.write(number, node, info, micro))

        return jax.lax.while_loop(goes_on, save, _Counted(jnp.asarray(0), at, saved))

    def _scanned(self, stepper: Plan, at: "_At", times: "_Times", loops: Loops) -> Trajectory:
        """All of a run from its first step, by loops that can be differentiated."""
        system, tolerance = stepper.system, stepper.solver.tolerance
        interval = self._interval(stepper, at.state, times, loops)

        def save(at: _At, _):
            at, info, micro = interval(at, times.save_every)
            node, at = _node(system, tolerance, at)
            return at, (node, info, micro)

        first, at = _node(system, tolerance, at)
        at, (nodes, info, micros) = loops.scan(save, at, self.num_saves)
        nodes = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first, nodes)
        before_end = _before_end(stepper.scheme, times.macro_dt)
        micro = None if micros is None else MicroNodes(nodes.state.t[1:, None] - before_end, micros)
        return Trajectory(*nodes, info=info, result=at.result, failed_at=at.failed_at, micro=micro)

    def _interval(self, stepper: Plan, state: State, times: "_Times", loops: Loops):
        """``at, info, micro = interval(at, count)``: the macro steps between two saved nodes."""
        no_info = RunInfo(np.asarray(0), np.asarray(0), np.zeros(()))
        no_micro = jnp.zeros((stepper.scheme.num_micro, state.q_f.shape[0])) if self.save_micro else None
        take = _step_of(stepper, times, self.save_micro)

        def interval(at: _At, count):
            at, info, micro = loops.repeat(count, take, (at, no_info, no_micro))
            if stepper.defers_projection:
                state, memory = stepper.project(at.state, at.memory)
                at = at._replace(state=state, memory=memory)
            return at, info, micro

        return interval

    def _nothing(self, state: State, num_micro: int) -> Saved:
        return Saved.none(state, self.num_saves, num_micro if self.save_micro else None)

    def _trajectory(self, scheme, done: "_Counted", times, macro_dt) -> Trajectory:
        status = {"result": done.at.result, "failed_at": done.at.failed_at}
        before_end = _before_end(scheme, macro_dt) if self.save_micro else None
        return done.saved.trajectory(done.at.state.q_s.shape[0], times, status, before_end)


engine = lru_cache(maxsize=32)(Engine)
"""The engine with these attributes. Thousands of programs would exhaust the memory maps that a process may have."""


def _before_end(scheme, macro_dt):
    """(num_micro,) by how much the micro nodes of a macro step are earlier than its end."""
    return macro_dt * (1 - scheme.micro_times)


@lru_cache(maxsize=256)
def _blank_memory(engine: Engine, shapes: tuple):
    """Zeros in the shapes of the memory of a stepper; `shapes` and types of the leaves and of the five arrays of a state."""

    def memory(*arrays):
        start = State(*arrays[-5:])  # the five arrays of a state
        return engine.stepper(list(arrays[:-5]), start).init(start, 1.0)

    blank = jax.eval_shape(memory, *(jax.ShapeDtypeStruct(*shape) for shape in shapes))
    return jax.device_put(jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), blank))


class _Times(NamedTuple):
    """Times of a run: that of its start, the macro step H, and the macro steps from one saved node to the next."""

    t_start: Any
    macro_dt: Any
    save_every: Any


class _At(NamedTuple):
    """Where a run is: before macro step `step`, with the worst `result` so far and the step that failed, -1 if none did."""

    state: State
    memory: Any
    step: Int[Numbers, ""]
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]

    @classmethod
    def before(cls, state: State, memory, step) -> "_At":
        """A step, without failures so far."""
        return cls(state, memory, jnp.asarray(step), np.asarray(int(Result.CONVERGED)), np.asarray(-1))


class _Counted(NamedTuple):
    """Number of the next node to be saved, where the run is, and the nodes that are saved."""

    number: Int[Numbers, ""]
    at: _At
    saved: Saved


def _step_of(stepper: Plan, times: _Times, save_micro: bool):
    """A macro step as the body of a loop. From a failure on momenta are NaN, and by them all positions after it."""
    t_start, macro_dt, _ = times

    def step(_, carry):
        at, worst, _ = carry
        alive = at.failed_at < 0
        state, info, memory = stepper.step(at.state, at.memory, macro_dt)
        ok = alive & (info.result <= Result.CONVERGED_AT_ROUNDOFF)
        now = RunInfo(info.method, info.iterations, info.residual)
        worst = jax.tree.map(lambda a, b: jnp.where(alive, jnp.maximum(a, b), a), worst, now)
        p_s, p_f = (jnp.where(ok, p, jnp.nan) for p in (state.p_s, state.p_f))
        state = State(t_start + (at.step + 1) * macro_dt, state.q_s, state.q_f, p_s, p_f)
        result = jnp.where(alive, jnp.maximum(at.result, info.result), at.result)
        failed_at = jnp.where(alive & ~ok, at.step, at.failed_at)
        micro = jnp.where(ok, info.q_f_micro, jnp.nan) if save_micro else None
        return _At(state, memory, at.step + 1, result, failed_at), worst, micro

    return step


def _node(system: System, tolerance, at: _At) -> tuple[Node, _At]:
    """What is saved of a node, and the status after a look at it.

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
    *phase, energy, residual = (jnp.where(failed_at < 0, a, jnp.nan) for a in (*phase, energy, residual))
    node = Node(State(jnp.asarray(state.t), *phase), energy, residual)
    return node, at._replace(result=result, failed_at=failed_at)
