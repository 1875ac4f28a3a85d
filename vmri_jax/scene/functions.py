"""The functions of a `System` as sums of terms, the `System` of a sorted scene, and the forces of its controls.

All classes here are compared by value: scenes of the same structure give equal functions, which JAX compiles only once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.kinematics import JOINTS, MASS, Kinematics
from vmri_jax.mechanics.masses import WithMassMatrix
from vmri_jax.mechanics.rows import Entries
from vmri_jax.mechanics.slots import Computed
from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.mechanics.terms import KINDS
from vmri_jax.scene.binding import Layout
from vmri_jax.scene.declare import arrays
from vmri_jax.scene.sorting import HOMES, Placed, Sorting, rows_of
from vmri_jax.scene.terms import joined, total, totals

IMPLIED = Computed("implied")
"""Key of params that holds the sizes of the dropped rows."""
UNCHANGED = Kinematics((), (), (), (0, 0))
"""The map from q to Q of functions whose terms depend on coordinates of the scene alone: Q = q."""
RESERVED = {
    MASS: "the masses",
    IMPLIED: "the sizes of rows that are left out",
    JOINTS: "the points and axes of joints that carry bodies",
}
"""Keys of params that no effect may have as its name, and their content, for messages."""


@dataclass(frozen=True)
class _OfTerms:
    """A function of a `System`, made of terms of the coordinates Q of bodies; compared by class and fields.

    field: the argument of `System`, see `vmri_jax.mechanics.terms.KINDS`.
    kinematics: the map from the coordinates q of the scene to Q.
    rows: of a constraint, those that are taken; None for all.
    """

    field: str
    terms: tuple[Any, ...]
    kinematics: Kinematics = UNCHANGED
    rows: Entries | None = None

    def by_name(self, arguments) -> tuple[Any, ...]:
        """(t, q_s, q_f, v_s, v_f, params) of the arguments of a call, with None for those that the function does not take."""
        *arguments, params = arguments
        names = ("t", *KINDS[self.field].arguments)[-len(arguments) :]  # rows that depend on time get t first
        values = dict(zip(names, arguments, strict=True))
        return *map(values.get, ("t", "q_s", "q_f", "v_s", "v_f")), params

    def bodies(self, q_s, q_f, params) -> tuple[Any, Any]:
        """(Q_s, Q_f) of q_s and q_f; one of these may be None if the terms do not depend on it, and zeros take its place."""
        slow, fast = (jnp.zeros(n) if q is None else q for q, n in zip((q_s, q_f), self.kinematics.sizes, strict=True))
        return self.kinematics(slow, fast, params.get(JOINTS))

    def motions(self, q_s, q_f, v_s, v_f, params):
        """Coordinates (Q_s, Q_f) of the bodies, and their velocities (V_s, V_f), ``V = dQ/dq v``."""
        return jax.jvp(lambda q_s, q_f: self.bodies(q_s, q_f, params), (q_s, q_f), (v_s, v_f))

    def forces_on(self, q_s, q_f, params, forces):
        """Generalised forces on (q_s, q_f) of forces F on the coordinates of bodies: ``(dQ/dq)^T F``."""
        return jax.vjp(lambda q_s, q_f: self.bodies(q_s, q_f, params), q_s, q_f)[1](forces)


class PotentialEnergy(_OfTerms):
    """V, W or V_i, the sum of its terms."""

    def __call__(self, *arguments):
        _, q_s, q_f, *_, params = self.by_name(arguments)
        bodies = self.bodies(q_s, q_f, params)
        return total([term.value(*bodies, params) for term in self.terms])


class ConstraintValues(_OfTerms):
    """g or g_s, the values of its terms one after the other; g_i, the values of the dropped rows over their sizes."""

    def __call__(self, *arguments):
        t, q_s, q_f, *_, params = self.by_name(arguments)
        bodies = self.bodies(q_s, q_f, params)
        values = jnp.concatenate([jnp.ravel(term.value(*bodies, params, t)) for term in self.terms])
        values = values if self.rows is None else self.rows.take(values)
        return values / params[IMPLIED] if self.field == "implied" else values


class KineticEnergy(_OfTerms, WithMassMatrix):
    """``T = sum m V_f^2 / 2`` of bodies that depend on fast coordinates, plus the velocity-dependent terms; ``T_s = sum m V_s^2 / 2`` of all others."""

    def __call__(self, *arguments):
        _, q_s, q_f, v_s, v_f, params = self.by_name(arguments)
        part, number = ("slow", 0) if self.field == "slow_kinetic" else ("fast", 1)
        if q_f is None:
            q_f = v_f = jnp.zeros(self.kinematics.sizes[1])
        bodies, rates = self.motions(q_s, q_f, v_s, v_f, params)
        of_bodies = jnp.sum(params[MASS][part] * rates[number] ** 2) / 2
        return total([of_bodies, *(term.kinetic(*bodies, *rates, params) for term in self.terms)])

    @property
    def has_mass_matrix(self) -> bool:
        return self.kinematics != UNCHANGED and not self.terms

    def mass_matrix(self, q_s, q_f, params):
        if q_f is not None:
            return self.kinematics.mass_matrix(q_s, q_f, params[JOINTS], jnp.asarray(params[MASS]["fast"]), "f")
        n_s, n_f = self.kinematics.sizes
        masses = jnp.asarray(params[MASS]["slow"])
        return self.kinematics.mass_matrix(q_s, jnp.zeros(n_f), params[JOINTS], masses, "s")[:n_s, :n_s]


class TotalForce(_OfTerms):
    """F, the sum of its terms."""

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        bodies, rates = self.motions(q_s, q_f, v_s, v_f, params)
        forces = totals([term.forces(t, *bodies, *rates, params) for term in self.terms])
        return self.forces_on(q_s, q_f, params, forces)


@dataclass(frozen=True)
class Actuation(_OfTerms):
    """Forces of controls, ``(q_s, q_f, u, params) -> (F_s, F_f)``; each effect has a term and names of its controls."""

    names: tuple[tuple[str, ...], ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all controls, in the order of u."""
        return tuple(chain(*self.names))

    def __call__(self, q_s, q_f, u, params):
        ends, bodies = np.cumsum([len(names) for names in self.names])[:-1], self.bodies(q_s, q_f, params)
        controls = zip(self.terms, jnp.split(u, ends), strict=True)
        forces = totals([term.controlled(*bodies, u_effect, params) for term, u_effect in controls])
        return self.forces_on(q_s, q_f, params, forces)


