"""The rows of a scene's constraints: names, also of coordinates, values and Jacobian at any positions."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, quickly_compiled, split_at
from vmri_jax.mechanics.constraints import RANK
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.mechanics.names import Names
from vmri_jax.scene.body import LARGEST_POINT
from vmri_jax.scene.declare import stacked
from vmri_jax.scene.effects.joint_base import ANGLES
from vmri_jax.scene.functions import ConstraintValues
from vmri_jax.scene.rates import positions
from vmri_jax.scene.sorting import HOMES, Home, Row, Sorting, rows_of
from vmri_jax.scene.terms import EffectTerm, Role

CANCELLED = 1e-14
"""An entry of the Jacobian dg/dq is the product of the row dg/dQ and the column dQ/dq. If it is below this fraction of
the product of their lengths it is round-off and set to zero, as for the rows that hold a planar loop in its plane. A
larger value removes rows with short levers; with a smaller value round-off counts as an independent row."""

REACHED = 1e-12
"""Newton's iteration ends when rows, relative to their sizes, are below this value, which is near round-off. With a
larger value loops have a visible gap, which the initial state refuses, and dropped rows carry the remaining error."""
COMPLEX_STEP = 1e-30
"""Imaginary step h of derivatives, in any unit: its square is below round-off of every value. A larger step is felt in
values; a smaller one may underflow in products."""
CORRECTIONS = 20
"""Most corrections of Newton's iteration; from nearby six reach round-off.

