"""`vmri sweep`: files, stores, what is said."""

import pickle
import re
import sys
import tomllib
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.cli.sweep import by_name, read_sweep
from vmri_jax.ensembles.quantities import drawn_by_default

SMALL = """
system = "fpu"
scheme = "explicit-slow"
out = "runs.zarr"
macro_dt = 0.05
num_steps = 4
num_micro = 2
[axes]
omega = [20.0, 50.0]
"""


@pytest.fixture
def vmri(vmri, tmp_path):
    """In a folder with a small sweep."""
    (tmp_path / "sweep.toml").write_text(SMALL)
    return vmri


def test_a_sweep_runs_is_drawn_and_gone_on_with(vmri, tmp_path):
    (tmp_path / "sweep.toml").write_text(f'save = ["end", "iterations"]\n{SMALL}')
    code, text = vmri("sweep", "sweep.toml", "--plot", "map.png")
    assert code == 0
    assert "Figure of iterations: map.png" in text
    assert re.search(r"runs 2 computed now 2 in [\d.]+ s", text)
    assert "chunks 1 of 1 are in the store, 2 runs each" in text
    assert 'vmri_jax.open_ensemble("runs.zarr")' in text
    assert (tmp_path / "map.png").stat().st_size > 5000
    assert vm.open_ensemble("runs.zarr").omega.values.tolist() == [20.0, 50.0]
    code, text = vmri("sweep")
    assert code == 2
    assert "is a stored ensemble, 1 of 1 chunks done" in text
    assert "computed now 0" in vmri("sweep", "--resume")[1]
    assert "computed now 2" in vmri("sweep", "--overwrite")[1]


def test_names_of_columns_say_which_number_they_set(fpu):
    params = fpu.system.params | {"spring": {"masses": np.ones((2, 2)), "k": np.ones(())}}
    problem = replace(fpu, system=fpu.system.with_params(params))
    row = {"spring.k": 2.0, "spring.masses[1,0]": 3.0, "v elongations[1]": 4.0, "q_s[2]": 5.0, "t": 6.0}
    changed = pickle.loads(pickle.dumps(by_name(problem, [*row, "num_micro"])))(problem, row)  # pyright: ignore[reportOptionalCall]
    params = changed.system.params["spring"]
    assert params["k"] == 2.0
    assert np.array_equal(params["masses"], [[1.0, 1.0], [3.0, 1.0]])
    assert (changed.v_f[0], changed.v_f[1], changed.q_s[2], changed.t) == (fpu.v_f[0], 4.0, 5.0, 6.0)
    assert by_name(problem, ["num_micro"]) is None


def test_what_cannot_be_drawn_is_refused_before_it_runs(vmri, tmp_path):
    code, text = vmri("sweep", "sweep.toml", "--plot", "map.png")
    assert code == 2
    assert '--plot draws one number per run or per saved node, and save = ["end"] keeps neither.' in text
    assert 'save = ["end", "energy_error"]' in text
    assert not (tmp_path / "runs.zarr").exists()


OWN = """
def reach(run):
    return run.q_s[:, 0].max()

def places(run):
    return {"first": run.position("centres")[0]}
"""


@pytest.mark.parametrize(
    ("save", "drawn"),
    [
        (["end", "extremes", "quantiles", "constraint_residual"], []),
        (["energy_error", "end", "iterations"], ["energy_error", "iterations"]),
        (["nodes"], ["node_energy"]),
        (["own.py:reach", "own.py:places"], ["reach"]),
    ],
)
def test_what_is_drawn_is_known_from_what_is_saved(vmri, tmp_path, fpu, save, drawn):
    (tmp_path / "own.py").write_text(OWN)
    assert drawn_by_default(save, fpu) == drawn


def test_workers(vmri, tmp_path):
    pytest.importorskip("distributed")
    code, text = vmri("sweep", "--workers", "1")
    assert code == 0
    assert re.search(r"dashboard: http://[\d.:]+/status", text)
    assert "computed now 2" in text


def test_the_example_is_complete(vmri, tmp_path):
    code, text = vmri("new", "mine.toml")
    assert code == 0
    assert "vmri sweep mine.toml --workers 2" in text
    given = read_sweep(tmp_path / "mine.toml")
    assert list(given["scheme"]) == ["explicit-slow", "fully-implicit"]
    assert given["design"].axes["omega"].unit == "rad/s"
    assert len(given["design"]) == 2 * 3 * 91
    assert vmri("new", "mine.toml")[0] == 2


def test_every_comment_of_the_example_is_valid(tmp_path):
    """With its lines of axes taken out, and those in comments put in."""
    text = files("vmri_jax.cli").joinpath("sweep.toml").read_text()
    head, axes = text.split("[axes]")
    commented = axes[axes.index("# [draws]") :]
    draws = "\n".join(line.removeprefix("# ") for line in commented.splitlines())
    (tmp_path / "draws.toml").write_text(f"{head}\nnum_steps = 10\nnum_micro = 2\n{draws}")
    assert tomllib.loads((tmp_path / "draws.toml").read_text())["draws"]["seed"] == 0
    given = read_sweep(tmp_path / "draws.toml")
    assert given["design"].rows(0, 3).keys() == {"omega", "v_s[0]"}


