"""Derivative of the solution of a step, by the implicit function theorem.

The unknowns x of a step solve ``R(e, x) = 0``, where e are the equations with all data that they depend on: the state at the start, the
step, the parameters. So ``dx = -(dR/dx)^-1 (dR/de) de``, with one matrix in both modes; no iteration is differentiated.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from vmri_jax.refusals import Refused
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.march import MarchEquations, linearised_pass, solve

ONLY_FIRST_DERIVATIVES = (
    "the adjoint of this run has first derivatives in reverse mode only. For second derivatives and forward mode take "
    "vmri_jax.simulate(..., save=vm.Save(adjoint='stored'))."
)


def _direction(equations: StepEquations, x: Unknowns):
    """The map ``residual -> -(dR/dx)^-1 residual``, with the matrix at x as a constant for derivatives."""
    march = MarchEquations(equations)
    z, x_flat = march.flat(x)
    matrices, _, by_positions = linearised_pass(march, z, x_flat, x_flat[-1], from_last=False, corrects=False)
    factors = jax.lax.stop_gradient((matrices, by_positions))
    return lambda residual: march.by_name(*solve(march, factors, *march.flat(residual)))


def _end(equations: StepEquations, x: Unknowns):
    """Fast position and momenta at the end of the step."""
    return equations.q_f + x.fast[:, -1].sum(0), *equations.evaluate(x)[1]


def _no_third_derivative(residual):
    """Zero, with the derivative zero, and second derivatives that are not finite: ``|s - s_0|^1.5`` at s_0 = s, the sum of all rows.

    Added to a point with the right first derivative only, it turns third derivatives of the step, which would be wrong, into NaN.
    """
    total = sum(jnp.sum(rows) for rows in jax.tree.leaves(residual))
    return jnp.abs(total - jax.lax.stop_gradient(total)) ** 1.5


@jax.custom_jvp
def differentiable(equations: StepEquations, x: Unknowns, end):
    """x and end unchanged, with the derivative of the root in both modes, twice; a third derivative is NaN."""
    return x, end


@differentiable.defjvp
def _implicit_derivative(primals, tangents):
    equations, root, _ = primals
    direction = _direction(equations, root)
    # For second derivatives: a Newton step x - (dR/dx)^-1 R at the root changes nothing, but makes x a function of the equations with the
    # right first derivative. A recursive call of `differentiable` would not do: for reverse mode JAX evaluates the first derivative in part,
    # and this partial evaluation drops the rules of custom derivatives (`process_custom_jvp_call` in jax/_src/interpreters/partial_eval.py).
    residual = equations.residual(root)
    unknown_beyond = _no_third_derivative(residual)
    x = jax.tree.map(lambda a, step: a + step + unknown_beyond, root, direction(residual))
    _, change = jax.jvp(lambda e: e.residual(x), (equations,), (tangents[0],))

    # dR/dx dx = -dR/de de. `custom_linear_solve` differentiates dx through `product`, that is through dR/dx at x; its own solves take the
    # factors of `direction`, computed once.
    rows, by_name = ravel_pytree(jax.tree.map(jnp.negative, change))

    def product(dx):
        """``dR/dx dx``."""
        return ravel_pytree(jax.jvp(equations.residual, (x,), (by_name(dx),))[1])[0]

    def solved(_, rows):
        """``(dR/dx)^-1`` times the rows."""
        return -ravel_pytree(direction(by_name(rows)))[0]

    def solved_transposed(_, rows):
        return jax.linear_transpose(partial(solved, None), rows)(rows)[0]

    dx = by_name(jax.lax.custom_linear_solve(product, rows, solved, solved_transposed))
    end, d_end = jax.jvp(_end, (equations, x), (tangents[0], dx))
    return (x, end), (dx, d_end)


@jax.custom_vjp
def differentiable_reverse_only(equations: StepEquations, x: Unknowns, end):
    """x and end unchanged, with one derivative in reverse mode for half the work; any other derivative raises a TypeError."""
    return x, end


def _kept(equations, x, end):
    return (x, end), (equations, x)


def _pulled_back(kept, cotangents):
    equations, x = only_once(kept)
    d_x, d_end = cotangents
    _, pull = jax.vjp(_end, equations, x)
    by_end, d_x_of_end = pull(d_end)
    d_x = jax.tree.map(jnp.add, d_x, d_x_of_end)
    # cotangent of e: (d end/de)^T d_end - (dR/de)^T (dR/dx)^-T d_x, where d_x contains (d end/dx)^T d_end by now
    (d_residual,) = jax.linear_transpose(_direction(equations, x), x)(d_x)
    _, pull = jax.vjp(lambda e: e.residual(x), equations)
    (by_residual,) = pull(d_residual)
    return jax.tree.map(_sum, by_end, by_residual), *jax.tree.map(jnp.zeros_like, (x, d_end))


def _sum(a, b):
    """The sum of two cotangents; integers have the cotangent type float0, which has no sum."""
    return a if a.dtype == jax.dtypes.float0 else a + b


differentiable_reverse_only.defvjp(_kept, _pulled_back)


@jax.custom_jvp
def only_once(tree):
    """The tree unchanged; its derivative raises a TypeError."""
    return tree


@only_once.defjvp
def _refused(primals, tangents):
    raise Refused(ONLY_FIRST_DERIVATIVES)
