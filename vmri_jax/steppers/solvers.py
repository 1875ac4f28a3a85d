"""Settings of the solvers for the implicit equations of a step. All solvers converge to the same solution.

| solver | Newton matrix | operations per micro step |
|---|---|---|
| `Nested` | approximate: passes over the slow path; in each pass every micro interval takes one Newton step with a small matrix | O(1), fewest |
| `Arrowhead` | exact, by elimination of the micro intervals in order; kept over passes and steps while corrections shrink | O(1) |
| `NullSpace` | as `Arrowhead`, in coordinates of the free motions: no multipliers among the unknowns | O(1) |
| `Dense` | exact, one dense matrix of all unknowns: baseline and reference | O(num_micro^2) |

In a *pass* of `Nested` every micro interval takes one Newton step, in order; then the slow variables are corrected.

`Auto` takes `Nested` where every term belongs to single micro intervals (constant masses, potentials on the micro grid, or kicks at the macro
nodes or at every k-th micro node), else `Arrowhead`. If a run does not converge with `Nested`, `Auto` computes it again with `Arrowhead`: the step (in
`macro_step`), the whole run (`prepare`), the lane (batches), or the piece that failed and all pieces after it (`simulate`, `stream`).
``StepInfo.method`` and ``Trajectory.info.method`` say which solver took a step, ``print(vm.plan(problem, scheme))`` says it beforehand. In
two special cases a cheaper solver replaces `Nested`, and ``method`` names it: RATTLE for a single drift along the constraints between
kicks, COLLOCATION for a single interval of higher degree (``galerkin(1, degree)``) without forces and with at most 16 fast variables, unless W is
a sum over single coordinates: solved for all variables at once in modes of time. The classes here are settings; the algorithms are each a `vmri_jax.steppers.solved.Solver`.

An iteration ends if its next correction is below a tenth of the tolerance times the motion (of slow variables over the macro step, of
fast variables over a micro step) plus the round-off of the positions: the formula is in `vmri_jax.steppers.accept`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.steppers.results import RUNNING, Result

if TYPE_CHECKING:
    from vmri_jax.steppers.solved import Solver
    from vmri_jax.steppers.stepper import Stepper


class Newton(eqx.Module):
    """Settings of Newton's iteration, shared by all solvers.

    Args:
        tolerance: the iteration ends when the next correction is below ``tolerance / 10 * max |increments|`` plus the round-off of the
            positions, for slow and for fast variables each (`vmri_jax.steppers.accept`). A saved node fails if the value of a constraint is above
            ``max(1e-6, 100 tolerance)`` of its size (`vmri_jax.mechanics.constraints`).
        max_iterations: a step that needs more iterations has failed; for the march and for `Nested` the passes count.
        fixed_iterations: number of iterations of every step, without a loop that depends on the data; the result is checked at the end, and
            a step that has not converged has failed, without a fallback. None: as many iterations as the tolerance needs.

    Raises:
        ValueError: a tolerance that is not positive, a number of iterations below 1.
        TypeError: an argument that is no number.
    """

    method: ClassVar[str] = ""
    tolerance: float = 1e-12
    max_iterations: int = 100
    fixed_iterations: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        name = type(self).__name__
        if not isinstance(self.fixed_iterations, int | None):
            raise TypeError(f"{name}: fixed_iterations is {self.fixed_iterations!r}; it must be an integer or None.")
        numbers = {"tolerance": self.tolerance, "max_iterations": self.max_iterations}
        if self.fixed_iterations is not None:
            numbers["fixed_iterations"] = self.fixed_iterations
        for field, value in numbers.items():
            if is_concrete(value) and not real_array(f"{name}: {field}", value, 0) > 0:
                raise ValueError(f"{name}: {field} is {value}; it must be positive.")

    def exact(self) -> "Arrowhead":
        """`Arrowhead` with the same tolerance and numbers of iterations."""
        return Arrowhead(self.tolerance, self.max_iterations, self.fixed_iterations)

    def status(self, ratio, iterations):
        """`Result` or RUNNING after some iterations.

        Args:
            ratio: next correction over the accepted one, see `vmri_jax.steppers.accept.Accepted.ratio`.
            iterations: number of iterations so far.
        """
        goes_on = self.fixed_iterations is None and iterations < self.max_iterations
        otherwise = jnp.where(goes_on, RUNNING, Result.STAGNATED)
        return jnp.where(jnp.isfinite(ratio), jnp.where(ratio <= 1, Result.CONVERGED, otherwise), Result.NON_FINITE)

    def iterate(self, step, iterate, done: int = 0):
        """Repeat ``iterate = step(iterate)``: while ``iterate.result`` is RUNNING, or ``fixed_iterations - done`` times.

        Args:
            step: from iterate to iterate.
            iterate: the first one.
            done: number of iterations that went into it; counts with `fixed_iterations` only.
        """
        if self.fixed_iterations is None:
            return jax.lax.while_loop(lambda iterate: iterate.result == RUNNING, step, iterate)
        return jax.lax.fori_loop(done, self.fixed_iterations, lambda _, iterate: step(iterate), iterate)


class Auto(Newton):
    """`Nested` where the terms allow it, with `Arrowhead` as a fallback; else `Arrowhead`."""

    method = "auto"


class Nested(Newton):
    """Passes over the micro intervals, each interval with a small matrix of masses and constraints of its own; without a fallback."""

    method = "nested"


class Arrowhead(Newton):
    """The march over the micro intervals with exact matrices, kept over passes and steps while corrections shrink."""

    method = "arrowhead"


class NullSpace(Newton):
    """The march in coordinates of the null space of the constraints: no multipliers among the unknowns."""

    method = "null_space"


class Dense(Newton):
    """The exact matrix of all unknowns of a macro step, factorised by LAPACK: baseline and reference."""

    method = "dense"


class Custom(Newton):
    """Steps by a stepper of the user, see docs/how_to/steppers.md.

        vm.simulate(chain, scheme, solver=vm.solvers.Custom(rotation), macro_dt=0.01, num_steps=100)

    Args:
        stepper: function ``stepper(system, scheme)`` that returns a `vmri_jax.steppers.stepper.Stepper` for the whole step, or a
            `vmri_jax.steppers.solved.Solver` for the equations between the kicks; of a composition it gets the scheme of a stage. It is
            called while JAX traces the run, so that runs, batches, files and gradients work as with other solvers.
        tolerance: a saved node fails if the value of a constraint is above ``max(1e-6, 100 tolerance)`` of its size.
    """

    method = "custom"
    stepper: TracedOnce = eqx.field(kw_only=True)

    def __init__(self, stepper: Callable[..., "Stepper | Solver"], tolerance: float = 1e-12):
        if not callable(stepper):
            raise TypeError(
                f"Custom: stepper is {stepper!r}; give a function of (system, scheme) that makes a Stepper."
            )
        self.stepper, self.tolerance, self.max_iterations, self.fixed_iterations = (
            TracedOnce(stepper),
            tolerance,
            100,
            None,
        )


def named(method: str) -> type[Newton]:
    """The solver with a name of the command line: "auto", "nested", "arrowhead", "null_space" or "dense".

    Raises:
        ValueError: no solver of this name.
    """
    kinds = {kind.method: kind for kind in (Auto, Nested, Arrowhead, NullSpace, Dense)}
    if method not in kinds:
        raise ValueError(f"solvers: method is {method!r}; it must be one of {', '.join(kinds)}.")
    return kinds[method]
