"""Projection of momenta onto the hidden constraints ``G v + dg/dt = 0``, with the velocities of the projected
momenta."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from vmri_jax import kernels
from vmri_jax.kernels import matmul, matvec
from vmri_jax.kernels.band import Full, Sparsity
from vmri_jax.kernels.saddle import saddle
from vmri_jax.mechanics.arrays import library, numbers_of, quickly_compiled, split_at
from vmri_jax.mechanics.constraint_pattern import all_rows
from vmri_jax.mechanics.masses import WithMassMatrix
from vmri_jax.mechanics.structure import has_constant_hessian
from vmri_jax.mechanics.surroundings import innermost
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import Term

MAX_ITERATIONS = 50
"""Most Newton iterations for the velocities of a kinetic energy that is not quadratic.

A larger number makes failures slower.
"""
SMALL_STEP = 1e-9
"""Newton step, relative to the velocities, at which the line search ends: the two further steps bring it to round-off.

A smaller value costs steps.
"""
ON_CONSTRAINTS = 1e-9
"""Largest violation of the hidden constraints, relative to the terms of a row, of an iterate whose energy is compared.
A larger value compares energies of velocities that violate the constraints."""
LARGEST_LAST_STEP = 1e-6
"""Largest last Newton step, relative to the velocities, of a converged iteration.

