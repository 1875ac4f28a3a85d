"""Preparation of an ensemble: checks of all arguments, its chunks, the arrays of its store, and the record that identifies it."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vmri_jax.accuracy.companions import resting
from vmri_jax.ensembles.columns import Row, numbers_in
from vmri_jax.ensembles.design import Axis, Chunks, Design, Draws, Product
from vmri_jax.ensembles.quantities import OVER_NODES, Quantity, label_of, quantity, what_is_kept
from vmri_jax.ensembles.work import Work, all_groups
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.names import Names
from vmri_jax.refusals import Refused
from vmri_jax.running.batch import lanes_at_once
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.store.identity import describe, environment, identity, operations
from vmri_jax.running.store.layout import Kept, rows_per_chunk
from vmri_jax.running.trajectory import Trajectory

MOST_CHUNKS = 20_000
"""Largest number of chunks of an ensemble, unless limits need more. A scheduler hands out some hundreds of tasks a second,
and every chunk has its files: a larger number costs more time than the runs."""
FEWEST_CHUNKS = 64
"""Target for the smallest number of chunks, so that workers share the runs evenly; batches that are computed side by side are not cut for
it. A larger one makes chunks so small that writing their files takes most of the time."""
MICRO_STEP_NANOSECONDS = {"explicit": 1.0, "implicit": 25.0}
"""Rough nanoseconds of a micro step, for each coordinate of each run in a batch, by kind of step. They only choose the size of chunks: with
larger ones chunks have fewer runs."""


def prepared(work: Work, design: Design, chunk: int | None = None) -> tuple[dict[str, Kept], Chunks, Simulation]:
    """The arrays of the store, the division of the runs, and the longest run, after all checks; nothing is computed."""
    jax.eval_shape(work.lane, _first_row(design))
    runs = [work.simulation(group) for group in all_groups(work, design)]  # one of each group
    runs[0].check("ensemble: the start", constraints=False)
    over_nodes = [name for name in OVER_NODES if name in work.save]
    if over_nodes and work.num_saves == 1:
        looks = f"{', '.join(over_nodes)} looks at the saved nodes of a run"
        raise Refused(f"ensemble: {looks}, and only its end is saved; give num_saves, for example 50.")
    runs.sort(key=lambda run: run.num_steps * run.scheme.num_micro, reverse=True)
    arrays = {
        "result": Kept(np.empty((), np.int32), (), "status of the run, see flag_meanings"),
        "failed_at": Kept(np.empty((), np.int32), (), "macro step that failed, -1 if none did"),
    }
    arrays |= what_is_kept(work.quantities, runs[0])
    return arrays, _chunks(runs, len(design), arrays, chunk), runs[0]


def _first_row(design: Design) -> Row:
    """The numbers of the first row of a design."""
    return {name: values[0] for name, values in numbers_in(design.rows(0, 1)).items()}


def _chunks(runs: list[Simulation], lanes: int, arrays: dict[str, Kept], chunk: int | None) -> Chunks:
    """Chunks of about `CHUNK_SECONDS`, of a power of two times `width` runs; `width` runs are computed side by side."""
    run = runs[0]
    # A chunk has runs of every group: a batch wider than the share of one group would be filled with copies.
    width = min(lanes_at_once(run), 2 ** (-(-lanes // len(runs)) - 1).bit_length(), lanes)
    if chunk is not None:
        size = min(whole_number("ensemble: chunk", chunk, otherwise=", or None"), lanes)
        return Chunks(lanes, size, min(width, size))
    kind = "implicit" if run.system.is_constrained or run.plan.has_fallback else "explicit"
    size_q = run.state.q_s.size + run.state.q_f.size
    micro_steps = run.num_steps * run.scheme.num_micro
    seconds = 1e-9 * MICRO_STEP_NANOSECONDS[kind] * micro_steps * run.scheme.degree**2 * size_q
    array_bytes = sum(kept.value.dtype.itemsize * int(np.prod(kept.value.shape)) for kept in arrays.values())
    bytes_of_run = array_bytes + 8 * (2 * size_q + 8) * (run.num_saves + 1)
    most_lanes = min(rows_per_chunk(lanes, seconds, bytes_of_run, MOST_CHUNKS), lanes / FEWEST_CHUNKS)
    size = width * 2 ** max(0, int(np.log2(max(most_lanes / width, 1.0))))
    return Chunks(lanes, min(size, lanes), width)


def attributes_of(work: Work, design: Design, run: Simulation, chunks: Chunks) -> dict[str, Any]:
    """Attributes of the store of an ensemble: the design, names of coordinates, the record that identifies it, versions."""
    names = (run.names or Names()).of_coordinates(run.state.q_s.size, run.state.q_f.size)
    design_record = {"kind": type(design).__name__, "columns": design.described()}
    if isinstance(design, Draws):
        design_record |= {"method": design.method, "seed": design.seed}
    return {
        "kind": "ensemble",
        "rows": chunks.lanes,
        "chunk": chunks.size,
        "width": chunks.width,
        "design": design_record,
        "system": work.system if isinstance(work.system, str) else "a problem",
        "slow": names.slow_coordinates,
        "fast": names.fast_coordinates,
        "identity": _identity(work, design, run),
        "made_with": environment(),
    }


def _identity(work: Work, design: Design, run: Simulation) -> dict[str, str]:
    """In words and digests, by name, everything that the results depend on."""
    about_run = identity(run, run.state).items()
    identity_record = {name: text for name, text in about_run if not name.startswith(("scheme", "macro_dt"))}
    for label, scheme in work.schemes.items():
        name = scheme if isinstance(scheme, str) else getattr(scheme, "__qualname__", None)
        identity_record |= {f"scheme {label}": name} if name else describe(f"scheme {label}", scheme)
    identity_record |= {name: str(value) for name, value in work.steps.items()}
    saved = [label_of(entry) if callable(entry) else Path(entry).name for entry in work.save]
    identity_record |= {"num_micro": str(work.num_micro), "save": ", ".join(saved)}
    for entry in filter(callable, work.save):
        values = partial(_values_of, quantity(entry))
        identity_record |= {f"operations of {label_of(entry)}": operations(values, resting(run))}
    identity_record |= {"num_saves": str(work.num_saves), "project": str(work.project), "runs": str(len(design))}
    identity_record |= {f"file {Path(file).name}": digest for file, digest in work.sources.items()}
    if work.vary is not None:
        identity_record |= describe("vary", work.vary)
        identity_record |= {"operations of vary": operations(work.lane, _first_row(design))}
    return identity_record | _describe_design(design)


def _values_of(quantity: Quantity, run: Trajectory) -> dict[str, Any]:
    return {name: array.value for name, array in quantity(run).items()}


def _describe_design(design: Design) -> dict[str, str]:
    """The design in words and digests, by column."""
    texts = {"design": type(design).__name__}
    if isinstance(design, Draws):
        texts |= {"method": design.method, "seed": str(design.seed)}
    for name, column in (design.axes if isinstance(design, Product) else design.columns).items():
        values = column.values if isinstance(column, Axis) else (column.name, *column.arguments)
        texts |= describe(f"column {name}", values)
    return texts