More only delay the message that it fails.
"""


def _derivatives(
    term: EffectTerm, params: Any, t: float, q: np.ndarray, num_slow: int
) -> tuple[np.ndarray, np.ndarray]:
    """Values (k,) of a term of analytic functions and their derivatives (k, n) by q = (Q_s, Q_f), by complex steps for
    all elements at once.

    ``g(q + i h e) = g + i h dg/dq e`` to round-off, with a tiny h.
    """
    roles = [role for (role,) in term.roles]
    of_roles = [_columns(role, num_slow) for role in roles]
    columns = np.concatenate(of_roles, axis=-1)  # (n, c), or (c,) of a single element
    steps = 1j * COMPLEX_STEP * np.eye(columns.shape[-1])
    x = q[columns] + (steps if columns.ndim == 1 else steps[:, None])
    parts = np.split(x, np.cumsum([of_role.shape[-1] for of_role in of_roles])[:-1], axis=-1)
    params = term.params_of(params)
    points = term.of_roles([role.of_bodies(x, params) for role, x in zip(roles, parts, strict=True)], params)
    arguments = map({"t": np.asarray(t), "q": points}.get, term.arguments)
    values = np.asarray(term.function(*arguments, params))
    columns = np.atleast_2d(columns)
    values = values.reshape(*columns.shape[::-1], -1)  # of each step, element, and row of the element
    rows, jacobian = np.arange(values[0].size).reshape(*values.shape[1:], 1), np.zeros((values[0].size, q.size))
    # added: a body that stands in for the ground has its columns twice
    np.add.at(jacobian, (rows, columns[:, None]), np.moveaxis(np.imag(values), 0, -1) / COMPLEX_STEP)
    return np.real(values[0]).ravel(), jacobian


def _columns(role: Role, num_slow: int) -> Any:
    """Numbers in (Q_s, Q_f) of the coordinates of a role, (n, c), or (c,) of a single element; none for the ground."""
    if role.rows is None:
        return stacked([np.zeros(0, int)] * role.count)
    return stacked([place.numbers(num_slow)[: role.rows.size] for place in role.rows.places])


@quickly_compiled
def _compiled_derivatives(functions: Sequence[TracedOnce], params, t, q_s, q_f):
    """Values and derivatives as of `_derivatives` of each function, which may be of the user: one program for all."""

    def values(q, function):
        value = function(t, *split_at(q, q_s.size), params)
        return value, value

    q = jnp.concatenate([q_s, q_f])
    return [jax.jacfwd(values, has_aux=True)(q, function)[::-1] for function in functions]


@dataclass(frozen=True)
class ConstraintRows:
    """The k rows of all constraints of a scene, in the order of `Sorting.placed`, over its n coordinates, slow ones
    first."""

    sorting: Sorting

    @classmethod
    def of(cls, sorting: Sorting) -> "ConstraintRows | None":
        """The rows of a scene; None if it has none, or if their numbers are traced."""
        rows = cls(sorting)
        return rows if rows.params and is_concrete((sorting.positions, sorting.joints, rows.params)) else None

    @cached_property
    def rows(self) -> list[Row]:
        """The names and origins of the rows."""
        return rows_of(self.sorting.placed, self.sorting.layout)

    @cached_property
    def params(self) -> dict[str, Any]:
        """The parameters of the constraints."""
        return {part.effect.name: part.effect.parameters for part in self.sorting.placed if part.home in HOMES}

    @cached_property
    def terms(self) -> list[tuple[EffectTerm, bool]]:
        """The terms of the rows, and whether their functions are analytic, see `Effect.is_analytic`."""
        layout, constraints = self.sorting.layout, (part for part in self.sorting.placed if part.home in HOMES)
        terms = ((part.effect, part.effect.terms(part.elements, layout)) for part in constraints)
        return [(term, effect.is_analytic) for effect, of_effect in terms for term in of_effect]

    def evaluate(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values g (k,) and Jacobian dg/dq (k, n) at a time and at positions (n,)."""
        q_bodies, by_coordinates = self.sorting.to_bodies(q)
        n_s, others = self.sorting.layout.ends[0], [term for term, is_analytic in self.terms if not is_analytic]
        functions = [TracedOnce(ConstraintValues("constraint", (term,))) for term in others]
        arguments = self.params, float(t), *split_at(q_bodies, n_s)
        of_others = iter(jax.device_get(_compiled_derivatives(functions, *arguments)) if others else ())
        parts = [
            _derivatives(term, self.params, t, q_bodies, n_s) if is_analytic else next(of_others)
            for term, is_analytic in self.terms
        ]
        values, by_bodies = (np.concatenate(of_parts) for of_parts in zip(*parts, strict=True))
        # dg/dq = dg/dQ dQ/dq, without entries that are round-off
        jacobian = by_bodies @ by_coordinates
        lengths = np.linalg.norm(by_bodies, axis=1)[:, None] * np.sqrt((by_coordinates * by_coordinates).sum(axis=0))
        return values, np.where(np.abs(jacobian) > CANCELLED * lengths, jacobian, 0.0)

    def onto(self, numbers: Any, q: np.ndarray, free: Any, t: float = 0.0, contraction: float = np.inf):
        """The nearest positions where rows vanish, by Newton's iteration in the `free` coordinates, the values of all
        rows (k,) over their sizes, and whether these positions are reached.

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
        return self.evaluate(0.0, self.sorting.positions)[1]

    @cached_property
    def by_masses(self) -> np.ndarray:
        """`jacobian` with the columns over the square roots of masses, so that the entries of a row have one unit.

        The masses of coordinates are the diagonal of J^T M J with J = dQ/dq; 1 if masses are traced, since they only
        weigh the choice of the rows to drop.
        """
        of_bodies, masses = self.sorting.of_bodies("masses"), np.ones(1)
        if is_concrete(of_bodies):
            jacobian = self.sorting.to_bodies(self.sorting.positions)[1]
            masses = of_bodies @ (jacobian * jacobian)
        return self.jacobian / np.sqrt(np.where(masses > 0, masses, 1.0))

    @cached_property
    def scales(self) -> np.ndarray:
        """(n,) change of each coordinate in a large motion: the extent of the scene for positions, 1 for directors of
        rigid bodies and angles of joints, and for general coordinates their largest value, or 1 if all are zero."""
        sorting, layout, points = self.sorting, self.sorting.layout, positions(self.sorting.bodies)
        # largest distance from the mean along an axis; of bodies at one place their largest coordinate, or 1 at the
        # origin
        extent = float(np.abs(points - points.mean(axis=0)).max() or np.abs(points).max() or 1.0)
        numbers, scales = layout.numbers, np.zeros(self.sorting.positions.size)
        for name in layout.coordinates.keys() & sorting.bodies.keys():
            body = sorting.bodies[name]
            largest = np.abs(np.asarray(body.coordinates)).max() or 1.0
            of_points = np.where(np.arange(body.size) < LARGEST_POINT, extent, 1.0)
            scales[numbers[name]] = largest if body.block else of_points
        for key in layout.freedoms:
            scales[numbers[key]] = 1.0 if key[2] in ANGLES else extent
        return scales

    @cached_property
    def sizes(self) -> np.ndarray:
        """(k,) change of each row in a large motion: the length of its gradient with respect to coordinates over
        `scales`; 1 if this is zero."""
        lengths = np.linalg.norm(self.jacobian * self.scales, axis=1)
        return np.where(lengths > 0, lengths, 1.0)

    def numbers(self, home: Home | None = None) -> list[int]:
        """Numbers of the kept rows, all or only the rows with a certain home."""
        return [i for i, row in enumerate(self.rows) if row.kept and home in (None, row.home)]


def names_of(sorting: Sorting) -> Names:
    """Bodies and constraints by name, in the order of the coordinates and of the rows."""
    sizes: dict[Any, dict[str, int]] = {"s": {}, "f": {}}
    for name, place in sorting.layout.coordinates.items():
        sizes[place.part][name] = place.size
    for home in HOMES:
        sizes[home] = dict(
            Counter(row.label for row in rows_of(sorting.placed, sorting.layout) if row.kept and row.home == home)
        )
    blocks, rigid = (
        [name for name, body in sorting.bodies.items() if getattr(body, kind)] for kind in ("block", "rigid")
    )
    carried = {name: place for name, place in sorting.layout.bodies.items() if name not in sorting.layout.coordinates}
    turning = {place for key, place in sorting.layout.freedoms.items() if key[2] in ANGLES}
    angles = [name for name, place in sorting.layout.coordinates.items() if place in turning]
    rows = sizes["constraint"], sizes["slow_constraint"]
    return Names(sizes["s"], sizes["f"], *rows, blocks, rigid, carried, sorting.layout.kinematics, angles=angles)
