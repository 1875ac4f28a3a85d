"""Commands that judge a step or show a scene: advise, stability, explain, new, and scenes in simulate and animate."""

import re
import runpy

import numpy as np
import pytest

from vmri_jax import Problem, systems
from vmri_jax.catalogue import find_problem, find_scene_or_problem
from vmri_jax.scene import Scene

SCENE = """
from vmri_jax.scene import Anchor, Body, Gravity, Scene, Spring
from vmri_jax.systems import fermi_pasta_ulam as chain

scene = Scene(
    [Body("hook", 5.0, [0.0, -1.0], pace="slow"), Body("load", 1.0, [0.5, -1.0], pace="fast")],
    [Gravity(), Anchor("hook", [0.0, 0.0]), Spring(("hook", "load"), 4e3, 0.5)],
)

def other():
    return scene.without("gravity")
"""


@pytest.fixture
def vmri(vmri, tmp_path):
    """In a folder with a scene."""
    (tmp_path / "my.py").write_text(SCENE)
    return vmri


def test_advice_against_an_unstable_step(vmri):
    code, text = vmri("advise", "fpu", "--scheme", "fully-explicit", "--num-micro", 1, "--macro-dt", 0.042)
    assert code == 1
    assert "stability limit" in text
    assert "nearest safe step" in text


def test_advice_needs_one_step(vmri):
    code, text = vmri("advise", "fpu")
    assert code == 2
    assert "--macro-dt" in text


def test_map_of_stable_steps(vmri, tmp_path):
    code, text = vmri("stability", "--scheme", "fully-explicit", "--num-micro", 2, "--until", 1.5, "--out", "map.png")
    assert code == 0
    start, stop = map(float, re.search(r"2 ([\d.]+) to ([\d.]+)", text).groups())  # pyright: ignore[reportOptionalMemberAccess]
    assert (start, stop) == pytest.approx((0.8912, 0.9003), abs=2e-4)  # by the matrices of kicks and drifts
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_a_scene_is_simulated_and_drawn(vmri, tmp_path):
    steps = ["--scheme", "fully-explicit", "--macro-dt", 0.01, "--steps", 20, "--num-micro", 4]
    code, text = vmri("simulate", "my.py:scene", *steps, "--out", "run.npz")
    assert code == 0, text
    with np.load(tmp_path / "run.npz") as arrays:
        assert '"hook"' in str(arrays["drawing"])
    code, text = vmri("animate", "run.npz")
    assert code == 0, text
    assert "hook" in (tmp_path / "run.html").read_text()


def test_scenes_are_found_in_files(vmri):
    assert isinstance(find_scene_or_problem("my.py"), Scene)
    assert isinstance(find_problem("my.py"), Problem)
    assert find_problem("my.py:other").system.params.keys() == {"anchors", "springs"}
    with pytest.raises(ValueError, match=r"has no name 'scen'\. Did you mean scene\? Problems in it: scene"):
        find_problem("my.py:scen")
    assert find_problem("fpu").q_s.shape == systems.fermi_pasta_ulam().q_s.shape


def test_explain_prints_the_ledger_of_scenes_and_of_systems_of_functions(vmri, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    code, text = vmri("explain", "tsp", "--no-measure", "--num-micro", "4")
    assert code == 0, text
    rows = (
        *("bob 1 body macro 3", "bob 3 body micro 12", "spring fast potential W micro 4", "a macro step 32"),
        "second_rod constraint g micro 4 4",
        "frequency period in fast coordinates kinetic energy in",
        "100 0.06283 100% bob 2 z 50%, bob 3 z 50%",  # sqrt(5000 (1 / 1 + 1 / 1)): the spring
    )
    assert [row for row in rows if row not in text] == []
    code, text = vmri("explain", "my.py", "--no-measure", "--num-micro", "4")
    assert code == 0, text
    assert [word for word in ("load", "gravity", "unknowns", "micro", "macro") if word not in text] == []
    code, text = vmri("explain", "nowhere.py")
    assert code == 2
    assert "does not exist" in text


@pytest.mark.parametrize("options", [[], ["--scene"]], ids=["system", "scene"])
def test_what_new_writes_runs(vmri, tmp_path, capsys, options):
    code, text = vmri("new", "mine.py", *options)
    assert code == 0, text
    assert "FILE" not in (tmp_path / "mine.py").read_text()
    runpy.run_path("mine.py", run_name="__main__")
    assert capsys.readouterr().out.strip() == "energy kept to 0.0357 J"
    assert (tmp_path / "run.png").exists()
    code, text = vmri("new", "mine.py")
    assert code == 2
    assert "exists already" in text
    assert vmri("new", "mine.txt")[0] == 2
