"""`stream`: runs that are written to disk while they are computed, and can be resumed."""

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.state import Movable, State
from vmri_jax.running.arguments import Steps
from vmri_jax.running.files import clear_partial, explained, is_new
from vmri_jax.running.interrupts import Interrupted, interrupts_noted
from vmri_jax.running.observables import Observables
from vmri_jax.running.progress import Progress, ShowsProgress, progress_to
from vmri_jax.running.saved import numbers_per_node
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.store import layout
from vmri_jax.running.store.identity import check_same, environment, identity
from vmri_jax.running.store.layout import Record
from vmri_jax.running.store.stored import StoredTrajectory
from vmri_jax.running.trajectory import join, trajectory_of
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solver import Solver

CHUNKS_PER_RUN = 100
"""Chunks of a long run on disk. With more chunks a kill loses less of the run, and the store has more files."""
LEAST_MICRO_STEPS = 1_000_000
"""Fewest micro steps of a chunk, about a second of computing: shorter chunks would spend their time on files, longer ones lose more after a
kill."""
MOST_BYTES = 2**26
"""Most bytes of a chunk, which is held in memory as a whole; a larger value takes more memory."""


def stream(
    system: Movable,
    scheme: Scheme | Composition,
    state: State | None = None,
    *,
    out: str | os.PathLike,
    macro_dt=None,
    micro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save_every: int = 1,
    save_micro: bool = False,
    solver: Solver | None = None,
    chunk: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    throw: bool = True,
    progress: ShowsProgress = False,
    drawing: dict | None = None,
) -> StoredTrajectory:
    """`simulate` that writes the trajectory to disk chunk by chunk; `resume` continues a run whose process was killed.

    A chunk counts when all of it is on disk, together with a checkpoint of everything that the next steps depend on, the
    state and the memory of the solver: on the same machine with the same versions, a resumed run is identical
    to an uninterrupted one to the last bit. One chunk is held in memory at a time. The run keeps what its functions read from around them at its
    start; a resumed run whose functions do other operations is refused.

    Args:
        system, scheme, state, macro_dt, micro_dt, t_end, save_every, save_micro, solver: as in `simulate`.
        out: folder of the store, a zarr group; conventionally named .zarr.
        num_steps: macro steps. A larger number than before makes a resumed run longer.
        chunk: saved intervals that are computed and written together, kept by the store; None for a hundredth of the run,
            within limits.
        resume: continue the run in `out`, which must be this run; start it if `out` does not exist. A complete run is returned at once.
        overwrite: replace a store in `out`.
        throw: raise `SimulationError` if a step fails; else return the store. Either way all computed chunks are on disk.
        progress: True for a bar, or a function of (what, done, total).
        drawing: plain data of a `vmri_jax.animation.Drawing`, kept in the store (see `Trajectory.save`).

    Returns:
        The `StoredTrajectory`. After a failure it ends with the chunk of the failure, NaN from the failing step on.

    Raises:
        ValueError, TypeError: bad arguments, or a store of another run, before anything is computed.
        FileExistsError: `out` exists, and neither `resume` nor `overwrite` is set.
        OSError: `out` cannot be written; after a full disk the earlier chunks are kept.
        SimulationError: a step failed; the store is its trajectory.
        Interrupted: Ctrl-C; the current chunk is finished first (a second Ctrl-C does not wait for it).
    """
    path = Path(out)
    _check_place(path, resume, overwrite)
    steps = Steps(macro_dt, micro_dt, num_steps, t_end, save_every, save_micro)
    run = simulation(system, scheme, state, solver, steps)
    num_steps = run.num_steps
    if not run.is_concrete:
        raise ValueError("stream: arguments are tracers; it writes files, call it outside of jax.jit, vmap and grad.")
    run.check("stream: the positions of the state")
    attributes = {
        "num_steps": num_steps,
        "save_every": save_every,
        "save_micro": save_micro,
        "chunk": _chunk(run) if chunk is None else whole_number("stream: chunk", chunk, otherwise=", or None"),
        "identity": identity(run, run.state),
        "made_with": environment(),
    }
    attributes |= {} if drawing is None else {"drawing": drawing}
    attributes |= {} if run.names is None else {"names": run.names.to_dict()}
    with interrupts_noted() as interrupted, progress_to("stream", progress) as tell:
        if overwrite or not path.exists():
            with explained(path, _advice(0)):
                layout.create(path, attributes, Record.of(run.start()))
        with layout.locked(path):
            stored = StoredTrajectory(path)
            check_same(path, "run", attributes, stored.attributes, chunk, stored.complete)
            if num_steps < stored.step:
                raise ValueError(f"stream: num_steps is {num_steps}, but {path} has {stored.step} already; open it.")
            if num_steps != stored.num_steps:
                with explained(path, _advice(stored.step)):
                    layout.change_attributes(path, num_steps=num_steps)
            clear_partial(path)
            for step in _continue(StoredTrajectory(path), run, tell):
                if interrupted():
                    raise Interrupted(StoredTrajectory(path), step, num_steps, "macro steps")
    stored = StoredTrajectory(path)
    stored = stored.with_origin(run.origin) if len(stored) else stored
    if throw:
        stored.raise_failure(scheme.num_micro)
    return stored


