"""Effects along a freedom of a joint: springs, limits, dampers, rotors, drives, prescribed motions."""

from collections.abc import Callable
from dataclasses import KW_ONLY, field, replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import library
from vmri_jax.scene.declare import number, of_time, positive
from vmri_jax.scene.effect import START
from vmri_jax.scene.effects.contact import penalty
from vmri_jax.scene.effects.freedoms import ANGLES, SINES, Freedom
from vmri_jax.scene.effects.joint_base import Joint, OfFreedoms, freedom_of, joint_named
from vmri_jax.scene.effects.springs import elastic_energy


class InJoint(OfFreedoms):
    """Base class of effects along the freedom x of a joint: the angle or displacement of b against a from the given position.

    Args:
        joint: name of a joint in the scene with an angle or a displacement. Angles count their turns where they are coordinates, see
            `Scene`; of directors an effect takes them up to 5/6 of half a turn, where a run ends.
        of: name of the freedom, if the joint has several; "auto" for the only freedom.
    """

    joint: Any
    of: Freedom | Literal["auto"] = field(default="auto", kw_only=True)

    derived = Joint.derived

    def resolved(self, effects):
        """A copy with the joint itself instead of its name."""
        return replace(self, joint=joint_named(self.name, self.joint, effects))

    @property
    def freedom(self) -> Freedom:
        """Name of the freedom that the effect acts on."""
        return freedom_of(self.joint, self.of, f"{self.name}: ")

    def _elements(self):
        return self.joint.elements

    def freedoms_of(self, i):
        return ((self.joint.name, i, self.freedom),)

    def _parameters(self):
        return super()._parameters() | self.joint.frames


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

    The depths are ``d_- = s log(1 + exp((lower - x) / s))`` and ``d_+ = s log(1 + exp((x - upper) / s))``, with the freedom x of the joint.

    Args:
        joint, of: as of `InJoint`.
        lower, upper: rad or m, from the given position, lower below upper; one number, or one for each pair of the joint.
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
        return None if self.freedom in ANGLES else self.stiffness

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
        inertia: J, positive, kg m^2 for an angle and kg for a displacement: the inertia of the rotor times its gear ratio squared; one
            number, or one for each pair of the joint.
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

    Minus the multiplier is the torque (N m) or the force (N) of the drive that turns or shifts b against a along a(t); it does work.

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
        return SINES.get(freedom, freedom)

    def check_parameters(self):
        super().check_parameters()
        start = self.path(np.zeros(()), self.parameters["path"])
        self.require(abs(library(start).asarray(start)) < START, "path(0)", start, "the joint starts at zero")
