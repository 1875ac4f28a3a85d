"""One small scene for every effect: the effect between a gravity and a spring that are in all of them."""

import jax.numpy as jnp
import numpy as np

from vmri_jax import ConstantMass, System
from vmri_jax import scene as sc

POINTS = {"a": [0.0, 0.0, 9.0], "b": [2.0, 0.0, 8.0], "c": [3.0, 1.0, 8.0], "d": [3.0, 2.0, 9.5]}
MASSES = {"a": 50.0, "b": 1.0, "c": 2.0, "d": 1.5}
BASE = sc.Scene(
    [sc.Body(name, MASSES[name], q, pace="slow" if name == "a" else "fast") for name, q in POINTS.items()],
    [sc.Gravity(9.81), sc.Spring(("c", "d"), 1e4, 1.7)],
)


def pull_along_x(q, params):
    return q[0][0] * params["f"]


def history(t, params):
    return params["f"] * jnp.sin(t) * jnp.ones(3)


def torque(t, params):
    return params["f"] * jnp.sin(t)


def path_of_b(t, params):
    return jnp.array([2.0, 0.0, 8.0]) + history(t, params)


def moving_plane(t, q, params):
    return q[0][:1] - 2.0 - params["f"] * jnp.sin(t)


def rotor(q, v, params):
    return params["f"] * v[0][0] * q[0][1]


def wind(t, q, v, params):
    return (params["f"] * jnp.ones(3),)


def sphere(q, params):
    return jnp.sum((q[0] - params["point"]) ** 2) / 2 - params["half"]


def held(x, params):
    return params["f"] * jnp.sin(x[0])


EFFECTS = [
    sc.NBodyGravity(1.0),
    sc.Spring(("a", "b"), 3.0, name="other spring"),
    sc.NonlinearSpring(("b", "c"), (1.0, 0.0, 2.0)),
    sc.RigidLink(("b", "c")),
    sc.Anchor("a", [0.0, 0.0, 0.0]),
    sc.SpringAnchor(["a", "b"], [0.0, 0.0, 0.0], 2.0),
    sc.MovingAnchor("b", history, 2.0, params={"f": 1.0}),
    sc.MovingPivot("b", history, params={"f": 1.0}),
    sc.Guide("b", path_of_b, params={"f": 1.0}),
    sc.Constraint(moving_plane, "b", {"f": 1.0}, timed=True),
    sc.Angle(("a", "b", "c"), 2.0),
    sc.Bending(("a", "b", "c"), 2.0),
    sc.Torsion(("a", "b", "c", "d"), 2.0),
    sc.Coulomb({"a": 1.0, "b": -1.0, "c": 2.0}, 1.0),
    sc.LennardJones(0.1, 1.0),
    sc.LinearDamping(0.1),
    sc.RayleighDamping(0.1, 0.001),
    sc.Dashpot(("b", "c"), 0.1),
    sc.QuadraticDrag(0.1),
    sc.HarmonicDrive("b", [1.0, 0.0, 0.0], 3.0),
    sc.Drive("b", history, {"f": 1.0}),
    sc.Controlled("b", "force"),
    sc.ConstantForce(["b", "c"], [1.0, 0.0, 0.0]),
    sc.FollowerForce(("b", "c"), 1.0),
    sc.PlaneContact(point=[0, 0, 0], normal=[0, 0, 1], stiffness=1e3, smoothing=0.01),
    sc.SphereContact(center=[0, 0, 0], sphere_radius=1.0, stiffness=1e3, smoothing=0.01),
    sc.MagneticField([0.0, 0.0, 1.0], 1.0, "b"),
    sc.Potential(pull_along_x, "b", {"f": 1.0}),
    sc.Constraint(sphere, "b", {"point": jnp.zeros(3), "half": 34.0}),
    sc.Kinetic(rotor, "b", {"f": 1.0}),
    sc.Force(wind, "b", {"f": 1.0}),
]

RIGID = sc.Scene(
    [
        sc.RigidBody("hub", 9.0, [1.0, 2.0, 2.5], [0.0, 0.0, 0.0], pace="slow"),
        sc.RigidBody("arm", 2.0, sc.Box((1.0, 0.2, 0.3)), [1.0, 0.0, 0.0], pace="fast"),
        sc.RigidBody("free", 3.0, sc.Cylinder(0.3, 1.0), [0.0, 2.0, 0.0], [0.3, 0.0, 0.0], pace="fast"),
    ],
    [sc.Gravity(9.81), sc.Revolute(("hub", "arm"), [0.5, 0.0, 0.0], name="pin")],
    coordinates="directors",
)
PAIR, AT = ("hub", "free"), [0.0, 1.0, 0.0]
RIGID_EFFECTS = [
    sc.Spherical(PAIR, AT),
    sc.Universal(PAIR, AT),
    sc.Revolute(PAIR, AT),
    sc.Fixed(PAIR, AT),
    sc.Cylindrical(PAIR, AT),
    sc.Prismatic(PAIR, AT),
    sc.Screw(PAIR, AT, pitch=0.1),
    sc.Planar(PAIR, AT),
    sc.JointSpring("pin", 2.0),
    sc.JointLimit("pin", -1.0, 1.0, stiffness=1e3, smoothing=0.01),
    sc.JointDamper("pin", 0.1),
    sc.JointDrive("pin", torque, {"f": 1.0}),
    sc.Controlled("pin", "torque", name="controlled pin"),
    sc.JointMotion("pin", torque, {"f": 1.0}),
    sc.RotorInertia("pin", 0.2),
    sc.Gear(["pin"], ratios=[2.0]),
    sc.JointCoupling(["pin"], held, {"f": 0.5}),
]
"""Joints, and what acts in them."""


def scene_with(effect: sc.Effect, base: sc.Scene = BASE) -> sc.Scene:
    """The base with an effect between its own two."""
    return sc.Scene(base.bodies, (base.effects[0], effect, base.effects[1]), coordinates=base.coordinates)


def weight(q_s, q_f, params):
    heights = jnp.concatenate([q_s, q_f])[2::3]
    return params["g"] * jnp.sum(params["m"] * heights)


def spring(q_f, params):
    return params["k"] / 2 * (jnp.linalg.norm(q_f[6:] - q_f[3:6]) - params["l"]) ** 2


def base_by_hand() -> System:
    """The system of the base, written without a scene."""
    m = np.array(list(MASSES.values()))
    params = {"g": np.asarray(9.81), "m": m, "k": np.asarray(1e4), "l": np.asarray(1.7)}
    return System(ConstantMass(np.repeat(m[:1], 3), np.repeat(m[1:], 3)), weight, spring, params=params)
