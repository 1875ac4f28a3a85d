"""Effects, each in a file of its own."""

from vmri_jax.scene.effects.anchors import Anchor, MovingAnchor, SpringAnchor
from vmri_jax.scene.effects.bending import Angle, Bending, Torsion
from vmri_jax.scene.effects.contact import PlaneContact, SphereContact
from vmri_jax.scene.effects.damping import Dashpot, LinearDamping, QuadraticDrag
from vmri_jax.scene.effects.drives import ConstantForce, Drive, FollowerForce, HarmonicDrive
from vmri_jax.scene.effects.gravity import Gravity, NBodyGravity
from vmri_jax.scene.effects.links import RigidLink
from vmri_jax.scene.effects.magnetic import MagneticField
from vmri_jax.scene.effects.pairs import Coulomb, LennardJones
from vmri_jax.scene.effects.rayleigh import RayleighDamping
from vmri_jax.scene.effects.springs import NonlinearSpring, Spring

__all__ = [
    "Anchor",
    "Angle",
    "Bending",
    "ConstantForce",
    "Coulomb",
    "Dashpot",
    "Drive",
    "FollowerForce",
    "Gravity",
    "HarmonicDrive",
    "LennardJones",
    "LinearDamping",
    "MagneticField",
    "MovingAnchor",
    "NBodyGravity",
    "NonlinearSpring",
    "PlaneContact",
    "QuadraticDrag",
    "RayleighDamping",
    "RigidLink",
    "SphereContact",
    "Spring",
    "SpringAnchor",
    "Torsion",
]
