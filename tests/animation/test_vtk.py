"""Files for ParaView: read back, they show the bodies where they are."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.animation import Drawing, motion, write_vtk
from vmri_jax.scene import Anchor, Body, Box, Gravity, RigidBody, Scene, Spring

meshio = pytest.importorskip("meshio")


@pytest.fixture(scope="module")
def moved():
    scene = Scene(
        [
            Body("bob", 1.0, [1.0, 0.0, 0.0], pace="slow"),
            Body("tip", 1.0, [1.0, 0.0, 1.0], pace="fast"),
            RigidBody("box", 2.0, Box((0.4, 0.6, 0.8)), [3.0, 0.0, 0.0], spin=[0.0, 0.0, 1.0], pace="fast"),
        ],
        [Gravity(), Anchor("bob", [0.0, 0.0, 0.0]), Spring(("bob", "tip"), 100.0)],
    )
    run = vm.simulate(scene, vm.fully_explicit(2), macro_dt=0.05, num_steps=6)
    return motion(run, Drawing.from_dict(scene.drawing()), scene.system())


def test_all_nodes_are_written(moved, tmp_path):
    write_vtk(moved, tmp_path / "run.pvd")
    sets = ET.parse(tmp_path / "run.pvd").getroot().findall("./Collection/DataSet")
    assert [float(entry.attrib["timestep"]) for entry in sets] == moved.t.tolist()
    names = [body.name for body in moved.drawing.bodies]
    for k, entry in enumerate(sets):
        mesh = meshio.read(tmp_path / entry.attrib["file"])
        np.testing.assert_allclose(mesh.points[: len(names)], moved.points[k], atol=1e-14)
        np.testing.assert_allclose(mesh.point_data["velocity"][: len(names)], moved.velocities[k], atol=1e-14)
    cells = mesh.cells_dict
    assert len(cells["vertex"]) == 2
    bob, tip = names.index("bob"), names.index("tip")
    assert {tuple(line) for line in cells["line"]} == {(bob, len(names)), (bob, tip)}
    np.testing.assert_allclose(mesh.points[len(names)], 0.0, atol=1e-14)  # the anchor
    sides = mesh.points[cells["quad"]]
    middle = mesh.points[names.index("box")]
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 1])
    assert len(sides) == 6
    assert np.sum(np.linalg.norm(normals, axis=1)) == pytest.approx(2 * (0.24 + 0.32 + 0.48))
    assert (np.sum(normals * (sides.mean(axis=1) - middle), axis=1) > 0).all()
    assert set(np.concatenate(mesh.cell_data["kind"])) == {0, 1, 2, 3}
    before, at, after = (meshio.read(tmp_path / "run" / f"{k:04d}.vtu") for k in (2, 3, 4))
    rates = (after.points - before.points) / (moved.t[4] - moved.t[2])  # to the order of the step, of corners too
    np.testing.assert_allclose(rates, at.point_data["velocity"], atol=0.02)
