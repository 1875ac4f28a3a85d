"""Prices: seconds of one evaluation of the gradient of each potential of a system, and their sum over a run."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.terms import label
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.row import Row

SLOW, FAST = "gradient of V", "gradient of W"
"""Names of gradients; `gradient_of` names the gradients of further potentials."""


def gradients(problem: Problem) -> dict[str, Callable]:
    """The gradients of the potentials that the system has, by name, as functions of positions."""
    system, n_s = problem.system, problem.q_s.size
    terms: dict[str, Callable] = {}
    if system.slow_potential is not None:
        terms[SLOW] = jax.grad(lambda q: system.slow_potential(q[:n_s], q[n_s:], system.params))  # pyright: ignore[reportOptionalCall]
    if system.fast_potential is not None:
        terms[FAST] = jax.grad(lambda q: system.fast_potential(q[n_s:], system.params))  # pyright: ignore[reportOptionalCall]
    for name, function in system.potentials:
        terms[gradient_of(name)] = jax.grad(lambda q, function=function: function(q[:n_s], q[n_s:], system.params))
    return terms


def gradient_of(name: str | int) -> str:
    """The name of a further potential's gradient."""
    return f"gradient of {label(name)}"


def prices(problem: Problem) -> dict[str, float]:
    """Seconds of one evaluation of each of `gradients`, each timed in a compiled loop of its own."""
    q = jnp.concatenate([jnp.asarray(problem.q_s), jnp.asarray(problem.q_f)])
    return {name: seconds_each(function, q) for name, function in gradients(problem).items()}


def seconds_of_gradients(price: Mapping[str, float], row: Row) -> float:
    """Seconds of a run in its gradients: evaluations times `prices`."""
    counts = {SLOW: row.slow_evaluations, FAST: row.fast_evaluations}
    counts |= {gradient_of(name): count for name, count in row.evaluations.items()}
    return sum(seconds * counts.get(name, 0) for name, seconds in price.items())
