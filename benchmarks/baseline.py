"""The figures that later code is held against, in one file: rows and ratios of all benchmarks at one commit."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("baseline.json")
PARTS = ("floor", "batch", "compile", "cost", "peers")
"""Benchmarks whose rows are taken over."""
SIDE = "before"
"""Of `benchmarks against`, which measures calls, first results and gradients; the other side is left out."""
DIGITS = 5


def assemble(folder: Path, commit: str) -> dict:
    """All that the benchmarks wrote into a folder, without what only figures need.

    Args:
        folder: where the JSON files are; ``against.json`` has `commit` on its side `before`.
        commit: of the code that was measured.

    Raises:
        ValueError: a file is missing, or ``against.json`` is of another commit.
    """
    missing = [name for name in (*PARTS, "against") if not (folder / f"{name}.json").exists()]
    if missing:
        raise ValueError(
            f"baseline: {folder} has no {', '.join(missing)}; run the benchmarks with --out {folder} first."
        )
    read = {name: json.loads((folder / f"{name}.json").read_text()) for name in (*PARTS, "against")}
    against = read.pop("against")
    measured = against[SIDE]["commit"]
    if not measured.startswith(commit):
        raise ValueError(f"baseline: against.json has commit {measured} on its side {SIDE}, not {commit}.")
    found = {"commit": measured, "machine": read["floor"]["machine"]}
    for name, part in read.items():
        rows = [{key: value for key, value in row.items() if key != "scan"} for row in part["rows"]]
        claims = [{"what": claim["what"], **claim["seen"]} for claim in part["claims"]]
        found[name] = {"size": part["size"], "rows": rows, "ratios": claims}
    found["calls"] = {"clock": against["clock"], "rows": [_one_side(row) for row in against["rows"] if _known(row)]}
    return _rounded(found)


def _known(row: Mapping) -> bool:
    return row[f"{SIDE}, ms"] is not None


def _one_side(row: Mapping) -> dict:
    return {key: row[key] for key in ("group", "case", "steps", "result")} | {"ms": row[f"{SIDE}, ms"]}


def _rounded(value: Any) -> Any:
    """The same with `DIGITS` digits."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
