"""Scenes: bodies and effects, turned into a `System` in which only what the scene calls for exists."""

from vmri_jax.scene.body import Body
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.angles import Angle, Bending, Torsion
from vmri_jax.scene.effects.contact import PlaneContact, SphereContact
from vmri_jax.scene.effects.custom import Constraint, Force, Kinetic, Potential
from vmri_jax.scene.effects.damping import Dashpot, LinearDamping, QuadraticDrag, RayleighDamping
from vmri_jax.scene.effects.drives import ConstantForce, Drive, FollowerForce, HarmonicDrive
from vmri_jax.scene.effects.fields import Gravity, MagneticField
from vmri_jax.scene.effects.links import Anchor, Guide, MovingPivot, RigidLink
from vmri_jax.scene.effects.pairs import Coulomb, LennardJones, NBodyGravity
from vmri_jax.scene.effects.springs import MovingAnchor, NonlinearSpring, Spring, SpringAnchor
from vmri_jax.scene.scene import Scene

__all__ = [
    "Anchor",
    "Angle",
    "Bending",
    "Body",
    "ConstantForce",
    "Constraint",
    "Coulomb",
    "Dashpot",
    "Drive",
    "Effect",
    "FollowerForce",
    "Force",
    "Gravity",
    "Guide",
    "HarmonicDrive",
    "Kinetic",
    "LennardJones",
    "LinearDamping",
    "MagneticField",
    "MovingAnchor",
    "MovingPivot",
    "NBodyGravity",
    "NonlinearSpring",
    "PlaneContact",
    "Potential",
    "QuadraticDrag",
    "RayleighDamping",
    "RigidLink",
    "Scene",
    "SphereContact",
    "Spring",
    "SpringAnchor",
    "Torsion",
]
