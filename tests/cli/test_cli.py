"""The command line: what it prints, what it writes, and how it refuses."""

import errno
import importlib
import os
import re
import shlex
import signal
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import vmri_jax as vm
from vmri_jax import cli
from vmri_jax.catalogue import SCHEMES, find_problem, find_scheme
from vmri_jax.cli.run import default_save_every
from vmri_jax.hard_cases import Outcome
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.simulation import Simulation
from vmri_jax.study import WorkPrecision, families, reference_solution

USER_FILE = """
import jax.numpy as jnp
import vmri_jax as vm

def soft(q_s, q_f, params):
    return jnp.sum((q_s - q_f) ** 2) / 2

def stiff(q_f, params):
    return 200.0 * jnp.sum(q_f**2)

one = jnp.ones(1)
my_problem = vm.Problem(vm.System(vm.ConstantMass(one, one), soft, stiff), one, 0 * one, one, one)

def make_problem():
    return my_problem

def needs_more(size):
    return my_problem

not_a_problem = 3
"""
RUN = ["--macro-dt", "0.1", "--steps", "4", "--scheme", "fully-explicit"]


@pytest.fixture
def vmri(vmri, tmp_path):
    """In a folder with files of a user."""
    (tmp_path / "user.py").write_text(USER_FILE)
    (tmp_path / "empty.py").write_text("x = 1")
    (tmp_path / "two.py").write_text(f"{USER_FILE}first = second = my_problem\ndel my_problem")
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "folder.zarr").mkdir()
    return vmri


PARTS = ("fpu", "tsp", "sam", "omega", "stiffness", "slow", "fast", "constraints")
SCHEME_OPTIONS = ("fully-implicit", "explicit-slow", "fully-explicit", "galerkin", "--alpha", "--degree --rule")
GROUPS = ("Run and see", "Is it right", "What it costs", "Many runs", "systems", "schemes", "simulate", "check")


@pytest.mark.parametrize(
    ("command", "pieces"),
    [
        (["systems"], PARTS),
        (["schemes"], SCHEME_OPTIONS),
        (["simulate", "--help"], ["Examples: vmri simulate"]),
        (["tune", "-h"], ["Examples: vmri tune"]),
        ([], GROUPS),
    ],
)
def test_lists_and_help(vmri, command, pieces):
    code, text = vmri(*command)
    assert code == (0 if command else 2)
    for piece in pieces:
        assert piece in text
    assert all(command.rich_help_panel for command in cli.app.registered_commands)


def test_simulate_writes_what_it_says(vmri, tmp_path):
    code, text = vmri("simulate", "fpu", *RUN, "--num-micro", 10, "--out", "run.npz", "--plot", "run.png")
    assert code == 0
    assert "macro steps 4, of 10 micro steps each" in text
    assert "from t = 0 to 0.4" in text
    assert "run.npz, run.png" in text
    assert "kept to" not in text
    expected = vm.simulate(vm.systems.fermi_pasta_ulam(), vm.fully_explicit(10), macro_dt=0.1, num_steps=4)
    np.testing.assert_array_equal(vm.Trajectory.load(tmp_path / "run.npz").q_f, expected.q_f)
    assert (tmp_path / "run.png").stat().st_size > 1000


@pytest.mark.parametrize("out", ["run.npz", "run.zarr"])
def test_a_saved_run_keeps_the_names_of_its_problem(vmri, tmp_path, monkeypatch, out):
    """The report has all nodes of the run, also where a figure has fewer."""
    monkeypatch.setattr("vmri_jax.cli.run.MOST_READ_NODES", 2)
    names = 'vm.Names(slow={"trolley": 1}, fast={"bell": 1})'
    (tmp_path / "named.py").write_text(
        USER_FILE.replace("one, one)\n\ndef make", f"one, one, names={names})\n\ndef make")
    )
    code, text = vmri("simulate", "named.py:my_problem", *RUN, "--out", out)
    assert code == 0, text
    run = vm.Trajectory.load(out) if out.endswith(".npz") else vm.StoredTrajectory(out)[:]
    assert "5 saved nodes from t = 0 to 0.4" in text
    assert run.position("bell").shape == (5, 1)
    assert run.names.slow_coordinates == ["trolley"]


