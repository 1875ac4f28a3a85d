"""Derivative of the solution of a step, by the implicit function theorem.

The unknowns x of a step solve ``R(e, x) = 0``, where e are the equations with all data that they depend on: the state
at the start, the step, the parameters. So ``dx = -(dR/dx)^-1 (dR/de) de``, with one matrix in both modes; no iteration
is differentiated.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from vmri_jax.kernels import matvec
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.steppers.march import FlatArriving, MarchEquations, Matrices, linearised_pass


def solve(march: MarchEquations, factors: tuple[Matrices, list], rows_z, rows_x):
    """(dz, dx) with ``dR/d(z, x) (dz, dx) = -(rows_z, rows_x)``; linear in the rows, and JAX can transpose it.

    Forward elimination with z fixed, then ``S dz = -(rows_z + change of R_s)``, then back substitution
    ``dx + (dx/dz) dz``.
    """
    (matrices, by_positions), n_f = factors, march.n_f

    def interval(arriving, of_interval):
        rows, inverse, hands_on, by_position, hands_on_by_position = of_interval
        # dx = -(dR/dx)^-1 (rows + dR/dq dq + dR/dp dp); h p_f is added to the first momentum equation: dR/dp is the
        # unit matrix there
        on_left = (rows + matvec(by_position, arriving.position)).at[:n_f].add(arriving.gradients[:n_f])
        dx = -matvec(inverse, on_left)
        gradients = arriving.gradients + matvec(hands_on, dx) + matvec(hands_on_by_position, arriving.position)
        # the momentum h D_{F_r} A is the sum of all impulses less the fast rows of the interval, whose change is -rows
        gradients = gradients.at[:n_f].add(rows[: march.num_fast].reshape(march.r, n_f).sum(0))
        return FlatArriving(arriving.position + march.last_increment(dx), gradients), dx

    intervals = rows_x, matrices.inverse, matrices.hands_on, *by_positions
    end, dx = jax.lax.scan(interval, jax.tree.map(jnp.zeros_like, march.start()), intervals)
    # The slow equations are linear in the arriving quantities: their derivative may be taken at any point.
    zero = jnp.zeros_like(rows_z)
    change = jax.jvp(lambda a: march.slow_equations(zero, a)[0], (march.start(),), (end,))[1]
    dz = -matvec(matrices.slow, rows_z + change)
    return dz, dx + jnp.sum(matrices.response * march.seen(dz), axis=-1)


def newton_direction(equations: StepEquations, x: Unknowns):
    """The map ``residual -> -(dR/dx)^-1 residual``, with the matrix at x as a constant for derivatives."""
    march = MarchEquations(equations)
    z, x_flat = march.flat(x)
    matrices, _, by_positions = linearised_pass(march, z, x_flat, x_flat[-1], from_last=False, corrects=False)
    factors = jax.lax.stop_gradient((matrices, by_positions))
    return lambda residual: march.by_name(*solve(march, factors, *march.flat(residual)))


def _with_derivative_of(values, others):
    """The values, with the derivatives of `others`, which equal the values up to round-off and are computed for
    derivatives alone.

    ``y = (value, 1)`` solves ``A y = (value - other, 1)`` with ``A = [[1, -other], [0, 1]]``, and
    ``dy = -A^-1 dA y = (d other, 0)``, since the first component of the right-hand side is held. `custom_linear_solve`
    takes its value from the solve alone, here the known one, and differentiates A.
    """
    (value, by_name), (other, _) = ravel_pytree(values), ravel_pytree(others)

    def product(y):
        return jnp.append(y[:-1] - other * y[-1], y[-1])

    def known(_, rows):
        return rows

    return by_name(jax.lax.custom_linear_solve(product, jnp.append(value, 1.0), known, known)[:-1])


def _no_third_derivative(residual):
    """Zero, with the derivative zero, and second derivatives that are not finite: ``|s - s_0|^1.5`` at s_0 = s, the sum
    of all rows.

    Added to a point with the right first derivative only, it turns third derivatives of the step, which would be wrong,
    into NaN.
    """
    total = sum(jnp.sum(rows) for rows in jax.tree.leaves(residual))
    return jnp.abs(total - jax.lax.stop_gradient(total)) ** 1.5


@jax.custom_jvp
def differentiable(equations: StepEquations, x: Unknowns, end):
    """x and end unchanged, with the derivative of the root in both modes, twice; a third derivative is NaN."""
    return x, end


@differentiable.defjvp
def _implicit_derivative(primals, tangents):
    equations, root, end = primals
    direction = newton_direction(equations, root)
    # For second derivatives: a Newton step x - (dR/dx)^-1 R at the root changes nothing, but makes x a function of the
    # equations with the right first derivative. A recursive call of `differentiable` would not do: for reverse mode JAX
    # evaluates the first derivative in part, and this partial evaluation drops the rules of custom derivatives.
    residual, _ = Intervals(equations).residual(root)
    unknown_beyond = _no_third_derivative(residual)
    newton = jax.tree.map(lambda a, step: a + step + unknown_beyond, root, direction(residual))
    x = _with_derivative_of(root, newton)
    (_, end_of_x), push = jax.linearize(lambda e, x: Intervals(e).residual(x), equations, x)
    change, _ = push(tangents[0], jax.tree.map(jnp.zeros_like, x))

    # dR/dx dx = -dR/de de. `custom_linear_solve` differentiates dx through `product`, that is through dR/dx at x; its
    # own solves take the factors of `direction`, computed once.
    rows, by_name = ravel_pytree(jax.tree.map(jnp.negative, change))
    none = jax.tree.map(jnp.zeros_like, tangents[0])

    def product(dx):
        """``dR/dx dx``."""
        return ravel_pytree(push(none, by_name(dx))[0])[0]

    def solved(_, rows):
        """``(dR/dx)^-1`` times the rows."""
        return -ravel_pytree(direction(by_name(rows)))[0]

    def solved_transposed(_, rows):
        return jax.linear_transpose(partial(solved, None), rows)(rows)[0]

    dx = by_name(jax.lax.custom_linear_solve(product, rows, solved, solved_transposed))
    _, d_end = push(tangents[0], dx)
    return (x, _with_derivative_of(end, end_of_x)), (dx, d_end)
