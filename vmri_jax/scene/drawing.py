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

from collections.abc import Iterable, Mapping

from vmri_jax.scene.body import Body
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.layout import Place

KINDS = ("links", "springs", "anchors", "planes", "spheres")


def drawing(bodies: Mapping[str, Body], effects: Iterable[Effect], places: Mapping[str, Place]) -> dict[str, list]:
    """The description of these bodies at these places with these effects."""
    seen: dict[str, list] = {kind: [] for kind in ("bodies", "blocks", *KINDS)}
    for name, body in bodies.items():
        axes = [[places[name].part, places[name].start + i] for i in range(body.size)]
        seen["blocks" if body.block else "bodies"].append({"name": name, "coordinates": axes})
    radii = {name: float(body.radius) for name, body in bodies.items() if body.radius is not None}
    for effect in effects:
        parts = effect.drawing(bodies)
        for kind in KINDS:
            seen[kind] += parts.get(kind, [])
        radii |= dict(parts.get("radii", []))
        seen |= {key: value for key, value in parts.items() if key == "up"}
    for entry in seen["bodies"]:
        if entry["name"] in radii:
            entry["radius"] = radii[entry["name"]]
    return seen
