"""Quantities of a run that the store keeps: arrays by name, which a worker computes from the saved nodes of the run."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from vmri_jax.accuracy.companions import resting
from vmri_jax.catalogue import imported
from vmri_jax.mechanics.checks import traced
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.mechanics.names import near
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused
from vmri_jax.running.export import DIMENSIONS
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.store.layout import Kept
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.scheme import fully_implicit

LEVELS = (0.05, 0.5, 0.95)
"""Probabilities of the quantiles over the saved nodes: the median, and an interval with 90 % of them."""
Saved = str | Callable[[Trajectory], Any]
"""An entry of the argument ``save`` of `vmri_jax.ensemble`."""
Quantity = Callable[[Trajectory], dict[str, Kept]]
"""A function of a single run that returns arrays by name."""


def _end(run: Trajectory) -> dict[str, Kept]:
    words = {"q": "positions at the end", "p": "momenta at the end"}
    ends = {name: getattr(run.states, name)[-1] for name in ("q_s", "q_f", "p_s", "p_f")}
    return {name: Kept(array, DIMENSIONS[name][1:], words[name[0]]) for name, array in ends.items()}


def _nodes(run: Trajectory) -> dict[str, Kept]:
    arrays = vars(run.states) | {"energy": run.energy}
    axes = {name: ("node", *DIMENSIONS[name][1:]) for name in arrays}
    return {f"node_{name}": Kept(array, axes[name], f"{name} at the saved nodes") for name, array in arrays.items()}


def _energy_error(run: Trajectory) -> dict[str, Kept]:
    error = jnp.max(jnp.abs(run.energy - run.energy[0]))
    return {"energy_error": Kept(error, (), "largest change of the energy since the start")}


def _energy_drift(run: Trajectory) -> dict[str, Kept]:
    t = run.t - jnp.mean(run.t)
    drift = jnp.sum(t * run.energy) / jnp.sum(t * t) * (run.t[-1] - run.t[0])
    return {"energy_drift": Kept(drift, (), "change of a line fitted to the energy over the run")}


def _constraints(run: Trajectory) -> dict[str, Kept]:
    largest = jnp.max(run.constraint_residual, axis=0)
    return {"constraint_residual": Kept(largest, ("level",), "largest residual of the constraints")}


def _iterations(run: Trajectory) -> dict[str, Kept]:
    return {"iterations": Kept(jnp.max(run.info.iterations), (), "most Newton iterations of a step")}


def _extremes(run: Trajectory) -> dict[str, Kept]:
    kinds = (("min", jnp.min, "smallest positions"), ("max", jnp.max, "largest positions"))
    return {
        f"{kind}_{name}": Kept(function(getattr(run.states, name), axis=0), DIMENSIONS[name][1:], words)
        for name in ("q_s", "q_f")
        for kind, function, words in kinds
    }


def _quantiles(run: Trajectory) -> dict[str, Kept]:
    values = {name: jnp.quantile(getattr(run.states, name), jnp.array(LEVELS), axis=0) for name in ("q_s", "q_f")}
    words, axes = "quantiles of the positions over the saved nodes", {name: DIMENSIONS[name][1:] for name in values}
    return {f"quantiles_{name}": Kept(array, ("quantile", *axes[name]), words) for name, array in values.items()}


QUANTITIES = {
    "end": _end,
    "nodes": _nodes,
    "energy_error": _energy_error,
    "energy_drift": _energy_drift,
    "constraint_residual": _constraints,
    "iterations": _iterations,
    "extremes": _extremes,
    "quantiles": _quantiles,
}
OVER_NODES = ("energy_error", "energy_drift", "constraint_residual", "extremes", "quantiles")
"""Quantities that need more saved nodes than the end."""


def quantity(saved: Saved) -> Quantity:
    """One of `QUANTITIES` by name, or a function of the user: itself, ``my_file.py:function`` or
    ``my_package.my_module:function``.

    A user's function takes the `Trajectory` of a single run and returns an array, which has the name of the function,
    or arrays by name, by operations of JAX.

    Raises:
        ValueError: an unknown name, a name without a function, or a function without a name.
    """
    if isinstance(saved, str) and saved in QUANTITIES:
        return QUANTITIES[saved]
    if not callable(saved) and not (isinstance(saved, str) and ":" in saved):
        known = f"{near(saved, QUANTITIES)} There are {', '.join(QUANTITIES)}, and functions of your own"
        raise Refused(
            f"ensemble: save has {saved!r}.{known}, function, my_file.py:function or my_package.module:function."
        )
    user_function, label = saved if callable(saved) else imported(saved), label_of(saved)
    if not callable(user_function):
        raise Refused(f"ensemble: save has {saved!r}, {type(user_function).__name__}; give a function of a trajectory.")
    if not label.isidentifier():
        raise Refused(f"ensemble: save has {saved!r}, a function without a name for its array; define it with def.")

    def function(run: Trajectory) -> dict[str, Kept]:
        result = user_function(run)
        by_name = result if isinstance(result, dict) else {label: result}
        arrays: dict[str, Any] = {key: jnp.asarray(value) for key, value in by_name.items()}
        description = (getattr(user_function, "__doc__", None) or "").strip().partition("\n")[0]
        axes = {key: tuple(f"{key}_{i}" for i in range(array.ndim)) for key, array in arrays.items()}
        return {key: Kept(array, axes[key], description) for key, array in arrays.items()}

    return function


def label_of(saved: Saved) -> str:
    """The name of a quantity of the user: the name of its function, without its file or module."""
    return getattr(saved, "__name__", "") if callable(saved) else saved.partition(":")[2]


def kept(quantities: Sequence[Quantity], run: Trajectory) -> dict[str, Kept]:
    """All arrays that the store keeps of a run."""
    arrays: dict[str, Kept] = {}
    for item in quantities:
        part = item(run)
        both = sorted(set(arrays) & set(part))
        if both:
            raise Refused(f"ensemble: save has two arrays called {', '.join(both)}; give one of them another name.")
        arrays |= part
    return arrays


def what_is_kept(quantities: Sequence[Quantity], run: Simulation) -> dict[str, Kept]:
    """The arrays that the store keeps of a run, with shapes in place of values; nothing is computed."""
    with traced("ensemble: a function in save"):
        return jax.eval_shape(partial(kept, quantities), resting(run))


def drawn_by_default(names: Sequence[str], problem: Problem) -> list[str]:
    """Arrays of these quantities that `vmri_jax.plots.plot_ensemble` draws: one number per run, or one per saved
    node."""
    run = simulation(problem, fully_implicit(1), None, None, 1.0, num_steps=1)
    arrays = what_is_kept(list(map(quantity, names)), run)
    return [name for name, kept in arrays.items() if kept.dimensions in ((), ("node",)) and name != "node_t"]


def of_lanes(quantities: Sequence[Quantity], run: Trajectory) -> dict[str, Any]:
    """The arrays that the store keeps of a batch, a row for each run, by a program that JAX keeps for these
    quantities."""
    return {name: array.value for name, array in _of_lanes(list(map(TracedOnce, quantities)), run).items()}


@jax.jit
def _of_lanes(functions: list[TracedOnce], run: Trajectory) -> dict[str, Kept]:
    return jax.vmap(partial(kept, [function.function for function in functions]))(run)
