"""Runs under transformations of JAX: the whole run is one function of arrays.

Names with `exact` belong to the fallback, see `vmri_jax.running.simulation`.
"""

from collections.abc import Callable
from functools import partial

import jax

from vmri_jax.running.adjoints import announced, chosen_adjoint, differentiated_by, forward, reversible, with_fallback
from vmri_jax.running.engine import Engine
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.trajectory import Trajectory


def traced_run(run: Simulation, adjoint: str) -> Trajectory:
    """All steps of a run, some of whose arrays are tracers; `adjoint` as of `simulate`."""
    system, scheme, every = run.system, run.scheme, run.save_every
    arrays = run.arrays
    kind = chosen_adjoint(adjoint, scheme, run.num_steps, system.force is not None)
    if adjoint == "auto" and kind != "stored":
        arrays = announced(kind, run.num_steps, arrays)
    if not run.plan.has_fallback:
        return _differentiated(kind, run.engine, every)(arrays)
    exact = run.exact_engine
    if kind == "reversible":  # long runs: the derivative of the faster first solver is worth a second program
        first, fallback = (_differentiated(kind, engine, every) for engine in (run.engine, exact))
        return with_fallback(first, fallback, arrays)
    stored = partial(_first_method, run.engine, exact, every)
    if kind == "checkpoint":
        return differentiated_by(_differentiated(kind, exact, every), stored, arrays)
    return stored(arrays) if kind == "stored" else forward(stored, arrays)


def _differentiated(kind: str, engine: Engine, save_every: int) -> Callable[[tuple], Trajectory]:
    """The run as a function of its arrays, with this adjoint."""
    run = partial(_stored, engine, save_every)
    kinds = {
        "stored": run,
        "forward": partial(forward, run),
        "reversible": partial(reversible, run, engine, save_every),
        "checkpoint": lambda arrays: engine.checkpointed(arrays, save_every),
    }
    return kinds[kind]


def _stored(engine: Engine, save_every: int, arrays) -> Trajectory:
    return engine.stored(arrays, save_every)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _first_method(first: Engine, exact: Engine, save_every: int, arrays) -> Trajectory:
    """The run with the first solver of its plan, or with the fallback if the first solver fails."""
    trajectory = _stored(first, save_every, arrays)
    return jax.lax.cond(trajectory.failed_at < 0, lambda: trajectory, lambda: _stored(exact, save_every, arrays))


@_first_method.defjvp
def _by_exact_matrices(first, exact, save_every, primals, tangents):
    """Value and derivative of the run with the fallback: to differentiate with both solvers would compile two programs.

    Values of the two solvers differ by the tolerance of the solver.
    """
    return jax.jvp(partial(_stored, exact, save_every), primals, tangents)
