"""Runs under transformations of JAX: all of a run is one function of arrays, with the fallback in it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import jax

from vmri_jax.running.adjoints import chosen, forward, one_or_other, reversible, telling
from vmri_jax.running.engine import Engine, engine
from vmri_jax.running.trajectory import Trajectory

if TYPE_CHECKING:
    from vmri_jax.running.simulate import Simulation


def traced_run(run: "Simulation", adjoint: str) -> Trajectory:
    """All steps of a run, some of whose arrays are tracers; `adjoint` as of `simulate`."""
    system, scheme, newton, every = run.system, run.scheme, run.newton, run.save_every
    arrays = run.leaves, run.start_arrays, run.macro_dt
    kind = chosen(adjoint, scheme, run.num_steps, system.force is not None)
    if adjoint == "auto" and kind != "stored":
        arrays = telling(kind, run.num_steps, arrays)
    if not run.plan.has_fallback:
        return _differentiated(kind, run.engine, every)(arrays)
    arrowhead = jax.tree.structure((replace(newton, method="arrowhead"), scheme, system))
    exact = engine(arrowhead, run.num_saves, run.save_micro, True)
    if kind in ("stored", "forward"):
        stored = partial(_march_first, run.engine, exact, run.exact_engine, every)
        return stored(arrays) if kind == "stored" else forward(stored, arrays)
    march, arrowhead_alone = (_differentiated(kind, one, every) for one in (run.engine, exact))
    return one_or_other(march, arrowhead_alone, arrays)


def _differentiated(kind: str, engine: Engine, save_every: int) -> Callable[[tuple], Trajectory]:
    """The run as a function of its arrays, with this adjoint."""
    run = partial(_stored, engine, save_every)
    kinds = {
        "stored": run,
        "forward": partial(forward, run),
        "reversible": partial(reversible, run, engine, save_every),
        "checkpoint": lambda arrays: engine.checkpointed(*arrays, save_every),
    }
    return kinds[kind]


def _stored(engine: Engine, save_every: int, arrays) -> Trajectory:
    return engine.stored(*arrays, save_every)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3))
def _march_first(march: Engine, exact: Engine, step_by_step: Engine, save_every: int, arrays) -> Trajectory:
    """The run by the nested march alone, whose loops are single kernels; by the arrowhead if that fails."""
    found = _stored(march, save_every, arrays)
    return jax.lax.cond(found.failed_at < 0, lambda: found, lambda: _stored(exact, save_every, arrays))


@_march_first.defjvp
def _of_each_step(march, exact, step_by_step, save_every, primals, tangents):
    """Derivatives are those of the run that falls back step by step: one program instead of two."""
    return jax.jvp(partial(_stored, step_by_step, save_every), primals, tangents)
