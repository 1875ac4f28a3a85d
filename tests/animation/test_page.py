"""The page: one file without a network, the same motion as in Python, and no error in a browser."""

import base64
import dataclasses
import html
import json
import re
import shutil
import subprocess
from importlib.resources import files

import numpy as np
import pytest

from tests.animation.support import PENDULUM, swinging
from vmri_jax.animation import Drawing, motion, write_html
from vmri_jax.animation.geometry import joint, spring
from vmri_jax.animation.html import MOST_COORDINATES
from vmri_jax.animation.layout import layout

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NODE = shutil.which("node")
SCRIPTS = files("vmri_jax.animation") / "page"


def data_of(page: str) -> dict:
    [text] = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)


def unpacked(text: str, dtype: type = np.float32) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def page_of(moved, path, title="Pendulum") -> str:
    write_html(moved, path, title)
    return path.read_text(encoding="utf-8")


def test_numbers_of_the_page_are_those_of_the_motion_and_it_asks_for_nothing_else(pendulum, tmp_path):
    page = page_of(pendulum, tmp_path / "run.html")
    assert not re.findall(r"(?:https?:)?//[a-z]", re.sub(r"(?m)//.*$", "", page))
    assert not re.findall(r"<script[^>]+src|<link[^>]+stylesheet|@import|fetch\(|XMLHttpRequest", page)
    data = data_of(page)
    np.testing.assert_array_equal(unpacked(data["t"], np.float64), pendulum.t)
    np.testing.assert_allclose(unpacked(data["points"]), pendulum.points.reshape(-1), atol=1e-7)
    np.testing.assert_allclose(unpacked(data["velocities"]), pendulum.velocities.reshape(-1), atol=1e-6)
    np.testing.assert_allclose(unpacked(data["energy"][0]), pendulum.energy[:, 0], rtol=1e-6)
    assert data["residual"] is None
    assert [body["name"] for body in data["bodies"]] == ["bob", "tip"]
    link, spring = data["connections"]
    assert (link["kind"], link["body"], link["other"], link["point"]) == ("link", 0, 1, None)
    assert (spring["kind"], spring["body"], spring["point"]) == ("spring", 0, [0.0, 0.0, 0.0])
    assert spring["pace"] == "slow"
    assert data["planes"][0]["solid"]


def test_constraints_have_a_strip_only_where_there_are_some_and_user_text_is_no_code(pendulum, tmp_path):
    free = page_of(pendulum, tmp_path / "free.html")
    held = page_of(dataclasses.replace(pendulum, residual=np.full((41, 2), 1e-14)), tmp_path / "held.html")
    assert 'id="residual"' not in free
    assert 'id="residual"' in held
    assert unpacked(data_of(held)["residual"][1]).max() == pytest.approx(1e-14)
    evil = "</script><script>alert(1)</script>"
    drawing = Drawing.from_dict({"bodies": [{"name": evil, "coordinates": [["s", 0]]}]})
    page = page_of(motion(swinging(), drawing), tmp_path / "run.html", evil)
    assert "alert(1)</script>" not in page
    assert data_of(page)["bodies"][0]["name"] == evil


def test_long_runs_are_thinned_and_the_page_says_so(tmp_path):
    count = MOST_COORDINATES // 6 + 10
    moved = motion(swinging(count, end=300.0), Drawing.from_dict(PENDULUM))
    data = data_of(page_of(moved, tmp_path / "run.html"))
    assert len(unpacked(data["points"])) <= MOST_COORDINATES
    assert data["caption"] == "Drawn from every 2nd node."
    assert data["speed"] == 20.0


@pytest.mark.skipif(NODE is None, reason="needs node")
def test_the_script_interpolates_as_python_does(pendulum, tmp_path):
    data = data_of(page_of(pendulum, tmp_path / "run.html"))
    times = [-1.0, 0.0, 0.123, 1.0, 2.345, 3.999, 9.0]
    program = (
        (SCRIPTS / "motion.js").read_text()
        + f"const motion = new Motion({json.dumps(data)});"
        + f"console.log(JSON.stringify({times}.map((time) => Array.from(motion.at(time)))));"
    )
    seen = subprocess.run([str(NODE), "-e", program], capture_output=True, text=True, check=True).stdout
    np.testing.assert_allclose(np.array(json.loads(seen)).reshape(-1, 2, 3), pendulum.at(times), atol=1e-6)


@pytest.mark.skipif(NODE is None, reason="needs node")
def test_the_script_draws_the_shapes_that_pictures_have(pendulum, tmp_path):
    data, sizes = data_of(page_of(pendulum, tmp_path / "run.html")), layout(pendulum)
    np.testing.assert_allclose(unpacked(data["planes"][0]["grid"]).reshape(-1, 7), sizes.grounds[0].grid, atol=1e-6)
    a, b, reach = np.array([0.0, 1.0, 2.0]), np.array([2.0, -1.0, 0.5]), (0.2, 0.1)
    [turns] = {line["turns"] for line in data["connections"] if line["kind"] == "spring"}
    arguments = f"painter, {a.tolist()}, {b.tolist()}, {reach[0]}, {reach[1]}"
    program = (
        "".join((SCRIPTS / name).read_text() for name in ("camera.js", "shapes.js"))
        + "const seen = [], axes = { right: [1, 0, 0], up: [0, 1, 0], back: [0, 0, 1] };"
        + "const camera = { ...axes, project: (point) => (seen.push(point), point) };"
        + f"const painter = {{ camera, data: {json.dumps(data)}, add() {{}} }};"
        + f"spring({arguments}, [0, 0, 0], {turns});"
        + f"console.log(JSON.stringify([joint(painter.data, {arguments.removeprefix('painter, ')}).slice(0, 2),"
        " seen]));"
    )
    seen = subprocess.run([str(NODE), "-e", program], capture_output=True, text=True, check=True).stdout
    ends, points = json.loads(seen)
    expected = joint(a, b, reach)
    assert expected is not None
    np.testing.assert_allclose(ends, expected, atol=1e-14)
    first, start, *rest = points  # the helix is asked for before its straight ends
    np.testing.assert_allclose([start, first, *rest], spring(*expected, sizes.coil, turns)[0], atol=1e-13)


@pytest.mark.skipif(BROWSER is None, reason="needs chromium")
def test_a_browser_shows_it_without_errors(pendulum, tmp_path):
    held = dataclasses.replace(pendulum, residual=np.full((41, 2), 1e-14), ending="It failed.")
    page_of(held, tmp_path / "run.html", "Swing & <tip>")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=1000"]
    command = [str(BROWSER), *options, "--dump-dom", (tmp_path / "run.html").as_uri() + "#t=2.5&theme=dark"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in done.stderr
    shown = html.unescape(re.sub(r"<script.*?</script>", "", done.stdout, flags=re.DOTALL))
    assert 'data-theme="dark"' in shown
    assert "Swing & <tip>" in shown
    assert ">t = 2.500<" in shown
    assert "It failed." in shown
    assert re.search(r"largest 5\.0 × 10⁻⁴", shown)
    assert re.search(r"position <b>1\.0 × 10⁻¹⁴</b>", shown)
    assert 'aria-valuetext="t = 2.500 of 4"' in shown
