"""The Newton matrix in blocks against the derivative of the whole residual, on a system with everything in it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from tests.user_systems import bent_system
from vmri_jax import Scheme, explicit_slow, fully_explicit, fully_implicit, galerkin, macro, micro, quadrature
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.steppers.newton import arrowhead, dense
from vmri_jax.steppers.newton.linearization import apply, linearize

SCHEMES = {
    "fully implicit": fully_implicit(3),
    "explicit slow": explicit_slow(3, 0.3),
    "fully explicit": fully_explicit(3, 0.3),
    "one micro step": fully_implicit(1),
    "macro gauss": Scheme(
        3, kinetic=micro(quadrature.midpoint), slow=macro(quadrature.gauss(2)), fast=micro(quadrature.simpson)
    ),
    "gauss 2": galerkin(3, 2),
    "lobatto 2": galerkin(3, 2, "lobatto"),
    "gauss 3, macro": Scheme(
        2,
        3,
        kinetic=micro(quadrature.gauss(3)),
        slow=macro(quadrature.gauss(2)),
        fast=micro(quadrature.affine(0.2)),
        force=micro(quadrature.lobatto(4)),
    ),
}


def equations_and_unknowns(scheme):
    rng = np.random.default_rng(3)
    q_s, q_f, p_s, p_f = rng.normal(size=(4, 3))
    equations = StepEquations(bent_system(), scheme, 0.4, q_s, q_f, p_s, p_f, 0.3)
    guess = equations.guess(0.5 * p_s, 0.5 * p_f, jnp.ones(2), jnp.ones(1))
    flat, unravel = ravel_pytree(guess)
    return equations, unravel(flat + 0.1 * rng.normal(size=flat.size))


@pytest.mark.parametrize("name", SCHEMES)
def test_blocks_are_the_derivative_of_the_residual(name):
    """And the direction of the arrowhead is the dense one."""
    equations, x = equations_and_unknowns(SCHEMES[name])
    flat, unravel = ravel_pytree(x)

    def residual(z):
        return ravel_pytree(equations.residual(unravel(z)))[0]

    @jax.jit
    def everything(flat):
        x = unravel(flat)
        blocks, at = linearize(equations, x), equations.residual(x)
        columns = jax.vmap(lambda e: ravel_pytree(apply(blocks, unravel(e)))[0])(jnp.eye(flat.size)).T

        def solve(solver):
            return ravel_pytree(solver.solve(solver.factor(blocks, x), at))[0]

        return columns, jax.jacfwd(residual)(flat), solve(arrowhead), solve(dense)

    columns, expected, direction, dense_direction = everything(flat)
    worst = float(jnp.max(jnp.abs(columns - expected)) / jnp.max(jnp.abs(expected)))
    assert worst < 3e-15  # measured 3.4e-16
    worst = float(jnp.max(jnp.abs(direction - dense_direction)) / jnp.max(jnp.abs(dense_direction)))
    assert worst < 5e-14  # measured 4.9e-15