def test_what_a_figure_compiles_is_no_part_of_the_run(vmri, tmp_path):
    """The work of the force is compiled for the figure, after the run: the compilation is not taken from the time of
    the run."""
    forced = "soft, stiff, force=lambda t, q_s, q_f, v_s, v_f, params: (-v_s, 0 * v_f))"
    (tmp_path / "forced.py").write_text(USER_FILE.replace("soft, stiff)", forced))
    code, text = vmri("simulate", "forced.py:my_problem", *RUN, "--plot", "run.png")
    assert code == 0, text
    times = re.search(r"wall time (\S+) s, of which (\S+) s compiling", text)
    assert times is not None, text
    whole, compiling = map(float, times.groups())
    assert compiling <= whole


def test_constraints_are_reported(vmri):
    code, text = vmri(
        "simulate", "tsp", "--scheme", "fully-explicit", "--macro-dt", 0.01, "--steps", 2, "--num-micro", 1
    )
    assert code == 0
    assert "kept to" in text


def test_a_failed_run_keeps_what_was_computed(vmri, tmp_path):
    options = ["--macro-dt", 1, "--steps", 60, "--scheme", "fully-explicit", "--num-micro", 1, "--out", "run.npz"]
    code, text = vmri("simulate", "fpu", *options)
    assert code == 1
    assert "The run failed" in text
    assert "Try a smaller macro_dt" in text
    assert "The trajectory up to there is in run.npz." in text
    assert "vmri advise fpu --macro-dt 1.0 --scheme fully-explicit --num-micro 1" in text
    trajectory = vm.Trajectory.load(tmp_path / "run.npz")
    assert np.isfinite(trajectory.q_s[0]).all()
    assert np.isnan(trajectory.q_s[-1]).all()


STREAM = ["simulate", "fpu", *RUN, "--out", "run.zarr"]


def test_simulate_streams_and_resumes(vmri, tmp_path):
    code, text = vmri(*STREAM)
    assert code == 0
    assert "from t = 0 to 0.4" in text
    assert "saved run.zarr" in text
    code, text = vmri(*STREAM)
    assert code == 2
    assert "run.zarr is a stored run, 2 of 2 chunks done. Go on with it (--resume), replace it (--overwrite)" in text
    code, text = vmri(*STREAM, "--resume", "--plot", "run.png")
    assert code == 0
    assert "per micro step" not in text
    longer = [{"4": "8"}.get(argument, argument) for argument in STREAM]
    code, text = vmri(*longer, "--resume")
    assert code == 0
    assert "macro steps 8" in text
    stored = vm.StoredTrajectory(tmp_path / "run.zarr")
    expected = vm.simulate(vm.systems.fermi_pasta_ulam(), vm.fully_explicit(10), macro_dt=0.1, num_steps=8)
    np.testing.assert_array_equal(stored.load().q_f, expected.q_f)
    assert vmri(*STREAM, "--overwrite")[0] == 0
    assert vm.StoredTrajectory(tmp_path / "run.zarr").num_steps == 4


@pytest.mark.parametrize(("out", "again"), [("run.zarr", True), ("run.npz", False)])
def test_ctrl_c_says_how_to_go_on(vmri, tmp_path, monkeypatch, out, again):
    real = Simulation.advance

    def advance(self, at, saves):
        os.kill(os.getpid(), signal.SIGINT)
        return real(self, at, saves)

    command = ["simulate", "fpu", *RUN[:2], "--steps", "100", *RUN[4:], "--out", out]
    monkeypatch.setattr("sys.argv", ["vmri", *command])
    with monkeypatch.context() as patch:
        patch.setattr(Simulation, "advance", advance)
        code, text = vmri(*command)
    assert code == 130
    assert f"The trajectory up to there is in {out}." in text
    assert ("Go on with it: vmri simulate fpu" in text) == again
    assert ("--out run.zarr --resume" in text) == again
    assert (tmp_path / out).exists()


