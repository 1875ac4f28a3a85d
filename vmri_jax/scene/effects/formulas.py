"""Formulas that several effects are made of. The last axis of an argument holds coordinates, the first ones elements."""

import jax.numpy as jnp


def elastic_energy(stiffness, elongation):
    """``sum k/2 e^2``."""
    return jnp.sum(stiffness / 2 * elongation**2)


def elongation(line, length):
    """``|x| - l``."""
    return jnp.linalg.norm(line, axis=-1) - length


def length_defect(line, length):
    """``(|x|^2 - l^2) / 2``, smooth also at x = 0."""
    return (jnp.sum(line**2, axis=-1) - length**2) / 2


def distance(q, params=None):
    """``|q_b - q_a|`` of the first two roles."""
    a, b = q
    return jnp.sqrt(jnp.sum((b - a) ** 2, axis=-1))


def norm(v):
    """``|v|``, with derivative zero at v = 0."""
    square = jnp.sum(v**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
