"""Measurements of time and memory: each prints tables, writes JSON with machine and versions, and draws figures."""

from collections.abc import Sequence
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated

import typer

from benchmarks import (
    adjoints,
    against,
    chains,
    control,
    cost,
    dear,
    ensembles,
    floor,
    gpu,
    imports,
    instructions,
    kills,
    mechanisms,
    peers,
    random_models,
    tricks,
    tuned,
)
from benchmarks.gail2014.report import gail2014
from benchmarks.hard_cases import hard
from benchmarks.measure import prepare
from benchmarks.report import console
from vmri_jax.cli.common import refusals
from vmri_jax.running.progress import progress_shown

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__, pretty_exceptions_show_locals=False)

Full = Annotated[bool, typer.Option("--full/--quick", help="All cases and more samples, or the few that show it.")]
Core = Annotated[int | None, typer.Option(help="Core to keep to; by default the last one allowed, -1 for all.")]
Out = Annotated[Path, typer.Option(help="Folder for the JSON files and the figures.")]
OUT = Path("out/benchmarks")

app.command()(refusals()(gail2014))
app.command()(refusals()(hard))


COMPILES = ("chains", "mechanisms", "kills", "programs")
"""Commands that report seconds of compilation, or start processes: programs in the cache would be no measure of
them."""
MANY_CORES = ("ensembles", "gpu", "kills")
"""Commands that keep to no core."""

HELP = {
    "only": "Cases of these names, or whose names begin so; may be repeated.",
    "peers": "Integrators, e.g. heyoka; may be repeated. Ours always runs.",
    "way": "Ways that begin so, e.g. joint; may be repeated.",
    "python": "Python of the other checkout; by default that in its .venv, else this one.",
}
"""Texts of options that are arguments of `sizes`."""


def _register(name: str, module) -> None:
    """A command with the arguments of the function `sizes` of its module as options; its help is the docstring of the
    module."""

    def command(full: Full = False, core: Core = None, out: Out = OUT, **options) -> None:
        prepare(-1 if core is None and name in MANY_CORES else core, cache=name not in COMPILES)
        _measure(name, module, full, out, **options)

    _, *own = signature(module.sizes).parameters.values()
    for i, option in enumerate(own):
        kind = list[str] if option.annotation == Sequence[str] else option.annotation
        if option.name in HELP:
            own[i] = option.replace(annotation=Annotated[kind, typer.Option(help=HELP[option.name])])
    *common, _ = signature(command).parameters.values()
    parameters = [p.replace(kind=Parameter.KEYWORD_ONLY) for p in (*own, *common)]
    command.__signature__ = Signature(parameters)  # pyright: ignore[reportFunctionMemberAccess]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    app.command(name, help=module.__doc__)(command)


for _name, _module in {
    "adjoints": adjoints,
    "against": against,
    "cost": cost,
    "dear": dear,
    "ensembles": ensembles,
    "floor": floor,
    "chains": chains,
    "control": control,
    "gpu": gpu,
    "imports": imports,
    "kills": kills,
    "mechanisms": mechanisms,
    "models": random_models,
    "peers": peers,
    "programs": instructions,
    "tricks": tricks,
    "tuned": tuned,
}.items():
    _register(_name, _module)


@app.command("all")
def all_command(full: Full = False, core: Core = None, out: Out = OUT) -> None:
    """Floor, programs and cost, one after the other."""
    prepare(core, cache=False)
    for name, module in (("floor", floor), ("programs", instructions), ("cost", cost)):
        _measure(name, module, full, out)


def _measure(title: str, module, full: bool, out: Path, **options) -> None:
    """Measure, print and write: after each case what is known by then, so that nothing is lost."""
    name, reports = "full" if full else "quick", {}
    size = module.sizes(name, **options)
    try:
        with progress_shown() as show:
            for report in module.run(size, name, lambda part: show(f"{title}: {part}", 0, 1)):
                reports[report.write(out)] = report
    finally:
        for path, report in reports.items():
            report.show()
            console.print(f"written to {path}\n")


if __name__ == "__main__":
    app()