def test_axes_and_files_are_seen_from_the_folder(tmp_path):
    (tmp_path / "a.toml").write_text(
        'system = "mine.py:chain"\nscheme = "galerkin"\nout = "a.zarr"\nsave = ["mine.py:own", "end"]\n'
        "[axes]\na = { from = 1, to = 100, count = 3, log = true }\nb = { values = [1, 2], unit = 'm' }\nc = 3.0\n"
    )
    given = read_sweep(tmp_path / "a.toml")
    assert given["system"] == f"{tmp_path / 'mine.py'}:chain"
    assert given["save"] == [f"{tmp_path / 'mine.py'}:own", "end"]
    assert given["out"] == tmp_path / "a.zarr"
    axes = given["design"].axes
    assert np.allclose(axes["a"].values, [1, 10, 100])
    assert (axes["b"].unit, axes["c"].values.tolist()) == ("m", [3.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("out =", "oout ="), "no entry 'oout'. Did you mean out?"),
        (('system = "fpu"\n', ""), "lacks the entry 'system'"),
        (('system = "fpu"\n', "system = 3\n"), 'system is int; give "fpu"'),
        (("[axes]\nomega = [20.0, 50.0]", "axes = 3"), "axes is int; give [axes]"),
        (("omega = [20.0, 50.0]", "num_micro = [1, 'a']"), "the column 'num_micro' has labels; give numbers"),
        (("omega = [20.0, 50.0]", "omega = { from = 1 }"), "the axis omega lacks the entry 'to'"),
        (("omega = [20.0, 50.0]", "omega = { values = [1], from = 1 }"), "the axis omega: there is no entry 'from'"),
        (("omega = [20.0, 50.0]", "omega = { from = 1, to = 2, count = 3.7 }"), "the axis omega: count is 3.7"),
        (("omega = [20.0, 50.0]", "omega = { from = 0, to = 2, count = 3, log = true }"), "both are positive"),
        (
            ("omega = [20.0, 50.0]", "omega = { from = 1, to = 2, count = 3, log = 'false' }"),
            "log is 'false'; it must",
        ),
        (("omega = [20.0, 50.0]", "omega = { form = 1 }"), "no entry 'form'. Did you mean from?"),
        (("omega", "omga"), "the column 'omga' sets no number of the problem. Did you mean omega?"),
        (("omega", '"q_s[7]"'), "the column 'q_s[7]' sets no number of the problem"),
        (("[axes]", '[axes]\n"q_s[0]" = 1\n"centres[0]" = 2'), "'q_s[0]' and 'centres[0]' set the same number"),
        (("[axes]", "[draws]"), "no entry 'omega'"),
        (("[axes]", "[draws]\ncount = 3\n[axes]"), "give either [axes] or [draws]"),
        (("macro_dt", "macro_dt ="), "is no TOML"),
        (("fpu", "fup"), "there is no system 'fup'"),
    ],
)
def test_bad_files_are_refused(vmri, tmp_path, change, message):
    (tmp_path / "sweep.toml").write_text(SMALL.replace(*change))
    code, text = vmri("sweep")
    assert code == 2
    assert message in text
    assert not (tmp_path / "runs.zarr").exists()


@pytest.mark.parametrize(
    ("column", "message"),
    [
        ("{ unit = 'm' }", "draws: omega lacks the entry 'distribution'"),
        ("{ distribution = 'normal' }", "the column 'omega' is 'normal'; give a distribution"),
    ],
)
def test_bad_draws_are_refused(tmp_path, column, message):
    axes = SMALL[SMALL.index("[axes]") :]
    draws = f"[draws]\ncount = 3\n[draws.columns]\nomega = {column}\n"
    (tmp_path / "sweep.toml").write_text(SMALL.replace(axes, draws))
    with pytest.raises(ValueError, match=message):
        read_sweep(tmp_path / "sweep.toml")


def test_bad_options_are_refused(vmri):
    assert "--workers is 0" in vmri("sweep", "--workers", "0")[1]
    assert "does not exist; write one with: vmri new sweep.toml" in vmri("sweep", "nothing.toml")[1]
    assert "must end in .png" in vmri("sweep", "--plot", "map.txt")[1]


@pytest.mark.parametrize(
    ("package", "options"),
    [("dask.array", ["--plot", "map.png"]), ("distributed", ["--workers", "tcp://localhost:1"])],
)
def test_a_package_that_is_not_installed_is_named_before_any_compute(vmri, tmp_path, monkeypatch, package, options):
    monkeypatch.setitem(sys.modules, package, None)
    code, text = vmri("sweep", *options)
    assert code == 1
    assert "Not installed" in text
    assert f"{options[0]} needs {package}; install it with pip install 'vmri_jax[ensemble]'" in text
    assert not (tmp_path / "runs.zarr").exists()
