"""Where the coordinates of bodies and joints lie in q_s and q_f."""

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.rows import Part, Place
from vmri_jax.scene.body import Bodies


class Pace(NamedTuple):
    """Whether a body is slow or fast, and why."""

    value: Literal["slow", "fast"]
    reason: str


@dataclass(frozen=True)
class Layout:
    """Where everything is.

    Attributes:
        bodies: the coordinates of every body as a point or rigid body, in Q_s and Q_f, see `Kinematics`. Those of bodies on no joint are
            coordinates of the scene, at the same place in q_s and q_f.
        own: the coordinates of the scene by name: those of bodies, and freedoms of joints.
        freedoms: the places of the freedoms of joints, by name of the joint, number of its pair of bodies, and name of the freedom.
        kinematics: the map from q to Q; None without trees.
    """

    bodies: dict[str, Place]
    own: dict[str, Place]
    freedoms: dict[tuple[str, int, str], Place] = field(default_factory=dict)
    kinematics: Kinematics | None = None

    @property
    def sizes(self) -> tuple[int, int]:
        """(n_s, n_f)."""
        slow, fast = (sum(place.size for place in self.own.values() if place.part == part) for part in ("s", "f"))
        return slow, fast

    @property
    def ends(self) -> tuple[int, int]:
        """Lengths of Q_s and Q_f."""
        slow, fast = (
            max(
                (
                    place.start + place.size
                    for place in (*self.own.values(), *self.bodies.values())
                    if place.part == part
                ),
                default=0,
            )
            for part in ("s", "f")
        )
        return slow, fast


def join(bodies: Bodies, layout: Layout, part: Part, what: str) -> Any:
    """One vector Q_s or Q_f of all slow or of all fast bodies, at their places; zero for freedoms of joints.

    Args:
        bodies: by name.
        layout: of these.
        part: "s" for slow ones, "f" for fast ones.
        what: "coordinates", "rates" or "masses".
    """
    pieces = {place.start: getattr(bodies[name], what) for name, place in layout.bodies.items() if place.part == part}
    pieces |= {place.start: np.zeros(1) for place in layout.freedoms.values() if place.part == part}
    found = [pieces[start] for start in sorted(pieces)]
    return library(found).concatenate(found) if found else np.zeros(0)
