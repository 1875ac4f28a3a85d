"""A motion that the tests of pictures share."""

import pytest

from tests.animation.support import PENDULUM, swinging
from vmri_jax.animation import Drawing, motion


@pytest.fixture(scope="session")
def pendulum():
    """The motion of `PENDULUM` along `swinging`."""
    return motion(swinging(), Drawing.from_dict(PENDULUM))
