"""Drawings of the built-in systems."""

import math
from itertools import pairwise

MAGNIFICATION = 10.0
"""Drawn over real elongation of the stiff springs of the Fermi-Pasta-Ulam chain, which stretch by a few percent. With 1 the
stretching could not be seen."""
STEEL_BALL = {"radius": 0.3, "color": "#8a97a1"}


def fermi_pasta_ulam(num_springs: int) -> dict:
    """The chain between two walls: masses displaced by ``(s_i - f_i) / sqrt 2`` and ``(s_i + f_i) / sqrt 2`` from their places at rest."""
    bodies, w = [], 1 / math.sqrt(2)
    for i in range(num_springs):
        for sign, place in ((-1.0, 4.5 * i + 3.0), (1.0, 4.5 * i + 4.5)):
            form = [[w, "s", i], [sign * MAGNIFICATION * w, "f", i]]
            bodies.append({"name": f"mass {len(bodies) + 1}", "coordinates": [form], "offset": [place], **STEEL_BALL})
    names = [body["name"] for body in bodies]
    springs = [[a, b, "slow" if i % 2 else "fast"] for i, (a, b) in enumerate(pairwise(names))]
    walls = [(names[0], 0.0), (names[-1], 4.5 * num_springs + 3.0)]
    return {
        "bodies": bodies,
        "springs": springs,
        "anchors": [{"body": name, "point": [x], "kind": "spring", "pace": "slow"} for name, x in walls],
        "planes": [{"point": [x], "normal": [normal]} for (_, x), normal in zip(walls, (1.0, -1.0), strict=True)],
        "caption": f"Elongations of the stiff springs are drawn {MAGNIFICATION:g} times as large as they are.",
    }


def triple_spherical_pendulum() -> dict:
    """A heavy bob on a rod, a light bob on a second rod, and the last bob on a stiff spring."""
    light = [_point(name, "f", i, 0.4) for i, name in enumerate(("light bob", "last bob"))]
    return {
        "bodies": [_point("heavy bob", "s", 0, 0.9), *light],
        "links": [["heavy bob", "light bob"]],
        "springs": [["light bob", "last bob"]],
        "anchors": [{"body": "heavy bob", "point": [0.0, 0.0, 0.0], "kind": "link"}],
    }


def simple_atomic_model() -> dict:
    """Two heavy atoms and four light ones, rigid bonds as links."""
    atoms = [_point("atom 1", "s", 0, 2.6), _point("atom 2", "s", 1, 2.0)]
    atoms += [_point(f"atom {i + 3}", "f", i, 1.3) for i in range(4)]
    springs, bonds = [(1, 2), (2, 3), (3, 4), (4, 5), (5, 3)], [(2, 4), (2, 5), (3, 6)]
    return {
        "bodies": atoms,
        "links": [[f"atom {i}", f"atom {j}"] for i, j in bonds],
        "springs": [[f"atom {i}", f"atom {j}"] for i, j in springs],
        "anchors": [{"body": "atom 1", "point": [0.0, 0.0, 0.0], "kind": "link"}],
    }


def _point(name: str, part: str, number: int, radius: float) -> dict:
    coordinates = [[part, 3 * number + axis] for axis in range(3)]
    return {"name": name, "coordinates": coordinates, "radius": radius}


def built_in(name: str, n_s: int) -> dict | None:
    """The drawing of a built-in system as plain data for `Drawing.from_dict`; None for other systems.

    Args:
        name: "fpu", "tsp" or "sam".
        n_s: number of its slow variables.
    """
    if name == "fpu":
        return fermi_pasta_ulam(n_s)
    if name == "tsp":
        return triple_spherical_pendulum()
    return simple_atomic_model() if name == "sam" else None
