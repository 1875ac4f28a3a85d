"""The functions of a `System` as sums of terms, the `System` of a sorted scene, and the forces of its controls.

All classes here are compared by value: scenes of the same structure give equal functions, which JAX compiles only once.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
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
from vmri_jax.mechanics.terms import KINDS, POSITIONS, VELOCITIES
from vmri_jax.refusals import Refused
from vmri_jax.scene.binding import Layout
from vmri_jax.scene.declare import arrays
from vmri_jax.scene.sorting import HOMES, Placed, Sorting, rows_of
from vmri_jax.scene.terms import joined, total

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

    def on_bodies(self, arguments) -> tuple[dict[str, Any], Any]:
        """Of the arguments of a call: "t", "q" with (Q_s, Q_f) and "v" with ``dQ/dq v``, as terms take them; and
        params."""
        *arguments, params = arguments
        names = ("t", *KINDS[self.field].arguments)[-len(arguments) :]  # rows that depend on time get t first
        values = dict(zip(names, arguments, strict=True))
        # the function does not depend on parts that it does not take
        zeros = tuple(map(jnp.zeros, self.kinematics.sizes))
        q, v = (tuple(map(values.get, pair, zeros)) for pair in (POSITIONS, VELOCITIES))
        if "v_s" not in values:
            return values | {"q": self.bodies(params)(*q)}, params
        q, v = jax.jvp(self.bodies(params), q, v)
        return values | {"q": q, "v": v}, params

    def bodies(self, params) -> Callable:
        """The map from (q_s, q_f) to (Q_s, Q_f)."""
        return lambda q_s, q_f: self.kinematics(q_s, q_f, params.get(JOINTS))

    def forces_on(self, q_s, q_f, params, forces):
        """Generalised forces on (q_s, q_f) of the sum F of forces on the coordinates of bodies: ``(dQ/dq)^T F``."""
        return jax.vjp(self.bodies(params), q_s, q_f)[1](total(forces))


class PotentialEnergy(_OfTerms):
    """V, W or V_i, the sum of its terms."""

    def __call__(self, *arguments):
        values, params = self.on_bodies(arguments)
        return total([term(values, params) for term in self.terms])


class ConstraintValues(_OfTerms):
    """g or g_s, the values of its terms one after the other; g_i, the values of the dropped rows over their sizes."""

    def __call__(self, *arguments):
        values, params = self.on_bodies(arguments)
        rows = jnp.concatenate([jnp.ravel(term(values, params)) for term in self.terms])
        rows = rows if self.rows is None else self.rows.take(rows)
        return rows / params[IMPLIED] if self.field == "implied" else rows


@dataclass(frozen=True)
class KineticEnergy(_OfTerms, WithMassMatrix):
    """``T = sum m V_f^2 / 2`` of bodies that depend on fast coordinates, plus the velocity-dependent terms;
    ``T_s = sum m V_s^2 / 2`` of all others.

    whole: the map from q to the coordinates of all bodies, whose masses T and T_s have together.
    """

    whole: Kinematics = UNCHANGED

    def __call__(self, *arguments):
        values, params = self.on_bodies(arguments)
        part, number = ("slow", 0) if self.field == "slow_kinetic" else ("fast", 1)
        of_bodies = jnp.sum(params[MASS][part] * values["v"][number] ** 2) / 2
        return total([of_bodies, *(term(values, params) for term in self.terms)])

    @property
    def has_mass_matrix(self) -> bool:
        return self.whole != UNCHANGED and not self.terms

    def mass_matrix(self, q_s, q_f, params, *others):
        fields = [energy.field for energy in (self, *others)]
        parts = (("slow", "slow_kinetic"), ("fast", "kinetic"))
        masses = [jnp.asarray(params[MASS][part]) * (field in fields) for part, field in parts]
        return self.whole.mass_matrix(q_s, q_f, params[JOINTS], masses)


class TotalForce(_OfTerms):
    """F, the sum of its terms."""

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        values, _ = self.on_bodies((t, q_s, q_f, v_s, v_f, params))
        return self.forces_on(q_s, q_f, params, [term.forces(values, params) for term in self.terms])


@dataclass(frozen=True)
class Actuation(_OfTerms):
    """Forces of controls, ``(q_s, q_f, u, params) -> (F_s, F_f)``; each effect has a term and names of its controls."""

    names: tuple[tuple[str, ...], ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all controls, in the order of u."""
        return tuple(chain(*self.names))

    def __call__(self, q_s, q_f, u, params):
        ends = np.cumsum([len(names) for names in self.names])[:-1]
        q, controls = self.bodies(params)(q_s, q_f), zip(self.terms, jnp.split(u, ends), strict=True)
        return self.forces_on(q_s, q_f, params, [term.forces({"q": q, "u": u}, params) for term, u in controls])


