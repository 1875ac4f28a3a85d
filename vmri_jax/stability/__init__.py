"""Stability of a step: maps of stable and unstable steps, multipliers along a trajectory, advice before a long run."""

from vmri_jax.stability.advice import Advice, Finding, advise
from vmri_jax.stability.map import StabilityMap, Window, plot_stability, stability_map
from vmri_jax.stability.multipliers import Monodromy, Multipliers, monodromy, multipliers
from vmri_jax.stability.oscillator import linear_model

__all__ = [
    "Advice",
    "Finding",
    "Monodromy",
    "Multipliers",
    "StabilityMap",
    "Window",
    "advise",
    "linear_model",
    "monodromy",
    "multipliers",
    "plot_stability",
    "stability_map",
]
