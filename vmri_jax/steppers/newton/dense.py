"""Newton direction by one dense factorisation over all unknowns of the macro step: O(num_micro^3) operations per macro step.

The method of the reference paper, kept as a baseline and as a reference for tests. The matrix is the derivative of the whole residual.
"""

import jax
from jax.flatten_util import ravel_pytree

from vmri_jax.schemes.equations import StepEquations, Unknowns


def matrix(equations: StepEquations, x: Unknowns):
    """``dR/dx`` (n, n) with all unknowns in one vector."""
    flat, unravel = ravel_pytree(x)
    return jax.jacfwd(lambda z: ravel_pytree(equations.residual(unravel(z)))[0])(flat)


def factor(equations: StepEquations, x: Unknowns):
    """LU factors of the matrix at x."""
    return jax.scipy.linalg.lu_factor(matrix(equations, x))


def solve(factors, residual: Unknowns) -> Unknowns:
    """The direction ``-matrix^-1 residual``."""
    flat, unravel = ravel_pytree(residual)
    return unravel(-jax.scipy.linalg.lu_solve(factors, flat))
