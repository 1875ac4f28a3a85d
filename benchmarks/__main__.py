"""Measurements of time and memory: each prints tables, writes JSON with machine and versions, and draws figures."""

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from benchmarks import against, baseline, batch, compilation, cost, floor, fuzz, kills, orders, peers, tricks
from benchmarks.gail2014.command import gail2014
from benchmarks.hard_cases.command import hard
from benchmarks.measure import prepare
from benchmarks.report import console, progress

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__, pretty_exceptions_show_locals=False)

Full = Annotated[bool, typer.Option("--full/--quick", help="All cases and more samples, or the few that show it.")]
Core = Annotated[int | None, typer.Option(help="Core to keep to; by default the last one allowed, -1 for all.")]
Out = Annotated[Path, typer.Option(help="Folder for the JSON files and the figures.")]
Devices = Annotated[int, typer.Option(min=1, help="CPU devices to spread the batch over, each a core; 1 pins.")]
Only = Annotated[
    list[str] | None, typer.Option(help="Cases, e.g. 'TSP t=1', or all of a system, e.g. TSP; may be repeated.")
]
Peer = Annotated[list[str] | None, typer.Option(help="Integrators, e.g. heyoka; may be repeated. Ours always runs.")]
Groups = Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(against.GROUPS)}; may be repeated.")]
Table = StrEnum("Table", ("absence", "presence", "orders"))
Tables = Annotated[list[Table] | None, typer.Option(help="Tables of scenes; may be repeated.")]
OUT = Path("out/benchmarks")

app.command()(gail2014)
app.command()(hard)


@app.command("cost")
def cost_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """Time per micro step against num_micro; the dense solve; Fig. 4 and 5 of the reference study; linearity."""
    prepare(core)
    _measure("cost", cost, full, out)


@app.command("floor")
def floor_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """Single runs against hand-written C loops."""
    prepare(core)
    _measure("floor", floor, full, out)


@app.command("batch")
def batch_command(full: Full = False, core: Core = None, out: Out = OUT, devices: Devices = 1) -> None:
    """Time per trajectory against the batch size, and against one run of the C loop."""
    prepare(core if devices == 1 else -1, devices=devices)
    _measure("batch", batch, full, out, devices=devices)


@app.command("compile")
def compile_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """Cold compile and first run in fresh processes; compilations over a sweep."""
    prepare(core)
    _measure("compile", compilation, full, out)


@app.command("orders")
def orders_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """Observed orders of Galerkin schemes and compositions, on all systems."""
    prepare(core)
    _measure("orders", orders, full, out)


@app.command("peers")
def peers_command(full: Full = False, core: Core = None, out: Out = OUT, only: Only = None, peer: Peer = None) -> None:
    """Time to reach an error, against other integrators; the extra `peers` installs them."""
    prepare(core)
    _measure("peers", peers, full, out, only=only or (), peers=peer or ())


@app.command("against")
def against_command(
    before: Annotated[Path, typer.Argument(help="Another checkout of this repository, to compare this one with.")],
    python: Annotated[
        Path | None, typer.Option(help="Its Python; by default that in its .venv, else this one.")
    ] = None,
    only: Groups = None,
    shared: Annotated[bool, typer.Option(help="Count processor time: other processes use the core too.")] = False,
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
) -> None:
    """Another checkout and this one, interleaved: runs, batches, calls, first results, gradients."""
    prepare(core)
    _measure("against", against, full, out, before=before, python=python, only=only or (), shared=shared)


@app.command("tricks")
def tricks_command(
    only: Annotated[list[str] | None, typer.Option(help="Functions of the kernels; may be repeated.")] = None,
    full: Full = False,
    core: Core = None,
    out: Out = OUT,
) -> None:
    """What each tuned function of the kernels buys, against its plain form."""
    prepare(core)
    _measure("tricks", tricks, full, out, markdown=True, only=only or ())


