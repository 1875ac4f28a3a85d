"""Saved nodes of a run: columns of numbers, and the status of the run.

A program writes the numbers of a node as one row into one array: XLA on CPU would take longer for one write into each
column. Derivatives go column by column: the derivative of positions then has no part of that of the observables.
"""

from functools import partial
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
import psutil
from jaxtyping import Int

from vmri_jax.mechanics.arrays import Numbers, is_concrete, library, split_at
from vmri_jax.mechanics.state import State
from vmri_jax.refusals import Refused
from vmri_jax.running.observables import Observables, fault, is_right
from vmri_jax.running.trajectory import MicroNodes, RunInfo, Trajectory, status

BYTES_PER_NUMBER = 8
UNCHECKED_BYTES = 100e6
"""Bytes of a trajectory up to which free memory is not looked up: the look-up takes some ten microseconds, as long as a
short run. With a larger value more runs may fill a small machine."""


class Columns(NamedTuple):
    """The columns of nodes as arrays, or their slices of a row.

    q_s, q_f, p_s, p_f: positions and momenta, as of a `State`.
    info: `RunInfo` of the steps since the node before.
    micro: fast positions at the micro nodes of the last of these steps.
    table: `Observables` of the state.
    """

    q_s: Any
    q_f: Any
    p_s: Any
    p_f: Any
    info: Any
    micro: Any
    table: Any

    @classmethod
    def of(cls, state: State, num_micro: int) -> "Columns":
        """The columns of nodes shaped like a state, or like the states of a batch, with `num_micro` saved micro
        nodes."""
        n_s, n_f = state.q_s.shape[-1], state.q_f.shape[-1]
        sizes = n_s, n_f, n_s, n_f, len(RunInfo._fields), num_micro * n_f, len(Observables._fields)
        return cls(*(slice(*ends) for ends in pairwise(accumulate(sizes, initial=0))))

    def split(self, rows) -> "Columns":
        """The arrays of rows (..., numbers) with these slices."""
        return Columns(*split_at(rows, *(column.stop for column in self[:-1])))


class Saved(NamedTuple):
    """Nodes of a run and its status; of JAX or NumPy; in a batch with lanes."""

    nodes: Columns
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]

    @property
    def method(self):
        """The largest `Method` of the steps."""
        return self.nodes.info[..., 0].max(axis=-1)

    def marked(self, run: Any, step: int = 0) -> "Saved":
        """The nodes of a `Simulation`, NaN from a failure on; a node that cannot be right, see `is_right`, is a
        failure, of the last step before it.

        Nodes after a failed step may have any numbers. There are `step` macro steps before the first node.
        """
        nodes, result, failed_at = self
        module, now = library(nodes.table), Observables.of(nodes.table)
        right = is_right(now)
        # a prepared run is called many times, and an operation of JAX takes as long as many steps
        if module is np and right.all() and (failed_at < 0).all():
            return self
        node, number = right.argmin(axis=-1), np.arange(right.shape[-1])[:, None]
        after_step = module.where(failed_at < 0, len(number), (failed_at - step) // run.save_every + 1)
        breaks = ~right.all(axis=-1) & (node < after_step)
        cause = module.take_along_axis(fault(now), node[..., None], -1)[..., 0]
        lost = number >= module.where(breaks, node, after_step)[..., None, None]
        unreached = number > module.where(breaks, len(number), after_step)[..., None, None]
        info = module.where(unreached, 0.0, nodes.info)

        def marked(_, column, lost=lost):
            return module.where(lost, np.nan, column)

        # Derivatives of lost nodes are NaN, too. Those of `where` would be zero, which a search by gradients takes for
        # its goal; as solution of ``x = column`` a column has rules of its own in forward and in reverse mode.
        solve = partial(jax.lax.custom_linear_solve, lambda x: x, solve=marked)
        solve = partial(solve, transpose_solve=lambda _, slope: marked(_, slope, lost & (slope != 0)))
        nodes = Columns(*map(partial(marked, None) if module is np else solve, nodes))._replace(info=info)
        failed_here = step + module.maximum(node * run.save_every - 1, 0)
        return Saved(nodes, module.where(breaks, cause, result), module.where(breaks, failed_here, failed_at))

    def trajectory(self, run: Any, step: int = 0) -> Trajectory:
        """The nodes as a trajectory of a `Simulation`, in a batch one whose arrays have an axis of lanes, after a
        number of macro steps."""
        *phase, info, q_f_micro, table = self.nodes
        t_start, macro_dt = (np.asarray(a) if is_concrete(a) else a for a in (run.state.t, run.macro_dt))
        t = t_start[..., None] + (step + np.arange(table.shape[-2]) * run.save_every) * macro_dt[..., None]
        states, micro = State(t, *phase), None
        method, iterations, residual = (info[..., 1:, i] for i in range(len(RunInfo._fields)))
        if run.save.micro:  # micro node i lies H (1 - c_i) before the end of its macro step
            before_end = macro_dt[..., None, None] * (1 - run.scheme.micro_times)
            shape = *residual.shape, before_end.shape[-1], states.q_f.shape[-1]
            micro = MicroNodes(t[..., 1:, None] - before_end, q_f_micro[..., 1:, :].reshape(shape))
        info = RunInfo(method.astype(int), iterations.astype(int), residual)
        return Trajectory(
            states, table[..., 0], table[..., 1:3], info, status(self.result), self.failed_at, micro, origin=run.origin
        )


def joined(pieces: list[Saved]) -> Saved:
    """Consecutive pieces as one; each starts with the last node of the piece before, and has the worst status of all
    before it."""
    if len(pieces) == 1:
        return pieces[0]
    columns = zip(*(piece.nodes for piece in pieces), strict=True)
    joined = ([a[min(i, 1) :] for i, a in enumerate(parts)] for parts in columns)
    return pieces[-1]._replace(nodes=Columns(*map(np.concatenate, joined)))


def check_memory(caller: str, run: Any, lanes: int = 1, num_saves: int | None = None) -> None:
    """Refuse runs side by side, with `num_saves` intervals each, None for those of `run`, that would not fit into the
    free memory; `caller` begins the message."""
    nodes = 1 + (num_saves or run.num_saves)
    needed = BYTES_PER_NUMBER * run.width * nodes * lanes
    if needed < UNCHECKED_BYTES:
        return
    free = psutil.virtual_memory().available
    if needed > free:
        kept = f"{nodes} saved nodes{f' of {lanes} runs' if lanes > 1 else ''} would take {needed / 1e9:.3g} GB"
        advice = "Save fewer of them (save=...), or write them to disk as they come (vmri_jax.stream)"
        raise Refused(f"{caller}: {kept}, and {free / 1e9:.3g} GB of memory are free. {advice}.")