FUNCTIONS: dict[str, Any] = {
    "kinetic": KineticEnergy,
    "potential": PotentialEnergy,
    "constraint": ConstraintValues,
    "implied": ConstraintValues,
    "force": TotalForce,
}
"""For each kind of a function of `System`, the class that makes it of its terms."""


def check_names(names: Iterable[str], effects: Collection[str]) -> None:
    """Refuse names of bodies, effects and freedoms that occur twice, and names of effects that are `RESERVED`."""
    for name, count in Counter(names).items():
        if count > 1:
            raise Refused(
                f"Scene: the name {name!r} occurs twice among bodies, effects and freedoms of joints; give each its "
                "own, name=..."
            )
    for name, content in RESERVED.items():
        if name in effects:
            raise Refused(
                f"Scene: an effect is called {name!r}, where the params keep {content}; give it another name."
            )


def build(sorting: Sorting, placed: Sequence[Placed]) -> System:
    """The system of the bodies and of some or all effects; a function without effects is None."""
    layout = sorting.layout
    parts: dict[Any, list[Placed]] = {}
    for part in placed:
        for home in (part.home, "implied") if part.dropped else (part.home,):
            parts.setdefault(home, []).append(part)
    parts = {home: of_home for home, of_home in parts.items() if home != "control"}
    # with joint coordinates the masses depend on positions, so that T is a function even without kinetic effects
    if layout.kinematics is not None:
        parts.setdefault("kinetic", [])
    if "kinetic" in parts and layout.sizes[0]:
        parts["slow_kinetic"] = []
    taken = _taken(placed, layout) if "implied" in parts else {}
    functions: dict[str, Any] = {"potentials": {}}
    for home, of_home in parts.items():
        terms, kinematics = _terms(of_home, layout, {"kinetic": "f", "slow_kinetic": "s"}.get(home, ""))
        if not terms and of_home:
            continue  # Rayleigh damping of no potential
        is_rows = home in (*HOMES, "implied")  # whose values keep the order of `rows_of`
        terms = joined(terms, in_order=is_rows)
        field = home if home in KINDS else "potentials"  # a potential with a rate of its own
        of_masses = (layout.kinematics or UNCHANGED,) if KINDS[field].kind == "kinetic" else ()
        function = FUNCTIONS[KINDS[field].kind](field, terms, kinematics, taken.get(home), *of_masses)
        if field == "potentials":
            functions[field][home] = function
        else:
            functions[home] = (
                Rheonomic(function) if is_rows and any("t" in term.arguments for term in terms) else function
            )
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
    marked: dict[Any, list] = {home: [row.kept for row in rows if row.home == home] for home in HOMES}
    marked["implied"] = [not row.kept for row in rows if placed[row.part].dropped]
    return {home: Entries(tuple(of_home)) for home, of_home in marked.items()}


def actuation(sorting: Sorting) -> Actuation | None:
    """The forces of the controls of a scene, None if it has no controls."""
    layout = sorting.layout
    controls: list[Any] = [part for part in sorting.placed if part.home == "control"]
    terms, kinematics = _terms(controls, layout)
    names = tuple(part.effect.components() for part in controls)
    return Actuation("control", tuple(terms), kinematics, names=names) if controls else None


def _terms(parts: Sequence[Placed], layout: Layout, with_masses_of: str = "") -> tuple[list[Any], Kinematics]:
    """The terms of some elements, and the map from q to the coordinates of the bodies on which they depend.

    The kinetic energy with the masses of a part, "s" or "f", depends on all bodies of this part.
    """

    def terms(layout: Layout) -> list[Any]:
        return [term for part in parts for term in part.effect.terms(part.elements, layout)]

    touched = {place for term in terms(layout) for place in term.places}
    names = [name for name, place in layout.bodies.items() if place in touched or place.part == with_masses_of]
    of_bodies = layout.of(names)
    kinematics = of_bodies.kinematics or UNCHANGED
    return terms(of_bodies), kinematics if kinematics.bodies or with_masses_of else UNCHANGED
