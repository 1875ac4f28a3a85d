"""The drawing of a scene: bodies, links, springs and the rest as plain lists, see
`vmri_jax.animation.Drawing.from_dict`."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from vmri_jax.scene.body import Frame
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.rigid import RigidBody
from vmri_jax.scene.sorting import Sorting

EFFECT_LISTS = ("solids", "links", "springs", "anchors", "planes", "spheres")
"""Lists of a drawing that effects add entries to."""


def drawing(sorting: Sorting, effects: Sequence[Effect]) -> dict[str, Any]:
    """The lists of a drawing, and the map from joint coordinates to bodies if the scene has some."""
    entries: dict[str, Any] = {kind: [] for kind in ("bodies", "blocks", *EFFECT_LISTS)}
    radii = {body.name: float(body.radius) for body in sorting.bodies.values() if body.radius is not None}
    for body in sorting.bodies.values():
        part, start, size = sorting.layout.bodies[body.name]
        if isinstance(body, RigidBody):
            for kind, of_body in body.drawing(part, start).items():
                entries[kind] += of_body
        elif not isinstance(body, Frame):
            coordinates = [[part, start + i] for i in range(size)]
            entries["blocks" if body.block else "bodies"].append({"name": body.name, "coordinates": coordinates})
    points: dict[str, dict[str, Any]] = {}
    for effect in effects:
        of_effect = effect.drawing()
        # ends phi + sum_i X_i d_i of links and springs in rigid bodies, as bodies that are not shown themselves
        for label, (name, components) in of_effect.get("points", {}).items():
            part, start, size = sorting.layout.bodies[name]
            weights = [1.0, *np.asarray(components).tolist()][: size // 3]
            forms = [[[w, part, start + 3 * k + i] for k, w in enumerate(weights) if w] for i in range(3)]
            points[label] = {"name": label, "coordinates": forms, "shown": ""}
        for kind in EFFECT_LISTS:
            entries[kind] += of_effect.get(kind, [])
        radii |= dict(of_effect.get("radii", []))
        if "up" in of_effect:
            entries["up"] = of_effect["up"]
    entries["bodies"] += points.values()
    for entry in entries["bodies"]:
        if entry["name"] in radii:
            entry["radius"] = radii[entry["name"]]
    if (kinematics := sorting.layout.kinematics) is not None:
        joints = {name: np.asarray(values).tolist() for name, values in sorting.joints.items()}
        entries["kinematics"] = {"map": asdict(kinematics), "joints": joints}
    return entries
