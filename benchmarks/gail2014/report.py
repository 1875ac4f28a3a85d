"""`python -m benchmarks gail2014` runs the reference study and writes it down: figures, tables and one self-contained
HTML report."""

import base64
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from benchmarks.gail2014.figures import SETTLED, Check, ConvergenceFigure, CostFigure
from benchmarks.gail2014.reference import reference_figures
from benchmarks.measure import prepare
from vmri_jax import plots
from vmri_jax.cli.common import check_target, console, print_failure
from vmri_jax.refusals import Refused
from vmri_jax.running.progress import Progress, part, progress_shown, silent
from vmri_jax.study.html import embedded, write_page

KINDS = ("order", "turn", "minimum", "structured", "longer")
"""Kinds of a `Check`."""
TEMPLATE = Path(__file__).parent / "report.html.j2"


@dataclass(frozen=True)
class FigureResult:
    """One figure of the report: what the paper saw, what was seen, checks and images, or why it failed."""

    name: str
    title: str
    paper: str
    seen: str
    checks: tuple[Check, ...]
    seconds: float
    image: str = ""
    image_dark: str = ""
    error: str = ""
    traceback: str = ""


@dataclass(frozen=True)
class Report:
    """The results of a study and where its report lies."""

    path: Path
    figures: tuple[FigureResult, ...]

    @property
    def failed(self) -> list[FigureResult]:
        """Figures that could not be made."""
        return [figure for figure in self.figures if figure.error]

    @property
    def checks(self) -> list[Check]:
        """The checks of all figures."""
        return [check for figure in self.figures for check in figure.checks]

    def in_five_lines(self) -> list[str]:
        """The orders, the dense solve, the structured solve, the differences, and the path of the page."""
        of = {kind: [check for check in self.checks if check.kind == kind] for kind in KINDS}
        agreeing = {kind: f"{sum(check.agrees for check in some)} of {len(some)}" for kind, some in of.items()}
        minima = (f"{c.quantity.partition(', dense')[0]}: {c.seen} (paper {c.expected})" for c in of["minimum"])
        most = {kind: max((float(check.seen) for check in of[kind]), default=float("nan")) for kind in KINDS[-2:]}
        known, surprising = (
            "; ".join(check.quantity for check in self.checks if not check.agrees and check.surprises == surprises)
            for surprises in (False, True)
        )
        return [
            f"Orders: {agreeing['order']} as expected, of positions and of momenta.",
            (
                f"Dense solve: {agreeing['turn']} curves of cost turn up again; cheapest numbers of micro steps: "
                f"{'; '.join(minima) or 'none'}."
            ),
            (
                f"Structured solve: with the most micro steps a micro step costs at most {most['structured']:g} times "
                f"as much as with about {SETTLED} in macro steps of one length, at most {most['longer']:g} times in "
                "macro steps that grow with their number."
            ),
            (
                f"Different from what was expected: {surprising or 'nothing'}. Different for reasons that the page "
                f"gives: {known or 'nothing'}."
            ),
            f"Page: {self.path}",
        ]


def gail2014(
    full: Annotated[
        bool, typer.Option("--full/--quick", help="The lists of the paper (an hour), or few values.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="Only this figure, e.g. fig6; may be repeated.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for figures, tables and the report.")] = Path("out"),
) -> None:
    """Run the reference study of Gail et al. (2014): figures, tables and out/report.html."""
    prepare()
    size = "full" if full else "quick"
    choose_figures(reference_figures(size), only or [])
    check_target("--out", out)
    with progress_shown() as show:
        report = reproduce(out, size, only or [], show, _figure_done)
    console.print("\n" + escape("\n".join(report.in_five_lines())), soft_wrap=True)
    if report.failed:
        reasons = "\n".join(f"{figure.name}: {figure.error}" for figure in report.failed)
        raise print_failure("Figures that failed", reasons)


def _figure_done(result: FigureResult) -> None:
    agreeing = f"{sum(check.agrees for check in result.checks)} of {len(result.checks)}"
    mark = "[red]failed[/red]" if result.error else agreeing
    console.print(f"{result.name:<11} {mark}  {result.title}  [dim]{result.seconds:.0f} s[/dim]")


def reproduce(
    out: str | Path = "out",
    size: str = "quick",
    only: Sequence[str] = (),
    progress: Progress = silent,
    figure_done: Callable[[FigureResult], None] | None = None,
) -> Report:
    """Run the study, or `only` some figures, and write figures, tables and ``report.html`` after each of them.

    A figure that fails is reported as failed; the others are kept.
    """
    chosen = choose_figures(reference_figures(size), only)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    references: dict = {}
    results: list[FigureResult] = []
    start = time.perf_counter()
    for i, figure in enumerate(chosen):
        results.append(_run_figure(figure, out, references, part(progress, i, len(chosen), f"{figure.name}: ")))
        _write_html(out / "report.html", results, size, time.perf_counter() - start)
        if figure_done is not None:
            figure_done(results[-1])
    return Report(out / "report.html", tuple(results))


def choose_figures(
    figures: Sequence[ConvergenceFigure | CostFigure], only: Sequence[str]
) -> list[ConvergenceFigure | CostFigure]:
    """The figures with the given names, in the order of the study; for no names all of them."""
    names = [figure.name for figure in figures]
    unknown = [name for name in only if name not in names]
    if unknown:
        raise Refused(f"reproduce: no figure {', '.join(map(repr, unknown))}; there are {', '.join(names)}.")
    return [figure for figure in figures if figure.name in (only or names)]


def _run_figure(figure, out: Path, references: dict, progress: Progress) -> FigureResult:
    start = time.perf_counter()
    result = partial(FigureResult, figure.name, figure.title, figure.paper)
    try:
        findings = figure.measure(progress, references)
        findings.study.to_csv(out / f"{figure.name}.csv")
        light = findings.draw(plots.LIGHT)
        plots.save(light, out / f"{figure.name}.png")
        light.set_layout_engine("none")  # its places stay: to find them takes half of the time of drawing
        images = embedded(lambda theme: light if theme is plots.LIGHT else findings.draw(theme))
        (out / f"{figure.name}.svg").write_bytes(base64.b64decode(images[0].partition(",")[2]))
    except Exception as error:  # whatever it is, the other figures are worth having
        message, details = f"{type(error).__name__}: {error}", "".join(traceback.format_exception(error))
        return result("", (), time.perf_counter() - start, error=message, traceback=details)
    return result(findings.seen, findings.checks, time.perf_counter() - start, *images)


def _write_html(path: Path, results: list[FigureResult], size: str, seconds: float) -> None:
    checks = Report(path, tuple(results)).checks
    about = {"agreeing": sum(check.agrees for check in checks), "num_checks": len(checks), "size": size}
    write_page(path, TEMPLATE, figures=results, minutes=seconds / 60, **about)