def _continue(stored: StoredTrajectory, run: Simulation, tell: Progress) -> Iterator[int]:
    """Compute and write the missing chunks; yields the number of macro steps done after every chunk."""
    path, chunk, record = stored.path, stored.chunk, stored.record
    rows = stored.num_steps // run.save_every
    if record.saved == rows or not stored.success:
        return
    try:
        checkpoint = record.checkpoint(like=run.start(fell_back=record.fell_back))
    except ValueError as error:
        raise ValueError(f"{path} can be read, but its run cannot go on: {error}.") from error
    writer = layout.Writer(path, rows + 1, chunk)
    # The start and the largest values so far, as a node before each chunk: energies are compared with the start of the run.
    before, has_warned = run.at_start(), False
    # Every write but the last ends at a multiple of `chunk` rows, so that no file is written twice.
    ends = [*range((record.saved + 1) // chunk * chunk + chunk, rows + 1, chunk), rows + 1]
    sizes = [end - begin for begin, end in pairwise([record.saved + 1, *ends])]
    for size in sizes:
        tell("simulating", record.saved, rows)
        pieces, checkpoint = run.advance(checkpoint, size)
        piece = join([trajectory_of(*part) for part in pieces])
        table = np.concatenate([before, *(table for _, table in pieces)])
        times = np.concatenate([[run.state.t], *(part.states.t for part, _ in pieces)])
        has_warned = has_warned or run.warn("stream", table, times, stacklevel=4)
        before = Observables.of(table).so_far()
        with explained(path, _advice(checkpoint.step - size * run.save_every)):
            writer.append(piece, record.saved)
            result = max(record.result, int(piece.result))  # failures have larger codes than successes
            record = Record.of(checkpoint, record.saved + size, result, int(piece.failed_at))
            layout.commit(path, record)
        yield checkpoint.step
        if record.failed_at >= 0:
            return


def _advice(step: int) -> str:
    """Advice where the file system fails after so many macro steps are on disk."""
    if step:
        return f"The run is kept up to macro step {step}: resume it when there is room."
    return "Give another place."


def _check_place(path: Path, resume: bool, overwrite: bool) -> None:
    """Refuse an existing file or store, unless it is to be resumed or replaced, and a folder that does not exist."""
    if is_new("stream", path, resume, overwrite):
        return
    stored = StoredTrajectory(path)  # raises if the path is no store
    if not (resume or overwrite):
        raise FileExistsError(
            f"{path} holds a run of {stored.num_steps} macro steps, {stored.step} of them done. Go on with it (resume), replace "
            "it (overwrite), or give another name."
        )


def _chunk(run: Simulation) -> int:
    """Saved intervals per chunk where the user gives none."""
    num_micro = run.scheme.num_micro
    numbers = numbers_per_node(run.state, num_micro if run.save_micro else 0)  # 8 bytes each
    wanted = max(run.num_saves // CHUNKS_PER_RUN, LEAST_MICRO_STEPS // (num_micro * run.save_every))
    return max(1, min(wanted, run.num_saves, MOST_BYTES // (8 * numbers)))
