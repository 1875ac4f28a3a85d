"""`Solver`: how the implicit equations of a step are solved. All matrices lead to the same solution, up to the
tolerance.

The Newton matrices:

* "masses": approximate, masses, W'' and constraints. Passes over the slow path; in each pass every micro interval takes
  one Newton step with a small matrix, the fewest operations. A single drift along the constraints between kicks is
  solved for its multipliers alone (RATTLE). With a kinetic energy T that is a function: the exact matrix, but for
  ``v^T M v / 2`` in place of T, ``M = d2T/dv2`` at the start of the step.
* "modes": approximate, for a single interval of higher degree (``galerkin(1, degree)``): all variables at once, in
  modes of time.
* "exact": exact, by elimination of the micro intervals in order; kept over passes and steps while corrections shrink.
  Where constraints are dependent, it names them as the cause of a failure.
* "null_space": as "exact", in coordinates of the free motions: no multipliers among the unknowns.

"masses" needs a kinetic energy that is a function, or every term in single micro intervals, or as kicks at the macro
nodes or at every k-th micro node; "modes" needs constant masses and no forces. "auto" takes the first matrix that the
structure allows: "modes" with at most 24 variables in an interval, unless W is a sum over single coordinates, else
"masses", else "exact". What "auto" does not solve is solved again with "exact": the step (`macro_step`), the whole run
(`prepare`), the lane (batches), or the piece that failed and all pieces after it (`simulate`, `stream`); see
`vmri_jax.running.engine`. ``print(vm.plan(problem, scheme))`` says beforehand which matrix a step takes,
``StepInfo.method`` and ``Trajectory.info.method`` afterwards.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from vmri_jax.mechanics.arrays import is_concrete, real_array
from vmri_jax.mechanics.functions import TracedOnce, traced_once
from vmri_jax.refusals import Refused
from vmri_jax.steppers.results import RUNNING, Result

MATRICES = ("auto", "masses", "modes", "exact", "null_space")


class Solver(eqx.Module):
    """How the implicit equations of a step are solved, see `vmri_jax.steppers.solver`.

        vm.simulate(problem, scheme, solver=vm.Solver("exact", tolerance=1e-10), macro_dt=0.01, num_steps=100)
        vm.simulate(chain, scheme, solver=vm.Solver(stepper=rotation), macro_dt=0.01, num_steps=100)

    Args:
        matrix: Newton matrix. "auto", the first one that the structure allows, and "exact" for what it does not solve;
            or "masses", "modes", "exact", "null_space" alone.
        tolerance: the iteration ends when the next correction is below ``tolerance / 10 * max |increments|`` plus the
            round-off of the positions, for slow variables (increments over the macro step) and for fast ones (over a
            micro step) each, see `vmri_jax.steppers.accept`. A saved node
            fails if the value of a constraint is above ``max(1e-6, 100 tolerance)`` of its size
            (`vmri_jax.mechanics.constraints`).
        max_iterations: a step that needs more iterations has failed; of "masses" and "exact" the passes count.
        stepper: steps of one's own in place of a matrix: a function ``stepper(system, scheme)`` that returns a
            `vmri_jax.steppers.stepper.Stepper` for the whole step, or a `vmri_jax.steppers.solved.StepSolver` for the
            equations between the kicks; of a composition it gets the scheme of a stage, and where slow and fast
            variables decouple it is called for each part. It is called while JAX traces the run, so that runs, batches,
            files and gradients work as with other solvers, see docs/how_to/steppers.md. It has a tolerance of its own;
            that of this class decides on constraints at saved nodes.

    Raises:
        ValueError: an unknown matrix, a matrix beside a stepper, a tolerance that is not positive, a number of
            iterations below 1.
        TypeError: an argument that is no number, a stepper that is no function.
    """

    matrix: str = eqx.field(static=True, default="auto")
    tolerance: float = 1e-12
    max_iterations: int = 100
    stepper: TracedOnce | None = eqx.field(default=None, converter=lambda f: f and traced_once(f), kw_only=True)

    def __check_init__(self):
        if self.matrix not in MATRICES:
            raise Refused(f"Solver: matrix is {self.matrix!r}; it must be one of {', '.join(MATRICES)}.")
        for name, value in {"tolerance": self.tolerance, "max_iterations": self.max_iterations}.items():
            if is_concrete(value) and not real_array(f"Solver: {name}", value, 0) > 0:
                raise Refused(f"Solver: {name} is {value}; it must be positive.")
        if self.stepper is None:
            return
        if not callable(getattr(self.stepper, "function", None)):
            raise Refused(
                f"Solver: stepper is {self.stepper!r}; give a function of (system, scheme) that makes a Stepper."
            )
        for name, value in {"matrix": self.matrix, "max_iterations": self.max_iterations}.items():
            if value != getattr(type(self), name):
                raise Refused(
                    f"Solver: {name} is {value!r} beside a stepper, which has its own way to solve; leave one of them "
                    "out."
                )

    def exact(self) -> "Solver":
        """The same with exact matrices."""
        return replace(self, matrix="exact")

    def status(self, ratio, iterations):
        """`Result` or RUNNING after some iterations.

        Args:
            ratio: next correction over the accepted one, see `vmri_jax.steppers.accept.Accepted.ratio`.
            iterations: number of iterations so far.
        """
        otherwise = jnp.where(iterations < self.max_iterations, RUNNING, Result.STAGNATED)
        return jnp.where(jnp.isfinite(ratio), jnp.where(ratio <= 1, Result.CONVERGED, otherwise), Result.NON_FINITE)


def iterated(step, iterate):
    """Repeat ``iterate = step(iterate)`` while ``iterate.result`` is RUNNING."""
    return jax.lax.while_loop(lambda iterate: iterate.result == RUNNING, step, iterate)


def only_if(wanted, function, x) -> Any:
    """``function(x)`` if `wanted`, else x.

    A loop of at most one turn: in a batch `jax.lax.cond` would compute both branches.
    """
    return jax.lax.while_loop(lambda a: a[0], lambda a: (jnp.asarray(False), function(a[1])), (wanted, x))[1]
