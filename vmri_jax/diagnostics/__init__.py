"""Quantities that a discrete trajectory should conserve, and measurements of them."""

from vmri_jax.diagnostics.linear import step_condition
from vmri_jax.diagnostics.orders import OrderFit, fit_order
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
from vmri_jax.mechanics.linearisation import Linearisation, linearise

__all__ = [
    "Linearisation",
    "OrderFit",
    "ShadowEnergy",
    "all_constraints",
    "constraint_residual",
    "energy",
    "energy_parts",
    "fit_order",
    "linearise",
    "momentum_map",
    "oscillatory_energies",
    "rotation_about",
    "shadow_energy",
    "step_condition",
    "translation_along",
    "velocity",
]
