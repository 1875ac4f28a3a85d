"""Where the coordinates of bodies and joints lie in q_s and q_f."""

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.rows import Part, Place
from vmri_jax.scene.body import Bodies

Key = tuple[str, int, str]
"""Name of a joint, number of its pair of bodies, and name of a freedom of the joint."""


class DecidedPace(NamedTuple):
    """Whether a body is slow or fast, and why."""

    value: Literal["slow", "fast"]
    reason: str


@dataclass(frozen=True)
class Layout:
    """Places of the coordinates q of the scene and of the coordinates Q of its bodies.

    Attributes:
        bodies: by name of the body, the place in Q_s or Q_f of its coordinates as a point or rigid body, see `Kinematics`. A body that is
            no function of joint coordinates has the same place in q_s or q_f.
        coordinates: by name, the place in q_s or q_f of the coordinates of a body or of a freedom of a joint.
        freedoms: places of the freedoms of joints in q_s or q_f.
        kinematics: the map from q to Q; None if Q = q.
    """

    bodies: dict[str, Place]
    coordinates: dict[str, Place]
    freedoms: dict[Key, Place] = field(default_factory=dict)
    kinematics: Kinematics | None = None

    @property
    def sizes(self) -> tuple[int, int]:
        """(n_s, n_f)."""
        n_s, n_f = (sum(place.size for place in self.coordinates.values() if place.part == part) for part in ("s", "f"))
        return n_s, n_f

    @property
    def ends(self) -> tuple[int, int]:
        """Lengths of Q_s and Q_f."""
        places = [*self.coordinates.values(), *self.bodies.values()]
        slow, fast = (max((p.start + p.size for p in places if p.part == part), default=0) for part in ("s", "f"))
        return slow, fast

    @property
    def columns(self) -> dict[str | Key, np.ndarray]:
        """Numbers of the coordinates of every body, and of every freedom of a joint, in (Q_s, Q_f), taken as one vector."""
        first, places = {"s": 0, "f": self.ends[0]}, {**self.bodies, **self.freedoms}
        return {name: first[part] + start + np.arange(size) for name, (part, start, size) in places.items()}


def join(bodies: Bodies, layout: Layout, part: Part, quantity: Literal["coordinates", "rates", "masses"]) -> Any:
    """A vector of the length of Q_s or Q_f with a quantity of all bodies at their places, and zeros for freedoms of joints."""
    pieces = {
        place.start: getattr(bodies[name], quantity) for name, place in layout.bodies.items() if place.part == part
    }
    pieces |= {place.start: np.zeros(1) for place in layout.freedoms.values() if place.part == part}
    ordered = [pieces[start] for start in sorted(pieces)]
    return library(ordered).concatenate(ordered) if ordered else np.zeros(0)
