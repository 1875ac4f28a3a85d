"""Scenes from files: as problems of the command line, and explained by it."""

import pytest
from typer.testing import CliRunner

from vmri_jax import Problem, cli, systems
from vmri_jax.catalogue import find_problem, find_scene_or_problem
from vmri_jax.scene import Scene

FILE = """
from vmri_jax.scene import Body, Gravity, Scene, SpringAnchor
from vmri_jax.systems import fermi_pasta_ulam as chain

scene = Scene([Body("bob", 1.0, [1.0, 0.0])], [Gravity(), SpringAnchor("bob", [0.0, 0.0], 9.0)])

def other():
    return scene.without("gravity")
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(FILE)
    return str(path)


def test_scenes_are_found_in_files(file):
    assert isinstance(find_scene_or_problem(file), Scene)
    assert isinstance(find_problem(file), Problem)
    assert find_problem(f"{file}:other").system.params.keys() == {"spring_anchors"}
    with pytest.raises(ValueError, match=r"has no name 'scen'\. Did you mean scene\? Problems in it: scene"):
        find_problem(f"{file}:scen")
    assert find_problem("fpu").q_s.shape == systems.fermi_pasta_ulam().q_s.shape


def test_explain_takes_systems_of_functions():
    result = CliRunner().invoke(cli.app, ["explain", "tsp", "--no-measure", "--num-micro", "4"])
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    assert "bob 1 body macro 3" in lines
    assert "bob 3 body micro 12" in lines
    assert "spring fast potential W micro 4" in lines
    assert "second_rod constraint g micro 4 4" in lines
    assert "a macro step 32" in lines
    head = lines.index("frequency period in fast coordinates kinetic energy in")
    assert lines[head + 1] == "100 0.06283 100% bob 2 z 50%, bob 3 z 50%"  # sqrt(5000 (1 / 1 + 1 / 1)): the spring


def test_explain_prints_the_ledger(file):
    result = CliRunner().invoke(cli.app, ["explain", file, "--no-measure", "--num-micro", "4"], env={"COLUMNS": "160"})
    assert result.exit_code == 0, result.output
    for word in ("bob", "gravity", "unknowns", "micro", "macro"):
        assert word in result.output
    result = CliRunner().invoke(cli.app, ["explain", "nowhere.py"])
    assert result.exit_code == 2
    assert "does not exist" in result.output
