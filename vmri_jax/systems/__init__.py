"""Systems of the reference study, written exactly as a user would write them."""

from vmri_jax.systems.fermi_pasta_ulam import fermi_pasta_ulam
from vmri_jax.systems.simple_atomic_model import simple_atomic_model
from vmri_jax.systems.triple_spherical_pendulum import triple_spherical_pendulum

__all__ = ["fermi_pasta_ulam", "simple_atomic_model", "triple_spherical_pendulum"]
