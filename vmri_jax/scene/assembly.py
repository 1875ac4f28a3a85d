"""The `System` of bodies and effects whose places are known."""

from collections.abc import Mapping, Sequence

from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.scene.body import Body
from vmri_jax.scene.layout import Place, join
from vmri_jax.scene.sorting import Placed
from vmri_jax.scene.terms import (
    MASS,
    FastPotential,
    KineticEnergy,
    MacroConstraint,
    MicroConstraint,
    SlowPotential,
    TotalForce,
)


def build(bodies: Mapping[str, Body], places: Mapping[str, Place], placed: Sequence[Placed]) -> System:
    """The system of these bodies with these effects; functions, constraints and forces that nothing calls for are None."""
    potentials = {}
    terms: dict[str, list] = {}
    for part in sorted(placed, key=lambda part: part.effect.kind != "potential"):  # forces may build on potentials
        made = part.effect.terms(part.elements, bodies, places, potentials)
        if part.effect.kind == "potential":
            potentials[part.effect.name] = (*potentials.get(part.effect.name, ()), *made)
        terms.setdefault(part.home, []).extend(made)

    def made_of(home: str, function):
        return function(tuple(terms[home])) if terms.get(home) else None

    def held_by(home: str, function):
        made = made_of(home, function)
        return Rheonomic(made) if made and any(term.timed for term in terms[home]) else made

    params = {part.effect.name: part.effect.parameters(bodies) for part in placed}
    slow, fast = (join(bodies, places, part, "mass") for part in ("s", "f"))
    kinetic = made_of("kinetic", KineticEnergy)
    if kinetic is not None:
        params[MASS] = {"slow": slow, "fast": fast}
    return System(
        ConstantMass(slow, fast) if kinetic is None else kinetic,
        slow_potential=made_of("slow_potential", SlowPotential),
        fast_potential=made_of("fast_potential", FastPotential),
        constraint=held_by("constraint", MicroConstraint),
        slow_constraint=held_by("slow_constraint", MacroConstraint),
        force=made_of("force", TotalForce),
        params=params,
    )
