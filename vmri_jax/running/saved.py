"""Saved nodes of a run while it is computed, one row of numbers for each node, and the run made from the rows.

A node is a single write into a single array: XLA on CPU would take longer for one write into each field.
"""

from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.state import State
from vmri_jax.running.trajectory import MicroNodes, Run, RunInfo

NUMBERS_PER_PIECE = 2**17
"""Numbers in the nodes of a piece of a run, a megabyte. A larger value takes more memory in processes with many systems; a smaller one
divides long runs into more calls of some 30 microseconds each."""
SOLVER_NUMBERS = len(RunInfo._fields)
"""Numbers of a row for the work of the solver since the previous node."""


class Saved(NamedTuple):
    """Arrays for the nodes of a run, of JAX or of NumPy.

    rows: a row for each node: its `State`, and the `RunInfo` since the previous node.
    micros: fast positions at micro nodes; None unless micro nodes are saved.
    """

    rows: Float[Numbers, "room+1 numbers"]
    micros: Float[Numbers, "room num_micro n_f"] | None

    @classmethod
    def none(cls, state: State, room: int, num_micro: int | None) -> "Saved":
        """Arrays without nodes; zeros, since `jax_debug_nans` stops a program that returns NaN. `num_micro` is None unless micro nodes are saved."""
        micros = None if num_micro is None else jnp.zeros((room, num_micro, state.q_f.shape[0]))
        return cls(jnp.zeros((room + 1, numbers_per_node(state))), micros)

    def write(self, number, state: State, info: RunInfo, micro) -> "Saved":
        """The arrays with node `number` written into them; node 0, the start, has no micro nodes before it."""
        row = jnp.concatenate([jnp.ravel(jnp.asarray(a, float)) for a in jax.tree.leaves((state, info))])
        rows = jax.lax.dynamic_update_index_in_dim(self.rows, row, number, 0)
        micros = self.micros
        if micros is not None:
            micros = jax.lax.dynamic_update_index_in_dim(micros, micro, jnp.maximum(number - 1, 0), 0)
        return Saved(rows, micros)

    def first(self, saves: int, written: int) -> "Saved":
        """The first `saves` saved intervals as arrays of NumPy; nodes from number `written` on are old data and become NaN."""
        rows = np.array(np.asarray(self.rows)[: saves + 1])
        rows[written:] = _empty_row(rows.shape[1])
        if self.micros is None:
            return Saved(rows, None)
        micros = np.array(np.asarray(self.micros)[:saves])
        micros[max(written - 1, 0) :] = np.nan
        return Saved(rows, micros)

    def ended(self, saves, written) -> "Saved":
        """The arrays of JAX with NaN in the nodes from number `written` to `saves`, which a failed run has not reached."""
        number = jnp.arange(len(self.rows))
        is_missing = (number >= written) & (number <= saves)
        rows = jnp.where(is_missing[:, None], _empty_row(self.rows.shape[1]), self.rows)
        micros = None if self.micros is None else jnp.where(is_missing[1:, None, None], jnp.nan, self.micros)
        return Saved(rows, micros)

    def run(self, num_slow: int, times, status: dict[str, Any], before_end) -> Run:
        """All nodes as a run.

        Args:
            num_slow: n_s.
            times: (room + 1,) times of all nodes, for the nodes after a failure, whose rows are empty.
            status: `result` and `failed_at`.
            before_end: (num_micro,) times from the micro nodes of a macro step to its end.
        """
        module = jnp if isinstance(self.rows, jax.Array) else np
        num_fast = (self.rows.shape[1] - 1 - SOLVER_NUMBERS) // 2 - num_slow
        ends = list(accumulate((1, num_slow, num_fast, num_slow, num_fast)))
        t, q_s, q_f, p_s, p_f, work = module.split(self.rows, ends, axis=1)
        t = module.where(module.isnan(t[:, 0]), times, t[:, 0])
        method, iterations, residual = work[1:].T
        info = RunInfo(method.astype(int), iterations.astype(int), residual)
        micro = None if self.micros is None else MicroNodes(t[1:, None] - before_end, self.micros)
        return Run(State(t, q_s, q_f, p_s, p_f), info, **status, micro=micro)


def numbers_per_node(state: State, num_micro: int = 0) -> int:
    """Numbers of a saved node, with `num_micro` micro nodes."""
    row = 1 + 2 * (state.q_s.size + state.q_f.size) + SOLVER_NUMBERS
    return row + num_micro * (state.q_f.size + 1)


def _empty_row(numbers: int) -> np.ndarray:
    """The row of a node that no step has reached: NaN, and zeros for the work of the solver."""
    return np.append(np.full(numbers - SOLVER_NUMBERS, np.nan), np.zeros(SOLVER_NUMBERS))


def room_of_a_piece(state: State, num_micro: int, save_micro: bool) -> int:
    """Saved intervals that fit into a piece of a run: the same for runs of all lengths, so that they share one program."""
    return max(NUMBERS_PER_PIECE // numbers_per_node(state, num_micro if save_micro else 0), 1)
