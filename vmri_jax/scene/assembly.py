"""The `System` of a sorted scene, and the forces of its controls."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.scene.layout import join
from vmri_jax.scene.sorting import Placed, Sorting
from vmri_jax.scene.terms import FUNCTIONS, IMPLIED, MASS, Actuation, DroppedRows, SomeRows


def build(sorting: Sorting, placed: Sequence[Placed]) -> System:
    """The system of these bodies with these effects; functions, constraints and forces that nothing calls for are None.

    Args:
        sorting: bodies at their places.
        placed: the effects, all of the sorting or some.
    """
    bodies, places = sorting.bodies, sorting.places
    potentials: dict[str, tuple] = {}
    terms: dict[str, list] = {}
    for part in sorted(placed, key=lambda part: part.effect.kind != "potential"):  # forces may build on potentials
        name, made = part.effect.name, part.effect.terms(part.elements, bodies, places, potentials)
        if part.effect.kind == "potential":
            potentials[name] = (*potentials.get(name, ()), *made)
        terms.setdefault(part.home, []).extend([SomeRows(made, part.dropped)] if part.dropped else made)
        if part.dropped:
            terms.setdefault("implied", []).append(DroppedRows(made, part.dropped))
    functions: dict[str, Any] = {home: FUNCTIONS[home](tuple(terms[home])) for home in FUNCTIONS if terms.get(home)}
    for home in ("constraint", "slow_constraint", "implied"):
        if any(term.timed for term in terms.get(home, ())):
            functions[home] = Rheonomic(functions[home])
    params: dict[str, Any] = {part.effect.name: part.effect.parameters(bodies) for part in placed}
    slow, fast = (join(bodies, places, part, "masses") for part in ("s", "f"))
    if "kinetic" in functions:
        params[MASS] = {"slow": slow, "fast": fast}
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
    terms = [part.effect.terms(part.elements, sorting.bodies, sorting.places, {}) for part in controls]
    names = tuple(part.effect.components(sorting.bodies) for part in controls)
    return Actuation(tuple(term for (term,) in terms), names) if controls else None
