# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
"""scipy: the adaptive Runge-Kutta method DOP853, its right-hand side compiled by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.peers import equations as by_hand
from benchmarks.peers.cases import Case, Ladder, tolerances


def ladders(case: Case, equations=by_hand) -> list[Ladder]:
    """One: relative and absolute tolerance alike; below 1e-13 the relative one stays, scipy allows no less."""
    start, n, accelerate = np.concatenate([case.q, case.v]), case.q.size, equations.acceleration(case)

    @jax.jit
    def rates(t, y):
        q, v = y[:n], y[n:]
        return jnp.concatenate([v, accelerate(q, v)])

    def build(tol: float):
        def run():
            options = {"method": "DOP853", "rtol": max(tol, 1e-13), "atol": tol, "t_eval": [case.t_end]}
            found = solve_ivp(lambda t, y: np.asarray(rates(t, y)), (0.0, case.t_end), start, **options)
            return found.y[:n, -1] if found.success else np.full(n, np.nan)

        return run

    return [Ladder("DOP853", "tol", tolerances(1e-1, 1e-13), build)]


energy = by_hand.energy
