"""What effects between points share: distances at the start, masses, norms that are smooth at zero."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from vmri_jax.scene.body import Body
from vmri_jax.scene.effect import Effect, Elements


def squeeze(values):
    """(n,) values of n elements; of a single one, ()."""
    return values[0] if len(values) == 1 else values


def distances(elements: Elements, bodies: Mapping[str, Body], a: int = 0, b: int = 1):
    """Distances at the start between roles a and b of every element, (n,), or () of a single one."""
    ends = [(bodies[element[a]].position, bodies[element[b]].position) for element in elements]
    return squeeze(jnp.stack([jnp.sqrt(jnp.sum((q_b - q_a) ** 2)) for q_a, q_b in ends]))


def require_apart(effect: Effect, bodies: Mapping[str, Body], a: int = 0, b: int = 1) -> None:
    """Refuse elements whose roles a and b are at one point at the start."""
    for element in effect.elements(bodies):
        apart = distances((element,), bodies, a, b)
        what = f"the distance of {element[a]} and {element[b]}"
        effect.require(apart > 0, what, apart, "they must not start at the same point; move one of them")


def mass_of(effect: Effect, elements: Elements, role: int, bodies: Mapping[str, Body]):
    """Masses of the bodies in one role, (n,), or () of a single one."""
    names = [element[role] for element in elements]
    for name in names:
        if bodies[name].mass.ndim:
            raise ValueError(
                f"{effect.name}: {name} has a mass for each coordinate; it needs bodies with one mass. Give bodies=."
            )
    return squeeze(jnp.stack([bodies[name].mass for name in names]))


def length_of(effect: Effect, length, bodies: Mapping[str, Body]):
    """A natural length: as given, else the distances at the start."""
    if length is None:
        return distances(effect.elements(bodies), bodies)
    return jnp.asarray(length, dtype=float)


def norm(v):
    """``|v|`` along the last axis, with derivative zero at v = 0."""
    square = jnp.sum(v**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def check_points(effect: Effect, bodies: Mapping[str, Body], dimensions=(1, 2, 3)) -> None:
    """Refuse bodies that are not points of these dimensions."""
    for element in effect.elements(bodies):
        for name in element:
            body = bodies[name]
            if body.block or body.size not in dimensions:
                has, allowed = "general " if body.block else "", " or ".join(map(str, dimensions))
                raise ValueError(
                    f"{effect.name}: {name} has {body.size} {has}coordinates; this effect is between points of dimension {allowed}."
                )


def vector_of(effect: Effect, name: str, value, bodies: Mapping[str, Body]):
    """A point or direction for every element, (n, d), of a single one (d,); one given for all is repeated."""
    elements, value = effect.elements(bodies), jnp.atleast_1d(jnp.asarray(value, dtype=float))
    size = bodies[elements[0][0]].size
    if value.shape not in ((size,), (len(elements), size)):
        raise ValueError(
            f"{effect.name}: {name} has shape {np.shape(value)}; its bodies have dimension {size}, give ({size},)"
            + (f", or one for each, ({len(elements)}, {size})." if len(elements) > 1 else ".")
        )
    return squeeze(jnp.broadcast_to(value, (len(elements), size)))
