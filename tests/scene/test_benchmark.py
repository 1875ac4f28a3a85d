"""The benchmark of scenes sees what it looks for: effects that stay behind, orders that are missed."""

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from benchmarks import __main__ as command_line
from benchmarks import scenes
from tests.scene.effect_scenes import EFFECTS
from vmri_jax import fully_implicit
from vmri_jax.scene import LinearDamping, Scene

TINY = scenes.Size(2, ("fully explicit",), 2, 1e-3, 10, 2, (("fully implicit", fully_implicit(2), (160, 320)),))
DAMPING = next(effect for effect in EFFECTS if isinstance(effect, LinearDamping))


@pytest.fixture
def one_effect(monkeypatch):
    monkeypatch.setattr(scenes, "EFFECTS", [DAMPING])
    monkeypatch.setattr(scenes, "_by_hand", lambda *_: {})


@pytest.mark.usefixtures("one_effect")
def test_what_is_taken_out_is_the_same_program():
    (report,) = scenes.absence(TINY, "quick")
    (row,) = report.rows
    assert row["effect"] == "damping"
    assert row["same"] == "yes"
    assert row["ops without"] == row["ops never"] < row["ops with"]
    assert row["unknowns"] == row["formula"] == 3 + 5 * 9
    assert row["calls without"] == 0 < row["calls with"]


@pytest.mark.usefixtures("one_effect")
def test_what_stays_behind_is_seen(monkeypatch):
    monkeypatch.setattr(Scene, "without", lambda scene, _: Scene(scene.bodies, scene.effects))
    (report,) = scenes.absence(TINY, "quick")
    (row,) = report.rows
    assert row["same"] == "no"
    assert report.notes[0].startswith("0 of 1")


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_calls_are_noted(effect):
    watched, calls = scenes.counted(effect)
    assert (type(watched).__name__, watched.name) == (type(effect).__name__, effect.name)
    with pytest.raises((TypeError, AttributeError)):
        watched.function()
    assert len(calls) == 1


def test_orders_are_held_against_the_scheme(monkeypatch):
    def convergence(scheme, steps):
        errors = {body: [n**-2.0 for n in steps] for body in scenes.EFFECT_OF}
        return errors, errors | {"falling": [1e-9, 1e-9]}

    monkeypatch.setattr(scenes, "convergence", convergence)
    (report,) = scenes.orders(TINY, "quick")
    found = {row["effect"]: row["holds"] for row in report.rows}
    assert found.pop("quadratic drag") == "no"
    assert set(found.values()) == {"yes"}


def test_command_writes_tables(tmp_path, monkeypatch):
    monkeypatch.setattr(command_line, "prepare", lambda *_: None)  # the tests have started JAX already
    monkeypatch.setattr(scenes, "SCENES", {"FPU l=3": scenes.SCENES["FPU l=3"]})
    part = replace(scenes.PARTS["presence"], sizes=lambda _: TINY)
    monkeypatch.setitem(scenes.PARTS, "presence", part)
    done = CliRunner().invoke(command_line.app, ["scenes", "--only", "presence", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "scene_presence.json").read_text())
    assert [row["program"] for row in found["rows"]] == ["scene", "by hand"]
    assert found["claims"][0]["at_most"] == scenes.MOST
    text = (tmp_path / "scene_presence.md").read_text()
    assert "| FPU l=3 | fully explicit | scene |" in text
    assert "| FPU l=3, fully explicit: scene over by hand |" in text
