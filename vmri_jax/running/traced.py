"""Runs under transformations of JAX: all of a run is one function of arrays, with the fallback in it."""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import jax

from vmri_jax.running.engine import Engine, engine
from vmri_jax.running.trajectory import Trajectory

if TYPE_CHECKING:
    from vmri_jax.running.simulate import Simulation


def traced_run(run: "Simulation") -> Trajectory:
    """All steps of a run, some of whose arrays are tracers."""
    system, scheme, newton = run.system, run.scheme, run.newton
    arrays = run.leaves, run.start_arrays, run.macro_dt
    if not run.plan.has_fallback:
        return _whole(run.engine, run.save_every, arrays)
    arrowhead = jax.tree.structure((replace(newton, method="arrowhead"), scheme, system))
    exact = engine(arrowhead, run.num_saves, run.save_micro, True)
    return _march_first(run.engine, exact, run.exact_engine, run.save_every, arrays)


def _whole(engine: Engine, save_every: int, arrays) -> Trajectory:
    return engine.whole_of_known_length(*arrays, save_every)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3))
def _march_first(march: Engine, exact: Engine, step_by_step: Engine, save_every: int, arrays) -> Trajectory:
    """The run by the nested march alone, whose loops are single kernels; by the arrowhead if that fails."""
    found = _whole(march, save_every, arrays)
    return jax.lax.cond(found.failed_at < 0, lambda: found, lambda: _whole(exact, save_every, arrays))


@_march_first.defjvp
def _of_each_step(march, exact, step_by_step, save_every, primals, tangents):
    """Derivatives are those of the run that falls back step by step: one program instead of two."""
    return jax.jvp(partial(_whole, step_by_step, save_every), primals, tangents)
