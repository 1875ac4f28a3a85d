"""Solvers: how the implicit equations of a step are solved. All of them end at the same solution.

| solver | matrix of an iteration | cost per micro step |
|---|---|---|
| `Nested` | slow path outside, micro intervals in order, each with a small matrix of its own | lowest |
| `Arrowhead` | the same march with exact matrices, kept over passes and steps while corrections shrink | |
| `NullSpace` | the same without multipliers: matrices of the free motions alone | |
| `Dense` | exact, one dense factorisation, O(num_micro^2): baseline and oracle | highest |

`Auto` takes `Nested` where the terms can be cut into micro intervals (constant masses, potentials on the micro grid or kicks at the macro
nodes), and `Arrowhead` where they cannot. A run in which the nested march does not converge is made again by `Arrowhead`, from where it
failed; under a transformation of JAX the step that fails is solved again. ``StepInfo.method`` and ``Trajectory.info.method`` say which one
took a step, ``print(vm.plan(problem, scheme))`` says it beforehand. `Nested` includes its special cases: a single drift along the
constraints between kicks (RATTLE), and a single interval of higher degree (``galerkin(1, degree)``), which is solved for all variables at
once in modes of time.

A correction that is still to come is accepted if it is below a tenth of the tolerance times the motion (of slow variables over the macro
step, of fast ones over a micro step), or round-off of the positions: the formula is in `vmri_jax.steppers.accept`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.steppers.results import RUNNING, Result

if TYPE_CHECKING:
    from vmri_jax.steppers.stepper import Stepper


class Newton(eqx.Module):
    """Newton's iteration, as all solvers use it.

    Args:
        tolerance: error of the increments of a step that is accepted, relative to the largest of them, slow and fast apart. Round-off of
            the positions is always accepted.
        max_iterations: a step that needs more iterations has failed; for `Nested` passes count.
        fixed_iterations: do this number of iterations and check the result afterwards, without a loop that depends on the data; a step that
            has not converged then has failed, whatever the solver. None for as many as the tolerance needs.

    Raises:
        ValueError: a tolerance that is not positive, a number of iterations below 1.
        TypeError: no number.
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
        """The march with exact matrices, with the same numbers."""
        return Arrowhead(self.tolerance, self.max_iterations, self.fixed_iterations)

    def status(self, change, iterations):
        """`Result` after this number of iterations, from the largest change still to come over the accepted one, or RUNNING."""
        goes_on = self.fixed_iterations is None and iterations < self.max_iterations
        otherwise = jnp.where(goes_on, RUNNING, Result.STAGNATED)
        return jnp.where(jnp.isfinite(change), jnp.where(change <= 1, Result.CONVERGED, otherwise), Result.NON_FINITE)

    def iterate(self, step, at, done: int = 0):
        """``step(at)`` while ``at.result`` is RUNNING, or `fixed_iterations` times; `done` iterations are behind."""
        if self.fixed_iterations is None:
            return jax.lax.while_loop(lambda at: at.result == RUNNING, step, at)
        return jax.lax.fori_loop(done, self.fixed_iterations, lambda _, at: step(at), at)


class Auto(Newton):
    """`Nested` where it is possible, with `Arrowhead` for steps that it does not solve; else `Arrowhead`."""

    method = "auto"


class Nested(Newton):
    """Slow path outside, micro intervals in order inside, each with a small matrix of masses and constraints; without a fallback."""

    method = "nested"


class Arrowhead(Newton):
    """The march over micro intervals with exact matrices, by `jax.jacfwd`, kept over passes and steps while corrections shrink."""

    method = "arrowhead"


class NullSpace(Newton):
    """The march in coordinates of the null space of the constraints: no multipliers among the unknowns."""

    method = "null_space"


class Dense(Newton):
    """The exact matrix of all unknowns of a macro step, factorised by LAPACK: baseline and oracle."""

    method = "dense"


class Custom(Newton):
    """Steps by a stepper of one's own, see the page on steppers of one's own.

        vm.simulate(chain, scheme, solver=vm.solvers.Custom(rotation), macro_dt=0.01, num_steps=100)

    Args:
        stepper: a function of a module, ``stepper(system, scheme)``, that returns a `vmri_jax.steppers.stepper.Stepper` for the whole step or
            a `vmri_jax.steppers.solved.Solver` for the equations between the kicks; of a composition it gets the scheme of a stage. It is called while JAX traces the run, so that runs, batches, files and gradients work as with other solvers.
    """

    method = "custom"
    stepper: Callable[..., "Stepper"] = eqx.field(static=True, kw_only=True)

    def __init__(self, stepper: Callable[..., "Stepper"], tolerance: float = 1e-12):
        if not callable(stepper):
            raise TypeError(
                f"Custom: stepper is {stepper!r}; give a function of (system, scheme) that makes a Stepper."
            )
        self.stepper, self.tolerance, self.max_iterations, self.fixed_iterations = stepper, tolerance, 100, None


def named(method: str) -> type[Newton]:
    """The solver with a name of the command line: "auto", "nested", "arrowhead", "null_space" or "dense".

    Raises:
        ValueError: no solver of this name.
    """
    kinds = {kind.method: kind for kind in (Auto, Nested, Arrowhead, NullSpace, Dense)}
    if method not in kinds:
        raise ValueError(f"solvers: method is {method!r}; it must be one of {', '.join(kinds)}.")
    return kinds[method]
