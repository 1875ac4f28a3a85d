"""Effects of one's own are a function and one line:

def magnet(q, params):
    ball, coil = q
    return -params["strength"] / jnp.linalg.norm(ball - coil) ** 3

Potential(magnet, ("ball", "coil"), {"strength": 2.0}, drawn_as="spring")
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from vmri_jax.scene.effect import Effect

DRAWN = {"link": "links", "spring": "springs"}
"""What joins two bodies in a drawing, and its entry there."""


@dataclass(frozen=True, eq=False)
class OwnEffect(Effect):
    """An effect given by a function of one element.

    Args:
        function: see `Effect`; define it at module level, it is compared by identity.
        bodies: names of the bodies it touches, in the order in which the function takes them.
        params: numbers, arrays or trees of them that the function gets; traced.
        name: the name of the function by default.
        drawn_as: "link" or "spring", between each of its bodies and the next one; None for nothing to see.

    Raises:
        TypeError: a function that cannot be called.
        ValueError: another drawing; (of the scene) one of a single body, or of blocks of general coordinates.
    """

    function: Callable  # pyright: ignore[reportIncompatibleVariableOverride]
    bodies: Any
    params: Any = field(default_factory=dict)
    drawn_as: Literal["link", "spring"] | None = field(default=None, kw_only=True)
    same_size: ClassVar[bool] = False

    def __post_init__(self):
        if not callable(self.function):
            raise TypeError(f"{type(self).__name__}: function is {self.function!r}; give a function of (q, ...).")
        if not self.name:
            object.__setattr__(self, "name", getattr(self.function, "__name__", type(self).__name__.lower()))
        super().__post_init__()
        if self.drawn_as not in (None, *DRAWN):
            raise ValueError(f"{self.name}: drawn_as is {self.drawn_as!r}; it must be 'link', 'spring' or None.")

    def elements(self, bodies):
        return ((self.bodies,) if isinstance(self.bodies, str) else tuple(self.bodies),)

    def parameters(self, bodies):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), self.params)

    def check(self, bodies):
        super().check(bodies)
        if self.drawn_as is None:
            return
        (element,) = self.elements(bodies)
        expected = "it is drawn between bodies, and {} is alone; leave it out"
        self.require(len(element) > 1, "drawn_as", repr(self.drawn_as), expected.format(*element))
        expected = "it is drawn between points, and {} has {} coordinates; leave it out"
        for name in element:
            sized = expected.format(name, bodies[name].size)
            self.require(not bodies[name].block, "drawn_as", repr(self.drawn_as), sized)

    def drawing(self, bodies):
        (element,) = self.elements(bodies)
        return {DRAWN[self.drawn_as]: [list(pair) for pair in pairwise(element)]} if self.drawn_as else {}


class Potential(OwnEffect):
    """A potential of one's own, ``function(q, params) -> ()``.

    Arguments are those of `OwnEffect`.
    """

    kind = "potential"


@dataclass(frozen=True, eq=False)
class Constraint(OwnEffect):
    """A holonomic constraint of one's own, ``function(q, params) -> (k,)``, kept zero.

    Arguments are those of `OwnEffect`, and

    Args:
        timed: it depends on time, ``function(t, q, params)``.
    """

    timed: bool = field(default=False, kw_only=True)  # pyright: ignore[reportIncompatibleVariableOverride]

    kind = "constraint"


class Kinetic(OwnEffect):
    """A velocity-dependent part of the Lagrangian, ``function(q, v, params) -> ()``, added to the kinetic energy.

    Arguments are those of `OwnEffect`.
    """

    kind = "kinetic"


class Force(OwnEffect):
    """A force of one's own, ``function(t, q, v, params)`` -> a tuple of one force per body, shaped like q.

    Arguments are those of `OwnEffect`.
    """

    kind = "force"
