"""Drawings: what they say, where bodies are, and how wrong ones are refused."""

import copy
import json
import sys

import numpy as np
import pytest

from tests.animation.support import PENDULUM, reference_run, swinging
from vmri_jax import systems
from vmri_jax.animation import Drawing, Joint, bars, motion
from vmri_jax.catalogue import SYSTEMS


def positions(drawing: Drawing, q_s, q_f):
    offset, matrix = drawing.maps(len(q_s), len(q_f))
    return offset + matrix @ np.concatenate([q_s, q_f])


def test_plain_data_and_its_json_text_give_the_same_drawing():
    drawing = Drawing.from_dict(PENDULUM)
    assert drawing == Drawing.from_dict(json.dumps(PENDULUM))
    assert [body.pace for body in drawing.bodies] == ["slow", "fast"]
    assert drawing.joints == (Joint("link", ("bob", "tip")), Joint("spring", ("bob",), (0.0, 0.0)))
    assert drawing.dimension == 2
    assert drawing.pace(Joint("link", ("bob", "tip"))) == "slow"  # of its bodies, or its own
    assert drawing.pace(Joint("link", ("tip", "tip"))) == "fast"
    assert drawing.pace(Joint("spring", ("bob", "tip"), pace="fast")) == "fast"


def test_linear_forms_and_offsets():
    form = [[2.0, "s", 1], [-0.5, "f", 0], [1.0, "f", 0]]
    body = {"name": "a", "coordinates": [[], form, ["f", 1]], "offset": [7.0, 1.0, 0.0]}
    drawing = Drawing.from_dict({"bodies": [body]})
    np.testing.assert_allclose(positions(drawing, [3.0, 4.0], [10.0, -2.0]), [[7.0, 1.0 + 8.0 + 5.0, -2.0]])


@pytest.mark.parametrize(
    ("coordinates", "up", "expected"),
    [
        (3, None, [1.0, 2.0, 3.0]),
        (3, [0.0, 5.0, 0.0], [1.0, -3.0, 2.0]),
        (3, [1.0, 0.0, 0.0], [2.0, 3.0, 1.0]),
        (3, [0.0, 0.0, -1.0], [1.0, -2.0, -3.0]),
        (2, None, [1.0, 0.0, 2.0]),
        (2, [1.0, 0.0], [-2.0, 0.0, 1.0]),
        (1, None, [1.0, 0.0, 0.0]),
        (1, [-2.0], [0.0, 0.0, -1.0]),
    ],
)
def test_up_is_shown_upwards_without_mirroring(coordinates, up, expected):
    body = {"name": "a", "coordinates": [["s", i] for i in range(coordinates)]}
    drawing = Drawing.from_dict({"bodies": [body], "up": up})
    np.testing.assert_allclose(positions(drawing, [1.0, 2.0, 3.0], []), [expected], atol=1e-15)
    if coordinates == 3:
        assert np.linalg.det(drawing.frame()) == pytest.approx(1.0)


def changed(path, value):
    data = copy.deepcopy(PENDULUM)
    *way, last = path
    entry = data
    for key in way:
        entry = entry[key]
    entry[last] = value
    return data


