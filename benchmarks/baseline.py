"""The figures that later code is held against, in one file: rows and ratios of all benchmarks at one commit."""

import json
from pathlib import Path

from benchmarks.report import each_float

FILE = Path(__file__).with_name("baseline.json")
PARTS = ("floor", "batch", "compile", "cost", "peers")
"""Benchmarks whose rows are taken over."""
SIDE = "before"
"""Of `benchmarks against`, which measures calls, first results and gradients; the other side is left out."""
DIGITS = 5


def write(folder: Path, commit: str) -> None:
    """Write `FILE`, one row a line."""
    text = json.dumps(assemble(folder, commit), separators=(",", ":"))
    FILE.write_text(text.replace("},{", "},\n{") + "\n")


def assemble(folder: Path, commit: str) -> dict:
    """All that the benchmarks wrote into a folder; ``against.json`` has the commit on its side `before`."""
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
    one_side = [
        {key: row[key] for key in ("group", "case", "steps", "result")} | {"ms": row[f"{SIDE}, ms"]}
        for row in against["rows"]
        if row[f"{SIDE}, ms"] is not None
    ]
    return _rounded(found | {"calls": {"rows": one_side}})


def _rounded(value):
    """The same with `DIGITS` digits."""
    return each_float(value, lambda x: float(f"{x:.{DIGITS}g}"))
