"""Names of the coordinates and constraints of a scene."""

from collections.abc import Sequence
from itertools import chain

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.names import Names
from vmri_jax.scene.body import label_of
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.sorting import Placed, Sorting


def element_label(effect: Effect, element: Sequence[str]) -> str:
    """The label of an element: the name of its effect and the names of its bodies."""
    return f"{effect.name} {'-'.join(map(label_of, element))}"


def names_of(sorting: Sorting) -> Names:
    """Bodies and constraints by name, in the order of the coordinates and of the rows.

    The rows of an effect with a single element have the name of the effect; with several elements the names of the bodies follow.
    """
    sizes: dict[str, dict[str, int]] = {"s": {}, "f": {}, "constraint": {}, "slow_constraint": {}}
    for name, place in sorting.layout.coordinates.items():
        sizes[place.part][name] = place.size
    for part in sorting.placed:
        if part.home in ("constraint", "slow_constraint"):
            sizes[part.home] |= _rows(sorting, part)
    blocks, rigid = (
        [name for name, body in sorting.bodies.items() if getattr(body, kind)] for kind in ("block", "rigid")
    )
    carried = {name: place for name, place in sorting.places.items() if name not in sorting.layout.coordinates}
    rows = sizes["constraint"], sizes["slow_constraint"]
    return Names(sizes["s"], sizes["f"], *rows, blocks, rigid, carried, sorting.layout.kinematics)


def _rows(sorting: Sorting, part: Placed) -> dict[str, int]:
    """Number of kept rows of each element of an effect by its label, in the order of the terms of the effect."""
    bodies, effect = sorting.bodies, part.effect
    elements, params = effect.elements(bodies), effect.parameters(bodies)
    t = (jnp.zeros(()),) if effect.timed else ()
    rows, first = {}, 0
    for i in chain(*effect.by_size(part.elements, bodies)):
        size = jax.eval_shape(effect.function, *t, *effect.element_arguments(i, bodies, params)).size
        kept = sum(row not in part.dropped for row in range(first, first + size))
        if kept:
            rows[effect.name if len(elements) == 1 else element_label(effect, elements[i])] = kept
        first += size
    return rows