def test_a_full_disk_is_told(vmri, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("vmri_jax.running.store.layout.commit", full)
    code, text = vmri(*STREAM)
    assert code == 1
    assert "Not written run.zarr cannot be written: No space left on device." in text
    monkeypatch.setattr("vmri_jax.running.trajectory.replaced", full)
    code, text = vmri(*STREAM[:-1], "run.npz")
    assert code == 1
    assert "No space left on device" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["simulate", "fpu", *RUN, "--out", "run.npz", "--resume"],
            "--resume is for a run that is written while it goes",
        ),
        (["simulate", "fpu", *RUN, "--out", "folder.zarr", "--resume"], "folder.zarr is not a stored run"),
        (["simulate", "fpu", *RUN, "--out", "nowhere/run.zarr"], "the folder nowhere does not exist; make it first"),
        (["simulate", "fpuu", *RUN], "there is no system 'fpuu'. Did you mean fpu? There are fpu, tsp, sam."),
        (
            ["simulate", "fpu", *RUN[:4], "--scheme", "fully_explict"],
            "Did you mean fully-explicit? There are fully-implicit",
        ),
        (["simulate", "none.py:x", *RUN], "the file none.py does not exist"),
        (["simulate", "empty.py", *RUN], "say which problem in that file; e.g. empty.py:my_problem"),
        (["simulate", "two.py", *RUN], "say which problem in that file; it has two.py:first, two.py:second"),
        (
            ["simulate", "user.py:my_problm", *RUN],
            "has no name 'my_problm'. Did you mean my_problem? Problems in it: my_problem.",
        ),
        (["simulate", "user.py:not_a_problem", *RUN], "is int; it must be a vmri_jax.Problem, or a function"),
        (["simulate", "user.py:needs_more", *RUN], "needs_more() in user.py failed: TypeError"),
        (["simulate", "user.py:my_problem", *RUN, "--out", "run.txt"], "must end in .npz"),
        (["simulate", "fpu", *RUN, "--out", "folder.npz"], "--out folder.npz is a folder"),
        (["simulate", "fpu", *RUN, "--plot", "nowhere/run.png"], "the folder nowhere does not exist"),
        (["simulate", "fpu", "--steps", 4], "macro_dt is missing"),
        (["simulate", "fpu", "--macro-dt", -1, "--steps", 4], "macro_dt is -1.0; it must be a positive number"),
        (["simulate", "fpu", "--macro-dt", 1, "--steps", 0], "num_steps is 0; it must be an integer of at least 1"),
        (["simulate", "fpu", *RUN, "--save-every", 3], "not a multiple of save = 3"),
        (["simulate", "fpu", *RUN, "--num-micro", 0], "num_micro is 0; it must be an integer of at least 1"),
        (["simulate", "fpu", *RUN, "--degree", 2], "the scheme fully-explicit has no degree"),
        (["simulate", "fpu", *RUN[:4], "--alpha", 0.5], "use explicit-slow or mollified-impulse or fully-explicit"),
        (["simulate", "fpu", *RUN[:4], "--scheme", "galerkin"], "needs the degree"),
        (
            ["simulate", "fpu", *RUN[:4], "--scheme", "galerkin", "--degree", 2, "--rule", "simpson"],
            "must be 'gauss', 'lobatto'",
        ),
        (["simulate", "fpu", *RUN, "--matrix", "sparse"], "it must be one of auto, masses, modes, exact, null_space"),
        (("tune", "user.py:my_problem", "--error", "1e-19", "--t-end", "1"), "round-off of float64 alone"),
        (("tune", "user.py:my_problem", "--error", "1e-3", "--t-end", "-1"), "t_end is -1 after the start"),
        (("tune", "user.py:my_problem", "--error", "1e-3", "--t-end", "1", "--out", "runs.txt"), ".csv"),
        (("cost", "user.py:my_problem", "--error", "-1"), "round-off of float64 alone"),
        (("cost", "user.py:my_problem", "--t-end", "0"), "t_end is 0 after the start"),
        (("simulate", "fpu", *RUN, "--compose", "yoshida5"), "there is no composition"),
        (("simulate", "fpu", "--macro-dt", "0.1"), "got neither of --steps and --accuracy"),
        (("simulate", "fpu", *RUN, "--accuracy", "1e-3"), "got both of --steps and --accuracy"),
        (("simulate", "fpu", "--accuracy", "1e-3"), "--accuracy and --t-end go together"),
        (("simulate", "fpu", *RUN, "--error", "--out", "run.zarr"), "--error compares runs that are in memory"),
        (("simulate", "fpu", "--accuracy", "1e-30", "--t-end", "1"), "round-off of float64"),
    ],
)
def test_bad_input_is_refused_in_one_panel(vmri, arguments, message):
    code, text = vmri(*arguments)
    assert code == 2
    assert message in text
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("source", "name", "said"),
    [
        ("first = make()", "", ""),
        ("problem = make()", "", ""),
        ("first = make()\nproblem = make()", "", "several.py: taking problem; there is also several.py:first."),
        ("first = second = make()", ":second", ""),
        ("first = second = make()", ":make", ""),
    ],
)
def test_problems_in_files(vmri, tmp_path, source, name, said):
    start = "from vmri_jax.systems import fermi_pasta_ulam as make\n"
    (tmp_path / "several.py").write_text(start + source)
    code, text = vmri("simulate", f"several.py{name}", *RUN)
    assert code == 0
    assert "nothing; give --out" in text
    assert said in text
    assert ("taking" in text) == bool(said)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = 1\nimport not_installed_anywhere", "line 2 of broken.py failed: ModuleNotFoundError"),
        ("import sys\nsys.exit('no')", "line 2 of broken.py failed: SystemExit: no"),
        ("def (", "broken.py failed: SyntaxError"),
    ],
)
def test_a_file_that_fails_to_run_says_where(vmri, tmp_path, source, message):
    (tmp_path / "broken.py").write_text(source)
    code, text = vmri("simulate", "broken.py:problem", *RUN)
    assert code == 2
    assert message in text


