"""Saved nodes of a run while it is computed: a row of numbers for each, so that a node is one write; and the trajectory they make."""

from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.state import State
from vmri_jax.running.trajectory import MicroNodes, RunInfo, Trajectory

NUMBERS = 2**17
"""Numbers in the nodes of a piece of a run, a megabyte. With more of them processes with many systems need more memory, with fewer long
runs are called for more often, which takes some 30 microseconds each time."""


OTHERS, DONE = 4, len(RunInfo._fields)
"""Numbers of a node besides positions and momenta (time, energy, two constraint residuals), and of the solver's work before it."""


class Node(NamedTuple):
    """Fields of a `Trajectory` at a node."""

    state: State
    energy: Float[Numbers, "*k"]
    constraint_residual: Float[Numbers, "*k 2"]


class Saved(NamedTuple):
    """Room for nodes, arrays of JAX or of NumPy.

    rows: each a `Node` and the `RunInfo` since the one before.
    micros: fast positions at micro nodes, None unless asked for.
    """

    rows: Float[Numbers, "room+1 numbers"]
    micros: Float[Numbers, "room num_micro n_f"] | None

    @classmethod
    def none(cls, state: State, room: int, num_micro: int | None) -> "Saved":
        """Before anything is saved. `num_micro` is None unless micro nodes are saved."""
        row = _unknown(_numbers(state))
        micros = None if num_micro is None else jnp.full((room, num_micro, state.q_f.shape[0]), jnp.nan)
        return cls(jnp.broadcast_to(row, (room + 1, row.size)), micros)

    def write(self, number, node: Node, info: RunInfo, micro) -> "Saved":
        """With node `number`; number 0 is the start, which has no micro nodes before it."""
        row = jnp.concatenate([jnp.ravel(jnp.asarray(a, float)) for a in jax.tree.leaves((node, info))])
        rows = jax.lax.dynamic_update_index_in_dim(self.rows, row, number, 0)
        micros = self.micros
        if micros is not None:
            micros = jax.lax.dynamic_update_index_in_dim(micros, micro, jnp.maximum(number - 1, 0), 0)
        return Saved(rows, micros)

    def first(self, saves: int, written: int) -> "Saved":
        """The first `saves` saved intervals as arrays of NumPy, of which only the first `written` nodes are known."""
        rows = np.array(np.asarray(self.rows)[: saves + 1])
        rows[written:] = _unknown(rows.shape[1])
        if self.micros is None:
            return Saved(rows, None)
        micros = np.array(np.asarray(self.micros)[:saves])
        micros[max(written - 1, 0) :] = np.nan
        return Saved(rows, micros)

    def trajectory(self, num_slow: int, times, status: dict[str, Any], before_end) -> Trajectory:
        """All nodes as a trajectory.

        Args:
            num_slow: n_s.
            times: (room + 1,) of all nodes, which nodes after a failure have, too.
            status: `result` and `failed_at`.
            before_end: (num_micro,) by how much the micro nodes of a step are earlier than its end.
        """
        module = jnp if isinstance(self.rows, jax.Array) else np
        num_fast = (self.rows.shape[1] - OTHERS - DONE) // 2 - num_slow
        ends = list(accumulate((1, num_slow, num_fast, num_slow, num_fast, 1, 2)))
        t, q_s, q_f, p_s, p_f, energy, residual, did = module.split(self.rows, ends, axis=1)
        t = module.where(module.isnan(t[:, 0]), times, t[:, 0])
        method, iterations, left = did[1:].T
        info = RunInfo(method.astype(int), iterations.astype(int), left)
        micro = None if self.micros is None else MicroNodes(t[1:, None] - before_end, self.micros)
        return Trajectory(State(t, q_s, q_f, p_s, p_f), energy[:, 0], residual, info, **status, micro=micro)


def _numbers(state: State) -> int:
    """Numbers in the row of a node."""
    return 2 * (state.q_s.size + state.q_f.size) + OTHERS + DONE


def _unknown(numbers: int) -> np.ndarray:
    """The row of a node that no step has reached: NaN, and no work of the solver before it."""
    return np.append(np.full(numbers - DONE, np.nan), np.zeros(DONE))


def room_of_a_piece(state: State, num_micro: int, save_micro: bool) -> int:
    """Saved intervals of a piece of a run: the same for all lengths, so that they share one program."""
    numbers = _numbers(state) + (num_micro * (state.q_f.size + 1) if save_micro else 0)
    return max(NUMBERS // numbers, 1)
