"""Newton's iteration for the equations of a macro step: its flavours, its convergence test, its derivative."""

from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.cpu import largest
from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.checks import CONSTRAINT_TOLERANCE
from vmri_jax.schemes.composition import stage_scheme
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.steppers.newton import arrowhead, collocation, drift, full, march
from vmri_jax.steppers.newton.interval import can_be_cut, is_linear
from vmri_jax.steppers.newton.linearization import linearize
from vmri_jax.steppers.results import RUNNING, Method, Result
from vmri_jax.steppers.split import is_drift, is_explicit, split

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
    is in ``StepInfo.method`` and ``Trajectory.info.method``. Where a step is a single drift along the constraints between kicks
    (``fully_explicit(1)``: RATTLE) "march" solves for the multipliers alone, and where it is a single interval of higher degree
    (``galerkin(1, degree)``) for all variables at once, in modes of time (`vmri_jax.steppers.newton.collocation`).

    Args:
        method: as above.
        tolerance: accepted error of the increments of the step, relative to their size. Errors of the positions at
            the level of round-off are always accepted.
        max_iterations: after so many iterations the step fails; with "march", so many passes.
        fixed_iterations: do exactly so many iterations and check the result afterwards, without a loop that depends
            on the data; a step that has not converged then has failed, whatever the method.

    Raises:
        ValueError: an unknown method, a tolerance that is not positive, a number of iterations below 1.
        TypeError: what is no number.
    """

    method: Choice = eqx.field(static=True, default="auto")
    tolerance: float = 1e-12
    max_iterations: int = 100
    fixed_iterations: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.method not in get_args(Choice):
            raise ValueError(f"Newton: method is {self.method!r}; it must be one of {', '.join(get_args(Choice))}.")
        if not isinstance(self.fixed_iterations, int | None):
            raise TypeError(f"Newton: fixed_iterations is {self.fixed_iterations!r}; it must be an integer or None.")
        for name in ("tolerance", "max_iterations", "fixed_iterations"):
            value = getattr(self, name)
            if (
                (name != "fixed_iterations" or value is not None)
                and is_concrete(value)
                and not real_array(f"Newton: {name}", value, 0) > 0
            ):
                raise ValueError(f"Newton: {name} is {value}; it must be positive.")

    def status(self, change, iterations):
        """`Result` after so many iterations, from the largest change still to come over what is accepted, or RUNNING."""
        goes_on = self.fixed_iterations is None and iterations < self.max_iterations
        otherwise = jnp.where(goes_on, RUNNING, Result.STAGNATED)
        return jnp.where(jnp.isfinite(change), jnp.where(change <= 1, Result.CONVERGED, otherwise), Result.NON_FINITE)

    def iterate(self, step, at, done: int = 0):
        """``step(at)`` while ``at.result`` is RUNNING, or as often as was asked for; `done` iterations are behind."""
        if self.fixed_iterations is None:
            return jax.lax.while_loop(lambda at: at.result == RUNNING, step, at)
        return jax.lax.fori_loop(done, self.fixed_iterations, lambda _, at: step(at), at)

    @property
    def falls_back(self) -> bool:
        """Whether a step that the nested march does not solve is solved by the exact arrowhead."""
        return self.method == "auto" and self.fixed_iterations is None

    def alone(self, system, scheme) -> "Newton":
        """The nested march alone where this method falls back from it (which takes long to compile), else the same."""
        return replace(self, method="march") if self.falls_back and self.marches(system, stage_scheme(scheme)) else self

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


def is_solved(system, scheme, q_s, q_f) -> bool:
    """Whether a step iterates at all: whether it is neither explicit nor linear, nor are its parts."""
    parts = split(system, scheme, q_s, q_f)
    if parts is not None:
        none = jnp.zeros(0)
        pairs = (parts.slow, parts.slow_scheme, q_s), (parts.fast, parts.fast_scheme, q_f)
        return any(is_solved(part, rules, none, q) for part, rules, q in pairs)
    return not is_explicit(system, scheme) and not (can_be_cut(system, scheme) and is_linear(system, scheme, q_s, q_f))


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
    marches = newton.marches(equations.system, equations.scheme)
    if marches and is_linear(equations.system, equations.scheme, equations.q_s, equations.q_f):
        done, warm = march.solve(equations, matrix, warm, newton, linear=True)  # one pass: differentiable as it is
        end = done.end.q_f, *_momenta_after(equations, done)
        status = np.zeros(()), done.result, done.passes, np.asarray(int(Method.LINEAR))
        return Solution(done.x, *end, *status), warm

    fixed, guess, matrix, warm = jax.lax.stop_gradient((equations, guess, matrix, warm))
    if marches:
        found, warm = _by_march(fixed, guess, matrix, warm, newton)
        if newton.falls_back:
            found = jax.lax.cond(
                found.result <= Result.CONVERGED_AT_ROUNDOFF,
                lambda: found,
                lambda: _over_all_unknowns(fixed, guess, newton, "arrowhead"),
            )
    else:
        method = "arrowhead" if newton.method == "auto" else newton.method
        found = _over_all_unknowns(fixed, guess, newton, method)
    x, end = _differentiable(equations, found.x, (found.q_f, found.p_s, found.p_f))
    return Solution(x, *end, *found[4:]), warm


def _by_march(equations: StepEquations, guess: Unknowns, matrix, warm, newton: Newton) -> tuple[Solution, Any]:
    """By the nested march; where a step is a drift only the multipliers are solved for, a single interval at once."""
    if is_drift(equations.system, equations.scheme):
        done, x, end, warm = drift.solve(equations, warm, newton)
        rows, g, iterations = 0.0, largest(done.g), done.iterations
    elif collocation.is_collocation(equations.system, equations.scheme, equations.q_s, equations.q_f):
        done, x, end, (rows, g) = collocation.solve(equations, guess, newton)
        iterations = done.iterations
    else:
        done, warm = march.solve(equations, matrix, warm, newton, linear=False)
        x, end, iterations = done.x, (done.end.q_f, *_momenta_after(equations, done)), done.passes
        rows, g = done.residual
    q_f, p_s, p_f = end
    result = _kept(done.result, equations, g, newton)
    residual, method = relative_residual(equations, rows, g), np.asarray(int(Method.MARCH))
    return Solution(x, q_f, p_s, p_f, residual, result, iterations, method), warm


def _momenta_after(equations: StepEquations, done: march.March):
    """Momenta after a march: the slow one by the impulse it received, the fast one as handed on."""
    per_h = 1 / equations.micro_dt
    return equations.p_s + per_h * done.impulse, per_h * done.end.p_f


def _end(equations: StepEquations, x: Unknowns):
    """Fast position and momenta at the end of the step."""
    return equations.q_f + x.fast[:, -1].sum(0), *equations.evaluate(x)[1]


def _over_all_unknowns(equations: StepEquations, guess: Unknowns, newton: Newton, method: str) -> Solution:
    x, result, iterations = full.solve(equations, guess, newton, method)
    residual, (p_s, p_f) = equations.evaluate(x)
    rows = jnp.maximum(largest(residual.slow), largest(residual.fast))
    g = jnp.maximum(largest(residual.multiplier), largest(residual.slow_multiplier))
    q_f = equations.q_f + x.fast[:, -1].sum(0)
    code = jnp.asarray(int(Method[method.upper()]))
    result = _kept(result, equations, g, newton)
    if equations.system.is_constrained:
        failed = result > Result.CONVERGED_AT_ROUNDOFF
        dependent = jax.lax.cond(failed, lambda: full.has_dependent_constraints(equations), lambda: jnp.asarray(False))
        result = jnp.where(dependent, Result.RANK_DEFICIENT, result)
    return Solution(x, q_f, p_s, p_f, relative_residual(equations, rows, g), result, iterations, code)


def _kept(result, equations: StepEquations, g, newton: Newton):
    """The status, unless the increments converged and the constraints are violated: by contradicting rows."""
    if not equations.system.is_constrained:
        return result
    violated = g > jnp.maximum(CONSTRAINT_TOLERANCE, 100 * newton.tolerance)
    return jnp.where((result <= Result.CONVERGED_AT_ROUNDOFF) & violated, Result.CONSTRAINT_VIOLATED, result)


def relative_residual(equations: StepEquations, rows, g):
    """Largest residual left: of the momentum equations relative to the momentum, of the constraints in their unit."""
    momentum = jnp.maximum(largest(equations.p_s), largest(equations.p_f)) * equations.micro_dt
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
