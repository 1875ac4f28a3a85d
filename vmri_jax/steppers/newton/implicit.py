"""Derivative of the solution of a step: that of a root, never of the iterations that found it."""

import jax
import jax.numpy as jnp

from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.newton import arrowhead


def _direction(equations: StepEquations, x: Unknowns, residual: Unknowns) -> Unknowns:
    """``-(dR/dx)^-1 residual`` with the matrix at x."""
    return arrowhead.solve(arrowhead.factor(equations, x), residual)


def _end(equations: StepEquations, x: Unknowns):
    """Fast position and momenta at the end of the step."""
    return equations.q_f + x.fast[:, -1].sum(0), *equations.evaluate(x)[1]


@jax.custom_jvp
def differentiable(equations: StepEquations, x: Unknowns, end):
    """x and end unchanged, with the derivative of the root: ``dx = -(dR/dx)^-1 (dR/dequations) dequations``."""
    return x, end


@differentiable.defjvp
def _implicit_derivative(primals, tangents):
    equations, root, _ = primals
    # One more Newton step moves nothing, but makes the root depend on the equations, for second derivatives. To call
    # `differentiable` again would not do: in reverse mode JAX forgets the rules of what it has evaluated already.
    x = jax.tree.map(jnp.add, root, _direction(equations, root, equations.residual(root)))
    _, change = jax.jvp(lambda e: e.residual(x), (equations,), (tangents[0],))
    dx = _direction(equations, x, change)
    end, d_end = jax.jvp(_end, (equations, x), (tangents[0], dx))
    return (x, end), (dx, d_end)
