"""Pictures: bodies are where the camera sees them, and every moment is drawn."""

import dataclasses

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from tests.animation.support import PENDULUM, swinging
from vmri_jax import plots
from vmri_jax.animation import Drawing, motion, plot_strip, write_gif
from vmri_jax.animation.geometry import FILLED_PART, Camera
from vmri_jax.animation.layout import layout, nice
from vmri_jax.animation.shapes import Stage


def test_camera_looks_at_its_target_with_perspective():
    camera = Camera(azimuth=-np.pi / 2, elevation=0.0, target=np.array([1.0, 2.0, 3.0]), distance=10.0)
    points = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [1.0, 2.0, 4.0], [2.0, -3.0, 3.0], [1.0, -9.0, 3.0]])
    xy, scale = camera.project(points)
    np.testing.assert_allclose(xy[0], [0.0, 0.0], atol=1e-12)
    assert xy[1, 0] > 0  # x to the right, z upwards
    assert xy[2, 1] > 0
    np.testing.assert_allclose(xy[3], 2 * xy[1], atol=1e-12)  # half as far: twice as large
    assert scale[4] == 0.0  # behind the eye
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 4.0])
def test_a_fitted_view_holds_everything_and_is_filled(aspect):
    points = np.random.default_rng(1).normal(size=(50, 3)) * [3.0, 1.0, 2.0]
    low, high = Camera(-1.0, 0.3, np.zeros(3), 1.0).fitted(points, 0.1, aspect).bounds(points, 0.1)
    np.testing.assert_allclose(low, -high, atol=1e-3)
    assert max(high[0] / aspect, high[1]) == pytest.approx(FILLED_PART, abs=2e-3)


def test_sizes_suit_the_picture(pendulum):
    sizes = layout(pendulum)
    np.testing.assert_allclose(sizes.radii[0], 0.2)
    assert sizes.radii[1] < 0.3 * 1.2  # less than the distance of the bodies
    assert sizes.coil < 0.5
    assert [ground.solid for ground in sizes.grounds] == [True]
    np.testing.assert_allclose(sizes.grounds[0].normal, [0.0, 0.0, 1.0], atol=1e-15)
    assert not [g for g in layout(motion(swinging(), Drawing.from_dict(PENDULUM | {"planes": []}))).grounds if g.solid]


def test_nice_numbers():
    assert [nice(x) for x in (0.9, 1.9, 3.4, 70.0, 0.052)] == [1.0, 2.0, 5.0, 50.0, pytest.approx(0.05)]


def pixels(figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255


@pytest.mark.parametrize("theme", [plots.LIGHT, plots.DARK])
def test_bodies_are_drawn_where_the_camera_sees_them(pendulum, theme):
    stage = Stage.of(pendulum, theme)
    camera, aspect = stage.camera, stage.aspect
    with plots.style(theme):
        figure = Figure(figsize=(9.0, 9.0 / aspect))
        stage.draw(figure, (0.0, 0.0, 1.0, 1.0), 1.3, 0.5)
    image = pixels(figure)
    height, width, _ = image.shape
    assert width / height == pytest.approx(aspect, rel=0.02)
    for place, color in zip(camera.project(pendulum.at([1.3])[0])[0], (theme.curves[0], "#aa3311"), strict=True):
        x, y = (place / [aspect, 1] + 1) / 2 * [width, height]
        np.testing.assert_allclose(image[height - 1 - round(y), round(x)], to_rgb(color), atol=0.25)
    np.testing.assert_allclose(image[2, 2], to_rgb(theme.paper), atol=0.01)


def test_a_strip_has_moments_names_a_legend_and_a_caption(pendulum):
    drawing = dataclasses.replace(pendulum.drawing, caption="Heights are modes times 2.")
    strip = plot_strip(pendulum, 3, "Pendulum")
    labels = [panel.texts[-1].get_text() for panel in strip.axes if panel.texts]
    assert labels == ["$t = 0.00$", "$t = 2.00$", "$t = 4.00$"]
    assert {text.get_text() for text in strip.axes[0].texts} == {"bob", "tip", "$t = 0.00$"}
    assert len(strip.axes[1].texts) == 1
    [legend] = strip.legends
    shown = {text.get_text(): line.get_color() for text, line in zip(legend.texts, legend.get_lines(), strict=True)}
    assert shown == {"slow": plots.LIGHT.curves[0], "fast": plots.LIGHT.curves[1]}
    figure = plot_strip(dataclasses.replace(pendulum, drawing=drawing), 3, "Pendulum")
    assert [text.get_text() for text in figure.texts] == ["Pendulum", "Heights are modes times 2."]
    assert figure.get_figheight() > strip.get_figheight()
    bodies = [{"name": name, "coordinates": [["s", 0], ["s", 1]]} for name in ("one", "same place")]
    crowded = motion(swinging(), Drawing.from_dict({"bodies": [*bodies, {**bodies[0], "name": "third"}]}))
    assert len(plot_strip(crowded, 1).axes[0].texts) == 3  # one name to the right, one to the left, the time
    with pytest.raises(ValueError, match=r"times is .*give at least one"):
        plot_strip(pendulum, [])


def test_pictures_of_a_strip_fill_its_width():
    wide = PENDULUM | {"anchors": [{"body": "bob", "point": [-3.0, 0.0], "kind": "spring"}]}
    shown = motion(swinging(), Drawing.from_dict(wide))
    for count, starts in ((4, [0, 1 / 2, 0, 1 / 2]), (5, [0, 1 / 3, 2 / 3, 1 / 6, 1 / 2])):
        pictures = plot_strip(shown, count).axes[:count]
        np.testing.assert_allclose([axes.get_position(original=True).x0 for axes in pictures], starts, atol=1e-12)


def test_a_gif_moves_and_takes_its_time(pendulum, tmp_path):
    done = []
    write_gif(pendulum, tmp_path / "run.gif", 0.4, progress=lambda *at: done.append(at))
    with Image.open(tmp_path / "run.gif") as image:
        assert getattr(image, "n_frames", 1) == 8
        assert image.info["duration"] == 50
        assert image.info["loop"] == 0
        frames = []
        for i in (0, 7):
            image.seek(i)
            frames.append(np.asarray(image.convert("RGB"), dtype=float))
    assert np.abs(frames[1] - frames[0]).max() > 100
    assert done[-1] == (8, 8)
    with pytest.raises(ValueError, match="seconds is 0"):
        write_gif(pendulum, tmp_path / "no.gif", 0)


def test_trails_have_as_many_places_as_nodes():
    many = motion(swinging(1001), Drawing.from_dict(PENDULUM))
    stage = Stage.of(many, plots.LIGHT)
    assert len(stage._trail_times(0.0, 2.0)) == 1002
    assert len(stage._trail_times(0.0, 0.01)) == 160
