"""The rows of a scene's constraints one by one: their names, their values and their Jacobian at any positions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, quickly_compiled
from vmri_jax.scene.body import LARGEST_POINT, AnyBody, Bodies, moving
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.freedoms import ANGLES
from vmri_jax.scene.labels import label
from vmri_jax.scene.layout import join
from vmri_jax.scene.sorting import Home, Placed, Sorting
from vmri_jax.scene.terms import EffectTerm

HOMES: tuple[Home, ...] = ("slow_constraint", "constraint")


CANCELLED = 1e-14
"""Part of the product of the gradient of a row by bodies and the motion of these by a coordinate below which their inner product is zero: so it is with the rows of a planar loop that
hold it in its plane. A larger one takes a row away whose lever is short, a smaller one takes round-off for an independent row."""


class Row(NamedTuple):
    """A row of a constraint.

    name: of its effect and bodies, with a number where these have several rows.
    part: number of its entry in `Sorting.placed`.
    number: of the row in that entry, in the order of its terms.
    effect, home, kept: of that entry; `kept` is False of a row that is left out.
    """

    name: str
    part: int
    number: int
    effect: Effect
    home: Home
    kept: bool


class _Element(NamedTuple):
    """An element of a constraint as a function of its coordinates.

    columns: where these are among the coordinates of all bodies (Q_s, Q_f).
    """

    term: EffectTerm
    params: dict[str, Any]
    columns: np.ndarray


@dataclass(frozen=True)
class ConstraintRows:
    """The k rows of all constraints, in the order of `Sorting.placed`, over the n coordinates, slow ones first.

    Attributes:
        rows: one entry for each of them.
        elements: their functions.
        start: (n,) coordinates at the start.
        masses: (n,); 1 each where they are traced, since they only weigh the choice of the rows to drop.
        scales: (n,) by how much each coordinate changes in a large motion: the extent of the scene for positions, 1 for
            directors of rigid bodies and angles of joints, and for general coordinates their value, at least 1.
        num_slow: number of slow coordinates.
        to_bodies: the coordinates of all bodies (Q_s, Q_f) one after the other at q, and their Jacobian.
    """

    rows: tuple[Row, ...]
    elements: tuple[_Element, ...]
    start: np.ndarray
    masses: np.ndarray
    scales: np.ndarray
    num_slow: int
    to_bodies: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

    @classmethod
    def of(cls, sorting: Sorting) -> "ConstraintRows | None":
        """The rows of the constraints of these effects; None where there are none, or where their numbers are traced."""
        bodies, held = sorting.bodies, [(i, part) for i, part in enumerate(sorting.placed) if part.home in HOMES]
        params = {i: part.effect.parameters(bodies) for i, part in held}
        if not held or not is_concrete((sorting.positions, sorting.joints, params)):
            return None
        where, to_bodies = sorting.layout, sorting.to_bodies
        columns = {
            name: place.start + np.arange(place.size) + (where.ends[0] if place.part == "f" else 0)
            for name, place in where.bodies.items()
        }
        start = np.concatenate(sorting.positions)
        masses = join(bodies, where, "s", "masses"), join(bodies, where, "f", "masses")
        masses = np.concatenate(masses) if is_concrete(masses) else None
        extended, jacobian = to_bodies(start)
        masses = np.ones_like(start) if masses is None else masses @ (jacobian * jacobian)
        rows, elements = [], []
        for i, part in held:
            number = 0
            for names, element in _elements(part, bodies, columns, params[i]):
                elements.append(element)
                size = _evaluated(element, extended, 0.0)[0].size
                for j in range(size):
                    name = names if size == 1 else f"{names} [{j}]"
                    rows.append(Row(name, i, number, part.effect, part.home, number not in part.dropped))
                    number += 1
        scales = _scales(sorting, _extent(bodies))
        return cls(tuple(rows), tuple(elements), start, masses, scales, where.sizes[0], to_bodies)

    def at(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (k,) and Jacobian (k, n) at a time and at positions (n,)."""
        bodies, of_bodies = self.to_bodies(q)
        values, jacobian, first = np.empty(len(self.rows)), np.zeros((len(self.rows), bodies.size)), 0
        for element in self.elements:
            value, entries = _evaluated(element, bodies, t)
            values[first : first + value.size] = value
            jacobian[first : first + value.size, element.columns] = entries
            first += value.size
        found = jacobian @ of_bodies
        largest = np.linalg.norm(jacobian, axis=1)[:, None] * np.sqrt((of_bodies * of_bodies).sum(axis=0))
        return values, np.where(np.abs(found) > CANCELLED * largest, found, 0.0)

    @cached_property
    def jacobian(self) -> np.ndarray:
        """The Jacobian (k, n) at the start."""
        return self.at(0.0, self.start)[1]

    @cached_property
    def sizes(self) -> np.ndarray:
        """By how much each row changes in a large motion, (k,): the length of its gradient in coordinates over `scales`, 1 where that is zero."""
        lengths = np.linalg.norm(self.jacobian * self.scales, axis=1)
        return np.where(lengths > 0, lengths, 1.0)

    @property
    def timed(self) -> bool:
        """Whether a row depends on time."""
        return any(row.effect.timed for row in self.rows)

    def numbers(self, home: Home | None = None) -> list[int]:
        """Numbers of the rows that are kept, all or those of a home."""
        return [i for i, row in enumerate(self.rows) if row.kept and home in (None, row.home)]

    def names(self, numbers: Sequence[int]) -> list[str]:
        """Names of some rows."""
        return [self.rows[i].name for i in numbers]