@pytest.mark.parametrize(
    ("data", "pieces"),
    [
        ("{", ["not valid JSON"]),
        ([], ["is list", "must be a dict"]),
        ({}, ["no bodies and no blocks"]),
        ({"bodies": [], "blocks": []}, ["no bodies and no blocks"]),
        ({"blocks": [{"name": "modes"}]}, ["blocks[0] lacks the entry 'coordinates'"]),
        ({"blocks": [{"name": "modes", "coordinates": []}]}, ["blocks[0]: coordinates", "['s' or 'f', index]"]),
        ({"blocks": [{"name": "modes", "coordinates": [[[2.0, "s", 1]]]}]}, ["blocks[0]: coordinates"]),
        (PENDULUM | {"blocks": [{"name": "bob", "coordinates": [["s", 0]]}]}, ["2 bodies are named 'bob'"]),
        (changed(["spring"], []), ["no entry 'spring'", "Did you mean springs?"]),
        (changed(["links"], [["bob", "tipp"]]), ["links[0]", "no body 'tipp'", "Did you mean tip?"]),
        (changed(["links"], [["bob", "bob"]]), ["links[0]", "with itself"]),
        (changed(["links"], [["bob"]]), ["links[0]", "pair of names"]),
        (changed(["links"], [["bob", "tip", "quick"]]), ["links[0]", "'quick'", "slow or fast"]),
        (changed(["links"], "bob"), ["links is str", "list"]),
        (changed(["anchors", 0, "kind"], "glue"), ["anchors[0]", "'glue'", "link or spring"]),
        (changed(["anchors", 0, "body"], "bo"), ["anchors[0]", "'bo'", "Did you mean bob?"]),
        (changed(["anchors", 0, "point"], [0.0, np.nan]), ["anchors[0]: point", "finite"]),
        (changed(["planes", 0, "normal"], [0.0, 0.0]), ["planes[0]: normal", "must not be zero"]),
        (changed(["spheres", 0, "radius"], -1.0), ["spheres[0]: radius", "-1.0", "positive"]),
        (changed(["bodies", 1, "name"], "bob"), ["2 bodies are named 'bob'"]),
        (changed(["bodies", 0, "color"], "red"), ["bodies[0]: color", "'red'", "#0072b2"]),
        (changed(["bodies", 0, "radius"], True), ["bodies[0]: radius", "True", "positive"]),
        (changed(["bodies", 0, "coordinates"], []), ["bodies[0]: coordinates", "1 to 3"]),
        (changed(["bodies", 0, "coordinates"], [["q", 0]]), ["bodies[0]", "['q', 0]", "'s' or 'f'"]),
        (changed(["bodies", 0, "coordinates"], [["s", -1]]), ["bodies[0]", "['s', -1]"]),
        (changed(["bodies", 0, "coordinates"], [[["x", "s", 1]]]), ["bodies[0]", "weight"]),
        (changed(["up"], [0.0, 0.0, 0.0]), ["up is", "must not be zero"]),
    ],
)
def test_wrong_drawings_are_refused(data, pieces):
    with pytest.raises(ValueError, match="drawing") as caught:
        Drawing.from_dict(data)
    for piece in pieces:
        assert piece in str(caught.value)


def test_coordinates_that_the_run_does_not_have():
    with pytest.raises(ValueError, match=r"'tip' uses \['f', 1\], but the run has 1 fast"):
        Drawing.from_dict(PENDULUM).maps(2, 1)
    blocks = [{"name": "modes", "coordinates": [["f", 2]]}]
    with pytest.raises(ValueError, match=r"'modes' uses \['f', 2\], but the run has 2 fast"):
        motion(swinging(), Drawing.from_dict({"blocks": blocks}))


def test_missing_coordinates_are_zero():
    drawing = Drawing.from_dict(PENDULUM | {"spheres": [{"center": [1.0, 2.0, 3.0], "radius": 1.0}]})
    assert drawing.dimension == 3
    np.testing.assert_allclose(positions(drawing, [5.0, 6.0], [7.0, 8.0]), [[5.0, 6.0, 0.0], [7.0, 8.0, 0.0]])


@pytest.mark.parametrize(("name", "macro_dt"), [("tsp_fully_implicit_p1", 0.01), ("sam_fully_implicit_a05_p4", 0.008)])
@pytest.mark.compiles
def test_links_of_built_in_drawings_keep_their_length_along_a_run(name, macro_dt):
    run = reference_run(name, macro_dt)
    drawing = Drawing.from_dict(SYSTEMS[name[:3]]().drawing)
    points = motion(run, drawing).points
    index = {body.name: i for i, body in enumerate(drawing.bodies)}
    links = [joint for joint in drawing.joints if joint.kind == "link"]
    fixed = drawing.place([link.point or () for link in links])
    ends = [
        (points[:, index[link.bodies[0]]], points[:, index[link.bodies[1]]] if link.point is None else point)
        for link, point in zip(links, fixed, strict=True)
    ]
    assert len(ends) == {"tsp": 2, "sam": 4}[name[:3]]
    lengths = np.array([np.linalg.norm(a - b, axis=-1) for a, b in ends])
    assert np.ptp(lengths, axis=1).max() < 1e-9  # measured 2e-13
    assert np.ptp(points, axis=0).max() > 0.01


