"""Equations between the freedoms of several joints: gears, racks, differentials, tendon-driven fingers."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import field, replace
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.mechanics.checks import describe, shape_of
from vmri_jax.mechanics.functions import NO_VELOCITY, check_arguments
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import MOST_ROLES
from vmri_jax.scene.declare import real_tree
from vmri_jax.scene.effect import START
from vmri_jax.scene.effects.joint_base import OfFreedoms, freedom_of, joint_named
from vmri_jax.scene.terms import Applied


def equation(law, q, params):
    """``g(x, params)`` of the freedoms x."""
    return law(jnp.stack(q), params["law"])


class _Coupling(OfFreedoms):
    """An equation between freedoms of joints, see `JointCoupling`."""

    joints: Any

    law: ClassVar[Any]
    """The equation ``g(x, params)`` of the freedoms x (n,)."""
    kind = "constraint"
    derived = ("joints",)

    @abstractmethod
    def numbers(self) -> Any:
        """The params of the equation."""

    def __post_init__(self):
        super().__post_init__()
        joints = () if isinstance(self.joints, str) else tuple(self.joints)
        if not 1 <= len(joints) <= MOST_ROLES // 2:
            raise Refused(
                f"{self.name}: joints is {self.joints!r}; give names of 1 to {MOST_ROLES // 2} joints, ['motor', 'wheel']."
            )
        object.__setattr__(self, "joints", joints)

    def resolved(self, effects):
        """A copy with pairs (joint, freedom) in `joints` instead of names."""
        pairs = []
        for item in self.joints:
            name, freedom = (item, "auto") if isinstance(item, str) else item
            joint = joint_named(self.name, name, effects)
            pairs.append((joint, freedom_of(joint, freedom, f"{self.name}: ")))
        return replace(self, joints=tuple(pairs))

    def _elements(self):
        return (tuple(name for joint, _ in self.joints for name in joint.elements[0]),)

    def freedoms_of(self, i):
        return tuple((joint.name, 0, freedom) for joint, freedom in self.joints)

    @property
    def function(self):
        return Applied(equation, (self.law,))

    def _parameters(self):
        return {"law": self.numbers(), "joints": tuple(joint.frames for joint, _ in self.joints)}

    def check_parameters(self):
        super().check_parameters()
        for joint, _ in self.joints:
            count, expected = len(joint.elements), "give each pair a joint of its own name"
            self.require(count == 1, f"the number of pairs of {joint.name}", count, expected)

    def check_start(self):
        violation = abs(self.law(np.zeros(len(self.joints)), self.numbers()))
        expected = (
            "it must be zero at the positions in `bodies`, where all freedoms are zero; change it, or set project=True"
        )
        self.require(violation < START, "the equation", violation, expected)


class JointCoupling(_Coupling):
    """An equation between the freedoms x of joints, ``g(x, params) = 0``.

        def cam(x, params):
            turn, lift = x
            return lift - params["stroke"] * (1 - jnp.cos(turn)) / 2

        JointCoupling(["camshaft", "valve"], cam, {"stroke": 0.01})

    Args:
        joints: names of 1 to 16 joints of the scene, each with a single pair of bodies; ``(name, freedom)`` for a joint with several freedoms.
        law: ``g(x, params) -> ()`` or (k,) with the freedoms x (n,) in the order of `joints`, rad and m from the given position; zero at x = 0.
        params: numbers, arrays or trees of them that the law gets. They may change without a new compilation, and runs have derivatives
            with respect to them.
    """

    law: Callable  # pyright: ignore[reportIncompatibleVariableOverride]
    params: Any = field(default_factory=dict)

    default_name = "coupling"

    def __post_init__(self):
        super().__post_init__()
        instead = NO_VELOCITY.format(moving="JointMotion, of one joint", force="JointDamper")
        check_arguments(f"{self.name}: law", self.law, "x, params", instead)

    def numbers(self):
        return real_tree(f"{self.name}: params", self.params)

    def check_parameters(self):
        value: Any = shape_of(f"{self.name}: law", self.law, jnp.zeros(len(self.joints)), self.numbers())
        if getattr(value, "ndim", 2) > 1:
            raise Refused(f"{self.name}: law returns {describe(value)}; it must return one value () or several (k,).")
        super().check_parameters()


def weighted_sum(x, params):
    """``sum_i r_i x_i``."""
    return (params["ratios"] * x).sum()


class Gear(_Coupling):
    """Joints whose freedoms move in fixed ratios, ``sum_i r_i x_i = 0``.

        Gear(["motor", "wheel"], ratios=[1.0, -4.0])  # the motor turns four times as fast as the wheel, the same way

    Args:
        joints: as of `JointCoupling`.
        ratios: (n,) r, not zero, in the order of `joints`.
    """

    ratios: Any

    default_name = "gear"
    law = staticmethod(weighted_sum)

    def numbers(self):
        return {"ratios": real_array(f"{self.name}: ratios", self.ratios)}

    def check_parameters(self):
        ratios = self.numbers()["ratios"]
        self.require(np.shape(ratios) == (len(self.joints),), "ratios", self.ratios, "give one for each of the joints")
        self.require(ratios != 0, "ratios", self.ratios, "none of them may be zero")
        super().check_parameters()
