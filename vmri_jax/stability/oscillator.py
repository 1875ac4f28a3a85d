"""Oscillators: a model of two, and the test equation ``q'' = -omega^2 q`` under a quadrature rule: phase and limit.

A step of length tau with a path of degree r has the discrete Lagrangian ``q^T S q / (2 tau)`` in the control points,
``S = D - x^2 B``, x = omega tau, with D and B the sums of the rules over ``l_i' l_j'`` and ``l_i l_j``. Eliminating the
control points inside leaves a symmetric 2 x 2 matrix, and the step turns by the phase phi per tau,

    cos(phi) = -(S_00 + S_11) / (2 S_01),          unstable where |cos(phi)| > 1.

Midpoint rule: ``phi = 2 atan(x / 2)``; kicks at the ends (Verlet): ``2 asin(x / 2)``, stable for x < 2. Kicks with
gradient correction (Takahashi and Imada) replace x^2 by ``x^2 (1 - x^2 / 12)``: stable for x < 2 sqrt(3).
"""

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.path import lagrange_basis, lagrange_derivative
from vmri_jax.schemes.quadrature import PlacedRule, Rule, midpoint
from vmri_jax.schemes.scheme import Scheme

RESOLUTION = 0.05
"""Spacing of x along which the phase is unwrapped and limits are searched; a larger one misses narrow intervals."""
LARGEST_X = 30.0
"""Largest x searched for a limit; larger limits count as infinite."""


def soft_spring(q_s, q_f, params):
    """``V = kappa / 2 |q_s - q_f|^2``."""
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2)


def stiff_spring(q_f, params):
    """``W = omega^2 / 2 |q_f|^2``."""
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


def linear_model(omega=50.0, kappa=25.0) -> Problem:
    """One slow and one fast variable of unit mass, ``V = kappa/2 (q_s - q_f)^2`` and ``W = omega^2/2 q_f^2``.

    Starts at ``q_s = 1, q_f = 1 / omega`` with unit velocity of the fast variable.

    Args:
        omega: frequency of the fast variable alone.
        kappa: stiffness of the spring between the two.
    """
    params = {"omega": jnp.asarray(omega, dtype=float), "kappa": jnp.asarray(kappa, dtype=float)}
    system = System(ConstantMass([1.0], [1.0]), soft_spring, stiff_spring, params=params)
    one = jnp.ones(1)
    return Problem(system, one, one / omega, 0 * one, one)


def phase(scheme: Scheme, x: float) -> float:
    """Phase by which a fast vibration turns in a micro step, ``x = omega h``; NaN where the step is unstable, or the
    fast potential is not on every micro interval."""
    if not scheme.fast.is_local:
        return np.nan
    path = np.linspace(0.0, x, 2 + int(abs(x) / RESOLUTION))
    kinetic, fast = scheme.kinetic, scheme.fast
    cosine, direction = _turn(scheme.degree, kinetic.rule, fast.rule, fast.gradient_corrected, path)
    if abs(cosine[-1]) > 1:
        return np.nan
    # Unwrapped from x = 0: the cosine alone gives the phase only up to sign and multiples of 2 pi.
    return float(np.sign(x) * np.unwrap(np.arctan2(direction * np.sqrt(np.maximum(1 - cosine**2, 0)), cosine))[-1])


def fast_limit(scheme: Scheme) -> float:
    """The smallest ``omega h`` at which the micro step is unstable for a fast vibration; infinite if there is none."""
    if scheme.fast.grid != "micro":
        return np.inf
    if scheme.fast.every > 1:
        return kick_limit(scheme.fast) / scheme.fast.every
    return _limit(scheme.degree, scheme.kinetic.rule, scheme.fast.rule, scheme.fast.gradient_corrected)


def kick_limit(placed: PlacedRule) -> float:
    """The smallest unstable ``omega tau`` of a vibration under kicks alone, tau the time from kick to kick; infinite
    for other rules."""
    return _limit(1, midpoint, placed.rule, False) if placed.only_ends else np.inf


def slow_limit(scheme: Scheme) -> float:
    """The smallest ``omega H`` at which the macro step is unstable for a vibration of the slow variables under V."""
    n = scheme.num_micro
    return _limit(scheme.degree, scheme.kinetic.composite(n), scheme.slow.composite(n), scheme.slow.gradient_corrected)


def _limit(degree: int, kinetic: Rule, potential: Rule, corrected: bool) -> float:
    """The smallest x at which ``|cos(phi)| > 1``, refined between grid points; infinite if there is none."""

    def first_unstable(x):
        unstable = np.flatnonzero(np.abs(_turn(degree, kinetic, potential, corrected, x)[0]) > 1 + 1e-12)
        return unstable[0] if unstable.size else None

    x = np.arange(0.0, LARGEST_X, RESOLUTION)
    while x[1] - x[0] > 1e-9:
        first = first_unstable(x)
        if first is None:
            return np.inf
        x = np.linspace(x[first - 1], x[first], 30)
    return float(x[-1])


def _turn(degree: int, kinetic: Rule, potential: Rule, corrected: bool, x):
    """cos(phi) and the sign of sin(phi), at every x."""
    slopes, values = lagrange_derivative(degree, kinetic.nodes), lagrange_basis(degree, potential.nodes)
    D = slopes.T @ (np.asarray(kinetic.weights)[:, None] * slopes)
    B = values.T @ (np.asarray(potential.weights)[:, None] * values)
    squares = np.asarray(x)[:, None, None] ** 2
    S = D - squares * (1 - corrected * squares / 12) * B
    # Schur complement of the inner control points: S_ee - S_ei S_ii^-1 S_ie, 2 x 2 in the control points at the ends.
    ends, inside = np.ix_([0, -1], [0, -1]), slice(1, -1)
    coupling = S[:, inside][:, :, [0, -1]]
    schur = S[:, *ends] - np.swapaxes(coupling, 1, 2) @ np.linalg.solve(S[:, inside, inside], coupling)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = -(schur[:, 0, 0] + schur[:, 1, 1]) / (2 * schur[:, 0, 1])
    return cosine, np.sign(-schur[:, 0, 1])