FUNCTIONS: dict[str, Any] = {
    "kinetic": KineticEnergy,
    "potential": PotentialEnergy,
    "constraint": ConstraintValues,
    "implied": ConstraintValues,
    "force": TotalForce,
}
"""For each kind of a function of `System`, the class that makes it of its terms."""


def build(sorting: Sorting, placed: Sequence[Placed]) -> System:
    """The system of the bodies and of some or all effects; a function without effects is None."""
    layout = sorting.layout
    terms: dict[Any, list] = {}
    for part in placed:
        for home in (part.home, "implied") if part.dropped else (part.home,):
            terms.setdefault(home, []).extend(part.effect.terms(part.elements, layout))
    terms = {home: of_home for home, of_home in terms.items() if of_home and home != "control"}
    # with joint coordinates the masses depend on positions, so that T is a function even without kinetic effects
    if layout.kinematics is not None:
        terms.setdefault("kinetic", [])
    if "kinetic" in terms and layout.sizes[0]:
        terms["slow_kinetic"] = []
    taken = _taken(placed, layout) if "implied" in terms else {}
    functions: dict[str, Any] = {"potentials": {}}
    for home, of_home in terms.items():
        is_rows = home in (*HOMES, "implied")  # whose values keep the order of `rows_of`
        of_home = joined(of_home, in_order=is_rows)
        field = home if home in KINDS else "potentials"  # a potential with a rate of its own
        function = FUNCTIONS[KINDS[field].kind](field, of_home, _kinematics(home, of_home, layout), taken.get(home))
        if field == "potentials":
            functions[field][home] = function
        else:
            functions[home] = Rheonomic(function) if is_rows and any(term.timed for term in of_home) else function
    params: dict[str, Any] = {part.effect.name: arrays(part.effect.parameters) for part in placed}
    masses, num_slow = sorting.of_bodies("masses"), layout.ends[0]
    slow, fast = masses[:num_slow], masses[num_slow:]
    if "kinetic" in functions:
        params[MASS] = {"slow": slow, "fast": fast}
    if layout.kinematics is not None:
        params[JOINTS] = sorting.joints
    if "implied" in functions:
        params[IMPLIED] = np.concatenate([part.sizes for part in placed])
    kinetic = functions.pop("kinetic", None) or ConstantMass(slow, fast)
    return System(kinetic, **functions, params=params)


def _taken(placed: Sequence[Placed], layout: Layout) -> dict[Any, Entries]:
    """The rows that each function of constraints takes of its terms."""
    rows = rows_of(placed, layout)
    taken: dict[Any, Entries] = {home: Entries.of([row.kept for row in rows if row.home == home]) for home in HOMES}
    return taken | {"implied": Entries.of([not row.kept for row in rows if placed[row.part].dropped])}


def actuation(sorting: Sorting) -> Actuation | None:
    """The forces of the controls of a scene, None if it has no controls."""
    layout = sorting.layout
    controls: list[Any] = [part for part in sorting.placed if part.home == "control"]
    terms = tuple(part.effect.terms(part.elements, layout)[0] for part in controls)
    names = tuple(part.effect.components() for part in controls)
    return Actuation("control", terms, _kinematics("control", terms, layout), names=names) if controls else None


def _kinematics(home: str, terms: Sequence, layout: Layout) -> Kinematics:
    """The map from q to Q that a function with these terms needs."""
    kinematics = layout.kinematics or UNCHANGED
    if not all(term.within(layout.sizes) for term in terms):
        return kinematics
    # a kinetic energy needs in any case the bodies on joints whose masses are part of it
    part: Any = {"kinetic": "f", "slow_kinetic": "s"}.get(home)
    return kinematics.of(part) if part else UNCHANGED
