"""The `System` of a sorted scene, and the forces of its controls."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vmri_jax.mechanics.kinematics import Kinematics
from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.scene.layout import Layout, join
from vmri_jax.scene.sorting import Placed, Sorting
from vmri_jax.scene.terms import FUNCTIONS, IMPLIED, JOINTS, MASS, Actuation, DroppedRows, SomeRows


def build(sorting: Sorting, placed: Sequence[Placed]) -> System:
    """The system of these bodies with these effects; functions, constraints and forces that nothing calls for are None.

    Args:
        sorting: bodies at their places.
        placed: the effects, all of the sorting or some.
    """
    bodies, where = sorting.bodies, sorting.layout
    potentials: dict[str, tuple] = {}
    terms: dict[Any, list] = {}
    for part in sorted(placed, key=lambda part: part.effect.kind != "potential"):  # forces may build on potentials
        name, made = part.effect.name, part.effect.terms(part.elements, bodies, where, potentials)
        if part.effect.kind == "potential":
            potentials[name] = (*potentials.get(name, ()), *made)
        terms.setdefault(part.home, []).extend([SomeRows(made, part.dropped)] if part.dropped else made)
        if part.dropped:
            terms.setdefault("implied", []).append(DroppedRows(made, part.dropped))
    if where.kinematics is not None:
        terms.setdefault("kinetic", [])
    if "kinetic" in terms and where.sizes[0]:
        terms["slow_kinetic"] = []
    functions: dict[str, Any] = {
        home: FUNCTIONS[home](tuple(terms[home]), _kinematics(home, terms[home], where))
        for home in FUNCTIONS
        if terms.get(home) or ("kinetic" in home and home in terms)
    }
    named = [home for home in terms if home == "fast" or isinstance(home, int)]
    if named:
        functions["potentials"] = {
            home: FUNCTIONS["slow_potential"](tuple(terms[home]), _kinematics("potentials", terms[home], where))
            for home in named
        }
    for home in ("constraint", "slow_constraint", "implied"):
        if any(term.timed for term in terms.get(home, ())):
            functions[home] = Rheonomic(functions[home])
    params: dict[str, Any] = {part.effect.name: part.effect.parameters(bodies) for part in placed}
    slow, fast = (join(bodies, where, part, "masses") for part in ("s", "f"))
    if "kinetic" in functions:
        params[MASS] = {"slow": slow, "fast": fast}
    if where.kinematics is not None:
        params[JOINTS] = sorting.joints
    if "implied" in functions:
        params[IMPLIED] = np.concatenate([part.sizes for part in placed])
    kinetic = functions.pop("kinetic", None) or ConstantMass(slow, fast)
    return System(kinetic, **functions, params=params)


def actuation(sorting: Sorting) -> Actuation | None:
    """The forces of the controls of a scene, None where nothing is controlled.

    Args:
        sorting: bodies at their places, effects at their homes.
    """
    controls = [part for part in sorting.placed if part.home == "control"]
    made = [part.effect.terms(part.elements, sorting.bodies, sorting.layout, {}) for part in controls]
    terms = tuple(term for (term,) in made)
    names = tuple(part.effect.components(sorting.bodies) for part in controls)
    return Actuation(terms, _kinematics("control", terms, sorting.layout), names) if controls else None


def _kinematics(home: str, terms: Sequence, layout: Layout) -> Kinematics | None:
    """The kinematics, unless the terms take nothing but coordinates of the scene; of a kinetic energy then those of its own bodies."""
    if layout.kinematics is None or not all(term.within(layout.sizes) for term in terms):
        return layout.kinematics
    own = {"kinetic": layout.kinematics.of_fast, "slow_kinetic": layout.kinematics.of_slow}
    return own.get(home)
