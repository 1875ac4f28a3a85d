"""What is known of an ensemble before it is computed: its chunks, the arrays of its store, and all that tells it from others."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vmri_jax.ensembles.design import Design, Draws, Product
from vmri_jax.ensembles.quantities import Kept, what_is_kept
from vmri_jax.ensembles.task import Chunks
from vmri_jax.ensembles.work import Work, all_groups
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.names import Names
from vmri_jax.running.batch import lanes_at_once
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.store.identity import changed_conditions, describe, differences, environment, identity
from vmri_jax.steppers.results import Result

SECONDS = 1.0
"""Seconds that a chunk of runs takes, about. With a larger value an interrupted ensemble loses more, with a smaller one workers wait for files."""
MOST_CHUNKS = 20_000
"""Most chunks of an ensemble. Schedulers hand out some hundreds of tasks a second, and every chunk has its files: more chunks cost more than they compute."""
MOST_BYTES = 2**26
"""Most bytes of the results of a chunk; with larger ones a worker needs more memory."""
PARTS = 64
"""and is at most such a part of all runs, so that workers share them evenly."""
NANOSECONDS = {"explicit": 1.0, "implicit": 25.0, "constrained": 25.0}
"""Rough times of a micro step for each coordinate of each run, in a batch."""


class Prepared(NamedTuple):
    """What is known of an ensemble before it is computed.

    arrays: what the store has of each run, by name: shape, dtype, dimensions and attributes.
    run: the longest one.
    """

    arrays: dict[str, dict]
    chunks: Chunks
    run: Simulation


def prepared(work: Work, design: Design, chunk: int | None = None) -> Prepared:
    """What is known before anything is computed; all that can be wrong with the arguments is refused.

    Raises:
        ValueError, TypeError: bad arguments.
    """
    runs = _checked(work, design)
    arrays = _arrays(work, runs[0])
    return Prepared(arrays, _chunks(runs, len(design), arrays, chunk), runs[0])


def _checked(work: Work, design: Design) -> list[Simulation]:
    """A run of each group, the longest first; all that can be wrong with the arguments is refused."""
    work.check_values(design.rows(0, 1))
    runs = [work.simulation(group) for group in all_groups(work, design)]
    runs[0].check("ensemble: the start", constraints=False)
    over_nodes = [name for name, one in zip(work.save, work.quantities, strict=True) if one.over_nodes]
    if over_nodes and work.num_saves == 1:
        raise ValueError(
            f"ensemble: {', '.join(over_nodes)} looks at the saved nodes of a run, and only its end is saved; give num_saves, "
            "say 50."
        )
    return sorted(runs, key=_micro_steps, reverse=True)


def _micro_steps(run: Simulation) -> int:
    return run.num_steps * run.scheme.num_micro


def _arrays(work: Work, run: Simulation) -> dict[str, dict]:
    """What the store has of each run: shape, dtype, dimensions and attributes."""
    meanings = " ".join(result.name.lower() for result in Result)
    values = [int(result) for result in Result]
    status = {
        "result": Kept(np.empty((), np.int32), (), "status of the run, see flag_meanings"),
        "failed_at": Kept(np.empty((), np.int32), (), "macro step that failed, -1 if none did"),
    }
    arrays = {}
    for name, one in (status | what_is_kept(work.quantities, run)).items():
        about = {"description": one.description} if one.description else {}
        flags = {"flag_values": values, "flag_meanings": meanings} if name == "result" else {}
        arrays[name] = {
            "shape": one.value.shape,
            "dtype": one.value.dtype,
            "dimensions": one.dimensions,
            "attributes": about | flags,
        }
    return arrays


def _chunks(runs: list[Simulation], lanes: int, arrays: dict[str, dict], chunk: int | None) -> Chunks:
    """About a second's work, a power of two times the lanes that are computed side by side."""
    run = runs[0]
    width = min(lanes_at_once(run), 2 ** (-(-lanes // len(runs)) - 1).bit_length(), lanes)
    if chunk is not None:
        size = min(whole_number("ensemble: chunk", chunk, otherwise=", or None"), lanes)
        return Chunks(lanes, size, min(width, size))
    kind = "constrained" if run.system.is_constrained else "implicit" if run.plan.has_fallback else "explicit"
    size_q = run.state.q_s.size + run.state.q_f.size
    seconds = 1e-9 * NANOSECONDS[kind] * _micro_steps(run) * run.scheme.degree**2 * size_q
    kept = sum(np.dtype(one["dtype"]).itemsize * int(np.prod(one["shape"])) for one in arrays.values())
    bytes_of_run = kept + 8 * (2 * size_q + 8) * (run.num_saves + 1)
    most = min(max(SECONDS / seconds, lanes / MOST_CHUNKS), MOST_BYTES / bytes_of_run, lanes / PARTS)
    size = width * 2 ** max(0, int(np.log2(max(most / width, 1.0))))
    return Chunks(lanes, min(size, lanes), width)


def attributes_of(work: Work, design: Design, run: Simulation, chunks: Chunks) -> dict[str, Any]:
    """Attributes of its store."""
    names = (run.names or Names()).of_coordinates(run.state.q_s.size, run.state.q_f.size)
    about = {"kind": type(design).__name__, "columns": design.described()}
    if isinstance(design, Draws):
        about |= {"method": design.method, "seed": design.seed}
    settings = {name: value for name, value in work.steps._asdict().items() if value is not None}
    return {
        "lanes": chunks.lanes,
        "chunk": chunks.size,
        "width": chunks.width,
        "design": about,
        "system": work.system if isinstance(work.system, str) else "a problem",
        "slow": names.slow_coordinates,
        "fast": names.fast_coordinates,
        "identity": _identity(work, design, run, settings),
        "made_with": environment(),
    }


def _identity(work: Work, design: Design, run: Simulation, settings: dict) -> dict[str, str]:
    """All that decides the results, by name."""
    schemes = {}
    for label, scheme in work.schemes.items():
        made = scheme if isinstance(scheme, str) else getattr(scheme, "__qualname__", None)
        schemes |= {f"scheme {label}": made} if made else describe(f"scheme {label}", scheme)
    found = {
        name: text for name, text in identity(run, run.state).items() if not name.startswith(("scheme", "macro_dt"))
    }
    found |= schemes | {name: str(value) for name, value in settings.items()}
    found |= {"num_micro": str(work.num_micro), "save": ", ".join(Path(name).name for name in work.save)}
    found |= {"num_saves": str(work.num_saves), "project": str(work.project), "runs": str(len(design))}
    found |= {f"file {Path(file).name}": digest for file, digest in work.sources.items()}
    return found | _describe_design(design)


def _describe_design(design: Design) -> dict[str, str]:
    """A design in words, by column."""
    found = {"design": type(design).__name__}
    if isinstance(design, Draws):
        return (
            found
            | {"method": design.method, "seed": str(design.seed)}
            | {f"column {name}": f"{draw.name} {draw.arguments}" for name, draw in design.columns.items()}
        )
    columns = design.axes if isinstance(design, Product) else design.columns
    for name, axis in columns.items():
        found |= describe(
            f"column {name}", axis.values if axis.values.dtype.kind != "U" else ", ".join(axis.values.ravel())
        )
    return found


def check_same(path: Path, attributes: dict, there: dict, chunk: int | None) -> None:
    """Refuse to go on with another ensemble; warn where versions have changed.

    Args:
        path: of the store.
        attributes, there: those of the ensemble that is asked for, and those of the store.
        chunk: that was asked for.

    Raises:
        ValueError: with all that differs.
    """
    made, now = there["made_with"], attributes["made_with"]
    found = differences(attributes["identity"], there["identity"], made["jax"] == now["jax"])
    if chunk not in (None, there["chunk"]):
        found.append(f"chunk: {chunk} here, {there['chunk']} in the store")
    if found:
        raise ValueError(
            f"{path} holds another ensemble and cannot go on with this one. What differs: {'; '.join(found)}. Give the arguments it "
            "was started with, or another name."
        )
    changed = changed_conditions(now, made)
    if changed:
        warnings.warn(
            f"{path} was started under other conditions; the last digits of its runs may differ. Now: {', '.join(changed)}.",
            stacklevel=3,
        )
