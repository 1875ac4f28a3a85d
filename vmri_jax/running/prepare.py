"""`prepare`: a run that is checked and compiled once, to be called many times."""

import jax

from vmri_jax.mechanics.state import Movable, State
from vmri_jax.running.arguments import Save, refuse_tracers
from vmri_jax.running.progress import Working
from vmri_jax.running.saved import check_memory
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver


def prepare(
    system: Movable,
    scheme: SchemeLike,
    state: State | None = None,
    *,
    macro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save: int | Save = 1,
    solver: Solver | None = None,
) -> Simulation:
    """Check and compile a run of `simulate` once, to be called many times.

        run = vm.prepare(system, scheme, state, macro_dt=0.01, num_steps=1000, save=10)
        trajectory = run()
        other = run(other_state, macro_dt=0.02, params=other_params)

    A call costs some ten microseconds besides its steps, and raises `SimulationError` if a step fails, as `simulate`
    does. The first call that needs the fallback compiles it, which takes as long as `prepare`. The run keeps what the
    functions of the system read from around them (globals, closures, attributes) when it was prepared. Arguments as of
    `simulate`; the run is one program, so that it has no bar.

    Returns:
        The `Simulation`.

    Raises:
        ValueError, TypeError: bad arguments, as of `simulate`.
    """
    run = simulation(system, scheme, state, solver, macro_dt, num_steps, t_end, save)
    refuse_tracers("prepare", run.leaves, ", or take simulate")
    run.check()
    run.save.without_bar("prepare")
    check_memory("prepare", run)
    run = jax.device_put(run)
    with Working("prepare: the program of the run"):
        jax.block_until_ready(run.engine.program(run.leaves, 0, 0))  # no steps: it only compiles
    return run
