"""Newton's iteration with a convergence test aware of round-off, differentiable by the implicit function theorem."""

from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from vmri_jax.equations import StepEquations, Unknowns
from vmri_jax.linearization import linearize
from vmri_jax.newton import arrowhead, dense
from vmri_jax.results import Result

LINEAR_SOLVERS = {"arrowhead": arrowhead, "dense": dense}
SAFETY = 100.0
"""Margin on the quadratic convergence that is expected of Newton's iteration."""
ROUNDOFF_FLOOR = 100.0
"""Updates below this many units of round-off of the positions that no longer shrink are at the floor."""


class Newton(eqx.Module):
    """How the implicit equations of a step are solved.

    Args:
        linear_solver: "arrowhead" (block march plus border, O(num_micro)) or "dense" (O(num_micro^3), the oracle).
        tolerance: accepted error of the increments of the step, relative to their size. Errors of the positions at
            the level of round-off are always accepted.
        max_iterations: after so many iterations the step fails.

    Raises:
        ValueError: an unknown solver, a tolerance that is not positive, max_iterations below 1.
    """

    linear_solver: Literal["arrowhead", "dense"] = eqx.field(static=True, default="arrowhead")
    tolerance: float = 1e-12
    max_iterations: int = 50

    def __check_init__(self):
        if self.linear_solver not in LINEAR_SOLVERS:
            raise ValueError(
                f"Newton: linear_solver is {self.linear_solver!r}; it must be one of {', '.join(LINEAR_SOLVERS)}."
            )
        for name, least in (("tolerance", 0.0), ("max_iterations", 0)):
            value = getattr(self, name)
            if isinstance(value, int | float) and not value > least:
                raise ValueError(f"Newton: {name} is {value}; it must be positive.")


def solve(equations: StepEquations, guess: Unknowns, newton: Newton):
    """Solve ``equations.residual(x) = 0`` from a guess; returns (x, `Result` code, iterations).

    Converged when the predicted size of all further updates is below ``tolerance`` times the increments, or round-off
    of the positions. With the contraction ``theta = |d_k| / |d_(k-1)|`` the next update is expected to be
    ``|d_k| theta min(1, SAFETY theta)``: quadratic convergence with a margin, linear convergence at worst.
    The solution is differentiable in both modes, twice, with respect to everything in `equations`.
    """
    fixed = jax.lax.stop_gradient(equations)
    x, result, iterations = _iterate(fixed, jax.lax.stop_gradient(guess), newton)
    return _differentiable(newton.linear_solver, equations, x), result, iterations


def _iterate(equations: StepEquations, guess: Unknowns, newton: Newton):
    eps = jnp.finfo(jnp.result_type(float)).eps
    positions = jnp.maximum(_largest(equations.q_s), _largest(equations.q_f))

    def size(d: Unknowns, x: Unknowns):
        """Largest update over what is accepted, slow and fast each by its own measure.

        Variables that only see round-off of the others (a centre of mass at rest) have no size of their own.
        """
        others = eps * jnp.maximum(_largest(x.slow), _largest(x.fast)) + jnp.finfo(eps.dtype).tiny
        return jnp.maximum(
            _largest(d.slow) / (newton.tolerance * _largest(x.slow) + eps * _largest(equations.q_s) + others),
            _largest(d.fast) / (newton.tolerance * _largest(x.fast) + eps * _largest(equations.q_f) + others),
        )

    def iterate(carry):
        x, previous, k, _ = carry
        d = _direction(newton.linear_solver, equations, x, equations.residual(x))
        x = jax.tree.map(jnp.add, x, d)
        update = size(d, x)
        contraction = update / previous
        shrink = contraction * jnp.minimum(1.0, SAFETY * contraction)  # of the next update: quadratic convergence
        error = jnp.where(contraction < 1, update * shrink / (1 - shrink), jnp.inf)
        error = jnp.where(k == 0, update, error)
        largest = jnp.maximum(_largest(d.slow), _largest(d.fast))
        at_floor = (contraction > 0.5) & (largest <= ROUNDOFF_FLOOR * eps * positions)
        last = jnp.where(update > previous, Result.DIVERGED, Result.STAGNATED)
        running = jnp.where(k + 1 >= newton.max_iterations, last, _RUNNING)
        result = jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, running)
        result = jnp.where(error <= 1, Result.CONVERGED, result)
        result = jnp.where(jnp.isfinite(update), result, Result.NON_FINITE)
        return x, update, k + 1, result

    start = (guess, jnp.inf, 0, jnp.asarray(_RUNNING))
    x, _, iterations, result = jax.lax.while_loop(lambda carry: carry[3] == _RUNNING, iterate, start)
    return x, result, iterations


_RUNNING = -1


def _direction(linear_solver: str, equations: StepEquations, x: Unknowns, residual: Unknowns) -> Unknowns:
    """``-(dR/dx)^-1 residual`` with the matrix at x."""
    solver = LINEAR_SOLVERS[linear_solver]
    return solver.solve(solver.factor(linearize(equations, x), x), residual)


def _largest(a):
    return jnp.max(jnp.abs(a), initial=0.0)


def relative_residual(equations: StepEquations, residual: Unknowns):
    """Largest residual left: of the momentum equations relative to the momentum, of the constraints in their unit."""
    momentum = jnp.maximum(_largest(equations.p_s), _largest(equations.p_f)) * equations.micro_dt
    equation = jnp.maximum(_largest(residual.slow), _largest(residual.fast)) / jnp.where(momentum > 0, momentum, 1.0)
    return jnp.maximum(equation, jnp.maximum(_largest(residual.multiplier), _largest(residual.slow_multiplier)))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(linear_solver: str, equations: StepEquations, x: Unknowns) -> Unknowns:
    """x unchanged, with the derivative of the root: ``dx = -(dR/dx)^-1 (dR/dequations) dequations``."""
    return x


@_differentiable.defjvp
def _implicit_derivative(linear_solver, primals, tangents):
    equations, root = primals
    # One more Newton step: it moves nothing, but makes the root depend on the equations, for second derivatives.
    x = jax.tree.map(jnp.add, root, _direction(linear_solver, equations, root, equations.residual(root)))
    _, change = jax.jvp(lambda e: e.residual(x), (equations,), (tangents[0],))
    return x, _direction(linear_solver, equations, x, change)
