"""The `System` of a sorted scene, and the forces of its controls."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vmri_jax.mechanics.kinematics import JOINTS, MASS, Kinematics
from vmri_jax.mechanics.rows import Entries
from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.mechanics.terms import KINDS
from vmri_jax.scene.declare import arrays
from vmri_jax.scene.functions import FUNCTIONS, IMPLIED, Actuation
from vmri_jax.scene.layout import Layout
from vmri_jax.scene.rows import rows_of
from vmri_jax.scene.sorting import HOMES, Placed, Sorting
from vmri_jax.scene.terms import joined


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
    taken = _taken(placed) if "implied" in terms else {}
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


def _taken(placed: Sequence[Placed]) -> dict[Any, Entries]:
    """The rows that each function of constraints takes of its terms."""
    rows = rows_of(placed)
    taken: dict[Any, Entries] = {home: Entries.of([row.kept for row in rows if row.home == home]) for home in HOMES}
    return taken | {"implied": Entries.of([not row.kept for row in rows if placed[row.part].dropped])}


def actuation(sorting: Sorting) -> Actuation | None:
    """The forces of the controls of a scene, None if it has no controls."""
    layout = sorting.layout
    controls: list[Any] = [part for part in sorting.placed if part.home == "control"]
    terms = tuple(part.effect.terms(part.elements, layout)[0] for part in controls)
    names = tuple(part.effect.components() for part in controls)
    return Actuation("control", terms, _kinematics("control", terms, layout), names=names) if controls else None


def _kinematics(home: str, terms: Sequence, layout: Layout) -> Kinematics | None:
    """The map from q to Q that a function with these terms needs; None if its terms depend on coordinates of the scene alone."""
    if layout.kinematics is None or not all(term.within(layout.sizes) for term in terms):
        return layout.kinematics
    # a kinetic energy needs in any case the bodies on joints whose masses are part of it
    part: Any = {"kinetic": "f", "slow_kinetic": "s"}.get(home)
    return layout.kinematics.of(part) if part else None
