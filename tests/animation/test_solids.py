"""Rigid bodies are drawn as solids that move with their centre and their directors."""

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.animation import Drawing, motion, plot_strip
from vmri_jax.animation.html import _data
from vmri_jax.animation.layout import layout
from vmri_jax.scene import Ball, Box, Cylinder, Revolute, RigidBody, Rod, Scene, Spring

EDGES = (1.0, 0.4, 0.2)
SOLID = {
    "name": "hub",
    "coordinates": [["s", i] for i in range(12)],
    "corners": [[0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5], [0, 0, 0]],
    "faces": [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]],
}


HUB = RigidBody("hub", 2.0, Box(EDGES), [1.0, 0.0, 2.0], [0.2, -0.4, 0.6], spin=[0.0, 0.0, 1.0], pace="fast")
ARM = RigidBody("arm", 1.0, Ball(0.1), [1.0, 1.0, 2.0], pace="fast")


@pytest.fixture(scope="module")
def run():
    """Both bodies, each on its own: joints and springs of other scenes change what is drawn, not what it takes to draw
    it."""
    return vm.simulate(Scene([HUB, ARM]), vm.fully_explicit(1), macro_dt=0.1, num_steps=3)


def test_corners_are_where_the_body_is(run):
    drawing = Drawing.from_dict(Scene([HUB, ARM]).drawing())
    seen = motion(run, drawing)
    [corners] = drawing.corners(seen.points)
    assert corners.shape == (4, 8, 3)
    q = run.position("hub")
    local = np.einsum("kci,kji->kcj", corners - q[:, None, :3], q[:, 3:].reshape(-1, 3, 3))
    np.testing.assert_allclose(np.abs(local), np.broadcast_to(np.array(EDGES) / 2, local.shape), atol=1e-12)
    assert [body.shown for body in drawing.bodies][:4] == ["name", "", "", ""]
    assert drawing.bodies[0].pace == "fast"


@pytest.mark.parametrize("shape", [Box(EDGES), Cylinder(0.3, 1.0)])
def test_faces_are_seen_from_outside(shape):
    corners, faces = shape.polyhedron()
    for face in faces:
        a, b, c = corners[face[:3]]
        assert np.cross(b - a, c - b) @ corners[face].mean(axis=0) > 0
    assert np.unique(np.concatenate(faces)).size == len(corners)


def test_balls_rods_plates_and_bodies_without_a_shape():
    bodies = [
        RigidBody("ball", 1.0, Ball(0.2), [0, 0, 0]),
        RigidBody("rod", 1.0, Rod(2.0), [1, 0, 0]),
        RigidBody("plate", 1.0, Box((1.0, 2.0, 0.0)), [2, 0, 0]),
        RigidBody("unknown", 3.0, Box(EDGES).inertia(3.0), [3, 0, 0]),
    ]
    drawing = Drawing.from_dict(Scene(bodies).drawing())
    assert {body.name: body.radius for body in drawing.bodies}["ball"] == 0.2
    assert [joint.bodies for joint in drawing.joints] == [("rod start", "rod end")]
    assert [solid.points[0] for solid in drawing.solids] == ["plate", "unknown"]
    size = np.abs(np.array(drawing.solids[1].corners)).max(axis=0)
    np.testing.assert_allclose(size / size[0], np.array(EDGES) / EDGES[0], rtol=1e-6)


def test_springs_end_at_points_of_bodies_and_arms_reach_to_joints(run):
    hinge = Revolute(("hub", "arm"), [1.0, 0.2, 2.0], name="hinge")
    spring = Spring((("hub", [0.5, 1e-17, 0]), ("ground", [3.0, 0, 2.0])), 5.0)
    scene = Scene([HUB, ARM], [hinge, spring], project=True, coordinates="directors")
    drawn = scene.drawing()
    assert drawn["links"] == [["arm", "hinge hub-arm in arm"]]  # within the hub there is nothing to see
    assert drawn["anchors"] == [{"body": "hub (0.5, 0, 0)", "point": [3.0, 0.0, 2.0], "kind": "spring"}]
    seen = motion(run, Drawing.from_dict(drawn))
    data = _data(seen, layout(seen))
    assert len(data["solids"]) == 1
    assert len(data["solids"][0]["faces"]) == 6
    assert {body["shown"] for body in data["bodies"]} == {"ball", "name", ""}
    assert len(plot_strip(seen, 2).axes) > 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coordinates": [["s", i] for i in range(11)]}, r"solids\[0\]: 11 coordinates and corners of shape \(4, 3\)"),
        ({"corners": [[0.5, 0.0]] * 4}, r"corners of shape \(4, 2\)"),
        ({"faces": [[0, 1, 7]]}, "a face has the number of a corner that does not exist; there are 4"),
        ({"shown": "ball"}, "shown"),
    ],
)
def test_solids_that_cannot_be(changes, message):
    with pytest.raises(ValueError, match=message):
        Drawing.from_dict({"solids": [SOLID | changes]})
