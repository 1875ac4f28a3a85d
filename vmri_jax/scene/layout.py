"""Where the coordinates of bodies and joints lie in q_s and q_f."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.rows import Place

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
        return _ends([*self.coordinates.values()])

    @property
    def ends(self) -> tuple[int, int]:
        """Lengths of Q_s and Q_f."""
        return _ends([*self.coordinates.values(), *self.bodies.values()])

    @property
    def columns(self) -> dict[str | Key, np.ndarray]:
        """Numbers of the coordinates of every body, and of every freedom of a joint, in (Q_s, Q_f), taken as one vector."""
        num_slow, places = self.ends[0], {**self.bodies, **self.freedoms}
        return {name: place.numbers(num_slow) for name, place in places.items()}

    @property
    def numbers(self) -> dict[str | Key, np.ndarray]:
        """Numbers of the coordinates of every name and freedom in (q_s, q_f), taken as one vector."""
        num_slow, places = self.sizes[0], {**self.coordinates, **self.freedoms}
        return {name: place.numbers(num_slow) for name, place in places.items()}


def _ends(places: Sequence[Place]) -> tuple[int, int]:
    slow, fast = (max((p.start + p.size for p in places if p.part == part), default=0) for part in ("s", "f"))
    return slow, fast
