"""What a scene looks like, as plain data that is stored with a run, see `vmri_jax.animation.Drawing.from_dict`."""

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
