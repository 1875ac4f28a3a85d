"""What a scene looks like, as plain data that is stored with a run.

    {
        "bodies":  [{"name": "bob", "coordinates": [["s", 0], ["s", 1], ["s", 2]], "radius": 0.1}, ...],
        "blocks":  [{"name": "modes", "coordinates": [["f", 0], ["f", 1], ["f", 2], ["f", 3]]}, ...],
        "links":   [["bob", "tip"], ...],
        "springs": [["tip", "load"], ...],
        "anchors": [{"body": "bob", "point": [0.0, 0.0, 0.0], "kind": "link"}, ...],
        "planes":  [{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}, ...],
        "spheres": [{"center": [0.0, 0.0, 0.0], "radius": 1.0}, ...],
        "up":      [0.0, 0.0, 1.0],
    }

`coordinates` says for each axis of a point (one to three of them), or for each general coordinate of a block, which entry
of q_s ("s") or q_f ("f") it is; `radius` is only there where the body has one, `up` where gravity has a direction. `kind`
is "link" or "spring". Everything is lists, strings and numbers.
"""

from collections.abc import Iterable

from vmri_jax.scene.effect import Effect
from vmri_jax.scene.sorting import Sorting

KINDS = ("links", "springs", "anchors", "planes", "spheres")


def drawing(sorting: Sorting, effects: Iterable[Effect]) -> dict[str, list]:
    """The description of a scene.

    Args:
        sorting: bodies at their places.
        effects: in the order in which they are drawn.
    """
    seen: dict[str, list] = {kind: [] for kind in ("bodies", "blocks", *KINDS)}
    radii = {}
    for name, body in sorting.bodies.items():
        part, start, size = sorting.places[name]
        axes = [[part, start + i] for i in range(size)]
        seen["blocks" if body.block else "bodies"].append({"name": name, "coordinates": axes})
        if body.radius is not None:
            radii[name] = float(body.radius)
    for effect in effects:
        parts = effect.drawing(sorting.bodies)
        for kind in KINDS:
            seen[kind] += parts.get(kind, [])
        radii |= dict(parts.get("radii", []))
        if "up" in parts:
            seen["up"] = parts["up"]
    for entry in seen["bodies"]:
        if entry["name"] in radii:
            entry["radius"] = radii[entry["name"]]
    return seen