def _elements(part: Placed, bodies: Bodies, columns: dict[str, np.ndarray], params: dict[str, Any]):
    """Elements of an effect in the order of its terms, each with its name."""
    effect = part.effect
    elements = effect.elements(bodies)
    for i in chain(*effect.by_size(part.elements, bodies)):
        of_element = np.concatenate([columns[name] for name in moving(elements[i])])
        yield label(effect, elements[i]), _Element(*effect.alone(i, bodies, params), of_element)


def _evaluated(element: _Element, q: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Values (m,) of an element at positions q (n,) of all bodies, and their derivatives by its own coordinates."""
    values, jacobian = _value_and_jacobian(element.term, q[element.columns], element.params, t)
    return np.asarray(values), np.asarray(jacobian)


@partial(quickly_compiled, static_argnames="term")
def _value_and_jacobian(term: EffectTerm, q, params, t):
    def values(q):
        value = jnp.reshape(term.value(q, None, params, t), (-1,))
        return value, value

    jacobian, value = jax.jacfwd(values, has_aux=True)(q)
    return value, jacobian


def _extent(bodies: Bodies) -> float:
    """Largest distance of a body from their mean along an axis; of a single place, its largest coordinate, or 1 at the origin."""
    points = [np.asarray(body.coordinates)[:LARGEST_POINT] for body in bodies.values() if not body.block]
    points = np.array([np.pad(point, (0, LARGEST_POINT - point.size)) for point in points]).reshape(-1, LARGEST_POINT)
    if not points.size:
        return 1.0
    return float(np.abs(points - points.mean(axis=0)).max() or np.abs(points).max() or 1.0)


def _scales(sorting: Sorting, extent: float) -> np.ndarray:
    """By how much each coordinate changes in a large motion, see `ConstraintRows`."""
    turning = {place: freedom in ANGLES for (_, _, freedom), place in sorting.layout.freedoms.items()}
    places = sorted(sorting.layout.own.items(), key=lambda item: (item[1].part == "f", item[1].start))
    found = [
        np.full(1, 1.0 if turning[place] else extent) if place in turning else _scales_of(sorting.bodies[name], extent)
        for name, place in places
    ]
    return np.concatenate(found)


def _scales_of(body: AnyBody, extent: float) -> np.ndarray:
    """By how much each coordinate of a body changes in a large motion."""
    q = np.asarray(body.coordinates)
    if body.block:
        return np.maximum(np.abs(q), 1.0)
    return np.where(np.arange(q.size) < LARGEST_POINT, extent, 1.0)
