"""The rows of a scene's constraints: names, also of coordinates, values and Jacobian at any positions."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, quickly_compiled
from vmri_jax.mechanics.constraints import RANK
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.mechanics.names import Names
from vmri_jax.scene.body import LARGEST_POINT, label_of, moving
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.freedoms import ANGLES
from vmri_jax.scene.layout import Key, join
from vmri_jax.scene.rates import positions
from vmri_jax.scene.sorting import HOMES, Home, Placed, Sorting
from vmri_jax.scene.terms import EffectTerm, alike, is_of_package

CANCELLED = 1e-14
"""An entry of the Jacobian dg/dq is the product of the row dg/dQ and the column dQ/dq. If it is below this fraction of the product of
their lengths it is round-off and set to zero, as for the rows that hold a planar loop in its plane. A larger value removes rows with
short levers; with a smaller value round-off counts as an independent row."""

REACHED = 1e-12
"""Newton's iteration ends when rows, relative to their sizes, are below this value, which is near round-off. With a larger value loops have a
visible gap, which the initial state refuses, and dropped rows carry the remaining error."""
COMPLEX_STEP = 1e-30
"""Imaginary step h of derivatives, relative to coordinates of any unit: its square is below round-off of every value. A larger step is felt in
values; a smaller one may underflow in products."""
CORRECTIONS = 20
"""Most corrections of Newton's iteration; from nearby six reach round-off. More only delay the message that it fails."""


class Row(NamedTuple):
    """A row of a constraint.

    label: of its element: the name of the effect and, if it has several elements, names of the bodies.
    name: of the effect and the bodies, with a number if an element has several rows.
    part: number of its entry in `Sorting.placed`, which has this effect and home.
    element: number of its element in the effect.
    number: of the row in this entry, in the order of its terms.
    kept: False for a row that the scene leaves out.
    """

    label: str
    name: str
    part: int
    element: int
    number: int
    effect: Effect
    home: Home
    kept: bool


def rows_of(placed: Sequence[Placed]) -> list[Row]:
    """The rows of constraints, in the order of `Sorting.placed` and of the terms of each effect."""
    rows = []
    for i, part in enumerate(placed):
        effect, number = part.effect, 0
        for group in effect.by_size(part.elements) if part.home in HOMES else ():
            # all elements of a group have as many rows
            t, one = (np.zeros(()),) if effect.timed else (), group[:1]
            size = jax.eval_shape(effect.function, *t, effect.positions(one), effect.params_of(one)).size
            for element in group:
                named = f"{effect.name} {'-'.join(map(label_of, effect.elements[element]))}"
                label = effect.name if len(effect.elements) == 1 else named
                for name in [named] if size == 1 else [f"{named} [{j}]" for j in range(size)]:
                    rows.append(Row(label, name, i, element, number, effect, part.home, number not in part.dropped))
                    number += 1
    return rows


