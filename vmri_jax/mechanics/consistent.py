"""Consistent starts: positions moved onto the constraints, and momenta onto the hidden constraints ``G v + dg/dt = 0``.

Of traced numbers these functions are parts of programs. Of known numbers NumPy does the linear algebra, and the
`Configuration` has values and Jacobians: a program of its own for every step of the start would take seconds to
compile.
"""

from contextlib import suppress
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.saddle import least_norm, regularized
from vmri_jax.mechanics.arrays import is_known, library, quickly_compiled, split_at
from vmri_jax.mechanics.constraints import configuration
from vmri_jax.mechanics.projection import is_quadratic, legendre, mass_and_momentum, project_momentum
from vmri_jax.mechanics.system import System

PROJECTION_STEPS = 20
"""Gauss-Newton steps onto the constraints.

They converge quadratically from close positions; a larger number takes longer.
"""


def project_positions(system: System, t, q_s, q_f):
    """Positions moved onto the constraints at a time, along ``M^-1 G^T`` of the start: to first order the nearest point
    in the mass metric."""
    n_s, q = q_s.shape[0], library(q_s, q_f).concatenate([q_s, q_f])
    start = configuration(system, t, q_s, q_f)
    xp = library(start)
    # D = M^-1 G^T at the start, with rows of coordinates over the square roots of masses: all have the same unit
    root = xp.sqrt(start.mass.diagonal())
    directions = xp.linalg.solve(start.mass / (root[:, None] * root), (start.jacobian / root).T) / root[:, None]

    # q <- q - D (G D)^+ g
    def corrected(_, q):
        here = configuration(system, t, *split_at(q, n_s), start.mass)
        return q - directions @ least_norm(here.jacobian @ directions, here.values)

    if xp is jnp:
        q = jax.lax.fori_loop(0, PROJECTION_STEPS, corrected, q)  # a loop, since its body is compiled once
        return split_at(q, n_s)
    with (
        np.errstate(all="ignore"),
        suppress(np.linalg.LinAlgError),
    ):  # of positions that are not finite, which the checks name
        for k in range(PROJECTION_STEPS):
            q = corrected(k, q)
    return split_at(q, n_s)


def consistent_momenta(system: System, t, q_s, q_f, v_s, v_f):
    """(p_s, p_f, violation): momenta projected onto the hidden constraints, and the violation of the hidden
    constraints, between 0 and 1.

    The violation is ``|v - v'| / max(|v|, |v'|)`` in the norm of the kinetic energy, with the projected velocities v':
    constraints may take velocity away, and moving constraints may add it.
    """
    n_s, arguments = np.shape(q_s)[0], (system, t, q_s, q_f, v_s, v_f)
    v = library(v_s, v_f).concatenate([v_s, v_f])
    momenta = _momenta_of_numbers if is_quadratic(system, q_s, q_f) and is_known(arguments) else _momenta
    p, projected_p, projected_v = momenta(*arguments)
    # |v - v'|^2 / max(|v|^2, |v'|^2) with |v|^2 = v . p
    xp = library(v, p, projected_p)
    size = xp.maximum(v @ p, projected_v @ projected_p)
    part = xp.where(size > 0, (v - projected_v) @ (p - projected_p) / xp.where(size > 0, size, 1.0), 0.0)
    return *split_at(projected_p, n_s), xp.sqrt(xp.clip(part, 0.0, 1.0))


@quickly_compiled
def _momenta(system, t, q_s, q_f, v_s, v_f):
    """p = dT/dv, and p and v after the projection onto the hidden constraints."""
    momenta = legendre(system, q_s, q_f, v_s, v_f)
    p_s, p_f, *velocities, _ = project_momentum(
        system, SimpleNamespace(t=t, q_s=q_s, q_f=q_f, p_s=momenta[0], p_f=momenta[1]), (v_s, v_f)
    )
    return tuple(jnp.concatenate(a) for a in (momenta, (p_s, p_f), velocities))


def _momenta_of_numbers(system, t, q_s, q_f, v_s, v_f):
    """`_momenta` by NumPy, of a T that is quadratic in v: a program would take seconds to compile."""
    v = np.concatenate([v_s, v_f])
    mass, p = mass_and_momentum(system, q_s, q_f, v_s, v_f)
    if not system.is_constrained:
        return p, p, v
    # G M^-1 G^T mu = G v + dg/dt
    *_, jacobian, rates = configuration(system, t, q_s, q_f, mass)
    directions = np.linalg.solve(mass, jacobian.T)
    try:
        mu = np.linalg.solve(regularized(jacobian @ directions), jacobian @ v + rates)
    except np.linalg.LinAlgError:
        mu = np.full(rates.shape, np.nan)  # a gradient that vanishes, which the checks name
    return p, p - jacobian.T @ mu, v - directions @ mu
