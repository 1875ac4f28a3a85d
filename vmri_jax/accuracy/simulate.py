"""`simulate`: a run with given steps, or with steps chosen for an accuracy; with an estimate of its error on request."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vmri_jax.accuracy.companions import check_function_of_run, with_error
from vmri_jax.accuracy.steps import with_accuracy
from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.checks import check_flags, check_system
from vmri_jax.mechanics.state import Movable, State
from vmri_jax.running.adjoints import check_adjoint, traced_run
from vmri_jax.running.arguments import Steps
from vmri_jax.running.failures import simulation_error
from vmri_jax.running.memory import check_memory
from vmri_jax.running.progress import ShowsProgress, progress_to
from vmri_jax.running.simulation import simulation
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solver import Solver


def simulate(
    system: Movable,
    scheme: Scheme | Composition | None = None,
    state: State | None = None,
    *,
    macro_dt=None,
    micro_dt=None,
    num_steps: int | None = None,
    t_end: float | None = None,
    save_every: int = 1,
    save_micro: bool = False,
    solver: Solver | None = None,
    throw: bool = True,
    progress: ShowsProgress = False,
    adjoint: str = "auto",
    error: bool = False,
    of: Callable[[Trajectory], Any] | None = None,
    accuracy: float | None = None,
    num_saves: int | None = None,
) -> Trajectory:
    """Simulate `num_steps` macro steps, or up to `t_end`, and save every `save_every`-th macro node.

        run = vm.simulate(problem, vm.fully_implicit(10), macro_dt=0.01, t_end=10.0)
        run = vm.simulate(problem, accuracy=1e-5, t_end=10.0)

    With an accuracy, trial runs choose the steps, and the scheme if none is given, see `vmri_jax.accuracy.steps`; ``run.settings`` has the
    choice, ``run.error`` the error of the run. Resonant steps are avoided in systems of up to 60 coordinates.

    Outside of transformations, `simulate` compiles once per structure of system and scheme: macro steps, parameters, rule weights, starts,
    numbers of steps and of saved nodes vary without another compilation; num_micro and save_micro are part of the structure. It works
    under ``jax.vmap`` over state, params and macro_dt, and under ``jax.grad`` and ``jax.jacfwd``, where save_every and the number of saved
    nodes are part of the structure, too. There a failed step does not raise: the status is in the trajectory. Names work inside of the
    transformed function: ``run.position("load")``. Under ``jax.vmap`` the matrix "auto" computes its fallback for every lane: take
    `simulate_batch`, or ``solver=vm.plan(system, scheme, state).first``.

    A run whose system keeps its energy warns with `LostEnergyWarning` if the energy changes by more than half of the largest kinetic energy, and a run
    across a pole of its coordinates with `SingularCoordinatesWarning`; ``run.concerns()`` has these sentences, also after a run in a transformation.

    Args:
        system: a `Problem` or a scene; or a `System`, with a state.
        scheme: a scheme or composition; None, with an accuracy, to have it chosen.
        state: start, from `initial_state` or an earlier run; None for the start of the problem.
        macro_dt, micro_dt: step size, exactly one of them (``macro_dt = num_micro * micro_dt``).
        num_steps, t_end: number of macro steps, a multiple of `save_every`, or the time of the end; exactly one of them.
        save_every: macro steps from one saved node to the next.
        save_micro: also keep the fast positions at the micro nodes of the macro step that ends at each saved node.
        solver: for implicit equations; None for ``Solver()``.
        throw: raise `SimulationError` (which carries the partial trajectory) if a step fails; else return the trajectory,
            NaN after the failure.
        progress: True for a bar, or a function of (what, done, total), with an accuracy called before every trial run. With False a run
            that takes more than two seconds prints lines on the error stream, whether it is tracing, compiling or stepping.
        adjoint: which states a run keeps for derivatives, see `vmri_jax.running.adjoints`: "stored" for all modes, "checkpoint" for reverse
            mode in little memory; "auto" chooses by length.
        error: estimate the error of the positions and its slow and fast share, ``run.error``, a `RunError`. This takes two more runs: one
            with half the macro step, one with twice the micro steps, which needs another program. A failed run has no error.
        of: with `error` or `accuracy`, a function of a run (without micro nodes) whose error is estimated, too, ``run.error.of``. It returns
            numbers, such as ``lambda run: run.position("load")``.
        accuracy: largest error of a position at a saved node, in the unit of the positions; replaces the step size, and needs `t_end`.
        num_saves: with an accuracy, the number of saved intervals, equally spaced. None for one per macro step, at most 1000; these are
            often few, so that a smooth curve takes, for example, num_saves=200.

    Returns:
        The `Trajectory`, with ``num_steps / save_every + 1`` saved nodes. Times are ``t_0 + k macro_dt``, computed from
        the step number k, never accumulated.

    Raises:
        ValueError, TypeError: bad arguments, before anything is computed; an accuracy larger than the motion, after the first trial runs.
        SimulationError: a step failed.
        Interrupted: Ctrl-C while `progress` is shown; it carries the trajectory computed so far.
    """
    check_flags(throw=throw, error=error)
    steps = Steps(macro_dt, micro_dt, num_steps, t_end, save_every, save_micro)
    if accuracy is not None:
        length = {"t_end": _end(steps, adjoint, num_saves), "num_saves": num_saves}
        with progress_to("simulate", progress) as tell:
            best, settings = with_accuracy(system, scheme, state, solver, accuracy, **length, of=of, progress=tell)
        run, trajectory = best.run, replace(best.trajectory, origin=replace(best.run.origin, settings=settings))
        if int(trajectory.failed_at) < 0:
            for concern in trajectory.concerns():
                warnings.warn(type(concern)(f"simulate: {concern}"), stacklevel=2)
            return with_error(run, trajectory, of, shares=error, trial=(best.halved, best.errors))
        if throw:
            raise simulation_error(trajectory, run.macro_dt, run.save_every, run.scheme.num_micro)
        return trajectory
    if scheme is None:
        raise ValueError(
            "simulate: scheme is None without an accuracy; give a scheme, or accuracy=1e-5 to have one chosen."
        )
    if num_saves is not None:
        raise ValueError(
            f"simulate: num_saves is {num_saves} without an accuracy; give an accuracy, or save_every with a step."
        )
    check_adjoint(adjoint)
    run = simulation(system, scheme, state, solver, steps)
    if not run.is_concrete:
        if error:
            raise ValueError(
                "simulate: error=True compares runs with numbers; call simulate outside of jax.jit, vmap and grad."
            )
        check_system(run.system, run.state.q_s, run.state.q_f)
        return traced_run(run, adjoint)
    run.check()
    check_memory("simulate", run.state, scheme.num_micro, run.num_saves, save_micro)
    check_function_of_run(of, error, run)
    trajectory = run.in_pieces(progress, "simulate")
    if throw and int(trajectory.failed_at) >= 0:
        raise simulation_error(trajectory, run.macro_dt, save_every, scheme.num_micro)
    return with_error(run, trajectory, of) if error and int(trajectory.failed_at) < 0 else trajectory


def _end(steps: Steps, adjoint: str, num_saves: int | None) -> float:
    """`t_end` of a run with an accuracy; refuses arguments of step size and saving, which the accuracy determines."""
    refused = [name for name in ("macro_dt", "micro_dt", "num_steps") if getattr(steps, name) is not None]
    others = {"save_every": steps.save_every != 1, "save_micro": steps.save_micro, "adjoint": adjoint != "auto"}
    refused += [name for name, is_set in others.items() if is_set]
    if refused:
        raise ValueError(
            f"simulate: got {' and '.join(refused)} with an accuracy, which chooses steps and saved nodes; leave them out, or the "
            "accuracy."
        )
    if steps.t_end is None:
        raise ValueError("simulate: an accuracy needs t_end, the time until which it is to be kept.")
    if num_saves is not None:
        whole_number("simulate: num_saves", num_saves)
    return steps.t_end
