"""Runs the reference study and writes it down: figures, tables and one self-contained HTML report."""

import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks.gail2014.figures import SETTLED, Check, ConvergenceFigure, CostFigure
from benchmarks.gail2014.reference import reference_figures
from vmri_jax import plots
from vmri_jax.running.progress import Progress, part, silent
from vmri_jax.study.html import embedded, svg, write_page

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
        agreeing = Counter(check.kind for check in self.checks if check.agrees)
        of = {kind: f"{agreeing[kind]} of {n}" for kind, n in Counter(check.kind for check in self.checks).items()}
        seen = {kind: [check.seen for check in self.checks if check.kind == kind] for kind in of}
        differing = [check.quantity for check in self.checks if not check.agrees]
        return [
            f"Orders: {of.get('order', 'none')} as expected, of positions and of momenta.",
            f"Dense solve: {of.get('turn', 'no')} curves of cost turn up again; {of.get('minimum', 'no')} minima are near the paper's.",
            "Structured solve: with the most micro steps a micro step costs "
            f"{max(map(float, seen.get('structured', ['nan'])))} times as much as with about {SETTLED}, or less.",
            f"Different from what was expected: {'; '.join(differing) or 'nothing'}.",
            f"Page: {self.path}",
        ]


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


ON_REQUEST = {"fig4-minimal"}
"""Figures that are not the paper's; their programs compile for minutes, which the study does not wait for."""


def choose_figures(
    figures: Sequence[ConvergenceFigure | CostFigure], only: Sequence[str]
) -> list[ConvergenceFigure | CostFigure]:
    """The figures with the given names, in the order of the study; for no names all but those that are made on request."""
    names = [figure.name for figure in figures]
    unknown = [name for name in only if name not in names]
    if unknown:
        raise ValueError(f"reproduce: no figure {', '.join(map(repr, unknown))}; there are {', '.join(names)}.")
    return [figure for figure in figures if figure.name in (only or set(names) - ON_REQUEST)]


def _run_figure(figure, out: Path, references: dict, progress: Progress) -> FigureResult:
    start = time.perf_counter()
    result = partial(FigureResult, figure.name, figure.title, figure.paper)
    try:
        findings = figure.measure(progress, references)
        findings.study.to_csv(out / f"{figure.name}.csv")
        plots.save(findings.draw(figure.title, plots.LIGHT), out / f"{figure.name}.png")
        (out / f"{figure.name}.svg").write_bytes(svg(findings.draw("", plots.LIGHT), plots.LIGHT))
        images = embedded(lambda theme: findings.draw("", theme))
    except Exception as error:  # whatever it is, the other figures are worth having
        message, details = f"{type(error).__name__}: {error}", "".join(traceback.format_exception(error))
        return result("", (), time.perf_counter() - start, error=message, traceback=details)
    return result(findings.seen, findings.checks, time.perf_counter() - start, *images)


def _write_html(path: Path, results: list[FigureResult], size: str, seconds: float) -> None:
    agreeing = [check.agrees for check in Report(path, tuple(results)).checks]
    about = {"agreeing": sum(agreeing), "num_checks": len(agreeing), "size": size, "minutes": seconds / 60}
    write_page(path, TEMPLATE, figures=results, **about)
