"""The benchmark of model files, on two small ones."""

from types import SimpleNamespace

import pytest

from benchmarks import imports, random_models

pytest.importorskip("mujoco")
MODEL = """
<mujoco>
  <worldbody>
    <body pos="0 0 1"><joint type="slide" axis="1 0 0" range="-1 1" limited="true"/><geom size=".1" mass="2"/>
      <body><joint axis="0 1 0" armature=".1"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".05"/></body></body>
  </worldbody>
  <actuator><position kp="3" {}/></actuator>
</mujoco>
"""


def test_files_of_installed_packages_move_as_in_mujoco(tmp_path, monkeypatch):
    folder = tmp_path / imports.FOLDERS["gymnasium"]
    folder.mkdir(parents=True)
    moves = MODEL.format('joint="j"').replace("<joint axis", '<joint name="j" axis')
    (folder / "cartpole.xml").write_text(moves)
    (folder / "swimmer.xml").write_text(moves.replace("<worldbody>", '<option density="1000"/><worldbody>'))
    (folder / "giant.xml").write_text(moves)
    known = {"gymnasium": SimpleNamespace(submodule_search_locations=[str(tmp_path)])}
    monkeypatch.setattr(imports, "find_spec", known.get)
    files = imports.sizes("quick")
    assert [file.stem for _, file in files] == ["cartpole", "swimmer"]
    assert [file.stem for _, file in imports.sizes("full", ["giant"])] == ["giant"]
    *_, report = imports.run(files, "quick")
    first, second = report.rows
    assert (first["file"], first["bodies"], first["coordinates"]) == ("gymnasium/cartpole.xml", 2, 2)
    assert first["error"] < 1e-8
    assert first["acceleration"] < 1e-12
    assert "fluid (density = 1000)" in second["not read"]
    assert "1 of 2 files are read" in report.notes[0]


def test_without_the_packages_it_says_how_to_get_the_files(monkeypatch):
    monkeypatch.setattr(imports, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match=r"neither gymnasium nor dm_control is installed: pip install"):
        imports.sizes("full")


@pytest.mark.parametrize("seed", [0, 4, 7])
def test_random_models_accelerate_as_in_mujoco_or_are_refused(seed):
    """Measured: 1e-14 at most; seed 0 is refused. ``python -m benchmarks models --full`` compares 300."""
    row = random_models.compare(seed)
    assert row.get("difference", 0.0) < random_models.LARGEST_DIFFERENCE
    assert ("refused" in row) == (seed == 0)
