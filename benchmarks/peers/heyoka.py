# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""heyoka: Taylor's method of adaptive step and order, compiled for equations without multipliers."""

from typing import Any

import heyoka as hy
import numpy as np

from benchmarks.peers.cases import Case, Ladder, tolerances
from benchmarks.peers.mechanics import chain_accelerations, chain_gaps

COMPACT = 50
"""From so many coordinates on loops are compiled; one long program would take minutes."""


def equations(case: Case) -> tuple[list, list[tuple[Any, Any]]]:
    """The variables (q, v), and their derivatives beside them."""
    n = case.q.size
    q, v = ([hy.expression(f"{name}{i}") for i in range(n)] for name in "qv")
    a = chain_accelerations(q, case.omega) if case.is_chain else case.particles.accelerations(q, v, hy.sqrt)
    return [*q, *v], list(zip([*q, *v], [*v, *a], strict=True))


def ladders(case: Case) -> list[Ladder]:
    """One: a tolerance per rung; the order follows from it."""

    def build(tol: float):
        start, n = np.concatenate([case.q, case.v]), case.q.size
        _, system = equations(case)
        taylor = hy.taylor_adaptive(system, start, tol=tol, compact_mode=n >= COMPACT)

        def run():
            taylor.time = 0.0
            taylor.state[:] = start
            taylor.propagate_until(case.t_end)
            return taylor.state[:n].copy()

        return run

    return [Ladder("Taylor", "tol", tolerances(1e-2, 1e-15), build)]


def energy(case: Case) -> float:
    """Of the start, by an expression of heyoka."""
    variables, _ = equations(case)
    q, v = variables[: case.q.size], variables[case.q.size :]
    kinetic = hy.sum([m / 2 * x**2 for m, x in zip(case.masses, v, strict=True)])
    function: Any = hy.cfunc([kinetic + _potential(case, q)], variables)
    return float(function(np.concatenate([case.q, case.v]))[0])


def _potential(case: Case, q: list):
    if case.is_chain:
        f = q[len(q) // 2 :]
        return hy.sum([d**4 / 4.0 for d in chain_gaps(q)] + [case.omega**2 / 2 * x**2 for x in f])
    p = case.particles
    weights = [p.gravity * m * q[3 * i + 2] for i, m in enumerate(p.masses)]
    lengths = [hy.sqrt(hy.sum([(q[3 * j + a] - q[3 * i + a]) ** 2 for a in range(3)])) for i, j, _, _ in p.springs]
    springs = [k / 2 * (x - rest) ** 2 for x, (_, _, k, rest) in zip(lengths, p.springs, strict=True)]
    return hy.sum(weights + springs)
