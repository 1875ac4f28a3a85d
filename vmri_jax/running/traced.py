"""Runs under transformations of JAX: all of a run is one function of arrays, made again with exact matrices where it fails."""

from collections.abc import Callable
from functools import partial

import jax

from vmri_jax.running.adjoints import by_the_other, chosen, forward, one_or_other, reversible, telling
from vmri_jax.running.engine import Engine
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.trajectory import Trajectory


def traced_run(run: Simulation, adjoint: str) -> Trajectory:
    """All steps of a run, some of whose arrays are tracers; `adjoint` as of `simulate`."""
    system, scheme, every = run.system, run.scheme, run.save_every
    arrays = run.arrays
    kind = chosen(adjoint, scheme, run.num_steps, system.force is not None)
    if adjoint == "auto" and kind != "stored":
        arrays = telling(kind, run.num_steps, arrays)
    if not run.plan.has_fallback:
        return _differentiated(kind, run.engine, every)(arrays)
    exact = run.exact_engine
    if kind == "reversible":  # long runs: the faster method is worth a second program
        march, exact_alone = (_differentiated(kind, one, every) for one in (run.engine, exact))
        return one_or_other(march, exact_alone, arrays)
    stored = partial(_march_first, run.engine, exact, every)
    if kind == "checkpoint":
        return by_the_other(stored, _differentiated(kind, exact, every), arrays)
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
def _march_first(march: Engine, exact: Engine, save_every: int, arrays) -> Trajectory:
    """The run by the first method, whose loops are single kernels; with exact matrices if that fails."""
    found = _stored(march, save_every, arrays)
    return jax.lax.cond(found.failed_at < 0, lambda: found, lambda: _stored(exact, save_every, arrays))


@_march_first.defjvp
def _by_exact_matrices(march, exact, save_every, primals, tangents):
    """Derivatives are those of the run with exact matrices, the same numbers: one program instead of two."""
    return jax.jvp(partial(_stored, exact, save_every), primals, tangents)