@pytest.mark.compiles
def test_the_drawn_chain_stretches_as_its_potentials_say(fpu, monkeypatch):
    monkeypatch.setattr(sys.modules["vmri_jax.systems.fermi_pasta_ulam"], "MAGNIFICATION", 1.0)
    run = reference_run("fpu3_fully_implicit_p1", 0.05)
    drawing = Drawing.from_dict(systems.fermi_pasta_ulam(3).drawing)
    x = motion(run, drawing).points[..., 0]
    walls = [joint.point[0] for joint in drawing.joints if joint.point is not None]
    x = np.concatenate([np.full((len(x), 1), walls[0]), x, np.full((len(x), 1), walls[1])], axis=1)
    stretch = np.diff(x, axis=1) - np.diff([walls[0], *(body.offset[0] for body in drawing.bodies), walls[1]])
    system, q_s, q_f = fpu.system, run.q_s[-1], run.q_f[-1]
    soft, stiff = stretch[-1, ::2], stretch[-1, 1::2]
    np.testing.assert_allclose(np.sum((np.sqrt(2) * soft) ** 4) / 4, system.slow_potential(q_s, q_f, system.params))
    np.testing.assert_allclose(stiff, np.sqrt(2) * q_f, atol=1e-14)
    paces = [drawing.pace(spring) for spring in drawing.joints if spring.point is None]
    assert paces == ["fast", "slow", "fast", "slow", "fast"]


def test_without_a_drawing_every_coordinate_is_a_bar_at_its_scale():
    run = swinging()
    moved = motion(run, Drawing.from_dict(bars(run)))
    drawing = moved.drawing
    assert [body.name for body in drawing.bodies] == ["q_s[0]", "q_s[1]", "q_f[0]", "q_f[1]"]
    np.testing.assert_allclose(moved.points[:, 0, 2], 2.0 * run.q_s[:, 0], atol=1e-14)
    np.testing.assert_allclose(moved.points[:, 3, 2], 0.5 * run.q_f[:, 1], atol=1e-14)
    assert drawing.caption == "Heights are q_s times 2 and q_f times 0.5."
    assert len({float(x) for x in moved.points[0, :, 0]}) == 4


@pytest.mark.parametrize(
    ("coordinates", "up"), [(1, None), (1, [-1.0]), (2, None), (2, [1.0, 2.0]), (3, None), (3, [0.0, 5.0, 0.0])]
)
def test_blocks_stand_upright_beside_the_points(coordinates, up):
    run = swinging()
    bob = {"name": "bob", "coordinates": [["s", i % 2] for i in range(coordinates)]}
    blocks = [{"name": "modes", "coordinates": [["f", 0], ["f", 1]]}]
    moved = motion(run, Drawing.from_dict({"bodies": [bob], "blocks": blocks, "up": up}))
    point, bars = moved.points[:, 0], moved.points[:, 1:]
    assert bars[..., 0].min() > point[:, 0].max()
    feet = moved.drawing.place([joint.point or () for joint in moved.drawing.joints])
    heights = bars - feet
    scale = heights[0, 1, 2] / run.q_f[0, 1]
    np.testing.assert_allclose(heights[..., 2], scale * run.q_f, atol=1e-13)
    np.testing.assert_allclose(heights[..., :2], 0.0, atol=1e-13)
    assert moved.drawing.caption == f"Heights are modes times {scale:g}."
