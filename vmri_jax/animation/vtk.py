"""Files for ParaView and other programs that read VTK: bodies as points, links and springs as lines, solids as
polygons."""

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from vmri_jax.animation.drawing import Drawing
from vmri_jax.animation.motion import Motion
from vmri_jax.running.export import extra
from vmri_jax.running.files import check_place

KINDS = ("body", "link", "spring", "solid")
"""Kinds of cells; their numbers in this list are the cell data `kind`."""
CELLS = {3: "triangle", 4: "quad"}
"""Names of cells by number of corners; polygons with more corners are cut into triangles."""


def write_vtk(motion: Motion, path: str | Path) -> None:
    """Write ``run.pvd``, which lists the times, and for each node of the run a file ``run/0000.vtu``.

    Cell data: `kind` (0 body, 1 link, 2 spring, 3 solid) and `fast` (0 or 1); point data: `velocity`.

    Args:
        motion: from `vmri_jax.animation.motion`; ``motion.thinned(200)`` has fewer nodes.
        path: name of the ``.pvd`` file.

    Raises:
        ImportError: without the package meshio.
        OSError: files cannot be written.
    """
    meshio = extra("meshio", "write_vtk", "vtk")
    path = Path(path)
    check_place(path)
    folder = path.with_suffix("")
    folder.mkdir(exist_ok=True)
    cells, data = _cells(motion.drawing)
    fixed = motion.drawing.place([joint.point for joint in motion.drawing.joints if joint.point is not None])
    entries = []
    for k, t in enumerate(motion.t):
        points, velocities = (
            np.concatenate([bodies[k], still, *motion.drawing.corners(bodies[k])])
            for bodies, still in ((motion.points, fixed), (motion.velocities, 0.0 * fixed))
        )
        file = folder / f"{k:04d}.vtu"
        meshio.Mesh(points, cells, point_data={"velocity": velocities}, cell_data=data).write(file)
        entries.append(f'    <DataSet timestep="{float(t)!r}" file={quoteattr(f"{folder.name}/{file.name}")}/>')
    listed = "\n".join(entries)
    path.write_text(
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n'
        f"  <Collection>\n{listed}\n  </Collection>\n</VTKFile>\n",
        encoding="utf-8",
    )


def _cells(drawing: Drawing) -> tuple[list, dict]:
    """Cells for meshio, and the data of each block of cells. Points are the bodies, fixed ends of joints, corners of
    solids, in this order."""
    index, next_point = drawing.numbers, len(drawing.bodies)
    cells_by_type: dict[str, list[tuple[list[int], str, bool]]] = {}
    for body in drawing.bodies:
        if body.shown == "ball":
            cells_by_type.setdefault("vertex", []).append(([index[body.name]], "body", body.pace == "fast"))
    for line in drawing.joints:
        ends = [index[name] for name in line.bodies] + [next_point] * (line.point is not None)
        next_point += line.point is not None
        cells_by_type.setdefault("line", []).append((ends, line.kind, drawing.pace(line) == "fast"))
    for solid in drawing.solids:
        fast = drawing.bodies[index[solid.points[0]]].pace == "fast"
        for face in solid.faces:
            numbers = [next_point + i for i in face]
            pieces = (
                [numbers]
                if len(face) in CELLS
                else [[numbers[0], *numbers[i : i + 2]] for i in range(1, len(face) - 1)]
            )
            for piece in pieces:
                cells_by_type.setdefault(CELLS[len(piece)], []).append((piece, "solid", fast))
        next_point += len(solid.corners)
    cells = [(kind, np.array([numbers for numbers, *_ in items])) for kind, items in cells_by_type.items()]
    data = {
        "kind": [np.array([KINDS.index(kind) for _, kind, _ in items]) for items in cells_by_type.values()],
        "fast": [np.array([int(fast) for *_, fast in items]) for items in cells_by_type.values()],
    }
    return cells, data
