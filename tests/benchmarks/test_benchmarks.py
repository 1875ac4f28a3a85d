"""The benchmarks measure fairly, and every command gives tables, JSON and figures."""

import dataclasses
import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import vmri_jax as vm
from benchmarks import __main__ as command_line
from benchmarks import c_loops, chains, cost, floor, programs, report, worker
from benchmarks.gail2014.cost import unknowns
from benchmarks.measure import Ratio, interleaved, ratio, steps_for
from benchmarks.report import Claim, Report
from vmri_jax.running import timing


# --- measuring -------------------------------------------------------------------------------------------------------
def test_ratio_of_medians_and_quartiles_of_pairs():
    found = ratio([2.0, 4.0, 6.0, 8.0, 100.0], [1.0, 2.0, 2.0, 2.0, 2.0])
    assert found == Ratio(3.0, 2.0, 4.0)
    assert str(found) == "3 (2 to 4)"


@pytest.mark.parametrize(("above", "below"), [([], []), ([1.0], [1.0, 2.0])])
def test_samples_that_are_no_pairs_are_refused(above, below):
    with pytest.raises(ValueError, match="must come from one `interleaved`"):
        ratio(above, below)


def busy(seconds):
    """Compute for these seconds: to wait takes no time."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_runs_take_turns():
    calls = []

    def run(name, seconds):
        def call():
            calls.append(name)
            busy(seconds)

        return call

    seconds = interleaved({"a": run("a", 0.02), "b": run("b", 0.004)}, 3, min_seconds=0.016)
    assert calls[:4] == ["a", "a", "b", "b"]  # one that compiles, one for the number of calls
    per_sample = calls[4:].count("b") // 3
    assert per_sample in (2, 3, 4)
    b = ["b"] * per_sample
    assert calls[4:] == ["a", *b, *b, "a", "a", *b]
    assert [len(sample) for sample in seconds.values()] == [3, 3]
    assert 3 < ratio(seconds["a"], seconds["b"]).value < 5.5


def test_steps_that_last_so_long():
    assert steps_for(lambda n: busy(1e-3 + 1e-4 * n), 0.05, unit=7) in range(280, 560, 7)
    assert steps_for(lambda n: busy(1e-4 * n), 0.05, unit=3, most=9) == 9


def test_pin():
    """In a process of its own: it would keep the tests to one core."""
    text = (
        "import os; from benchmarks.measure import pin; everything = os.sched_getaffinity(0)\n"
        "assert pin(-1) is None and os.sched_getaffinity(0) == everything\n"
        "assert pin(None) == max(everything) and os.sched_getaffinity(0) == {max(everything)}\n"
        "try: pin(10**6)\n"
        "except ValueError as error: assert 'not one this process may use' in str(error)\n"
        "else: raise AssertionError"
    )
    if hasattr(os, "sched_setaffinity"):
        subprocess.run([sys.executable, "-c", text], check=True)


# --- reporting -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("at_most", "at_least", "holds", "target"),
    [
        (2.5, None, True, "≤ 2.5"),
        (1.9, None, False, "≤ 1.9"),
        (None, 2.0, True, "≥ 2"),
        (2.2, 2.1, False, "≥ 2.1 and ≤ 2.2"),
        (None, None, True, ""),
    ],
)
def test_claim(at_most, at_least, holds, target):
    claim = Claim("a over b", Ratio(2.0, 1.0, 3.0), at_most, at_least)
    assert claim.holds is holds
    assert claim.target == target


def test_report_is_written_and_shown(tmp_path, monkeypatch):
    console = Console(width=100, record=True, quiet=False, file=open(os.devnull, "w"))  # noqa: SIM115
    monkeypatch.setattr(report, "console", console)
    rows = [{"case": "first", "us": 1.25, "to C": None}, {"case": "second", "us": float("nan"), "to C": 2.0}]
    found = Report("one", "quick", rows, [Claim("a over b", Ratio(2.0, 1.5, 2.5), 1.9)], ["Left out: nothing."])
    path = found.write(tmp_path / "deep")
    found.show()
    console.file.close()

    written = json.loads(path.read_text())
    assert written["benchmark"] == "one"
    assert written["rows"][1]["us"] is None
    assert written["claims"] == [
        {
            "what": "a over b",
            "seen": {"value": 2.0, "low": 1.5, "high": 2.5},
            "at_most": 1.9,
            "at_least": None,
            "holds": False,
        }
    ]
    assert {"processor", "cores", "python", "jax", "vmri_jax", "xla_flags"} <= written["machine"].keys()
    text = console.export_text()
    assert "first" in text
    assert "2 (1.5 to 2.5)" in text
    assert "Left out" in text


# --- commands --------------------------------------------------------------------------------------------------------
FLOOR = floor.Case("FPU l=3", 1e-3, 2, ("fully explicit", "explicit slow"), 2.5, 3.0, (2, 256), 0.6)
TINY = {
    "cost": (cost, cost.Size((("FPU l=3", "fully explicit"),), (100, 200), 2, 1e-3)),
    "floor": (floor, floor.Size((FLOOR,), 2, 1e-3)),
    "chains": (chains, chains.Size((2,), (2,), 1, (2,), ())),
}


@pytest.mark.parametrize("name", TINY)
def test_command(name, tmp_path, monkeypatch):
    module, size = TINY[name]
    monkeypatch.setattr(module, "sizes", lambda _: size)
    monkeypatch.setattr(command_line, "prepare", lambda *_, **__: None)  # the tests have started JAX already
    told = []
    run = module.run
    monkeypatch.setattr(module, "run", lambda size, name, tell: run(size, name, told.append))
    done = CliRunner().invoke(command_line.app, [name, "--out", str(tmp_path)])
    assert done.exit_code == 0, done.exception
    assert told

    written = json.loads((tmp_path / f"{name}.json").read_text())
    assert written["size"] == "quick"
    assert all(row[column] is not None for row in written["rows"] for column in ("system", "case") if column in row)
    for claim in written["claims"]:
        seen = claim["seen"]
        assert seen["low"] <= seen["high"]
        assert seen["low"] > 0
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.json"]
    CHECKS[name](written)


def test_what_was_measured_before_a_failure_is_kept(tmp_path, monkeypatch):
    def run(size, name, tell):
        yield Report("floor", name, [{"case": "first"}])
        raise RuntimeError("the second case")

    monkeypatch.setattr(command_line, "prepare", lambda *_, **__: None)
    monkeypatch.setattr(floor, "run", run)
    done = CliRunner().invoke(command_line.app, ["floor", "--out", str(tmp_path)])
    assert str(done.exception) == "the second case"
    assert json.loads((tmp_path / "floor.json").read_text())["rows"] == [{"case": "first"}]


def check_cost(found):
    assert [(row["num_micro"], row["result"]) for row in found["rows"]] == [(100, "CONVERGED"), (200, "CONVERGED")]
    assert all(row["bytes"] > 0 for row in found["rows"])
    assert [claim["what"].partition(" of log ")[2].split()[0] for claim in found["claims"]] == ["time", "memory"]


def check_floor(found):
    programs = [row["program"] for row in found["rows"]]
    ours = ["fully explicit", "explicit slow", "batch of 2", "batch of 256"]
    assert [row["result"] for row in found["rows"][:4]] == ["CONVERGED"] * 4
    if c_loops.compiler() is None:
        assert "No C compiler" in found["notes"][0]
        assert programs == ours
    else:
        assert programs == [*ours, "C"]
        assert found["rows"][-1]["to C"] == 1.0
        claims = [claim["what"] for claim in found["claims"]]
        assert claims[:2] == [f"FPU l=3, num_micro 2: {words} over C" for words in ("fully explicit", "batch of 256")]


def check_chains(found):
    (row,) = found["rows"]
    assert row["rows"] == 22
    assert row["band, us"] != row["full, us"]
    assert row["band, us a body"] == row["band, us"] / 2
    assert row["directors over joint"] == row["full, us"] / row["joint, us"]
    assert row["joint, first s"] > 0


CHECKS = {"cost": check_cost, "floor": check_floor, "chains": check_chains}


def test_floor_without_a_compiler(monkeypatch):
    monkeypatch.setattr(c_loops, "compiler", lambda: None)
    (found,) = floor.run(floor.Size((dataclasses.replace(FLOOR, batches=()),), 1, 1e-3), "quick")
    assert "No C compiler" in found.notes[0]
    assert [claim.what for claim in found.claims] == ["FPU l=3, num_micro 2: explicit slow over fully explicit"]
    assert found.rows[0]["to C"] is None


# --- what is measured ------------------------------------------------------------------------------------------------
def test_unknowns_as_in_the_reference_study():
    assert unknowns(programs.problem("FPU l=3"), vm.fully_implicit(60)) == 183
    assert unknowns(programs.problem("SAM"), vm.fully_implicit(20)) == 307


@pytest.mark.parametrize("system", ["FPU l=3", "TSP", "SAM"])
def test_starts_differ_and_keep_to_the_constraints(system):
    problem = programs.problem(system)
    states = worker.starts(problem, 3)
    assert states.q_s.shape == (3, problem.q_s.size)
    assert np.abs(states.p_f[0] - states.p_f[1]).max() > 1e-4
    assert isinstance(problem.system.kinetic, vm.ConstantMass)
    for i in range(3):
        velocity = problem.system.kinetic.velocity(states.p_s[i], states.p_f[i])
        rates = problem.system.constraint_rates(0.0, states.q_s[i], states.q_f[i], *velocity)
        assert np.abs(rates).max(initial=0) < 1e-12


def test_slope():
    x = np.array([1.0, 10.0, 100.0])
    assert cost.slope(x, 7 * x**1.5) == pytest.approx(1.5)


@pytest.mark.parametrize("name", ["quick", "full"])
def test_sizes(name):
    for module in (cost, floor):
        assert module.sizes(name).repeats >= 2
    assert timing.MIN_SECONDS >= 0.01
