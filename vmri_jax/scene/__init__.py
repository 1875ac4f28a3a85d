"""Scenes: bodies and the effects between them, from which a scene builds a `System` without unneeded terms."""

from vmri_jax.scene.body import Body, Frame
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.contact import PlaneContact, SphereContact
from vmri_jax.scene.effects.controls import Controlled
from vmri_jax.scene.effects.custom import Constraint, CustomEffect, Force, Kinetic, Potential
from vmri_jax.scene.effects.forces import (
    ConstantForce,
    Dashpot,
    Drive,
    FollowerForce,
    Gravity,
    HarmonicDrive,
    LinearDamping,
    MagneticField,
    QuadraticDrag,
    RayleighDamping,
)
from vmri_jax.scene.effects.joint_base import Joint
from vmri_jax.scene.effects.joint_effects import (
    Gear,
    JointCoupling,
    JointDamper,
    JointDrive,
    JointLimit,
    JointMotion,
    JointSpring,
    RotorInertia,
)
from vmri_jax.scene.effects.joints import Cylindrical, Fixed, Planar, Prismatic, Revolute, Screw, Spherical, Universal
from vmri_jax.scene.effects.potentials import Angle, Bending, Coulomb, LennardJones, NBodyGravity, Torsion, within_bonds
from vmri_jax.scene.effects.springs import (
    Anchor,
    Guide,
    MovingAnchor,
    MovingPivot,
    NonlinearSpring,
    RigidLink,
    Spring,
    SpringAnchor,
)
from vmri_jax.scene.rigid import RigidBody, angular_momentum, angular_velocity, quaternion, rotation
from vmri_jax.scene.scene import Scene
from vmri_jax.scene.shapes import Ball, Box, Cylinder, Rod

__all__ = [
    "Anchor",
    "Angle",
    "Ball",
    "Bending",
    "Body",
    "Box",
    "ConstantForce",
    "Constraint",
    "Controlled",
    "Coulomb",
    "CustomEffect",
    "Cylinder",
    "Cylindrical",
    "Dashpot",
    "Drive",
    "Effect",
    "Fixed",
    "FollowerForce",
    "Force",
    "Frame",
    "Gear",
    "Gravity",
    "Guide",
    "HarmonicDrive",
    "Joint",
    "JointCoupling",
    "JointDamper",
    "JointDrive",
    "JointLimit",
    "JointMotion",
    "JointSpring",
    "Kinetic",
    "LennardJones",
    "LinearDamping",
    "MagneticField",
    "MovingAnchor",
    "MovingPivot",
    "NBodyGravity",
    "NonlinearSpring",
    "Planar",
    "PlaneContact",
    "Potential",
    "Prismatic",
    "QuadraticDrag",
    "RayleighDamping",
    "Revolute",
    "RigidBody",
    "RigidLink",
    "Rod",
    "RotorInertia",
    "Scene",
    "Screw",
    "SphereContact",
    "Spherical",
    "Spring",
    "SpringAnchor",
    "Torsion",
    "Universal",
    "angular_momentum",
    "angular_velocity",
    "quaternion",
    "rotation",
    "within_bonds",
]
