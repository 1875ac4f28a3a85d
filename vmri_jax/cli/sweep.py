"""`vmri sweep`: an ensemble of a .toml file; the name of a column says which number of a problem it sets."""

import json
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.markup import escape
from typer import Argument, Option

from vmri_jax import plots
from vmri_jax.animation.parts import check_keys
from vmri_jax.catalogue import MODELS, find_problem
from vmri_jax.cli.common import PICTURES, check_target, console, print_failure, print_named, print_written
from vmri_jax.ensembles import Axis, Draw, Draws, Ensemble, EnsembleError, Product, ensemble
from vmri_jax.ensembles.design import SCHEMES, STEPS, columns_of_problems
from vmri_jax.ensembles.quantities import drawn_by_default
from vmri_jax.executors.executor import local_workers
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.checks import check_flags, check_number, check_type
from vmri_jax.mechanics.names import near
from vmri_jax.mechanics.places import START, Index, Placed, places_of
from vmri_jax.mechanics.slots import free
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused
from vmri_jax.running.export import extra

SETTINGS = ("t_end", "num_steps", "macro_dt", "num_micro", "save", "num_saves", "project", "chunk")
"""Entries whose names and values are arguments of `ensemble`."""
WORDS = ("unit", "description")
"""Entries of axes and draws that the store keeps with the results."""


def sweep(
    file: Annotated[Path, Argument(help="A .toml, which vmri new sweep.toml writes.")] = Path("sweep.toml"),
    workers: Annotated[
        str | None, Option(help="Number, or Dask tcp://host:port. [dim]default: this process[/dim]")
    ] = None,
    resume: Annotated[bool, Option("--resume", help="Compute the missing runs of the store.")] = False,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace the store.")] = False,
    plot: Annotated[Path | None, Option(help="Draw the last saved number of each run: .png, .svg or .pdf.")] = None,
) -> None:
    """Run a sweep of parameters, starts, steps and schemes, on one core or on a cluster, into a store on disk.

    Finished runs stay if a worker or this program dies; --resume computes the others.
    """
    check_target("--plot", plot, *PICTURES)
    if plot is not None:
        for package in ("xarray", "dask.array"):  # refuse a missing package now: the figure comes after all runs
            extra(package, "--plot", "ensemble")
    arguments = read_sweep(file)
    problem = find_problem(arguments["system"])
    arguments["vary"] = by_name(problem, list(arguments["design"].described()))
    drawn = [] if plot is None else drawn_by_default(arguments["save"], problem)
    if plot is not None and not drawn:  # before anything runs
        raise Refused(
            f"--plot draws one number per run or per saved node, and save = {json.dumps(arguments['save'])} keeps "
            f"neither. Add one to the file, e.g. save = {json.dumps([*arguments['save'], 'energy_error'])}, or a "
            "function of your own."
        )
    with _client(workers) as client:
        try:
            runs = ensemble(**arguments, executor=client, resume=resume, overwrite=overwrite, progress=True)
        except EnsembleError as error:
            _print_summary(error.ensemble)
            raise print_failure("Not all chunks could be computed", str(error)) from error
        except RuntimeError as error:
            raise print_failure("Stopped", str(error)) from error
    _print_summary(runs)
    if plot is not None:
        plots.save(plots.plot_ensemble(runs.open(), drawn[-1], title=file.stem), plot)
        print_written(f"Figure of {drawn[-1]}", plot)


def read_sweep(file: Path) -> dict[str, Any]:
    """Arguments of `ensemble` from a file, which is checked; paths in it are relative to its folder."""
    if not file.is_file():
        raise FileNotFoundError(f"{file} does not exist; write one with: vmri new sweep.toml")
    try:
        entries = tomllib.loads(file.read_text())
    except tomllib.TOMLDecodeError as error:
        raise Refused(f"{file} is no TOML: {error}.") from error
    check_keys(entries, ("system", "scheme", "out"), (*SETTINGS, "axes", "draws"), f"{file}")
    kinds = {"system": (str, '"fpu"'), "out": (str, '"a.zarr"'), "axes": (dict, "[axes]"), "draws": (dict, "[draws]")}
    for name in kinds.keys() & entries:
        check_type(f"{file}: {name}", entries[name], *kinds[name])
    if ("axes" in entries) == ("draws" in entries):
        raise Refused(f"{file}: give either [axes] or [draws].")
    if "axes" in entries:
        design = Product({name: _axis(f"{file}: the axis {name}", axis) for name, axis in entries["axes"].items()})
    else:
        design = _draws(file, entries["draws"])
    folder, scheme = file.resolve().parent, entries["scheme"]
    arguments = {name: entries[name] for name in SETTINGS if name in entries}
    arguments["save"] = [_located(str(name), folder) for name in np.atleast_1d(arguments.get("save", "end")).tolist()]
    return arguments | {
        "system": _located(entries["system"], folder),
        "scheme": scheme if isinstance(scheme, str) else {name: name for name in np.atleast_1d(scheme).tolist()},
        "out": folder / entries["out"],
        "design": design,
    }


