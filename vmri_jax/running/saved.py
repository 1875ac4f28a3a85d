"""Saved nodes of a run while it is computed: a row of numbers for each, so that a node is one write; and the trajectory they make."""

from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.state import State
from vmri_jax.running.trajectory import RunInfo, Trajectory

NUMBERS = 2**17
"""Numbers in the nodes of a piece of a run, a megabyte. With more of them processes with many systems need more memory, with fewer long
runs are called for more often, which takes some 30 microseconds each time."""


class Node(NamedTuple):
    """What is saved of a node: fields of a `Trajectory`."""

    t: Float[Numbers, "*k"]
    q_s: Float[Numbers, "*k n_s"]
    q_f: Float[Numbers, "*k n_f"]
    p_s: Float[Numbers, "*k n_s"]
    p_f: Float[Numbers, "*k n_f"]
    energy: Float[Numbers, "*k"]
    constraint_residual: Float[Numbers, "*k 2"]


class Saved(NamedTuple):
    """Room for nodes.

    rows: each a `Node` and what the solver did since the one before.
    micros: fast positions at micro nodes, None unless asked for.
    """

    rows: Float[Array, "room+1 numbers"]
    micros: Float[Array, "room num_micro n_f"] | None

    @classmethod
    def none(cls, state: State, room: int, num_micro: int | None) -> "Saved":
        """Before anything is saved: NaN, and nothing done. `num_micro` is None unless micro nodes are saved."""
        n_s, n_f = state.q_s.shape[0], state.q_f.shape[0]
        row = np.concatenate([np.full(2 * (n_s + n_f) + 4, np.nan), np.zeros(len(RunInfo._fields))])
        micros = None if num_micro is None else jnp.full((room, num_micro, n_f), jnp.nan)
        return cls(jnp.broadcast_to(row, (room + 1, row.size)), micros)

    def write(self, number, node: Node, info: RunInfo, micro) -> "Saved":
        """With node `number`; number 0 is the start, which has no micro nodes before it."""
        row = jnp.concatenate([jnp.ravel(jnp.asarray(a, float)) for a in (*node, *info)])
        rows = jax.lax.dynamic_update_index_in_dim(self.rows, row, number, 0)
        micros = self.micros
        if micros is not None:
            micros = jax.lax.dynamic_update_index_in_dim(micros, micro, jnp.maximum(number - 1, 0), 0)
        return Saved(rows, micros)

    def first(self, saves: int, written: int) -> "Saved":
        """The first `saves` saved intervals as arrays of NumPy, of which only the first `written` nodes are known."""
        rows = np.array(np.asarray(self.rows)[: saves + 1])
        rows[written:] = np.append(np.full(rows.shape[1] - 3, np.nan), np.zeros(3))
        if self.micros is None:
            return Saved(rows, None)  # pyright: ignore[reportArgumentType]
        micros = np.array(np.asarray(self.micros)[:saves])
        micros[max(written - 1, 0) :] = np.nan
        return Saved(rows, micros)  # pyright: ignore[reportArgumentType]

    def trajectory(self, num_slow: int, times, status: dict[str, Any], before_end) -> Trajectory:
        """All nodes as a trajectory, arrays of JAX or of NumPy.

        Args:
            num_slow: n_s.
            times: (room + 1,) of all nodes, which nodes after a failure have, too.
            status: `result` and `failed_at`.
            before_end: (num_micro,) by how much the micro nodes of a step are earlier than its end.
        """
        num_fast = (self.rows.shape[1] - 7 - 2 * num_slow) // 2
        ends = accumulate((1, num_slow, num_fast, num_slow, num_fast, 1, 2))
        starts = [0, *ends]
        columns = [self.rows[:, a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]
        t, q_s, q_f, p_s, p_f, energy, residual, info = columns
        where = jnp.where if isinstance(t, jax.Array) else np.where
        t = where(t[:, 0] == t[:, 0], t[:, 0], times)
        method, iterations, left = info[1:].T
        did = RunInfo(method.astype(int), iterations.astype(int), left)
        t_micro = None if self.micros is None else t[1:, None] - before_end
        return Trajectory(
            t, q_s, q_f, p_s, p_f, energy[:, 0], residual, info=did, **status, t_micro=t_micro, q_f_micro=self.micros
        )


def room_of_a_piece(state: State, num_micro: int, save_micro: bool) -> int:
    """Saved intervals of a piece of a run: the same for all lengths, so that they share one program."""
    numbers = 2 * (state.q_s.size + state.q_f.size) + 7 + (num_micro * (state.q_f.size + 1) if save_micro else 0)
    return max(NUMBERS // numbers, 1)
