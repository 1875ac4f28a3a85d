"""Effects along a freedom of a joint: springs, limits, dampers, rotors, drives, prescribed motions; and equations
between the freedoms of several joints: gears, racks, differentials, tendon-driven fingers."""

from collections.abc import Callable
from dataclasses import KW_ONLY, field, replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library, real_array
from vmri_jax.mechanics.checks import describe, shape_of
from vmri_jax.mechanics.constraints import START_TOLERANCE
from vmri_jax.mechanics.functions import NO_VELOCITY, check_arguments
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import MOST_ROLES
from vmri_jax.scene.declare import number, of_time, positive, real_tree
from vmri_jax.scene.effects.joint_base import (
    ANGLES,
    FREEDOMS,
    Freedom,
    Joint,
    OfFreedoms,
    freedom_of,
    joint_named,
    sine_and_cosine,
)
from vmri_jax.scene.effects.potentials import penalty
from vmri_jax.scene.effects.springs import elastic_energy
from vmri_jax.scene.terms import Applied


class InJoint(OfFreedoms):
    """Base class of effects along the freedom x of a joint: the angle or displacement of b against a from the given
    position.

    Args:
        joint: name of a joint in the scene with an angle or a displacement. Angles count their turns where they are
            coordinates, see `Scene`; of directors an effect takes them up to 5/6 of half a turn, where a run ends.
        of: name of the freedom, if the joint has several; "auto" for the only freedom.
    """

    joint: Any
    of: Freedom | Literal["auto"] = field(default="auto", kw_only=True)

    derived = Joint.derived

    def resolved(self, effects):
        """A copy with the joint itself instead of its name, and the freedom by its name."""
        joint = joint_named(self.name, self.joint, effects)
        return replace(self, joint=joint, of=freedom_of(joint, self.of, f"{self.name}: "))

    @property
    def joint_freedoms(self):
        return ((self.joint, self.of),)

    def _parameters(self):
        return super()._parameters() | self.joint.numbers(FREEDOMS[self.of])

    def check_of_time(self, about, value):
        """Refuse a function of time that returns no number; of forces also one number for each pair of the joint."""
        sizes = {1, len(self.elements)} if self.kind == "force" else {1}
        if getattr(value, "size", None) not in sizes:
            raise Refused(f"{about} returns {describe(value)}; it must return a number, ().")


class JointSpring(InJoint):
    """Springs in joints, ``V = sum k/2 (x - x_0)^2``.

    Args:
        joint, of: as of `InJoint`.
        stiffness: k, N m/rad or N/m, positive; one number, or one for each pair of the joint.
        neutral: x_0, rad or m, where the spring is relaxed; likewise. Zero, the given position, by default.
    """

    stiffness: Any = positive()
    neutral: Any = number(default=0.0)

    kind = "potential"
    marks = ("neutral",)
    default_name = "joint_springs"

    @staticmethod
    def function(q, params):
        (x,) = q
        return elastic_energy(params["stiffness"], x - params["neutral"])


class JointLimit(InJoint):
    """Stops of a joint by a smooth penalty: ``V = sum k/2 (d_-^2 + d_+^2)``.

    The depths are ``d_- = s log(1 + exp((lower - x) / s))`` and ``d_+ = s log(1 + exp((x - upper) / s))``, with the
    freedom x of the joint.

    Args:
        joint, of: as of `InJoint`.
        lower, upper: rad or m, from the given position, lower below upper; one number, or one for each pair of the
            joint.
        stiffness: k, N m/rad or N/m, positive; likewise.
        smoothing: s, rad or m, positive: the distance from the limit at which the force sets in.
    """

    lower: Any = number()
    upper: Any = number()
    _: KW_ONLY
    stiffness: Any = positive()
    smoothing: Any = positive()

    kind = "potential"
    marks = ("lower", "upper")
    default_name = "joint_limits"

    @staticmethod
    def function(q, params):
        (x,) = q
        return penalty(x - params["lower"], params) + penalty(params["upper"] - x, params)

    def curvature(self):
        return None if self.of in ANGLES else self.stiffness

    def check_parameters(self):
        super().check_parameters()
        params = self.parameters
        self.require(params["lower"] < params["upper"], "lower", params["lower"], "it must be below upper")


class JointDamper(InJoint):
    """Dampers in joints, against the rate of the freedom: ``f = -c x'``.

    Args:
        joint, of: as of `InJoint`.
        coefficient: c, N m s/rad or N s/m, positive; one number, or one for each pair of the joint.
    """

    coefficient: Any = positive()

    kind = "force"
    counts_turns = False
    default_name = "joint_dampers"

    @staticmethod
    def function(t, q, v, params):
        (rate,) = v
        return (-params["coefficient"] * rate,)


class RotorInertia(InJoint):
    """Inertia that moves with a joint alone, such as the rotor of its motor: ``T = J x'^2 / 2``; MuJoCo's armature.

    Args:
        joint, of: as of `InJoint`.
        inertia: J, positive, kg m^2 for an angle and kg for a displacement: the inertia of the rotor times its gear
            ratio squared; one number, or one for each pair of the joint.
    """

    inertia: Any = positive()

    kind = "kinetic"
    counts_turns = False
    default_name = "rotors"

    @staticmethod
    def function(q, v, params):
        (rate,) = v
        return jnp.sum(params["inertia"] * rate**2) / 2


class JointDrive(InJoint):
    """A torque about the axis of a joint, or a force along it, as a function of time; b gets it and a its opposite.

    Args:
        joint, of: as of `InJoint`.
        history: ``history(t, params) -> ()``, N m or N.
        params: of `history`. They may change without a new compilation, and runs have derivatives with respect to them.
    """

    history: Callable = of_time()
    params: Any = field(default_factory=dict)

    kind = "force"
    counts_turns = False
    default_name = "joint_drive"

    @staticmethod
    def function(history, t, q, v, params):
        return (history(t, params["history"]),)


