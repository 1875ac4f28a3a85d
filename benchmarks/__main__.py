"""Command line of the benchmarks: every run prints a table and writes JSON with versions and machine."""

import json
import os
from pathlib import Path
from typing import Annotated

import jax
import typer
from rich.console import Console
from rich.table import Table

from benchmarks import num_micro

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)


@app.callback()
def one_core(core: Annotated[int, typer.Option(help="Core to run on, -1 for all.")] = 0) -> None:
    """Pin the process to one core and switch 64-bit floats on."""
    if core >= 0 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    jax.config.update("jax_enable_x64", True)


@app.command("num-micro")
def num_micro_command(
    out: Annotated[Path, typer.Option(help="Folder for the JSON file.")] = Path("out/benchmarks"),
    repeats: Annotated[int, typer.Option(help="Interleaved repeats; the median is shown.")] = 7,
) -> None:
    """Time and memory of the arrowhead solver against num_micro, at constant micro step."""
    rows = num_micro.measure(repeats)
    table = Table(title="fully implicit, arrowhead: time and memory against num_micro")
    for name in rows[0]:
        table.add_column(name, justify="left" if name == "system" else "right")
    for row in rows:
        table.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()))
    Console().print(table)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "num_micro.json"
    path.write_text(json.dumps({"machine": num_micro.machine(), "rows": rows}, indent=1))
    Console().print(f"written to {path}")


if __name__ == "__main__":
    app()
