"""Prices: seconds of one evaluation of the gradient of each potential of a system, and their sum over a run."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp

from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.terms import Term
from vmri_jax.running.timing import seconds_each
from vmri_jax.study.row import Row


def prices(problem: Problem) -> dict[str | int, float]:
    """Seconds of one evaluation of the gradient of each potential that the system has, by the name of the potential,
    each timed in a compiled loop of its own."""
    system, n_s = problem.system, problem.q_s.size

    def gradient(term: Term) -> Callable:
        return jax.grad(lambda q: term(system.params, q_s=q[:n_s], q_f=q[n_s:]))

    q = jnp.concatenate([jnp.asarray(problem.q_s), jnp.asarray(problem.q_f)])
    return {term.name: seconds_each(gradient(term), q) for term in system.of_kind("potential")}


def seconds_of_gradients(price: Mapping[str | int, float], row: Row) -> float:
    """Seconds of a run in its gradients: evaluations times `prices`."""
    counts = {"V": row.slow_evaluations, "W": row.fast_evaluations, **row.evaluations}
    return sum(seconds * counts.get(name, 0) for name, seconds in price.items())


def bound_of(price: Mapping[str | int, float], rows: Sequence[Row]) -> tuple[tuple[float, float], ...]:
    """Seconds and error of runs whose time is that of their gradients alone.

    A gradient that is evaluated in a loop of its own may take longer than in the run, so that the time of the run
    bounds it.
    """
    return tuple((min(seconds_of_gradients(price, row), row.seconds), row.error_q) for row in rows)