A larger value accepts iterates that have not converged.
"""


def legendre(system: System, q_s, q_f, v_s, v_f):
    """Continuous Legendre transform ``p = dT/dv``: (p_s, p_f)."""
    if system.has_constant_mass:
        return system.kinetic.momentum(v_s, v_f)
    return jax.grad(system.kinetic_energy, argnums=(2, 3))(q_s, q_f, v_s, v_f)


def mass_and_momentum(system: System, q_s, q_f, v_s, v_f):
    """Mass matrix ``d2T/dv2`` (n, n) and momentum ``dT/dv`` (n,): of known numbers by NumPy, and for constant masses
    without a program."""
    v = library(v_s, v_f).concatenate([v_s, v_f])
    if system.has_constant_mass:
        mass = system.kinetic.matrix
        return mass, mass @ v
    return numbers_of(_program_of_masses(system, q_s, q_f, v))


def masses_of_function(system: System, q_s, q_f, v):
    """`mass_and_momentum` of a T that is a function, at velocities (n,), as a part of a program."""
    masses = closed_masses(system.of_kind("kinetic"), q_s, q_f, system.params)
    if masses is not None:
        return masses, matvec(masses, v)
    momentum = jax.grad(lambda v: system.kinetic_energy(q_s, q_f, *split_at(v, q_s.size)))
    p, times_mass = jax.linearize(momentum, v)
    return jax.vmap(times_mass)(jnp.eye(p.size)), p


_program_of_masses = quickly_compiled(masses_of_function)


def have_closed_masses(energies: Iterable[Term]) -> bool:
    """Whether these kinetic energies are ``v^T M v / 2`` with masses M in closed form, see `WithMassMatrix`."""
    functions = [innermost(term.function) for term in energies]
    return all(isinstance(function, WithMassMatrix) and function.has_mass_matrix for function in functions)


def is_quadratic(system: System, q_s, q_f) -> bool:
    """Whether the kinetic energy is at most quadratic in the velocities."""
    if system.has_constant_mass or have_closed_masses(system.of_kind("kinetic")):
        return True
    return has_constant_hessian(partial(system.kinetic_energy, q_s, q_f), jnp.zeros(q_s.size), jnp.zeros(q_f.size))


def closed_masses(energies: Iterable[Term], q_s, q_f, params):
    """The mass matrix (n, n) of kinetic energies by their closed forms; None if one of them has none."""
    energies = list(energies)
    if not have_closed_masses(energies):
        return None
    first, *others = (innermost(term.function) for term in energies)
    return first.mass_matrix(q_s, q_f, params, *others)


def project_momentum(system: System, state, guess=None, constraints=None, sparsity: Sparsity | None = None):
    """Momenta projected onto the hidden constraints, ``p <- p - G^T mu`` with ``G v + dg/dt = 0``, and their
    velocities.

    The velocity v of the projected momentum, ``p - G^T mu = dT/dv``, minimises ``T(v) - p . v`` over all v with
    ``G v + dg/dt = 0``. If T is quadratic in v with the masses M, that takes one linear solve,
    ``G M^-1 G^T mu = G v + dg/dt`` with the velocity v of p. Else it takes Newton's iteration with a line search, and T
    must be convex in v.

    Args:
        system: with its kinetic energy and constraints.
        state: a `State`: time, positions and momenta.
        guess: velocities (v_s, v_f) from which Newton's iteration starts, by default zero.
        constraints: G (m, n) and dg/dt (m,); None for those of the system.
        sparsity: of ``G M^-1 G^T``, for constant masses; found if it is None.

    Returns:
        (p_s, p_f, v_s, v_f, masses), the last one the mass matrix ``d2T/dv2`` (n, n), None for constant masses; NaN
        where Newton's iteration does not converge.
    """
    t, q_s, q_f, n_s = state.t, state.q_s, state.q_f, state.q_s.size
    p = jnp.concatenate([state.p_s, state.p_f])
    if constraints is None:
        jacobian = jnp.concatenate(jax.jacrev(system.constraints, argnums=(1, 2))(t, q_s, q_f), axis=1)
        constraints = jacobian, time_rates(system, t, q_s, q_f)
    if system.has_constant_mass:
        (p, v), masses = _with_constant_masses(system, q_s, q_f, p, constraints, sparsity), None
    else:
        p, v, masses = _with_masses(system, q_s, q_f, p, constraints, guess)
    return *split_at(p, n_s), *split_at(v, n_s), masses


def _with_constant_masses(system: System, q_s, q_f, p, constraints, sparsity: Sparsity | None):
    jacobian, rates = constraints

    def over_masses(p):
        """``M^-1 p`` for (..., n)."""
        return jnp.concatenate(system.kinetic.velocity(*split_at(p, q_s.size)), axis=-1)

    if rates.size:
        sparsity = sparsity or all_rows(system, q_s, q_f)
        seeded = jacobian if isinstance(sparsity, Full) else matmul(sparsity.seeds, jacobian)
        products = matmul(over_masses(seeded), jacobian.T)
        p -= matvec(jacobian.T, sparsity.solve(products, matvec(jacobian, over_masses(p)) + rates))
    return p, over_masses(p)


def _with_masses(system: System, q_s, q_f, p, constraints, guess):
    v = gradient = jnp.zeros_like(p)
    masses = closed_masses(system.of_kind("kinetic"), q_s, q_f, system.params)
    in_one_solve = is_quadratic(system, q_s, q_f)
    if not in_one_solve:
        guess = v if guess is None else jnp.concatenate(guess)
        v, impulse = _velocity_and_impulse(system, q_s, q_f, constraints, p, guess)
    if masses is None:
        masses, gradient = masses_of_function(system, q_s, q_f, v)
    if in_one_solve:
        v, impulse = _by_one_solve(masses, p - gradient, *constraints)  # p = M v + dT/dv(0)
    return (p - impulse if constraints[1].size else p), v, masses


def _by_one_solve(masses, p, jacobian, rates):
    """The velocity ``v - M^-1 G^T mu``, with ``M v = p`` and ``G M^-1 G^T mu = G v + dg/dt``, and ``G^T mu``."""
    solve = partial(jax.scipy.linalg.cho_solve, (jnp.linalg.cholesky(masses), True))
    # the derivative is one more solve: JAX does not differentiate the factors
    v = jax.lax.custom_linear_solve(partial(matvec, masses), p, lambda _, b: solve(b), symmetric=True)
    if not jacobian.shape[0]:
        return v, jnp.zeros_like(p)
    columns = solve(jacobian.T)
    mu = Full(len(rates)).solve(matmul(jacobian, columns).T, matvec(jacobian, v) + rates)
    return v - matvec(columns, mu), matvec(jacobian.T, mu)


def time_rates(system: System, t, q_s, q_f):
    """``dg/dt`` of all constraints (n_g + n_gs,) at fixed positions."""
    if not system.is_rheonomic:
        return jnp.zeros(sum(system.num_constraints(q_s, q_f)))
    return system.constraint_rates(t, q_s, q_f, jnp.zeros_like(q_s), jnp.zeros_like(q_f))


def _velocity_and_impulse(system: System, q_s, q_f, constraints, p, guess):
    """The v that minimises ``T(v) - p . v`` over ``G v + dg/dt = 0``, and ``G^T mu``, with `constraints` (G, dg/dt);
    NaN without convergence."""

    def kinetic(system, q_s, q_f, v):
        return system.kinetic_energy(q_s, q_f, *split_at(v, q_s.size))

    # Newton direction d:  [T'', G^T; G, 0] (d, mu) = (p - T'(v), -(G v + rates))
    def direction(data, v):
        system, q_s, q_f, jacobian, rates, p = data
        gradient, times_hessian = jax.linearize(jax.grad(lambda v: kinetic(system, q_s, q_f, v)), v)
        matrix = saddle(jax.vmap(times_hessian)(jnp.eye(v.size)), jacobian.T, jacobian)
        rows = jnp.concatenate([p - gradient, -(jacobian @ v + rates)])
        d, mu = split_at(kernels.solve(matrix, rows[:, None])[:, 0], v.size)
        # |d| / |v| in the norm of the mass matrix T''
        squared = (d @ times_hessian(d)) / jnp.maximum(v @ times_hessian(v), jnp.finfo(float).tiny)
        return d, jacobian.T @ mu, jnp.sqrt(squared)

    def search(carry):
        v, k, _ = carry
        system, q_s, q_f, jacobian, rates, p = constants
        d, _, size = direction(constants, v)
        # line search: the longest step that decreases T - p . v; off the constraints every finite step is a progress
        merit = jax.vmap(lambda v: kinetic(system, q_s, q_f, v) - p @ v)(v + fractions[:, None] * d)
        sizes = jnp.abs(jacobian) @ jnp.abs(v) + jnp.abs(rates)
        on_constraints = jnp.all(jnp.abs(jacobian @ v + rates) <= ON_CONSTRAINTS * sizes)
        better = jnp.isfinite(merit) & ((merit < merit[-1]) | ~on_constraints)
        stop = (size <= SMALL_STEP) | ~jnp.any(better)
        return jnp.where(stop, v, v + fractions[jnp.argmax(better)] * d), k + 1, stop

    data = (system, q_s, q_f, *constraints, p)
    constants, guess = jax.lax.stop_gradient((data, guess))
    fractions = jnp.append(0.5 ** jnp.arange(40.0), 0.0)  # near the speed of light steps are short
    start = (guess, 0, jnp.asarray(False))
    v = jax.lax.while_loop(lambda carry: ~carry[2] & (carry[1] < MAX_ITERATIONS), search, start)[0]
    # Newton's map has the derivative zero by v at its fixed point: two steps outside of the loop carry first and second
    # derivatives
    for _ in range(2):
        d, impulse, size = direction(data, v)
        v = v + d
    converged = size <= LARGEST_LAST_STEP
    return jnp.where(converged, v, jnp.nan), jnp.where(converged, impulse, jnp.nan)


@quickly_compiled
def at_same_velocities(system: System, other: System, state):
    """The state of another system at the positions and velocities of a state, ``p = dT/dv``."""
    _, _, *velocities, _ = project_momentum(system, state)
    return replace(state, **dict(zip(("p_s", "p_f"), legendre(other, state.q_s, state.q_f, *velocities), strict=True)))
