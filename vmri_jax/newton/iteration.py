"""Newton's iteration for the equations of a macro step: its flavours, its convergence test, its derivative."""

from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.equations import StepEquations, Unknowns
from vmri_jax.linearization import linearize
from vmri_jax.newton import arrowhead, dense, march
from vmri_jax.newton.interval import can_be_cut, is_linear
from vmri_jax.newton.march import RUNNING
from vmri_jax.results import Method, Result

SAFETY = 100.0
"""Margin on the quadratic convergence that is expected of Newton's iteration."""
ROUNDOFF_FLOOR = 100.0
"""Updates below this many units of round-off of the positions that no longer shrink are at the floor."""

Choice = Literal["auto", "march", "frozen", "decoupled", "arrowhead", "dense"]


class Newton(eqx.Module):
    """How the implicit equations of a step are solved; every method ends at the same solution.

    | method | matrix of an iteration | cost per micro step |
    |---|---|---|
    | "march" | slow path outside, micro intervals in order, each with a small matrix of its own | lowest |
    | "frozen" | the arrowhead, factorised once per macro step | |
    | "decoupled" | the same, without the weak coupling of slow and fast variables | |
    | "arrowhead" | exact block elimination, O(num_micro) | |
    | "dense" | exact, one dense factorisation, O(num_micro^2): baseline and oracle | highest |

    "auto" takes "march" where the terms can be cut into micro intervals (constant masses, potentials on the micro grid
    or kicks at the macro nodes), and "arrowhead" where they cannot or where "march" does not converge; which one it was
    is in ``StepInfo.method`` and ``Trajectory.info.method``.

    Args:
        method: as above.
        tolerance: accepted error of the increments of the step, relative to their size. Errors of the positions at
            the level of round-off are always accepted.
        max_iterations: after so many iterations the step fails.
        fixed_iterations: do exactly so many iterations and check the result afterwards, without a loop that depends
            on the data; a step that has not converged then has failed, whatever the method.

    Raises:
        ValueError: an unknown method, a tolerance that is not positive, a number of iterations below 1.
    """

    method: Choice = eqx.field(static=True, default="auto")
    tolerance: float = 1e-12
    max_iterations: int = 50
    fixed_iterations: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.method not in get_args(Choice):
            raise ValueError(f"Newton: method is {self.method!r}; it must be one of {', '.join(get_args(Choice))}.")
        for name, least in (("tolerance", 0.0), ("max_iterations", 0), ("fixed_iterations", 0)):
            value = getattr(self, name)
            if isinstance(value, int | float) and not value > least:
                raise ValueError(f"Newton: {name} is {value}; it must be positive.")

    @property
    def falls_back(self) -> bool:
        """Whether a step that the nested march does not solve is solved by the exact arrowhead."""
        return self.method == "auto" and self.fixed_iterations is None

    def marches(self, system, scheme) -> bool:
        """Whether the nested march is what this method starts with.

        Raises:
            ValueError: "march" is asked for where it is not possible.
        """
        possible = can_be_cut(system, scheme)
        if self.method == "march" and not possible:
            raise ValueError(
                "Newton: method 'march' needs a ConstantMass, and potentials and forces on the micro grid or as kicks at the "
                "macro nodes; a term of this scheme has nodes inside the macro interval. Take 'auto' or 'arrowhead'."
            )
        return possible and self.method in ("auto", "march")


class Solution(NamedTuple):
    """Unknowns of a macro step, fast position and momenta at its end, and how they were found (see `StepInfo`)."""

    x: Unknowns
    q_f: Any
    p_s: Any
    p_f: Any
    residual: Any
    result: Any
    iterations: Any
    method: Any


def solve(
    equations: StepEquations, guess: Unknowns, newton: Newton, matrix: Any = None, warm: Any = None
) -> tuple[Solution, Any]:
    """Solve ``equations.residual(x) = 0``.

    Args:
        guess: where iterations over all unknowns start.
        matrix, warm: matrix of the micro intervals and what the last step handed on, for the nested march.

    The solution is differentiable in both modes, twice, with respect to everything in `equations`.
    """
    fixed, guess, matrix, warm = jax.lax.stop_gradient((equations, guess, matrix, warm))
    if newton.marches(equations.system, equations.scheme):
        linear = is_linear(equations.system, equations.scheme, equations.q_s, equations.q_f)
        done, warm = march.solve(fixed, matrix, warm, newton, linear)
        p_s, p_f = _momenta_after(fixed, done)
        residual = np.zeros(()) if linear else relative_residual(fixed, *done.residual)
        method = np.asarray(int(Method.LINEAR if linear else Method.MARCH))
        found = Solution(done.x, done.end.q_f, p_s, p_f, residual, done.result, done.passes, method)
        if newton.falls_back and not linear:
            found = jax.lax.cond(
                done.result <= Result.CONVERGED_AT_ROUNDOFF,
                lambda: found,
                lambda: _over_all_unknowns(fixed, guess, newton, "arrowhead"),
            )
    else:
        method = "arrowhead" if newton.method == "auto" else newton.method
        found = _over_all_unknowns(fixed, guess, newton, method)
    x, end = _differentiable(equations, found.x, (found.q_f, found.p_s, found.p_f))
    return Solution(x, *end, *found[4:]), warm


