"""What a scene looks like, as plain data that is stored with a run.

    {
        "bodies":  [{"name": "bob", "coordinates": [["s", 0], ["s", 1], ["s", 2]], "radius": 0.1}, ...],
        "links":   [["bob", "tip"], ...],
        "springs": [["tip", "load"], ...],
        "anchors": [{"body": "bob", "point": [0.0, 0.0, 0.0], "kind": "link"}, ...],
        "planes":  [{"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}, ...],
        "spheres": [{"center": [0.0, 0.0, 0.0], "radius": 1.0}, ...],
        "up":      [0.0, 0.0, 1.0],
    }

`coordinates` says for each axis (one to three of them) which entry of q_s ("s") or q_f ("f") it is; `radius` is only
there where the body has one, `up` where gravity has a direction. A block of more than three general coordinates is drawn
as that many bodies ``name[i]`` side by side, at `offset`, each as high as its coordinate. `kind` is "link" or "spring".
Everything is lists, strings and numbers.
"""

from collections.abc import Iterable, Mapping

from vmri_jax.scene.body import Body
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.layout import Place

KINDS = ("links", "springs", "anchors", "planes", "spheres")


def drawing(bodies: Mapping[str, Body], effects: Iterable[Effect], places: Mapping[str, Place]) -> dict[str, list]:
    """The description of these bodies at these places with these effects."""
    seen: dict[str, list] = {
        "bodies": [entry for body in bodies.values() for entry in _entries(body, places[body.name])]
    }
    seen |= {kind: [] for kind in KINDS}
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


def _entries(body: Body, place: Place) -> list[dict]:
    axes = [[place.part, place.start + i] for i in range(place.size)]
    if body.is_point:
        return [{"name": body.name, "coordinates": axes}]
    return [
        {"name": f"{body.name}[{i}]", "coordinates": [[], axis], "offset": [float(i), 0.0]}
        for i, axis in enumerate(axes)
    ]
