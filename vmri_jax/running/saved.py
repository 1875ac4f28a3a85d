"""Saved nodes of a run: the columns of their numbers, and the status of the run.

A program writes the numbers of a node as one row into one array: XLA on CPU would take longer for one write into each column.
"""

from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
import psutil
from jaxtyping import Int

from vmri_jax.mechanics.arrays import Numbers, is_concrete, library
from vmri_jax.mechanics.state import State
from vmri_jax.refusals import Refused
from vmri_jax.running.observables import Observables
from vmri_jax.running.trajectory import MicroNodes, RunInfo, Trajectory, status
from vmri_jax.steppers.results import Result

BYTES_PER_NUMBER = 8
UNCHECKED_BYTES = 100e6
"""Bytes of a trajectory up to which free memory is not looked up: the look-up takes some ten microseconds, as long as a short run. With a
larger value more runs may fill a small machine."""


def columns_of(state: State, num_micro: int) -> tuple[slice, ...]:
    """The columns of a row, in the order of `Saved`, of nodes shaped like a state, or like the states of a batch, with `num_micro` saved micro nodes."""
    n_s, n_f = state.q_s.shape[-1], state.q_f.shape[-1]
    sizes = n_s, n_f, n_s, n_f, len(RunInfo._fields), num_micro * n_f, len(Observables._fields)
    return tuple(slice(*ends) for ends in pairwise(accumulate(sizes, initial=0)))


class Saved(NamedTuple):
    """Nodes of a run, (k, ...) each, and its status, of JAX or NumPy; in a batch with lanes.

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
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]

    @classmethod
    def of(cls, rows, columns: tuple[slice, ...], result, failed_at) -> "Saved":
        """Rows of a program, column by column, with the status of their run."""
        return cls._make([*(rows[..., column] for column in columns), result, failed_at])

    def marked(self, save_every: int, step: int = 0) -> "Saved":
        """The nodes, NaN from a failure on; a node that cannot be right, see `is_right`, is a failure, of the last step before it.

        Nodes after a failed step may have any numbers. There are `step` macro steps before the first node.
        """
        *columns, result, failed_at = self
        module, now = library(self), Observables.of(self.table)
        right = is_right(now)
        # a prepared run is called many times, and an operation of JAX takes as long as many steps
        if module is np and right.all() and (failed_at < 0).all():
            return self
        node, num_nodes = right.argmin(axis=-1), right.shape[-1]
        after_step = module.where(failed_at < 0, num_nodes, (failed_at - step) // save_every + 1)
        breaks = ~right.all(axis=-1) & (node < after_step)
        cause = module.take_along_axis(fault(now), node[..., None], -1)[..., 0]
        number = np.arange(num_nodes)[:, None]
        lost = number >= module.where(breaks, node, after_step)[..., None, None]
        unreached = number > module.where(breaks, num_nodes, after_step)[..., None, None]
        marks = [(unreached, 0.0) if column is self.info else (lost, np.nan) for column in columns]
        columns = (module.where(*mark, column) for mark, column in zip(marks, columns, strict=True))
        failed_here = step + module.maximum(node * save_every - 1, 0)
        result, failed_at = module.where(breaks, cause, result), module.where(breaks, failed_here, failed_at)
        return Saved._make([*columns, result, failed_at])

    def trajectory(self, run: Any, step: int = 0) -> Trajectory:
        """The nodes as a trajectory of a `Simulation`, in a batch one whose arrays have an axis of lanes, after a number of macro steps."""
        *phase, info, q_f_micro, table, result, failed_at = self
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
            states, table[..., 0], table[..., 1:3], info, status(result), failed_at, micro, origin=run.origin
        )


def is_right(now: Observables) -> Any:
    """Whether nodes may be right.

    A node may be wrong although its steps succeeded, for four reasons: the energy is not finite although its gradient is (a logarithm beyond
    its pole); a lane of a batch started off its constraints; the rows of ``system.implied``, redundant constraints that the solver leaves
    out, are violated; or a stepper of the user leaves the constraints.
    """
    return library(now.energy).isfinite(now.energy) & (now.solved > 0) & (now.implied > 0)


def fault(now: Observables) -> Any:
    """The `Result` of nodes that are not right; if the solved rows are kept, the implied rows are to blame."""
    module = library(now.energy)
    violated = module.where(now.solved > 0, int(Result.NOT_IMPLIED), int(Result.CONSTRAINT_VIOLATED))
    return module.where(module.isfinite(now.energy), violated, int(Result.NON_FINITE))


def joined(pieces: list[Saved]) -> Saved:
    """Consecutive pieces as one; each starts with the last node of the piece before, and has the worst status of all before it."""
    *columns, results, failures = zip(*pieces, strict=True)
    parts = [[part[min(i, 1) :] for i, part in enumerate(column)] for column in columns]
    whole = (part[0] if len(part) == 1 else np.concatenate(part) for part in parts)
    return Saved._make([*whole, results[-1], failures[-1]])


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
