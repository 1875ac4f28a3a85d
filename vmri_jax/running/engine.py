"""The engine of all runs: a loop of macro steps inside a loop over saved nodes, compiled once per structure. It returns
states and statuses, and beside each saved state its `Observables`, which it computes after all steps.

Names: `save_every` macro steps lie between two saved nodes; `num_saves` saved intervals fit into the arrays of an
engine; a call computes the first `saves` of them.

The derivative of a step is the derivative of the root of its equations (`vmri_jax.steppers.implicit`). Reverse
mode visits the steps from the last to the first and needs the state at which each step started, see `loops`. Runs have
derivatives in both modes, up to second ones; third derivatives are NaN where equations are solved by iteration.

The fallback: what the first matrix of "auto" does not solve is solved again with exact matrices, in a program of its
own. `unsolved` decides for all runs: for a step (`macro_step`), a run or a piece of it, the lanes of a batch, and runs
under transformations of JAX (`solved_again`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vmri_jax.mechanics.arrays import Numbers, options_of_runs
from vmri_jax.mechanics.state import State
from vmri_jax.running import loops
from vmri_jax.running.observables import observed
from vmri_jax.running.saved import Columns, Saved
from vmri_jax.steppers.plan import Plan
from vmri_jax.steppers.results import Method, Result
from vmri_jax.steppers.stepper import StepStatus

FALLING_BACK = (
    'a step was not solved: computing its part of the run again with exact matrices (matrix "exact"), as accurate '
    "but slower"
)
"""Line about a fallback that takes more than two seconds."""
NODES_AT_ONCE = 16
"""Nodes whose observables are computed side by side. With fewer nodes XLA uses no vector instructions; with 64 the
matrices of scenes no longer fit into the first-level cache, and a run of a few nodes takes longer."""


class Cursor(NamedTuple):
    """A run between two steps, all that its next steps depend on: state and memory of the stepper before macro step
    `step`, the worst `result` so far, the failed step or -1. Memory None: the stepper has none of earlier steps."""

    state: State
    memory: Any
    step: Int[Numbers, ""]
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]

    @classmethod
    def at_start(cls, state: State, memory=None) -> "Cursor":
        """The cursor of a run that begins."""
        return cls(state, memory, np.asarray(0), np.asarray(int(Result.CONVERGED)), np.asarray(-1))


@dataclass(frozen=True)
class Engine:
    """Compiled runs of all systems and schemes of one structure, as functions of the leaves of a `Simulation` and of
    numbers of steps.

    A run is flattened once: to flatten a system at every call would take longer than a short run. `structure` is the
    structure of a run without its length and names, whose arrays have room for `num_saves` saved intervals.
    """

    structure: Any
    num_saves: int

    @cached_property
    def program(self):
        """`steps`, compiled; the numbers of steps are traced arguments."""
        return jax.jit(self.steps, compiler_options=options_of_runs())

    def steps(self, leaves: list, save_every, saves=None, cursor: Cursor | None = None, is_first: Any = True):
        """The first `saves` saved intervals: rows of `Saved`, more of them by a part of a block, and the cursor after
        them.

        `saves` None: all intervals, failed or not. The end of the loop then depends on no lane of a batch, and
        `jax.vmap` need not select between old and new values in every lane.
        `cursor` None: the start of the run. In place of a cursor the program then returns (2,) result and failed step,
        since each array costs some microseconds.
        `is_first`: whether the memory of a first step replaces the memory of the cursor.
        """
        run: Any = jax.tree.unflatten(self.structure, leaves)
        stepper, begin = run.plan, cursor or Cursor.at_start(run.state)
        memory = stepper.init(begin.state, run.macro_dt)
        if cursor is not None:
            memory = jax.tree.map(partial(jnp.where, is_first), memory, cursor.memory)
        interval = _interval(stepper, run, partial(jax.lax.fori_loop, 0))

        def goes_on(loop):
            number, cursor, _ = loop
            return number <= self.num_saves if saves is None else (number <= saves) & (cursor.failed_at < 0)

        def save(loop):
            number, cursor, rows = loop
            # turn 0 takes no step and saves the start, so that the code for nodes is compiled once
            cursor, worst, micro = interval(cursor, jnp.where(number > 0, save_every, 0))
            row = _row(cursor.state, worst, micro)
            return number + 1, cursor, jax.lax.dynamic_update_slice(rows, row[None], (number, 0))

        begin = jax.tree.map(jnp.asarray, begin._replace(memory=memory))
        room = (self.num_saves // self._block + 1) * self._block  # of whole blocks
        rows = jnp.zeros((room, run.width))  # `jax_debug_nans` stops a program that returns NaN
        _, end, rows = jax.lax.while_loop(goes_on, save, (jnp.asarray(0), begin, rows))
        rows = self._rows_as_saved(run, rows, begin.step, save_every, self.num_saves if saves is None else saves)
        return rows, jnp.stack([end.result, end.failed_at]) if cursor is None else end

    @property
    def _block(self) -> int:
        """Nodes whose observables are computed side by side."""
        return min(NODES_AT_ONCE, self.num_saves + 1)

    def _rows_as_saved(self, run, rows, step, save_every, saves):
        """The rows as they are saved, block by block, up to the node `saves`, and copies of this node up to the end of
        its block."""

        def block(i, rows):
            number = jnp.minimum(i * self._block + jnp.arange(self._block), saves)  # beyond it there may be no state
            nodes = run.columns.split(rows[number])
            row = jnp.concatenate(_as_saved(run, nodes, step + number * save_every), axis=1)
            return jax.lax.dynamic_update_slice(rows, row, (i * self._block, 0))

        return jax.lax.fori_loop(0, saves // self._block + 1, block, rows)

    @cached_property
    def differentiable(self):
        """``differentiable(leaves, save_every)``: a whole run as `Saved` without observables, by `jax.lax.scan`, which
        reverse mode can differentiate; the numbers of steps are static."""

        def by_scan(leaves: list, save_every: int) -> Saved:
            run: Any = jax.tree.unflatten(self.structure, leaves)
            numbers = sum(a.size for a in jax.tree.leaves(run.state)) * run.scheme.num_micro  # of a step, about
            in_parts, stepper = self.num_saves * save_every * numbers > loops.MOST_STORED_NUMBERS, run.plan
            interval = _interval(stepper, run, partial(loops.differentiable, in_parts=in_parts))

            def save(cursor: Cursor, _):
                cursor, worst, micro = interval(cursor, save_every)
                return cursor, _row(cursor.state, worst, micro)

            cursor = Cursor.at_start(run.state, stepper.init(run.state, run.macro_dt))
            cursor, rows = loops.scan(save, jax.tree.map(jnp.asarray, cursor), self.num_saves, in_parts, save_every)
            first = _row(run.state, *_nothing(run))
            nodes = run.columns.split(jnp.concatenate([first[None], rows]))
            return Saved(nodes, cursor.result, cursor.failed_at)

        return jax.jit(by_scan, static_argnums=1)

    @cached_property
    def nodes_as_saved(self):
        """``nodes_as_saved(leaves, saved, save_every)``: the nodes of `differentiable` as they are saved, with
        failures."""

        def nodes_as_saved(leaves: list, saved: Saved, save_every) -> Saved:
            run: Any = jax.tree.unflatten(self.structure, leaves)
            nodes = _as_saved(run, saved.nodes, jnp.arange(self.num_saves + 1) * save_every)
            return saved._replace(nodes=nodes).marked(replace(run, save_every=save_every))

        return jax.jit(nodes_as_saved)  # else JAX would compile the operations of a gradient outside of jit one by one


engine = lru_cache(maxsize=32)(Engine)
"""``engine(structure, num_saves)``: the `Engine` with these attributes, made once. The 33rd structure displaces the one
used least recently, which compiles again when it is needed: each program takes memory maps, of which a process has a
limited number."""


@lru_cache(maxsize=256)
def blank_memory(engine: Engine, shapes: tuple):
    """Zeros in the shapes of the memory of the stepper, from the shapes and types of the leaves of a run."""

    def first_memory(leaves):
        run = jax.tree.unflatten(engine.structure, leaves)
        return run.plan.init(run.state, run.macro_dt)

    blank = jax.eval_shape(first_memory, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    return jax.device_put(jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), blank))


def _as_saved(run, nodes: Columns, steps) -> Columns:
    """The nodes after these numbers of macro steps, with projected momenta and `Observables`."""

    def node(t, *phase):
        state, table = observed(run.system, State(t, *phase), run.macro_dt, run.solver.tolerance)
        return state.p_s, state.p_f, table

    p_s, p_f, table = jax.vmap(node)(run.state.t + steps * run.macro_dt, *nodes[:4])
    return nodes._replace(p_s=p_s, p_f=p_f, table=table)


def _row(state: State, worst: StepStatus, micro) -> Float[Numbers, "numbers"]:
    """The row of a node before its observables; of the steps before it the largest `RunInfo`."""
    phase = state.q_s, state.q_f, state.p_s, state.p_f
    return jnp.concatenate([*phase, *(jnp.asarray(a, float)[None] for a in worst[1:]), micro.reshape(-1)])


def _nothing(run) -> tuple[StepStatus, Any]:
    """The status of the steps, and the micro nodes, before the first step."""
    num_micro = run.scheme.num_micro if run.save.micro else 0
    return StepStatus.direct(Method.EXPLICIT), jnp.zeros((num_micro, run.state.q_f.shape[0]))


def _interval(stepper: Plan, run, repeat: Callable):
    """``cursor, worst, micro = interval(cursor, count)``: the `count` macro steps between two saved nodes."""
    t_start, macro_dt = run.state.t, run.macro_dt

    def step(_, carry):
        cursor, worst, micro = carry
        alive = cursor.failed_at < 0
        state, info, memory = stepper.step(cursor.state, cursor.memory, macro_dt)
        ok = alive & (info.result <= Result.CONVERGED_AT_ROUNDOFF)
        worst = jax.tree.map(partial(jnp.where, alive), worst.worse(info.status), worst)
        # NaN in the momenta alone: the next step carries it into all positions.
        p_s, p_f = (jnp.where(ok, p, jnp.nan) for p in (state.p_s, state.p_f))
        # t_k = t_0 + k H from the step number, since a sum of steps would accumulate round-off; the time of the stepper
        # is ignored.
        state = State(t_start + (cursor.step + 1) * macro_dt, state.q_s, state.q_f, p_s, p_f)
        failed_at = jnp.where(alive & ~ok, cursor.step, cursor.failed_at)
        micro = jnp.where(ok, info.q_f_micro, jnp.nan) if run.save.micro else micro
        return Cursor(state, memory, cursor.step + 1, cursor.result, failed_at), worst, micro

    def interval(cursor: Cursor, count):
        cursor, worst, micro = repeat(count, step, (cursor, *_nothing(run)))
        return cursor._replace(result=jnp.maximum(cursor.result, worst.result)), worst, micro

    return interval


def unsolved(result, method):
    """Whether steps failed that exact matrices may solve, from their worst `Result` and largest `Method`.

    They cannot help explicit and linear equations, nor steps that were solved but violate implied constraints.
    """
    return (result > Result.CONVERGED_AT_ROUNDOFF) & (result != Result.NOT_IMPLIED) & (method > Method.LINEAR)


def solved_again(first: Callable, exact: Callable, status: Callable, arguments: Any) -> Any:
    """``first(arguments)``, or ``exact(arguments)`` where that is `unsolved`, in one program, to be transformed.

    The derivative is the derivative of `exact`, with its value: to differentiate both would compile two programs.
    Values of the two differ by the tolerance of the solver. ``status(value)`` is (result, method) of a value.
    """

    @jax.custom_jvp
    def run(arguments):
        value = first(arguments)
        return jax.lax.cond(unsolved(*status(value)), lambda: exact(arguments), lambda: value)

    run.defjvp(lambda primals, tangents: jax.jvp(exact, primals, tangents))
    return run(arguments)
