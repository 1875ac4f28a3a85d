"""``vmri animate``: what it writes, which drawing it takes, and how it refuses."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import vmri_jax as vm
from tests.animation.support import PENDULUM, reference_run, swinging
from vmri_jax.running.store.layout import change_attributes
from vmri_jax.running.store.stream import stream

RUN = swinging()


@pytest.fixture
def animate(vmri, tmp_path):
    """The command in a folder with runs."""
    RUN.save("plain.npz")
    RUN.save("drawn.npz", PENDULUM)
    (tmp_path / "text.npz").write_text("no run")
    (tmp_path / "wrong.json").write_text(json.dumps(PENDULUM | {"links": [["bob", "tipp"]]}))
    (tmp_path / "broken.json").write_text("{")
    return partial(vmri, "animate")


def page(path="run.html") -> dict:
    with open(path, encoding="utf-8") as file:
        [text] = re.findall(r'id="data">(.*?)</script>', file.read(), re.DOTALL)
    return json.loads(text)


def names(data: dict) -> list[str]:
    return [body["name"] for body in data["bodies"]]


def test_which_drawing_is_taken(animate):
    """One's own goes first, then that stored with the run; without any, all coordinates are shown."""
    assert animate("drawn.npz")[0] == 0
    assert names(page("drawn.html")) == ["bob", "tip"]
    code, text = animate("plain.npz", "--out", "run.html")
    assert code == 0
    assert "run.html 0.0" in text
    assert names(page()) == ["q_s[0]", "q_s[1]", "q_f[0]", "q_f[1]"]
    with open("mine.json", "w", encoding="utf-8") as file:
        json.dump({"bodies": [{"name": "mine", "coordinates": [["s", 0]]}]}, file)
    assert animate("drawn.npz", "--drawing", "mine.json", "--out", "run.html")[0] == 0
    assert names(page()) == ["mine"]


def test_a_built_in_system_gives_its_drawing_and_its_velocities(animate):
    reference_run("tsp_fully_implicit_p1", 0.01).save("tsp.npz")
    assert animate("tsp.npz", "--system", "tsp", "--from", 0.1, "--to", 0.3)[0] == 0
    data = page("tsp.html")
    assert names(data) == ["heavy bob", "light bob", "last bob"]
    assert data["speed"] == 0.01


def test_a_streamed_run_as_far_as_it_is_on_disk(animate, fpu):
    scheme, run = vm.fully_explicit(2), {"macro_dt": 0.01, "num_steps": 12, "chunk": 4}
    stream(fpu.system, scheme, fpu.state(), out="run.zarr", **run)
    assert animate("run.zarr", "--system", "fpu")[0] == 0
    assert len(names(page())) == 6
    change_attributes(Path("run.zarr"), drawing={"bodies": [{"name": "first", "coordinates": [["s", 0]]}]})
    assert animate("run.zarr")[0] == 0
    assert names(page()) == ["first"]


def test_pictures_by_their_suffix(animate):
    assert animate("drawn.npz", "--out", "run.png", "--frames", 2)[0] == 0
    assert animate("drawn.npz", "--out", "dark.png", "--frames", 2, "--dark")[0] == 0
    assert animate("drawn.npz", "--out", "run.GIF", "--seconds", 0.2)[0] == 0
    light, dark = (np.asarray(Image.open(name).convert("L")).mean() for name in ("run.png", "dark.png"))
    assert light > 200
    assert dark < 90
    with Image.open("run.GIF") as image:
        assert getattr(image, "n_frames", 1) == 4


def test_a_failed_run_is_drawn_up_to_there_and_says_so(animate):
    broken = np.where(np.arange(41) < 25, 1.0, np.nan)[:, None]
    fields = {name: getattr(RUN, name) * broken for name in ("q_s", "q_f", "p_s", "p_f")}
    RUN.with_arrays(**fields, result=4, failed_at=24).save("failed.npz", PENDULUM)
    code, text = animate("failed.npz")
    assert code == 0
    assert "failed in macro step 24, after t = 2.4" in text
    assert "macro step 24" in page("failed.html")["ending"]


@pytest.mark.parametrize(
    ("arguments", "pieces"),
    [
        (["none.npz"], ["none.npz does not exist"]),
        (["none.zarr"], ["none.zarr"]),
        (["text.npz"], ["text.npz cannot be read"]),
        (["plain.npz", "--out", "run.mp4"], ["--out run.mp4", ".html", ".gif"]),
        (["plain.npz", "--out", "no/run.html"], ["--out no/run.html", "does not exist"]),
        (["plain.npz", "--system", "tps"], ["no system 'tps'", "Did you mean tsp?"]),
        (["plain.npz", "--system", "fpu"], ["the run has 2 slow and 2 fast coordinates"]),
        (["plain.npz", "--drawing", "none.json"], ["none.json", "does not exist"]),
        (["plain.npz", "--drawing", "broken.json"], ["not valid JSON"]),
        (["plain.npz", "--drawing", "wrong.json"], ["links[0]", "'tipp'", "Did you mean tip?"]),
        (["plain.npz", "--from", "9"], ["no part of the run, which goes from t = 0 to 4"]),
        (["plain.npz", "--frames", "0"], ["--frames", "greater than or equal to 1"]),
    ],
)
def test_bad_input_is_refused_in_words(animate, arguments, pieces):
    code, text = animate(*arguments)
    assert code == 2
    for piece in pieces:
        assert piece in text


def test_the_view_may_be_given(animate):
    assert animate("drawn.npz", "--out", "run.html", "--view=-90,90")[0] == 0
    assert page()["view"] == {"azimuth": pytest.approx(-np.pi / 2), "elevation": pytest.approx(np.pi / 2)}
    for wrong in ("above", "10", "0,91"):
        code, text = animate("drawn.npz", "--view", wrong)
        assert code == 2
        assert "--view is" in text
        assert "azimuth and elevation in degrees" in text


@pytest.mark.parametrize("out", ["run.npz", "run.zarr"])
def test_runs_keep_their_micro_nodes_and_names_for_pictures(vmri, out):
    options = ["fpu", "--macro-dt", "0.1", "--num-micro", "5", "--steps", "2000", "--out", out, "--save-micro"]
    code, text = vmri("simulate", *options)
    assert code == 0, text
    assert vmri("animate", out, "--out", "run.html", "--to", "1")[0] == 0
    assert len(page()["t"]) > 8 * 50 * 4 / 3  # 8 bytes of 50 nodes in base 64