@app.command("baseline")
def baseline_command(
    commit: Annotated[str, typer.Argument(help="Of the code that was measured.")],
    folder: Annotated[Path, typer.Option("--from", help="Folder with what the benchmarks wrote.")] = OUT,
) -> None:
    """Put all figures of one commit into benchmarks/baseline.json."""
    found = baseline.assemble(folder, commit)
    baseline.FILE.write_text(json.dumps(found, separators=(",", ":")).replace("},{", "},\n{") + "\n")
    console.print(f"written to {baseline.FILE}")


@app.command("kills")
def kills_command(count: Annotated[int, typer.Option(min=1, help="Kills.")] = 100, out: Out = OUT) -> None:
    """A streaming run killed at random moments, and resumed to the last bit."""
    prepare(cache=False)
    _measure("kills", kills, False, out, count=count)


@app.command("fuzz")
def fuzz_command(
    count: Annotated[int, typer.Option(min=1, help="Runs in all; those done before are kept.")] = 2000,
    seed: Annotated[int, typer.Option(help="Other seeds are other systems.")] = 0,
    limit: Annotated[
        float, typer.Option(help="Seconds after which a run, compiling included, counts as a hang.")
    ] = 600.0,
    reduce: Annotated[
        int | None, typer.Option(help="Simplify this run, as long as it goes wrong in the same way.")
    ] = None,
    core: Core = None,
    out: Out = OUT,
) -> None:
    """Random systems: how their runs end, and every one that ends wrong."""
    prepare(core)
    if reduce is not None:
        for part in fuzz.reduce(seed, reduce, console.log):
            console.print(part)
        return
    path = out / f"fuzz_{seed}.jsonl"
    with progress("fuzz") as tell:
        found = fuzz.fuzz(count, seed, path, limit, tell)
    fuzz.table(found, console)
    if wrong := fuzz.wrong(found):
        console.print(f"\nsimplify one with: python -m benchmarks fuzz --seed {seed} --reduce {min(wrong)}")
        raise typer.Exit(1)


@app.command("oracle")
def oracle_command(
    count: Annotated[int, typer.Option(min=1, help="Systems.")] = 500,
    seed: Annotated[int, typer.Option(help="Other seeds are other systems.")] = 0,
    core: Core = None,
    out: Out = OUT,
) -> None:
    """Random systems: every stepper against the textbook."""
    prepare(core)
    from benchmarks import oracle  # only now: the textbook starts JAX

    path = out / f"oracle_{seed}.json"
    with progress("oracle") as tell:
        found = oracle.run(count, seed, path, tell)
    oracle.show(found, console)
    console.print(f"written to {path}\n")


@app.command("scenes")
def scenes_command(full: Full = False, core: Core = None, out: Out = OUT, only: Tables = None) -> None:
    """What an effect costs that a scene does not have, a scene against a system by hand, orders under forces."""
    prepare(core)
    from benchmarks import scenes  # only now: bodies are arrays, which start JAX

    for name in only or Table:
        _measure(f"scenes, {name}", scenes.PARTS[name], full, out, markdown=True)


@app.command("all")
def all_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """All of them, one after the other."""
    prepare(core)
    for name, module in (("floor", floor), ("batch", batch), ("compile", compilation), ("cost", cost)):
        _measure(name, module, full, out)


def _measure(title: str, module, full: bool, out: Path, markdown: bool = False, **options) -> None:
    """Measure, print and write: after each case what is known by then, so that nothing is lost."""
    name, report, path = "full" if full else "quick", None, None
    size = module.sizes(name, **options)
    try:
        with progress(title) as tell:
            for report in module.run(size, name, tell):
                path = report.write(out)
                if markdown:
                    path.with_suffix(".md").write_text(report.markdown(module.COLUMNS), encoding="utf-8")
    finally:
        if report is not None:
            report.show(module.COLUMNS)
            console.print(f"written to {path}\n")


if __name__ == "__main__":
    app()
