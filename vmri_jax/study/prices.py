"""Prices: seconds of one evaluation of each function of a system, and the parts of the time of a run that they take."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import label
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.row import Row

SLOW, FAST, CONSTRAINTS = "gradient of V", "gradient of W", "constraints"
"""Names of functions whose evaluations take time; `gradient_of` names the gradients of further potentials."""
REMAINDER = "everything else"
"""Name of the time outside of these functions: moving, solving, and starting the run."""


def functions(problem: Problem) -> dict[str, Callable]:
    """The functions of positions that the system has, by name: gradients of the potentials; constraints with their Jacobian, summed."""
    system, n_s = problem.system, problem.q_s.size
    terms: dict[str, Callable] = {}
    if system.slow_potential is not None:
        terms[SLOW] = jax.grad(lambda q: system.slow_potential(q[:n_s], q[n_s:], system.params))  # pyright: ignore[reportOptionalCall]
    if system.fast_potential is not None:
        terms[FAST] = jax.grad(lambda q: system.fast_potential(q[n_s:], system.params))  # pyright: ignore[reportOptionalCall]
    for name, function in system.potentials:
        terms[gradient_of(name)] = jax.grad(lambda q, function=function: function(q[:n_s], q[n_s:], system.params))
    if any(system.num_constraints(problem.q_s, problem.q_f)):

        def constraints(q):
            return system.constraints(problem.t, q[:n_s], q[n_s:])

        terms[CONSTRAINTS] = lambda q: jax.jacrev(constraints)(q).sum(0) + constraints(q).sum()
    return terms


def gradient_of(name: str | int) -> str:
    """The name of a further potential's gradient."""
    return f"gradient of {label(name)}"


def prices(problem: Problem) -> dict[str, float]:
    """Seconds of one evaluation of each of `functions`, each timed in a compiled loop of its own."""
    q = jnp.concatenate([jnp.asarray(problem.q_s), jnp.asarray(problem.q_f)])
    return {name: seconds_each(function, q) for name, function in functions(problem).items()}


def seconds_by_function(price: Mapping[str, float], row: Row) -> dict[str, float]:
    """Seconds of a run in each function, its evaluations times `prices`."""
    counts = {SLOW: row.slow_evaluations, FAST: row.fast_evaluations}
    counts |= {gradient_of(name): count for name, count in row.evaluations.items()}
    counts[CONSTRAINTS] = row.fast_evaluations or row.slow_evaluations  # about one evaluation for each fast gradient
    return {name: seconds * counts.get(name, 0) for name, seconds in price.items()}


def shares(price: Mapping[str, float], row: Row) -> dict[str, float]:
    """Parts of the time of a run by function; with the remainder they sum to 1."""
    parts = {name: seconds / row.seconds for name, seconds in seconds_by_function(price, row).items()}
    total = sum(parts.values())  # above 1 where functions cost less in the run than in loops of their own
    parts = {name: part / max(total, 1.0) for name, part in parts.items()}
    return parts | {REMAINDER: max(0.0, 1.0 - total)}
