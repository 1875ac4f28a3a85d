"""Stability of a step: maps of stable and unstable steps, multipliers along a trajectory, advice before a long run."""

from vmri_jax.stability.advice import Advice, Finding, advise
from vmri_jax.stability.figures import plot_stability
from vmri_jax.stability.linear import SmallMotions, linear_model, small_motions
from vmri_jax.stability.map import StabilityMap, Window, stability_map
from vmri_jax.stability.multipliers import Monodromy, Multipliers, monodromy, multipliers
from vmri_jax.stability.vibrations import Vibration, Vibrations, vibrations

__all__ = [
    "Advice",
    "Finding",
    "Monodromy",
    "Multipliers",
    "SmallMotions",
    "StabilityMap",
    "Vibration",
    "Vibrations",
    "Window",
    "advise",
    "linear_model",
    "monodromy",
    "multipliers",
    "plot_stability",
    "small_motions",
    "stability_map",
    "vibrations",
]