@pytest.mark.parametrize(("steps", "save_every"), [(1, 1), (1000, 1), (2000, 2), (100_000, 100), (2003, 1), (3001, 1)])
def test_about_a_thousand_nodes_are_saved(steps, save_every):
    assert default_save_every(steps) == save_every


@pytest.fixture
def short_menu(monkeypatch):
    """The search chooses among few schemes."""
    menu = [family for family in families() if family.name in ("fully explicit", "explicit slow")]
    monkeypatch.setattr("vmri_jax.study.tuning.families", lambda: menu)


def test_tune_prints_a_command_that_keeps_its_promise(vmri, short_menu, tmp_path):
    code, text = vmri("tune", "user.py:my_problem", "--error", "1e-3", "--t-end", "1", "--out", "runs.csv")
    assert code == 0
    assert (tmp_path / "runs.csv").read_text().startswith("scheme,num_micro,order")
    command = re.search(r"vmri (simulate user\.py:my_problem .*run\.npz)", text)
    assert command
    assert vmri(*command[1].split())[0] == 0
    run = vm.Trajectory.load(tmp_path / "run.npz")
    truth = reference_solution(find_problem("user.py:my_problem"), 1.0, num_saves=1)
    assert abs(run.q_s[-1, 0] - truth.q[-1, 0]) < 1e-3
    assert float(run.t[-1]) == pytest.approx(1.0)


def test_tune_that_reaches_nothing_keeps_the_runs(vmri, short_menu, tmp_path, monkeypatch):
    monkeypatch.setattr("vmri_jax.accuracy.search.MOST_STEPS", 16)
    code, text = vmri("tune", "user.py:my_problem", "--error", "1e-9", "--t-end", "1", "--out", "runs.csv")
    assert code == 1
    assert "no setting reached 1e-09" in text
    assert "error_q" in (tmp_path / "runs.csv").read_text()


@pytest.mark.parametrize("name", SCHEMES)
def test_schemes_are_found_with_dashes_and_underscores(name):
    options: dict[str, Any] = {"degree": 2} if name == "galerkin" else {}
    found = find_scheme(name.replace("-", "_"), 3, **options)
    assert found == SCHEMES[name](3, **options)


def test_simulate_for_an_accuracy(vmri):
    code, text = vmri("simulate", "fpu", "--accuracy", "1e-3", "--t-end", "0.4", "--error", "--out", "run.npz")
    assert code == 0
    assert "positions are wrong by about" in text
    command = re.search(r"vmri (simulate fpu .*--save-every \d+)", text)
    assert command is not None
    code, _ = vmri(*shlex.split(command[1]), "--out", "again.npz")
    assert code == 0
    run, again = (vm.Trajectory.load(name) for name in ("run.npz", "again.npz"))
    assert run.error.largest <= 1e-3
    np.testing.assert_array_equal(run.q_f, again.q_f)


def test_simulate_composes(vmri):
    code, text = vmri("simulate", "fpu", *RUN, "--num-micro", "3", "--compose", "suzuki4")
    assert code == 0
    assert "15 micro steps" in text