class JointMotion(InJoint):
    """A prescribed angle or displacement of a joint, ``x = a(t)``.

    Minus the multiplier is the torque (N m) or the force (N) of the drive that turns or shifts b against a along a(t);
    it does work.

    Args:
        joint, of: as of `InJoint`.
        path: a, ``path(t, params) -> ()``, rad or m from the given position, zero at t = 0.
        params: of `path`. They may change without a new compilation, and runs have derivatives with respect to them.
    """

    path: Callable = of_time()
    params: Any = field(default_factory=dict)

    kind = "constraint"
    is_analytic = True
    counts_turns = False
    default_name = "joint_motion"
    timed = True

    @staticmethod
    def function(path, t, q, params):
        (x,), a = q, path(t, params["path"])
        if not isinstance(x, tuple):
            return x - a
        # homogeneous in the directors, unlike the angle itself
        (sine, cosine), xp = x, library(a)
        return sine * xp.cos(a) - cosine * xp.sin(a)

    def by_directors(self, freedom):
        return sine_and_cosine if freedom in ANGLES else super().by_directors(freedom)

    def check_parameters(self):
        super().check_parameters()
        start = self.path(np.zeros(()), self.parameters["path"])
        self.require(abs(library(start).asarray(start)) < START_TOLERANCE, "path(0)", start, "the joint starts at zero")


def equation(law, q, params):
    """``g(x, params)`` of the freedoms x."""
    return law(jnp.stack(q), params["law"])


class JointCoupling(OfFreedoms):
    """An equation between the freedoms x of joints, ``g(x, params) = 0``.

        def cam(x, params):
            turn, lift = x
            return lift - params["stroke"] * (1 - jnp.cos(turn)) / 2

        JointCoupling(["camshaft", "valve"], cam, {"stroke": 0.01})

    Args:
        joints: names of 1 to 16 joints of the scene, each with a single pair of bodies; ``(name, freedom)`` for a joint
            with several freedoms.
        law: ``g(x, params) -> ()`` or (k,) with the freedoms x (n,) in the order of `joints`, rad and m from the given
            position; zero at x = 0.
        params: numbers, arrays or trees of them that the law gets. They may change without a new compilation, and runs
            have derivatives with respect to them.
    """

    joints: Any
    law: Callable
    params: Any = field(default_factory=dict)

    kind = "constraint"
    derived = ("joints",)
    default_name = "coupling"

    def __post_init__(self):
        super().__post_init__()
        joints = () if isinstance(self.joints, str) else tuple(self.joints)
        if not 1 <= len(joints) <= MOST_ROLES // 2:
            raise Refused(
                f"{self.name}: joints is {self.joints!r}; give names of 1 to {MOST_ROLES // 2} joints, ['motor', "
                "'wheel']."
            )
        object.__setattr__(self, "joints", joints)
        instead = NO_VELOCITY.format(moving="JointMotion, of one joint", force="JointDamper")
        check_arguments(f"{self.name}: law", self.law, "x, params", instead)

    def resolved(self, effects):
        """A copy with pairs (joint, freedom) in `joints` instead of names."""
        pairs = []
        for item in self.joints:
            name, freedom = (item, "auto") if isinstance(item, str) else item
            joint = joint_named(self.name, name, effects)
            pairs.append((joint, freedom_of(joint, freedom, f"{self.name}: ")))
        return replace(self, joints=tuple(pairs))

    @property
    def joint_freedoms(self):
        return self.joints

    @property
    def function(self):
        return Applied(equation, (self.law,))

    def numbers(self) -> Any:
        """The params of the law."""
        return real_tree(f"{self.name}: params", self.params)

    def _parameters(self):
        return {
            "law": self.numbers(),
            "joints": tuple(joint.numbers(FREEDOMS[freedom]) for joint, freedom in self.joints),
        }

    def check_parameters(self):
        value: Any = shape_of(f"{self.name}: law", self.law, jnp.zeros(len(self.joints)), self.numbers())
        if getattr(value, "ndim", 2) > 1:
            raise Refused(f"{self.name}: law returns {describe(value)}; it must return one value () or several (k,).")
        super().check_parameters()
        for joint, _ in self.joints:
            count, expected = len(joint.elements), "give each pair a joint of its own name"
            self.require(count == 1, f"the number of pairs of {joint.name}", count, expected)


def weighted_sum(x, params):
    """``sum_i r_i x_i``."""
    return (params["ratios"] * x).sum()


class Gear(JointCoupling):
    """Joints whose freedoms move in fixed ratios, ``sum_i r_i x_i = 0``.

        Gear(["motor", "wheel"], ratios=[1.0, -4.0])  # the motor turns four times as fast as the wheel, the same way

    Args:
        joints: as of `JointCoupling`.
        ratios: (n,) r, not zero, in the order of `joints`.
    """

    law: Callable = field(default_factory=lambda: weighted_sum, init=False)
    params: Any = field(default=None, init=False)
    ratios: Any

    default_name = "gear"

    def numbers(self):
        return {"ratios": real_array(f"{self.name}: ratios", self.ratios)}

    def check_parameters(self):
        ratios = self.numbers()["ratios"]
        self.require(np.shape(ratios) == (len(self.joints),), "ratios", self.ratios, "give one for each of the joints")
        self.require(ratios != 0, "ratios", self.ratios, "none of them may be zero")
        super().check_parameters()