class _Group(NamedTuple):
    """n elements of constraints that are one function of their c coordinates, see `Effect.element_term`.

    params, columns, rows: with an axis for the elements; columns (n, c) are numbers of the coordinates in (Q_s, Q_f), rows (n, m) of the rows.
    """

    term: EffectTerm
    is_analytic: bool
    params: Any
    columns: np.ndarray
    rows: np.ndarray

    def at_complex(self, q: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Values (n, m) and derivatives (n, m, c), by a complex step: ``g(q + i h e) = g + i h dg/dq e`` to round-off, with a tiny h."""
        (n, c), x, params = self.columns.shape, q[self.columns], self.params
        steps = 1j * COMPLEX_STEP * np.eye(c)[:, None]
        if n == 1:  # a path of the user takes the params of a single element
            x, steps, params = x[0], steps[:, 0], jax.tree.map(lambda a: a[0], params)
        values = np.asarray(self.term.value(x + steps, None, params, t)).reshape(c, n, -1)
        return values[0].real, np.moveaxis(values.imag, 0, -1) / COMPLEX_STEP


@dataclass(frozen=True)
class _Values:
    """The rows (m,) of an element at the coordinates of its bodies."""

    term: EffectTerm

    def __call__(self, q, params, t):
        return jnp.ravel(self.term.value(q, None, params, t))


@dataclass(frozen=True)
class ConstraintRows:
    """The k rows of all constraints, in the order of `Sorting.placed`, over the n coordinates, slow ones first.

    masses: (n,) of the coordinates; 1 for traced masses, since they only weigh the choice of the rows to drop.
    scales: (n,) change of each coordinate in a large motion: the extent of the scene for positions, 1 for
        directors of rigid bodies and angles of joints, and for general coordinates their largest value, or 1 if all are zero.
    to_bodies: (Q_s, Q_f) as one vector at q, and its Jacobian dQ/dq.
    """

    rows: tuple[Row, ...]
    groups: tuple[_Group, ...]
    start: np.ndarray
    masses: np.ndarray
    scales: np.ndarray
    num_slow: int
    to_bodies: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

    @classmethod
    def of(cls, sorting: Sorting) -> "ConstraintRows | None":
        """The rows of all constraints of a scene; None if it has none, or if their numbers are traced."""
        bodies, layout, to_bodies = sorting.bodies, sorting.layout, sorting.to_bodies
        constraints = [part for part in sorting.placed if part.home in HOMES]
        if not constraints or not is_concrete(
            (sorting.positions, sorting.joints, [part.effect.parameters for part in constraints])
        ):
            return None
        start, columns = np.concatenate(sorting.positions), layout.columns
        _, jacobian = to_bodies(start)
        # the diagonal of J^T M J with J = dQ/dq
        of_bodies = join(bodies, layout, "s", "masses"), join(bodies, layout, "f", "masses")
        is_known = is_concrete(of_bodies)
        masses = np.concatenate(of_bodies) @ (jacobian * jacobian) if is_known else np.ones_like(start)
        rows = tuple(rows_of(sorting.placed))
        groups = tuple(_groups(rows, columns))
        return cls(rows, groups, start, masses, _scales(sorting), layout.sizes[0], to_bodies)

    def evaluate(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values g (k,) and Jacobian dg/dq (k, n) at a time and at positions (n,)."""
        q_bodies, by_coordinates = self.to_bodies(q)
        values, by_bodies = np.empty(len(self.rows)), np.zeros((len(self.rows), q_bodies.size))
        compiled = [group for group in self.groups if not group.is_analytic]
        functions = [TracedOnce(_Values(group.term)) for group in compiled]
        arguments = [(q_bodies[group.columns], group.params) for group in compiled]
        of_compiled = iter(jax.device_get(_values_and_jacobians(functions, arguments, t)) if compiled else ())
        for group in self.groups:
            of_rows, entries = group.at_complex(q_bodies, t) if group.is_analytic else next(of_compiled)
            values[group.rows] = of_rows
            by_bodies[group.rows[:, :, None], group.columns[:, None]] = entries
        # dg/dq = dg/dQ dQ/dq, without entries that are round-off
        jacobian = by_bodies @ by_coordinates
        lengths = np.linalg.norm(by_bodies, axis=1)[:, None] * np.sqrt((by_coordinates * by_coordinates).sum(axis=0))
        return values, np.where(np.abs(jacobian) > CANCELLED * lengths, jacobian, 0.0)

    def onto(self, numbers: Any, q: np.ndarray, free: Any, t: float = 0.0, contraction: float = np.inf):
        """The nearest positions where rows vanish, by Newton's iteration in the `free` coordinates, the values of all rows (k,) over their
        sizes, and whether these positions are reached.

        Args:
            numbers: of the rows.
            q: (n,) where the iteration starts.
            contraction: largest ratio of consecutive corrections, relative to scales.
        """
        previous, values = np.inf, np.empty(0)
        for _ in range(CORRECTIONS):
            values, jacobian = self.evaluate(t, q)
            values = values / self.sizes
            if np.abs(values[numbers]).max(initial=0.0) <= REACHED:
                return q, values, True
            scaled = jacobian[np.ix_(numbers, free)] * self.scales[free] / self.sizes[numbers, None]
            correction = np.linalg.lstsq(scaled, values[numbers], rcond=RANK)[0]
            size = np.linalg.norm(correction)
            if not size / contraction <= previous:
                break
            q, previous = q.copy(), size
            q[free] -= self.scales[free] * correction
        return q, values, False

    @cached_property
    def jacobian(self) -> np.ndarray:
        """The Jacobian (k, n) at the start."""
        return self.evaluate(0.0, self.start)[1]

    @cached_property
    def by_masses(self) -> np.ndarray:
        """`jacobian` with the columns over the square roots of masses, so that the entries of a row have one unit."""
        return self.jacobian / np.sqrt(np.where(self.masses > 0, self.masses, 1.0))

    @cached_property
    def sizes(self) -> np.ndarray:
        """(k,) change of each row in a large motion: the length of its gradient with respect to coordinates over `scales`; 1 if this is zero."""
        lengths = np.linalg.norm(self.jacobian * self.scales, axis=1)
        return np.where(lengths > 0, lengths, 1.0)

    def numbers(self, home: Home | None = None) -> list[int]:
        """Numbers of the kept rows, all or only the rows with a certain home."""
        return [i for i, row in enumerate(self.rows) if row.kept and home in (None, row.home)]


def _groups(rows: Sequence[Row], columns: dict[str | Key, np.ndarray]) -> Iterator[_Group]:
    """The elements of all constraints, of which these are all rows."""
    items = []
    for _, numbers in groupby(range(len(rows)), key=lambda k: (rows[k].part, rows[k].element)):
        effect, i = rows[(of_element := [*numbers])[0]].effect, rows[of_element[0]].element
        freedoms = [key for key in effect.freedoms_of(i) if key in columns]
        of_bodies = np.concatenate([columns[name] for name in (*moving(effect.elements[i]), *freedoms)])
        term, params = effect.element_term(i, freedoms)
        # a function of the user may be right for a single element alone
        alone = effect.is_analytic and not is_of_package(term.function) and of_element[0]
        items.append(((term, effect.is_analytic, alone), (params, of_bodies, np.array(of_element))))
    for (term, is_analytic, _), _, arrays in alike(items):
        yield _Group(term, is_analytic, *arrays)


@quickly_compiled
def _values_and_jacobians(functions: Sequence[TracedOnce], arguments, t):
    """Values (n, m) of n elements of each function, and their derivatives (n, m, c) by the coordinates of their bodies."""

    def of_element(function, q, params):
        def values(q):
            value = function(q, params, t)
            return value, value

        jacobian, value = jax.jacfwd(values, has_aux=True)(q)
        return value, jacobian

    return [
        jax.vmap(partial(of_element, function))(*of_function)
        for function, of_function in zip(functions, arguments, strict=True)
    ]


def _scales(sorting: Sorting) -> np.ndarray:
    """(n,) change of each coordinate in a large motion, see `ConstraintRows`."""
    points, layout = positions(sorting.bodies), sorting.layout
    # largest distance from the mean along an axis; of bodies at one place their largest coordinate, or 1 at the origin
    extent = float(np.abs(points - points.mean(axis=0)).max() or np.abs(points).max() or 1.0)
    scales = {place: np.full(1, 1.0 if key[2] in ANGLES else extent) for key, place in layout.freedoms.items()}
    for name, body in sorting.bodies.items():
        if name in layout.coordinates and layout.coordinates[name] not in scales:
            q = np.asarray(body.coordinates)
            of_points = np.where(np.arange(q.size) < LARGEST_POINT, extent, 1.0)
            of_block = np.full(q.size, np.abs(q).max() or 1.0)
            scales[layout.coordinates[name]] = of_block if body.block else of_points
    return np.concatenate(
        [scales[place] for place in sorted(scales, key=lambda place: (place.part == "f", place.start))]
    )


def names_of(sorting: Sorting) -> Names:
    """Bodies and constraints by name, in the order of the coordinates and of the rows."""
    sizes: dict[Any, dict[str, int]] = {"s": {}, "f": {}}
    for name, place in sorting.layout.coordinates.items():
        sizes[place.part][name] = place.size
    for home in HOMES:
        sizes[home] = dict(Counter(row.label for row in rows_of(sorting.placed) if row.kept and row.home == home))
    blocks, rigid = (
        [name for name, body in sorting.bodies.items() if getattr(body, kind)] for kind in ("block", "rigid")
    )
    carried = {name: place for name, place in sorting.layout.bodies.items() if name not in sorting.layout.coordinates}
    turning = {place for key, place in sorting.layout.freedoms.items() if key[2] in ANGLES}
    angles = [name for name, place in sorting.layout.coordinates.items() if place in turning]
    rows = sizes["constraint"], sizes["slow_constraint"]
    return Names(sizes["s"], sizes["f"], *rows, blocks, rigid, carried, sorting.layout.kinematics, angles=angles)
