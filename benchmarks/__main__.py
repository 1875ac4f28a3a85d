"""Measurements of time and memory: each prints tables, writes JSON with machine and versions, and draws figures."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks import (
    adjoints,
    against,
    baseline,
    batch,
    chains,
    compilation,
    control,
    cost,
    dear,
    ensemble_kills,
    ensembles,
    errors,
    floor,
    gpu,
    imports,
    instructions,
    kills,
    mechanisms,
    orders,
    peers,
    random_models,
    savings,
    scenes,
    tricks,
    tuned,
)
from benchmarks.gail2014.command import gail2014
from benchmarks.hard_cases.command import hard
from benchmarks.measure import prepare
from benchmarks.report import console, progress

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__, pretty_exceptions_show_locals=False)

Full = Annotated[bool, typer.Option("--full/--quick", help="All cases and more samples, or the few that show it.")]
Core = Annotated[int | None, typer.Option(help="Core to keep to; by default the last one allowed, -1 for all.")]
Out = Annotated[Path, typer.Option(help="Folder for the JSON files and the figures.")]
OUT = Path("out/benchmarks")

app.command()(gail2014)
app.command()(refusals()(hard))


COMPILES = ("chains",)
"""Commands that report seconds of compilation: programs in the cache would be no measure of them."""


def _plain_command(name: str, module) -> None:
    """A command without options of its own; its help is the docstring of the benchmark."""

    @app.command(name, help=module.__doc__)
    def command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
        prepare(core, cache=name not in COMPILES)
        _measure(name, module, full, out)


for _name, _module in {
    "adjoints": adjoints,
    "cost": cost,
    "floor": floor,
    "chains": chains,
    "compile": compilation,
    "control": control,
    "errors": errors,
    "models": random_models,
    "orders": orders,
    "programs": instructions,
    "savings": savings,
    "scenes": scenes,
}.items():
    _plain_command(_name, _module)


@app.command("dear", help=dear.__doc__)
def dear_command(
    shared: Annotated[bool, typer.Option(help="Count processor time: other processes use the core too.")] = False,
    only: Annotated[
        list[str] | None, typer.Option(help="Systems that begin so, e.g. network; may be repeated.")
    ] = None,
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
) -> None:
    prepare(core)
    _measure("dear", dear, full, out, only=only or (), shared=shared)


@app.command("tuned", help=tuned.__doc__)
def tuned_command(
    shared: Annotated[bool, typer.Option(help="Count processor time: other processes use the core too.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="Systems, e.g. 'FPU l=3'; may be repeated.")] = None,
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
) -> None:
    prepare(core)
    _measure("tuned", tuned, full, out, only=only or (), shared=shared)


@app.command("batch", help=batch.__doc__)
def batch_command(
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
    devices: Annotated[int, typer.Option(min=1, help="CPU devices to spread the batch over, each a core; 1 pins.")] = 1,
) -> None:
    prepare(core if devices == 1 else -1, devices=devices)
    _measure("batch", batch, full, out, devices=devices)


@app.command("gpu", help=gpu.__doc__)
def gpu_command(full: Full = False, out: Out = OUT) -> None:
    prepare()
    _measure("gpu", gpu, full, out)


@app.command("peers")
def peers_command(
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
    only: Annotated[
        list[str] | None, typer.Option(help="Cases, e.g. 'TSP t=1', or all of a system, e.g. TSP; may be repeated.")
    ] = None,
    peer: Annotated[
        list[str] | None, typer.Option(help="Integrators, e.g. heyoka; may be repeated. Ours always runs.")
    ] = None,
) -> None:
    """Time to reach an error, against other integrators; the extra `peers` installs them."""
    prepare(core)
    _measure("peers", peers, full, out, only=only or (), peers=peer or ())


@app.command("mechanisms", help=mechanisms.__doc__)
def mechanisms_command(
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Mechanisms, e.g. 'chain 3', or all of a kind, e.g. chain; may be repeated."),
    ] = None,
    way: Annotated[list[str] | None, typer.Option(help="Ways that begin so, e.g. joint; may be repeated.")] = None,
) -> None:
    prepare(core, cache=False)
    _measure("mechanisms", mechanisms, full, out, only=only or (), way=way or ())


@app.command("imports", help=imports.__doc__)
def imports_command(
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
    only: Annotated[
        list[str] | None, typer.Option(help="Files whose names begin so, e.g. humanoid; may be repeated.")
    ] = None,
) -> None:
    prepare(core)
    _measure("imports", imports, full, out, only=only or ())


@app.command("against", help=against.__doc__)
def against_command(
    before: Annotated[Path, typer.Argument(help="Another checkout of this repository, to compare this one with.")],
    python: Annotated[
        Path | None, typer.Option(help="Its Python; by default that in its .venv, else this one.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(against.GROUPS)}; may be repeated.")] = None,
    shared: Annotated[bool, typer.Option(help="Count processor time: other processes use the core too.")] = False,
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
) -> None:
    prepare(core)
    _measure("against", against, full, out, before=before, python=python, only=only or (), shared=shared)


@app.command("tricks", help=tricks.__doc__)
def tricks_command(
    only: Annotated[list[str] | None, typer.Option(help="Functions of the kernels; may be repeated.")] = None,
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
) -> None:
    prepare(core)
    _measure("tricks", tricks, full, out, only=only or ())


@app.command("ensembles", help=ensembles.__doc__)
def ensembles_command(
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(ensembles.PARTS)}; may be repeated.")] = None,
    full: Full = False,
    out: Out = OUT,
) -> None:
    prepare()
    for name in only or ensembles.PARTS:
        _measure(f"ensembles, {name}", ensembles.part(name), full, out)


@app.command("baseline")
def baseline_command(
    commit: Annotated[str, typer.Argument(help="Of the code that was measured.")],
    folder: Annotated[Path, typer.Option("--from", help="Folder with what the benchmarks wrote.")] = OUT,
) -> None:
    """Put all figures of one commit into benchmarks/baseline.json."""
    baseline.write(folder, commit)
    console.print(f"written to {baseline.FILE}")


@app.command("kills", help=kills.__doc__)
def kills_command(count: Annotated[int, typer.Option(min=1, help="Kills.")] = 100, out: Out = OUT) -> None:
    prepare(cache=False)
    _measure("kills", kills, False, out, count=count)


@app.command("ensemble-kills", help=ensemble_kills.__doc__)
def ensemble_kills_command(
    workers: Annotated[int, typer.Option(min=0, help="Workers to kill.")] = 50,
    mains: Annotated[int, typer.Option(min=0, help="Whole processes to kill.")] = 20,
    out: Out = OUT,
) -> None:
    prepare()
    _measure("ensemble kills", ensemble_kills, False, out, workers=workers, mains=mains)


@app.command("all")
def all_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """Floor, batch, compile and cost, one after the other."""
    prepare(core)
    for name, module in (("floor", floor), ("batch", batch), ("compile", compilation), ("cost", cost)):
        _measure(name, module, full, out)


def _measure(title: str, module, full: bool, out: Path, **options) -> None:
    """Measure, print and write: after each case what is known by then, so that nothing is lost."""
    name, report, path = "full" if full else "quick", None, None
    size = module.sizes(name, **options)
    try:
        with progress(title) as tell:
            for report in module.run(size, name, tell):
                path = report.write(out)
    finally:
        if report is not None:
            report.show(module.COLUMNS)
            console.print(f"written to {path}\n")


if __name__ == "__main__":
    app()
