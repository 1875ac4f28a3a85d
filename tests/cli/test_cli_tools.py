"""Commands that judge a step or show a scene: advise, stability, explain, and scenes in simulate and animate."""

import re

import numpy as np
import pytest

SCENE = """
from vmri_jax.scene import Anchor, Body, Gravity, Scene, Spring

scene = Scene(
    [Body("hook", 5.0, [0.0, -1.0], pace="slow"), Body("load", 1.0, [0.5, -1.0], pace="fast")],
    [Gravity(), Anchor("hook", [0.0, 0.0]), Spring(("hook", "load"), 4e3, 0.5)],
)
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
    code, text = vmri(
        "simulate", "my.py:scene", "--macro-dt", 0.01, "--steps", 20, "--num-micro", 4, "--out", "run.npz"
    )
    assert code == 0, text
    with np.load(tmp_path / "run.npz") as arrays:
        assert '"hook"' in str(arrays["drawing"])
    code, text = vmri("animate", "run.npz")
    assert code == 0, text
    assert "hook" in (tmp_path / "run.html").read_text()
