"""Quantities that a discrete trajectory should conserve, and measurements of them."""

from vmri_jax.diagnostics.linear import frequencies, step_condition, symplectic_defect, tangents
from vmri_jax.diagnostics.orders import OrderFit, fit_order, observed_order
from vmri_jax.diagnostics.shadow import ShadowEnergy, shadow_energy
from vmri_jax.mechanics.invariants import (
    all_constraints,
    constraint_residual,
    energy,
    energy_parts,
    momentum_map,
    oscillatory_energies,
    rotation_about,
    translation_along,
    velocity,
)

__all__ = [
    "OrderFit",
    "ShadowEnergy",
    "all_constraints",
    "constraint_residual",
    "energy",
    "energy_parts",
    "fit_order",
    "frequencies",
    "momentum_map",
    "observed_order",
    "oscillatory_energies",
    "rotation_about",
    "shadow_energy",
    "step_condition",
    "symplectic_defect",
    "tangents",
    "translation_along",
    "velocity",
]