def _momenta_after(equations: StepEquations, done: march.March):
    """Momenta after a march: the slow one by the impulse it received, the fast one as handed on."""
    per_h = 1 / equations.micro_dt
    return equations.p_s + per_h * done.impulse, per_h * done.end.p_f


def _end(equations: StepEquations, x: Unknowns):
    """Fast position and momenta at the end of the step."""
    return equations.q_f + x.fast[:, -1].sum(0), *equations.evaluate(x)[1]


def _over_all_unknowns(equations: StepEquations, guess: Unknowns, newton: Newton, method: str) -> Solution:
    x, result, iterations = _iterate(equations, guess, newton, method)
    residual, (p_s, p_f) = equations.evaluate(x)
    rows = jnp.maximum(_largest(residual.slow), _largest(residual.fast))
    g = jnp.maximum(_largest(residual.multiplier), _largest(residual.slow_multiplier))
    q_f = equations.q_f + x.fast[:, -1].sum(0)
    code = jnp.asarray(int(Method[method.upper()]))
    return Solution(x, q_f, p_s, p_f, relative_residual(equations, rows, g), result, iterations, code)


def _iterate(equations: StepEquations, guess: Unknowns, newton: Newton, method: str):
    """Newton's iteration with the matrix at the present point, or at the guess; (x, `Result`, iterations).

    Converged when the predicted size of all further updates is below ``tolerance`` times the increments, or round-off
    of the positions. With the contraction ``theta = |d_k| / |d_(k-1)|`` the next update is expected to be
    ``|d_k| theta min(1, SAFETY theta)``: quadratic convergence with a margin, linear convergence at worst. A matrix
    that is not renewed converges linearly; there the last update itself has to be that small.
    """
    renewed = method in ("arrowhead", "dense")
    solver = dense if method == "dense" else arrowhead
    factor = partial(arrowhead.factor, coupled=False) if method == "decoupled" else solver.factor
    factors = None if renewed else factor(linearize(equations, guess), guess)
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
        now = factor(linearize(equations, x), x) if renewed else factors
        d = solver.solve(now, equations.residual(x))  # pyright: ignore[reportArgumentType]
        x = jax.tree.map(jnp.add, x, d)
        update = size(d, x)
        contraction, error = update / jnp.maximum(previous, jnp.finfo(eps.dtype).tiny), update
        if renewed:  # quadratic convergence: the next update is known to be much smaller
            shrink = contraction * jnp.minimum(1.0, SAFETY * contraction)
            predicted = jnp.where(contraction < 1, update * shrink / (1 - shrink), jnp.inf)
            error = jnp.where(k == 0, update, predicted)
        largest = jnp.maximum(_largest(d.slow), _largest(d.fast))
        at_floor = (contraction > 0.5) & (largest <= ROUNDOFF_FLOOR * eps * positions)
        last = jnp.where(update > previous, Result.DIVERGED, Result.STAGNATED)
        running = jnp.where(k + 1 >= newton.max_iterations, last, RUNNING)
        result = jnp.where(at_floor, Result.CONVERGED_AT_ROUNDOFF, running)
        result = jnp.where(error <= 1, Result.CONVERGED, result)
        result = jnp.where(jnp.isfinite(update), result, Result.NON_FINITE)
        return x, update, k + 1, result

    start = (guess, jnp.inf, 0, jnp.asarray(RUNNING))
    if newton.fixed_iterations is None:
        x, _, iterations, result = jax.lax.while_loop(lambda carry: carry[3] == RUNNING, iterate, start)
    else:
        x, _, iterations, result = jax.lax.fori_loop(0, newton.fixed_iterations, lambda _, at: iterate(at), start)
        result = jnp.where(result == RUNNING, Result.STAGNATED, result)
    return x, result, iterations


def _largest(a):
    return jnp.max(jnp.abs(a), initial=0.0)


def relative_residual(equations: StepEquations, rows, g):
    """Largest residual left: of the momentum equations relative to the momentum, of the constraints in their unit."""
    momentum = jnp.maximum(_largest(equations.p_s), _largest(equations.p_f)) * equations.micro_dt
    return jnp.maximum(rows / jnp.where(momentum > 0, momentum, 1.0), g)


def _direction(equations: StepEquations, x: Unknowns, residual: Unknowns) -> Unknowns:
    """``-(dR/dx)^-1 residual`` with the matrix at x."""
    return arrowhead.solve(arrowhead.factor(linearize(equations, x), x), residual)


@jax.custom_jvp
def _differentiable(equations: StepEquations, x: Unknowns, end):
    """x and end unchanged, with the derivative of the root: ``dx = -(dR/dx)^-1 (dR/dequations) dequations``."""
    return x, end


@_differentiable.defjvp
def _implicit_derivative(primals, tangents):
    equations, root, _ = primals
    # One more Newton step: it moves nothing, but makes the root depend on the equations, for second derivatives.
    x = jax.tree.map(jnp.add, root, _direction(equations, root, equations.residual(root)))
    _, change = jax.jvp(lambda e: e.residual(x), (equations,), (tangents[0],))
    dx = _direction(equations, x, change)
    end, d_end = jax.jvp(_end, (equations, x), (tangents[0], dx))
    return (x, end), (dx, d_end)
