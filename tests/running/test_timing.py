"""Times that a busy machine does not change."""

import time

import jax
import jax.numpy as jnp

from vmri_jax.running.timing import least_seconds


def test_time_of_other_programs_does_not_count():
    """A program that only waits, as for its turn on a core, takes no time; the order of two that compute stays."""

    @jax.jit
    def once(a):
        return jnp.sin(a @ a).sum()

    a = jnp.ones((300, 300))
    once(a).block_until_ready()

    def times(count):
        return lambda: [once(a).block_until_ready() for _ in range(count)]

    waits, short, long = least_seconds([lambda: time.sleep(0.2), times(2), times(20)], 3)
    assert 0 < short < long
    assert waits < 0.02  # measured 2e-4
