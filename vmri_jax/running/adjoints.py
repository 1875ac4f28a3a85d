"""Derivatives of runs: the whole run as one function of arrays, and the states that reverse mode keeps of it.

The derivative of a step is the derivative of the root of its equations (`vmri_jax.steppers.newton.implicit`). Reverse mode visits
the steps from the last to the first and needs the state at which each step started. Two adjoints provide this state:

* *stored*: the run keeps the start of every step and the solution of its equations; works in forward and reverse mode, up to second
  derivatives; third derivatives are NaN where equations are solved by iteration;
* *checkpoint*: the run keeps the starts of some steps and computes the steps between them again, see `Recursive`; works in reverse mode,
  once.
"""

from collections.abc import Callable

from vmri_jax.running.engine import Engine
from vmri_jax.running.fallback import solved_again, unsolved
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.trajectory import Trajectory

LONGEST_STORED_RUN = 10_000
"""Macro steps of the longest run for which "auto" stores the start of every step; a larger value takes more memory."""


def traced_run(run: Simulation) -> Trajectory:
    """All steps of a run, some of whose arrays are tracers."""
    adjoint = run.save.adjoint
    if adjoint == "auto":
        adjoint = "stored" if run.num_steps <= LONGEST_STORED_RUN else "checkpoint"
    first = _differentiable(run.engine, adjoint, run.save_every)
    if not run.plan.has_fallback:
        return run.traced(first(run.leaves))
    exact = _differentiable(run.exact.engine, adjoint, run.save_every)
    return run.traced(solved_again(first, exact, _is_unsolved, run.leaves))


def _is_unsolved(run: Trajectory):
    return unsolved(run.result, run.info.method.max())


def _differentiable(engine: Engine, adjoint: str, save_every: int) -> Callable[[list], Trajectory]:
    """The run as a function of the leaves of its motion, with this adjoint."""
    program = engine.stored if adjoint == "stored" else engine.checkpointed
    return lambda leaves: program(leaves, save_every)
