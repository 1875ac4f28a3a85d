"""What a benchmark hands over: rows and claims as tables, a JSON file with machine and versions, figures."""

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks.measure import Ratio, Tell, machine
from vmri_jax import plots

console = Console(width=None if sys.stdout.isatty() else 160)


@dataclass(frozen=True)
class Claim:
    """One ratio held against its target.

    at_most, at_least: the target; None where there is none on that side.
    """

    what: str
    seen: Ratio
    at_most: float | None = None
    at_least: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the ratio of the medians keeps the target."""
        below = self.at_most is None or self.seen.value <= self.at_most
        return below and (self.at_least is None or self.seen.value >= self.at_least)

    @property
    def target(self) -> str:
        """In words."""
        parts = [f"≥ {self.at_least:.3g}"] if self.at_least is not None else []
        return " and ".join(parts + ([f"≤ {self.at_most:.3g}"] if self.at_most is not None else []))


@dataclass(frozen=True)
class Report:
    """All that one benchmark found.

    rows: one dictionary per program.
    notes: what was left out, and why.
    figures: by file name, functions that draw.
    about: what else belongs into the file.
    """

    name: str
    size: str
    rows: list[dict]
    claims: list[Claim]
    notes: list[str]
    figures: dict[str, Callable[[], Figure]]
    about: dict = field(default_factory=dict)

    def write(self, out: Path) -> Path:
        """Write ``out/name.json`` and the figures; returns the path of the JSON file."""
        out.mkdir(parents=True, exist_ok=True)
        path = out / f"{self.name}.json"
        claims = [asdict(claim) | {"holds": claim.holds} for claim in self.claims]
        found = {"benchmark": self.name, "size": self.size, "machine": machine(), **self.about, "claims": claims}
        found |= {"notes": self.notes, "rows": self.rows}
        path.write_text(json.dumps(_finite(found), indent=1))
        for name, draw in self.figures.items():
            figure = draw()
            _signature(figure)
            plots.save(figure, out / f"{name}.png")
        return path

    def markdown(self, columns: Sequence[str]) -> str:
        """Rows (these columns of them), claims and notes as Markdown."""
        tables = [[columns, *([_cell(row.get(name)) for name in columns] for row in self.rows)]]
        if self.claims:
            claims = [(c.what, str(c.seen), c.target, "yes" if c.holds else "no") for c in self.claims]
            tables.append([("ratio", "seen (quartiles)", "target", "holds"), *claims])
        lines = [f"## {self.name}, {self.size}"]
        for head, *body in tables:
            lines += ["", *(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body))]
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes), ""])

    def show(self, columns: Sequence[str]) -> None:
        """Print the rows (these columns of them), the claims and the notes."""
        if self.rows:
            console.print(_rows_table(f"{self.name}, {self.size}", self.rows, columns))
        if self.claims:
            console.print(_claims_table(self.claims))
        for note in self.notes:
            console.print(note, style="dim")


@contextmanager
def progress(title: str, total: int) -> Iterator[Tell]:
    """A bar of `total` parts; yields the function that is told each part before it starts."""
    columns = (
        TextColumn(title),
        BarColumn(30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[at]}"),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=total, completed=-1, at="")
        yield lambda at: bar.update(task, advance=1, at=at)


def _rows_table(title: str, rows: Sequence[dict], columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for name in columns:
        text = all(isinstance(row.get(name), str | None) for row in rows)
        table.add_column(name, justify="left" if text else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(_cell(row.get(name)) for name in columns))
    return table


def _claims_table(claims: Sequence[Claim]) -> Table:
    table = Table(title="\nratios (quartiles)", title_justify="left", box=None, pad_edge=False, header_style="bold")
    for name in ("what", "seen", "target", ""):
        table.add_column(name)
    for claim in claims:
        verdict = "[green]yes[/green]" if claim.holds else "[red]no[/red]"
        table.add_row(claim.what, str(claim.seen), claim.target, verdict if claim.target else "")
    return table


def _cell(value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _finite(value):
    """The same with None for NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _signature(figure: Figure) -> None:
    """Machine and versions, at the top right."""
    m = machine()
    cores = "" if m["cores"] is None else f", {len(m['cores'])} core{'s' if len(m['cores']) > 1 else ''}"
    text = f"{m['processor']}{cores}; Python {m['python']}, JAX {m['jax']}, vmri_jax {m['vmri_jax']}"
    figure.text(0.995, 0.99, text, ha="right", va="top", fontsize=6.5, color=plots.LIGHT.ink)
