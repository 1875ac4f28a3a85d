"""`stream`: runs that are written to disk while they are computed, and can be resumed."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.state import Movable, State
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Save, refuse_tracers
from vmri_jax.running.export import DIMENSIONS, rows_of
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.files import explained
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.observables import Observables, observed
from vmri_jax.running.origin import at_nodes
from vmri_jax.running.progress import Progress, progress_to
from vmri_jax.running.saved import BYTES_PER_NUMBER, Saved
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.store import layout
from vmri_jax.running.store.identity import check_same, environment, identity
from vmri_jax.running.store.layout import Kept
from vmri_jax.running.store.stored import Record, StoredTrajectory
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver

CHUNKS_PER_RUN = 100
"""Most chunks of a run, unless their size is limited.

With more chunks a kill loses less, and the store has more files.
"""
MICRO_STEP_SECONDS = 1e-6
"""Rough seconds of a micro step, which only choose the size of chunks: a larger value makes smaller ones."""


def stream(
    system: Movable,
    scheme: SchemeLike,
    state: State | None = None,
    *,
    out: str | os.PathLike,
    macro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save: int | Save = 1,
    solver: Solver | None = None,
    chunk: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    drawing: dict | None = None,
) -> StoredTrajectory:
    """`simulate` that writes the trajectory to disk chunk by chunk; `resume` continues a run whose process was killed.

    A chunk counts when all of it is on disk, together with a checkpoint of everything that the next steps depend on,
    the state and the memory of the solver: on the same machine with the same versions, a resumed run is identical to an
    uninterrupted one to the last bit. One chunk is held in memory at a time. The run keeps what its functions read from
    around them at its start; a resumed run whose functions do other operations is refused.

    Args:
        system, scheme, state, macro_dt, t_end, save, solver: as in `simulate`.
        out: folder of the store, a zarr group; conventionally named .zarr.
        num_steps: macro steps. A larger number than before makes a resumed run longer.
        chunk: saved intervals that are computed and written together, kept by the store; None for a hundredth of the
            run, within limits.
        resume: continue the run in `out`, which must be this run; start it if `out` does not exist. A complete run is
            returned at once.
        overwrite: replace a store in `out`.
        drawing: plain data of a `vmri_jax.animation.Drawing`, kept in the store (see `Trajectory.save`).

    Returns:
        The `StoredTrajectory`.

    Raises:
        ValueError, TypeError: bad arguments, or a store of another run, before anything is computed.
        FileExistsError: `out` exists, and neither `resume` nor `overwrite` is set.
        OSError: `out` cannot be written; after a full disk the earlier chunks are kept.
        SimulationError: a step failed; its trajectory is the store, whose last chunk is NaN from the failing step on.
        Interrupted: Ctrl-C; the current chunk is finished first (a second Ctrl-C does not wait for it).
    """
    path = Path(out)
    layout.check_place("stream", path, "run", resume, overwrite)
    run = simulation(system, scheme, state, solver, macro_dt, num_steps, t_end, save)
    num_steps = run.num_steps
    refuse_tracers("stream", run.leaves, ", since it writes files")
    run.check("stream: the positions of the state")
    length = {"rows": run.num_saves + 1, "num_steps": num_steps}
    attributes = length | {
        "kind": "run",
        "save_every": run.save_every,
        "save_micro": run.save.micro,
        "chunk": _chunk(run) if chunk is None else whole_number("stream: chunk", chunk, otherwise=", or None"),
        "identity": identity(run),
        "made_with": environment(),
    }
    attributes |= {} if drawing is None else {"drawing": drawing}
    attributes |= {} if run.names is None else {"names": run.names.to_dict()}
    two_nodes = Saved(run.columns.split(np.zeros((2, run.width))), np.asarray(0), np.asarray(-1)).trajectory(run)
    arrays = {name: Kept(rows[0], DIMENSIONS[name][1:]) for name, rows in rows_of(two_nodes).items()}
    with (
        interrupts_noted() as interrupted,
        progress_to("stream", run.save.progress) as tell,
        layout.writing(path, attributes, arrays, overwrite),
    ):
        stored = StoredTrajectory(path)
        check_same(path, attributes, stored.attributes, chunk, stored.complete)
        if num_steps < stored.step:
            raise Refused(f"stream: num_steps is {num_steps}, but {path} has {stored.step} already; open it.")
        if num_steps != stored.num_steps:
            with explained(path, _advice(stored.step)):
                layout.change_attributes(path, **length)
        for step in _continue(StoredTrajectory(path), run, tell):
            if interrupted():
                raise Interrupted(StoredTrajectory(path), step, num_steps, "macro steps")
    stored = StoredTrajectory(path)
    stored = stored.with_origin(run.origin) if len(stored) else stored
    if not stored.success:
        raise simulation_error(run, stored)
    return stored


def _continue(stored: StoredTrajectory, run: Simulation, tell: Progress) -> Iterator[int]:
    """Compute and write the missing chunks; yields the number of macro steps done after every chunk."""
    path, chunk, record = stored.path, stored.chunk, stored.record
    rows = run.num_saves
    if record.saved == rows or not stored.success:
        return
    try:
        cursor, current = record.cursor(run)
    except ValueError as error:
        raise Refused(f"{path} can be read, but its run cannot go on: {error}.") from error
    with explained(path, _advice(record.step)):
        writer = layout.Writer(path)
    # The start and the largest values so far, as a node before each chunk but the first: energies are compared with the
    # start of the run.
    start, has_warned = jax.tree.map(lambda a: a[None], run.state), False
    before = at_nodes(observed, run.origin, start)[1] if record.saved else np.zeros((0, len(Observables._fields)))
    while record.saved < rows and record.failed_at < 0:
        tell("simulating", record.saved, rows)
        # Every write but the last ends at a multiple of `chunk` rows, so that no file is written twice.
        size = min(chunk - (record.saved + 1) % chunk, rows - record.saved)
        saved, cursor, current = current.advance(cursor, size)
        piece, table = saved.trajectory(run, record.step), np.concatenate([before, saved.nodes.table])
        if not record.saved:
            run.tell_of_start("stream", piece)
        has_warned = has_warned or run.warn("stream", table, np.append(start.t[: len(before)], piece.states.t))
        before = Observables.of(table).so_far()
        skip = int(record.saved > 0)  # the first chunk has the start
        first, values = record.saved + skip, {name: value[skip:] for name, value in rows_of(piece).items()}
        with explained(path, _advice(record.step)):
            record = Record.of(cursor, record.saved + size, fell_back=current is not run)
            writer.write(first, values, record.packed())
        yield record.step


def _advice(step: int) -> str:
    """Advice where the file system fails after so many macro steps are on disk."""
    if step:
        return f"The run is kept up to macro step {step}: resume it when there is room."
    return "Give another place."


def _chunk(run: Simulation) -> int:
    """Saved intervals per chunk where the user gives none."""
    seconds = MICRO_STEP_SECONDS * run.scheme.num_micro * run.save_every
    rows = layout.rows_per_chunk(run.num_saves, seconds, BYTES_PER_NUMBER * run.width, CHUNKS_PER_RUN)
    return max(1, min(int(rows), run.num_saves))
