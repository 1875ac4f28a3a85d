"""Saved nodes of a run while it is computed, one row of numbers for each node, and the run made from the rows.

A node is a single write into a single array: XLA on CPU would take longer for one write into each field.
"""

from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import psutil
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers
from vmri_jax.mechanics.state import State
from vmri_jax.refusals import Refused
from vmri_jax.running.observables import Observables
from vmri_jax.running.trajectory import MicroNodes, RunInfo, Trajectory

NUMBERS_PER_PIECE = 2**17
"""Numbers in the nodes of a piece of a run, a megabyte. A larger value takes more memory in processes with many systems; a smaller one
divides long runs into more calls of some 30 microseconds each."""
SOLVER_NUMBERS = len(RunInfo._fields)
"""Numbers of a row for the work of the solver since the previous node."""
BYTES_PER_NUMBER = 8
UNCHECKED_BYTES = 100e6
"""Bytes of a trajectory up to which free memory is not looked up: the look-up takes some ten microseconds, as long as a short run. With a
larger value more runs may fill a small machine."""


class Saved(NamedTuple):
    """Arrays for the nodes of a run, of JAX or of NumPy, in a batch with an axis of lanes.

    rows: a row for each node: positions and momenta of its `State`, and the `RunInfo` since the previous node.
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
        row = jnp.concatenate([*vars(state).values()][1:] + [jnp.asarray(a, float)[None] for a in info])
        rows = jax.lax.dynamic_update_index_in_dim(self.rows, row, number, 0)
        micros = self.micros
        if micros is not None:
            micros = jax.lax.dynamic_update_index_in_dim(micros, micro, jnp.maximum(number - 1, 0), 0)
        return Saved(rows, micros)

    def first(self, saves: int) -> "Saved":
        """The first `saves` saved intervals as arrays of NumPy."""
        rows = np.array(np.asarray(self.rows)[: saves + 1])
        return Saved(rows, None if self.micros is None else np.array(np.asarray(self.micros)[:saves]))

    def states(self, start: State, t) -> State:
        """The nodes as states at the times t; `start` has the numbers of variables."""
        ends = accumulate(a.shape[-1] for a in (start.q_s, start.q_f, start.p_s, start.p_f))
        return State(t, *(self.rows[..., a:b] for a, b in pairwise([0, *ends])))

    def run(self, start: State, t, result, failed_at, scheme, macro_dt) -> Trajectory:
        """All nodes at their times t as a trajectory without observables, with this status."""
        first = 2 * (start.q_s.shape[-1] + start.q_f.shape[-1])
        method, iterations, residual = (self.rows[..., 1:, first + k] for k in range(SOLVER_NUMBERS))
        info = RunInfo(method.astype(int), iterations.astype(int), residual)
        micro = None if self.micros is None else MicroNodes.of(t, scheme, macro_dt, self.micros)
        return Trajectory(self.states(start, t), None, None, info, result, failed_at, micro)


def numbers_per_node(state: State, num_micro: int = 0) -> int:
    """Numbers of a saved node, with `num_micro` micro nodes."""
    row = 2 * (state.q_s.size + state.q_f.size) + SOLVER_NUMBERS
    return row + num_micro * (state.q_f.size + 1)


def room_of_a_piece(state: State, num_micro: int, save_micro: bool) -> int:
    """Saved intervals that fit into a piece of a run: the same for runs of all lengths, so that they share one program."""
    return max(NUMBERS_PER_PIECE // numbers_per_node(state, num_micro if save_micro else 0), 1)


def check_memory(caller: str, run: Any, lanes: int = 1, num_saves: int | None = None) -> None:
    """Refuse a run whose trajectory would not fit into the free memory.

    Args:
        caller: the function that was called, for the message.
        run: the `Simulation` of one lane.
        lanes: runs whose trajectories are kept together.
        num_saves: saved intervals; None for those of the run.

    Raises:
        ValueError: the trajectory is larger than the free memory.
    """
    nodes = 1 + (num_saves or run.num_saves)
    micro = run.scheme.num_micro if run.save_micro else 0
    needed = BYTES_PER_NUMBER * (numbers_per_node(run.state, micro) + len(Observables._fields)) * nodes * lanes
    if needed < UNCHECKED_BYTES:
        return
    free = psutil.virtual_memory().available
    if needed > free:
        raise Refused(
            f"{caller}: {nodes} saved nodes{f' of {lanes} runs' if lanes > 1 else ''} would take {needed / 1e9:.3g} GB, and "
            f"{free / 1e9:.3g} GB of memory are free. Save fewer of them (save=...), or write them to disk as they come "
            "(vmri_jax.stream)."
        )