# --- places that cannot be written, and parts that fail late
# -----------------------------------------------------------


COMPUTING = (
    ("cli.run", "_run"),
    ("study", "tune"),
    ("study.tuning", "Tuning"),
    ("cli.right", "stability_map"),
    ("cli.right", "cases_for"),
)
"""What the commands compute with."""


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "fpu", *RUN, "--out", "PLACE.npz"),
        ("simulate", "fpu", *RUN, "--out", "PLACE.zarr"),
        ("simulate", "fpu", *RUN, "--plot", "PLACE.png"),
        ("tune", "fpu", "--error", "1e-3", "--t-end", "1", "--out", "PLACE.csv"),
        ("cost", "fpu", "--out", "PLACE"),
        ("stability", "--out", "PLACE.png"),
        ("check", "fpu", "--out", "PLACE"),
        ("animate", "run.npz", "--out", "PLACE.html"),
    ],
)
@pytest.mark.parametrize("place", ["user.py/x", "no/such/folder/x", "x" * 260])
def test_a_place_that_cannot_be_written_is_refused_before_any_compute(vmri, monkeypatch, arguments, place):
    if arguments[0] in ("cost", "check") and place.startswith("no/"):
        pytest.skip("folders are made")

    def too_early(*_, **__):
        raise AssertionError("computed before the place was checked")

    for module, name in COMPUTING:
        monkeypatch.setattr(importlib.import_module(f"vmri_jax.{module}"), name, too_early)
    code, text = vmri(*(word.replace("PLACE", place) for word in arguments))
    assert code in (1, 2)
    assert re.search("cannot be (written|made)|does not exist|Not written", text), text


def test_a_fault_inside_is_no_usage_error(tmp_path, monkeypatch):
    """An error that another library raises, or Python itself, is shown with its origin, and what was computed is told
    first."""
    monkeypatch.chdir(tmp_path)

    def broken(*_):
        return int("a fault")

    monkeypatch.setattr("vmri_jax.plots.plot_trajectory", broken)
    result = CliRunner().invoke(cli.app, ["simulate", "fpu", *RUN, "--plot", "run.png", "--out", "run.npz"])
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError)
    assert "Usage" not in result.output
    assert "A fault inside" in result.output
    assert "changed by at most" in result.output
    assert (tmp_path / "run.npz").exists()


NOTHING = WorkPrecision(())


def test_a_page_that_cannot_be_drawn_leaves_the_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = importlib.import_module("vmri_jax.study.tuning")

    def failing(problem, name, out, **_):
        page._write(page.CostReport(out / "cost.html", name, 1.0, (1e-2,), NOTHING), problem)

    def broken(*_, **__):
        return int("no figure")

    monkeypatch.setattr("vmri_jax.plots.plot_work_precision", broken)
    monkeypatch.setattr("vmri_jax.study.cost_report", failing)
    result = CliRunner().invoke(cli.app, ["cost", "fpu", "--out", "page"])
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError)  # the fault itself, no usage error
    assert "all runs are in cost.csv" in result.exception.__notes__[0]
    assert (tmp_path / "page" / "cost.csv").exists()


def test_ctrl_c_leaves_the_runs_of_a_search(vmri, tmp_path, monkeypatch):
    def stopped(*_, **__):
        raise Interrupted(NOTHING, 0, None, "runs")

    monkeypatch.setattr("vmri_jax.study.tune", stopped)
    code, text = vmri("tune", "fpu", "--error", "1e-2", "--t-end", "0.2", "--out", "runs.csv")
    assert code == 130
    assert "After 0 runs." in text
    assert (tmp_path / "runs.csv").exists()


def test_ctrl_c_leaves_the_cases_that_were_done(vmri, tmp_path, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("vmri_jax.hard_cases.cases.Resolved.single_precision", lambda *_: Outcome("refused", True))
    monkeypatch.setattr("vmri_jax.hard_cases.cases.Resolved.bad_lane", stopped)
    code, text = vmri("check", "user.py:my_problem", "--case", "10", "--case", "11", "--out", "cases")
    assert code == 130
    assert "1 of 1 criteria met" in text
    assert "After 1 of 2 cases" in text
    assert (tmp_path / "cases" / "cases.csv").exists()
