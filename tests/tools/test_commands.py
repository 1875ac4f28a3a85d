"""Every system through the commands of `vmri`."""

import re

import pytest
from typer.testing import CliRunner

from tests.tools.table import ERROR, MACRO_DT, STEPS, T_END, Cell, cells, check
from vmri_jax import cli

SCHEME = ["--scheme", "fully-explicit", "--num-micro", 1]


def vmri(*words, codes: tuple[int, ...] = (0,)) -> str:
    """What a command prints.

    Raises:
        ValueError: a refusal, exit code 2.
    """
    result = CliRunner().invoke(cli.app, [str(word) for word in words])
    text = " ".join(re.sub("[│╭╮╰╯─]", " ", result.output).split())
    if result.exit_code == 2:
        raise ValueError(text)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code in codes, text
    return text


def named(cell: Cell) -> str:
    return f"tests.small_systems:{cell.system}"


def simulate(cell: Cell) -> None:
    out, plot = cell.folder / "run.npz", cell.folder / "run.png"
    assert "iterations per step" in vmri(
        *("simulate", named(cell), *SCHEME, "--macro-dt", MACRO_DT, "--steps", STEPS, "--out", out, "--plot", plot)
    )
    assert out.exists()
    assert plot.exists()


def animate(cell: Cell) -> None:
    run = cell.folder / "run.npz"
    cell.run.save(run, cell.problem.drawing)
    vmri("animate", run)
    vmri("animate", run, "--frames", 2, "--out", cell.folder / "strip.png", "--system", named(cell))
    assert (cell.folder / "run.html").exists()


def explain(cell: Cell) -> None:
    assert "Small vibrations" in vmri("explain", named(cell), *SCHEME, "--no-measure")


def advise(cell: Cell) -> None:
    vmri("advise", named(cell), *SCHEME, "--macro-dt", MACRO_DT, codes=(0, 1))


def stability(cell: Cell) -> None:
    out = cell.folder / "map.png"
    vmri("stability", named(cell), *SCHEME, "--until", 0.2, "--out", out)
    assert out.exists()


def check_float32(cell: Cell) -> None:
    assert "1 of 1 criteria met" in vmri("check", named(cell), "--case", 10, "--out", cell.folder)


def tune(cell: Cell) -> None:
    cell.quick_searches()
    assert "vmri simulate" in vmri("tune", named(cell), "--error", ERROR, "--t-end", T_END)


def cost(cell: Cell) -> None:
    cell.quick_searches()
    vmri("cost", named(cell), "--error", ERROR, "--t-end", T_END, "--out", cell.folder)
    assert (cell.folder / "cost.html").exists()


SWEEP = """
system = "{system}"
scheme = "fully-explicit"
out = "runs.zarr"
num_micro = 1
num_steps = {steps}
num_saves = {steps}
save = ["end", "energy_error"]

[axes]
macro_dt = [0.01, 0.005]
"""


def sweep(cell: Cell) -> None:
    file = cell.folder / "sweep.toml"
    file.write_text(SWEEP.format(system=named(cell), steps=STEPS))
    assert "2 in" in vmri("sweep", file, "--plot", cell.folder / "sweep.png")


TOOLS = {
    "simulate": simulate,
    "animate": animate,
    "explain": explain,
    "advise": advise,
    "stability": stability,
    "check": check_float32,
    "tune": tune,
    "cost": cost,
    "sweep": sweep,
}
REFUSED = {}


@cells(TOOLS)
def test_cell(tool: str, system: str, tmp_path, monkeypatch: pytest.MonkeyPatch):
    check(TOOLS, REFUSED, tool, Cell(system, tmp_path, monkeypatch))
