"""64-bit floats before anything else, and what many tests share."""

import jax
import pytest
from hypothesis import settings

jax.config.update("jax_enable_x64", True)

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=50)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def fpu():
    """The Fermi-Pasta-Ulam chain with three stiff springs."""
    from vmri_jax import systems

    return systems.fermi_pasta_ulam()


@pytest.fixture(scope="session")
def tsp():
    """The triple spherical pendulum."""
    from vmri_jax import systems

    return systems.triple_spherical_pendulum()


@pytest.fixture(scope="session")
def sam():
    """The simple atomic model."""
    from vmri_jax import systems

    return systems.simple_atomic_model()