def _axis(subject: str, entry) -> Any:
    if not isinstance(entry, Mapping):
        return np.atleast_1d(np.asarray(entry))
    words = entry.get("unit", ""), entry.get("description", "")
    if "values" in entry:
        check_keys(entry, ("values",), WORDS, subject)
        return Axis(entry["values"], *words)
    check_keys(entry, ("from", "to", "count"), ("log", "values", *WORDS), subject)
    logarithmic, count = entry.get("log", False), whole_number(f"{subject}: count", entry["count"])
    check_flags(**{f"{subject}: log": logarithmic})
    first, last = (float(check_number(f"{subject}: {name}", entry[name])) for name in ("from", "to"))
    if logarithmic and min(first, last) <= 0:
        raise Refused(f"{subject}: from is {first:g} and to is {last:g}; with log = true both are positive.")
    return Axis((np.geomspace if logarithmic else np.linspace)(first, last, count), *words)


def _draws(file: Path, entries: Mapping[str, Any]) -> Draws:
    check_keys(entries, ("count", "columns"), ("seed", "method"), f"{file}: draws")
    columns = dict(check_type(f"{file}: draws.columns", entries["columns"], dict, "[draws.columns]"))
    for name, entry in columns.items():
        if isinstance(entry, Mapping):
            check_keys(entry, ("distribution",), WORDS, f"{file}: draws: {name}")
            draw, words = entry["distribution"], (entry.get("unit", ""), entry.get("description", ""))
            columns[name] = Draw(draw[0], tuple(draw[1:]), *words) if isinstance(draw, list) and draw else draw
    return Draws(entries["count"], columns, **{name: entries[name] for name in ("seed", "method") if name in entries})


def _located(name: str, folder: Path) -> str:
    """The name of a system or function, with the path of its file, if it has one, relative to a folder."""
    file, colon, function = name.partition(":")
    return f"{folder / file}{colon}{function}" if file.endswith((".py", *MODELS)) else name


@contextmanager
def _client(workers: str | None) -> Iterator[Any]:
    """A client of workers on this machine, or of a scheduler, whose dashboard it prints; None without either."""
    if workers is None:
        yield None
        return
    if workers.isdigit():
        opened = local_workers(whole_number("--workers", int(workers)))
    else:
        distributed = extra("distributed", "--workers", "ensemble")
        try:
            opened = distributed.Client(workers, timeout=10)
        except (OSError, ValueError) as error:
            raise Refused(f"--workers {workers}: no scheduler of Dask answers there ({error}).") from error
    with opened as client:
        if client.dashboard_link:
            console.print(f"dashboard: [bold]{escape(client.dashboard_link)}[/bold]", soft_wrap=True)
        yield client


def _print_summary(runs: Ensemble) -> None:
    print_named(
        {
            "runs": f"{len(runs):,}" + (f", of which {runs.failed_runs:,} failed" if runs.failed_runs else ""),
            "computed now": f"{runs.computed:,} in {runs.seconds:.1f} s"
            + (f", {runs.runs_per_second:,.0f} a second" if runs.computed else ""),
            "chunks": f"{len(runs.done)} of {runs.chunks.count} are in the store, {runs.chunks.size:,} runs each",
            "store": f'{runs.path}; read it with vmri_jax.open_ensemble("{os.path.relpath(runs.path)}")',
        }
    )


def by_name(problem: Problem, columns: Sequence[str]) -> Placed | None:
    """The function that sets the numbers which columns name; None where all columns are steps and schemes."""
    known = {name: place for name, (place, shape) in places_of(problem).items() if not shape}
    places: dict[str, Index] = {}
    for name in columns_of_problems(columns):
        if name not in known:
            listed = [other for other in free(known) if "[" not in other]
            raise Refused(
                f"the column {name!r} sets no number of the problem.{near(name, [*known, *STEPS, *SCHEMES])} There are "
                f"{', '.join([*listed, *STEPS, *SCHEMES])}, and numbers of arrays, {START[1]}[0] for example."
            )
        twice = [other for other, place in places.items() if place == known[name]]
        if twice:
            raise Refused(f"the columns {twice[0]!r} and {name!r} set the same number; leave one of them out.")
        places[name] = known[name]
    return Placed(places) if places else None
