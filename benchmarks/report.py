"""What a benchmark hands over: tables of rows and claims, a JSON file with machine and versions, figures."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.markup import escape

from benchmarks.measure import Ratio, machine
from vmri_jax import plots
from vmri_jax.running.printed import OutputConsole, PrintedTable

console = OutputConsole()


@dataclass(frozen=True)
class Claim:
    """One ratio held against its target, which may have no bound on a side."""

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
    def verdict(self) -> str:
        """Whether it keeps its target, if it has one."""
        return "" if not self.target else "yes" if self.holds else "no"

    @property
    def target(self) -> str:
        """In words."""
        parts = [f"≥ {self.at_least:.3g}"] if self.at_least is not None else []
        return " and ".join(parts + ([f"≤ {self.at_most:.3g}"] if self.at_most is not None else []))


@dataclass(frozen=True)
class Report:
    """All that one benchmark has measured by now; figures are functions that draw, by file name, about is what else
    belongs into the file."""

    name: str
    size: str
    rows: list[dict] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    figures: dict[str, Callable[[], Figure]] = field(default_factory=dict)
    about: dict = field(default_factory=dict)

    def write(self, out: Path) -> Path:
        """Write ``out/name.json`` and the figures; returns the path of the JSON file."""
        out.mkdir(parents=True, exist_ok=True)
        path = out / f"{self.name}.json"
        claims = [asdict(claim) | {"holds": claim.holds} for claim in self.claims]
        found = {"benchmark": self.name, "size": self.size, "machine": machine(), **self.about, "claims": claims}
        found |= {"notes": self.notes, "rows": self.rows}
        finite = each_float(found, lambda x: x if math.isfinite(x) else None)  # JSON knows no NaN
        path.write_text(json.dumps(finite, indent=1))
        for name, draw in self.figures.items():
            figure = draw()
            _signature(figure)
            plots.save(figure, out / f"{name}.png")
        return path

    def note(self, text: str) -> None:
        """Add a note, once."""
        if text not in self.notes:
            self.notes.append(text)

    def show(self) -> None:
        """Print the numbers and words of the rows, the claims and the notes."""
        console.print(f"{self.name}, {self.size}", style="bold")
        for head, *body in self._tables():
            table = PrintedTable(*head)
            for row in body:
                table.add_row(*map(escape, row))
            console.print(table, "")
        for note in self.notes:
            console.print(escape(note), style="dim")

    def _tables(self) -> Iterator[list[Sequence[str]]]:
        """Rows and claims as text, the heads first; those that are empty are left out, and so are lists in rows."""
        columns = list(dict.fromkeys(k for row in self.rows for k, x in row.items() if not isinstance(x, list)))
        if columns:
            yield [columns, *([_cell(row.get(name)) for name in columns] for row in self.rows)]
        if self.claims:
            claims = [(c.what, str(c.seen), c.target, c.verdict) for c in self.claims]
            yield [("ratio", "seen (quartiles)", "target", "holds"), *claims]


def spread(what: str, seen: Ratio) -> dict:
    """Columns of a row: a median by its name, and its quartiles."""
    return {what: seen.value, "low": seen.low, "high": seen.high}


def _cell(value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def each_float(value, function: Callable) -> Any:
    """The same dictionaries and lists with this function of every float."""
    if isinstance(value, dict):
        return {key: each_float(item, function) for key, item in value.items()}
    if isinstance(value, list):
        return [each_float(item, function) for item in value]
    return function(value) if isinstance(value, float) else value


def _signature(figure: Figure) -> None:
    """Machine and versions, at the top right."""
    m = machine()
    cores = "" if m["cores"] is None else f", {len(m['cores'])} core{'s' if len(m['cores']) > 1 else ''}"
    text = f"{m['processor']}{cores}; Python {m['python']}, JAX {m['jax']}, vmri_jax {m['vmri_jax']}"
    figure.text(0.995, 0.99, text, ha="right", va="top", fontsize=6.5, color=plots.LIGHT.ink)
