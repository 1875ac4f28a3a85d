"""What the coordinates and constraints of a scene are called."""

from collections.abc import Sequence
from itertools import chain

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.names import Names
from vmri_jax.scene.body import label_of
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.sorting import Placed, Sorting


def label(effect: Effect, element: Sequence[str]) -> str:
    """The name of one element of an effect, with its bodies.

    Args:
        effect: what has several elements.
        element: names of the bodies.
    """
    return f"{effect.name} {'-'.join(map(label_of, element))}"


def names_of(sorting: Sorting) -> Names:
    """Bodies and constraints by name, in the order of the coordinates and of the rows.

    An effect with one element gives its name to the constraint, one with several its name and the bodies of each.

    Args:
        sorting: bodies at their places, effects at their homes.
    """
    sizes: dict[str, dict[str, int]] = {"s": {}, "f": {}, "constraint": {}, "slow_constraint": {}}
    for name, place in sorting.layout.own.items():
        sizes[place.part][name] = place.size
    for part in sorting.placed:
        if part.home in ("constraint", "slow_constraint"):
            sizes[part.home] |= _rows(sorting, part)
    blocks, rigid = (
        [name for name, body in sorting.bodies.items() if getattr(body, kind)] for kind in ("block", "rigid")
    )
    carried = {name: place for name, place in sorting.places.items() if name not in sorting.layout.own}
    rows = sizes["constraint"], sizes["slow_constraint"]
    return Names(sizes["s"], sizes["f"], *rows, blocks, rigid, carried, sorting.layout.kinematics)


def _rows(sorting: Sorting, part: Placed) -> dict[str, int]:
    """Rows of the elements of an effect, in the order of its terms: those of bodies of the same sizes together."""
    bodies, effect = sorting.bodies, part.effect
    elements, params = effect.elements(bodies), effect.parameters(bodies)
    t = (jnp.zeros(()),) if effect.timed else ()
    rows, at = {}, 0
    for i in chain(*effect.by_size(part.elements, bodies)):
        size = jax.eval_shape(effect.function, *t, *effect.one(i, bodies, params)).size
        kept = sum(k not in part.dropped for k in range(at, at + size))
        if kept:
            rows[effect.name if len(elements) == 1 else label(effect, elements[i])] = kept
        at += size
    return rows
