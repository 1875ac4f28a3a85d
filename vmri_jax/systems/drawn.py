"""Points of the drawings of these systems."""

from typing import Any


def point(name: str, part: str, number: int, radius: float) -> dict[str, Any]:
    """The entry of a body whose coordinates are the point of this number of q_s ("s") or q_f ("f")."""
    return {"name": name, "coordinates": [[part, 3 * number + axis] for axis in range(3)], "radius": radius}
