"""Prices: seconds of one evaluation of the gradient of each potential of a system, and their sum over a run."""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.terms import Term, label
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.row import Row


def gradients(problem: Problem) -> dict[str, Callable]:
    """The gradients of the potentials that the system has, by name, as functions of positions."""
    system, n_s = problem.system, problem.q_s.size

    def gradient(term: Term) -> Callable:
        return jax.grad(lambda q: term(system.params, q_s=q[:n_s], q_f=q[n_s:]))

    return {gradient_of(term.name): gradient(term) for term in system.of_kind("potential")}


def gradient_of(name: str | int) -> str:
    """The name of a potential's gradient."""
    return f"gradient of {label(name)}"


def prices(problem: Problem) -> dict[str, float]:
    """Seconds of one evaluation of each of `gradients`, each timed in a compiled loop of its own."""
    q = jnp.concatenate([jnp.asarray(problem.q_s), jnp.asarray(problem.q_f)])
    return {name: seconds_each(function, q) for name, function in gradients(problem).items()}


def seconds_of_gradients(price: Mapping[str, float], row: Row) -> float:
    """Seconds of a run in its gradients: evaluations times `prices`."""
    counts = {"V": row.slow_evaluations, "W": row.fast_evaluations, **row.evaluations}
    counts = {gradient_of(name): count for name, count in counts.items()}
    return sum(seconds * counts.get(name, 0) for name, seconds in price.items())
