"""`vmri simulate`: one run, and a report of its steps, errors and files."""

import math
import shlex
import sys
import time
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from typer import Option

from vmri_jax import plots
from vmri_jax.accuracy.simulate import simulate as run_at_once
from vmri_jax.catalogue import find_problem, find_scheme
from vmri_jax.cli import common
from vmri_jax.cli.common import PICTURES, check_target, console, print_failure, print_named
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Save, nothing_fast
from vmri_jax.running.export import summary_of
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.store.stored import StoredTrajectory
from vmri_jax.running.store.stream import stream
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.steppers.results import SimulationError
from vmri_jax.steppers.solver import Solver

DEFAULT_SCHEME = "fully-implicit"
"""The scheme of a run without --scheme and --accuracy."""
DEFAULT_SAVED_NODES = 1000
"""Approximate number of saved nodes of a run without --save-every; more make larger files."""
MOST_READ_NODES = 10_000
"""Largest number of nodes of a figure, and of a store in its summary; more are not seen, and take longer."""


def simulate(
    system: common.System,
    steps: Annotated[int | None, Option(help="Number of macro steps; not with --accuracy.")] = None,
    macro_dt: common.MacroStep = None,
    scheme: Annotated[
        str | None, Option(help="See vmri schemes. [dim]default: fully-implicit; with --accuracy chosen[/dim]")
    ] = None,
    num_micro: common.NumMicro = 10,
    alpha: common.Alpha = None,
    degree: common.Degree = None,
    rule: common.Rule = None,
    compose: common.Compose = None,
    accuracy: Annotated[float | None, Option(help="Largest error of a position, for which steps are chosen.")] = None,
    t_end: Annotated[float | None, Option(help="End of the run, with --accuracy.")] = None,
    error: Annotated[bool, Option("--error", help="Estimate the error of the positions.")] = False,
    save_every: Annotated[
        int | None, Option(help=f"Macro steps per saved node. [dim]default: {DEFAULT_SAVED_NODES} nodes[/dim]")
    ] = None,
    save_micro: Annotated[bool, Option("--save-micro", help="Keep the fast motion within macro steps too.")] = False,
    matrix: Annotated[str, Option(help="auto, masses, modes, exact or null-space.")] = "auto",
    out: Annotated[Path | None, Option(help="Write it here: .npz at the end, or .zarr during the run.")] = None,
    resume: Annotated[bool, Option("--resume", help="Go on with the run in --out, a .zarr.")] = False,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace the run in --out, a .zarr.")] = False,
    plot: Annotated[Path | None, Option(help="Draw the run here: .png, .svg or .pdf.")] = None,
) -> None:
    """Simulate a system, and report steps, energy, constraints and time.

    Examples:

    vmri simulate fpu --macro-dt 0.1 --steps 2000 --out run.npz --plot run.png

    vmri simulate fpu --macro-dt 0.1 --steps 10000000 --out run.zarr

    vmri simulate tsp --scheme fully-explicit --alpha 0.5 --num-micro 5 --macro-dt 0.01 --steps 1000

    vmri simulate my_file.py:my_problem --scheme galerkin --degree 2 --macro-dt 0.05 --steps 400
    """
    check_target("--plot", plot, *PICTURES)
    streamed, problem = _check_options(out, resume, overwrite, steps, accuracy, t_end, error), find_problem(system)
    of_scheme, chosen = {"compose": compose, "alpha": alpha, "degree": degree, "rule": rule}, None
    if scheme is not None or accuracy is None:
        scheme = scheme or DEFAULT_SCHEME
        chosen = find_scheme(scheme, num_micro, **of_scheme)
    elif without := " and ".join(f"--{name}" for name, value in of_scheme.items() if value is not None):
        raise Refused(f"got {without} without --scheme, which --accuracy chooses then; give --scheme with it.")
    before = StoredTrajectory(out) if out is not None and resume and out.exists() else None
    if save_every is None and steps is not None and not save_micro:
        save_every = default_save_every(steps) if before is None else before.save_every
    arguments = {
        "macro_dt": macro_dt,
        "num_steps": steps,
        "save": Save(save_every, micro=save_micro, progress=True),
        "solver": Solver(matrix.replace("-", "_")),
    }
    if streamed:
        arguments |= {"out": out, "resume": resume, "overwrite": overwrite, "drawing": problem.drawing}
    else:
        arguments |= {"accuracy": accuracy, "t_end": t_end, "error": error}
    compiling = _compile_clock()
    start = time.perf_counter()
    trajectory, stopped = _run(stream if streamed else run_at_once, problem, chosen, arguments)
    seconds, compiled = time.perf_counter() - start, sum(compiling)
    stride = -(-len(trajectory) // MOST_READ_NODES)
    saved, nodes = [str(out)] if streamed else [], trajectory[::stride]
    try:  # the report is printed even if a file cannot be written
        if out is not None and isinstance(trajectory, Trajectory):
            trajectory.save(out, problem.drawing)
            saved.append(str(out))
        if plot is not None:
            title = f"{system}, accuracy {accuracy:g}" if accuracy else f"{system}, {scheme}, {num_micro} micro steps"
            plots.save(plots.plot_trajectory(nodes, title), plot)
            saved.append(str(plot))
    finally:
        if stopped is None:
            _, lines = summary_of(nodes if streamed else trajectory)
            times = f"t = {trajectory[0].t:.6g} to {trajectory[-1].t:.6g}"
            read = f"; this summary is of one in {stride}" if streamed and stride > 1 else ""
            lines["nodes"] = f"{len(trajectory)} saved nodes from {times}{read}"
            if steps is not None and chosen is not None:  # else the time includes trial runs
                lines["macro steps"] = f"{steps}, of {chosen.num_micro} micro steps each"
                done = (steps - (0 if before is None else before.step)) * chosen.num_micro
                lines["per micro step"] = f"{1e6 * max(seconds - compiled, 0.0) / done:.3g} µs" if done else ""
            lines |= {} if trajectory.keeps_energy else _energy_balance(trajectory)
            lines["wall time"] = f"{seconds:.2f} s, of which {compiled:.2f} s compiling"
            lines["saved"] = ", ".join(saved) or "nothing; give --out run.npz or --plot run.png"
            lines[""] = "" if chosen is None else nothing_fast(chosen, problem.q_f.size)
            print_named(lines)
            if steps is None and trajectory.settings.options:  # the scheme was chosen
                command = trajectory.settings.command(system) + ("" if matrix == "auto" else f" --matrix {matrix}")
                console.print(f"The same run again:\n[bold]{escape(command)}[/bold]", soft_wrap=True)
        else:
            _print_stop(stopped, saved, streamed)
    if isinstance(stopped, Interrupted):
        raise stopped
    if stopped is not None:
        of_step = {"macro-dt": macro_dt, "scheme": scheme, "num-micro": num_micro} | of_scheme
        words = [word for name, x in of_step.items() if x is not None for word in (f"--{name}", str(x))]
        command = escape(shlex.join(["vmri", "advise", system, *words]))
        text = "Whether this step is stable, which one near it is, and whether slow and fast are swapped"
        Console(stderr=True).print(f"{text}:\n[bold]{command}[/bold]", soft_wrap=True)
        raise typer.Exit(1)


def _run(run, problem, scheme, arguments: dict):
    """The trajectory, and the exception that stopped the run before its end, or None."""
    try:
        return jax.block_until_ready(run(problem, scheme, **arguments)), None
    except (SimulationError, Interrupted) as stopped:
        return stopped.trajectory if isinstance(stopped, SimulationError) else stopped.done, stopped


def _print_stop(stopped: SimulationError | Interrupted, saved: list[str], streamed: bool) -> None:
    """Print the reason of a failure, and the files of a run that was stopped."""
    if isinstance(stopped, SimulationError):
        labels = f"\n\n{stopped.labels}" if stopped.labels else ""
        reason = f"Macro step {stopped.step} at t = {stopped.time:.6g}: {stopped.result.message}{labels}"
        print_failure("The run failed", reason)
    if saved:
        console.print(f"The trajectory up to there is in {escape(' and '.join(saved))}.", soft_wrap=True)
    if streamed and isinstance(stopped, Interrupted):
        again = [word for word in sys.argv[1:] if word not in ("--resume", "--overwrite")]
        command = escape(shlex.join(["vmri", *again, "--resume"]))
        console.print(f"Go on with it:\n[bold]{command}[/bold]", soft_wrap=True)


def _check_options(out, resume, overwrite, steps, accuracy, t_end, error) -> bool:
    """Whether to stream the run into a store; refuses options that contradict each other or do not fix its length."""
    streamed = out is not None and out.suffix.lower() == ".zarr"
    if (resume or overwrite) and not streamed:
        option = "--resume" if resume else "--overwrite"
        raise Refused(f"{option} is for a run that is written while it goes; give --out run.zarr.")
    if out is not None and not (streamed and out.is_dir()):  # `stream` checks an existing store
        check_target("--out", out, ".npz", ".zarr")
    if (steps is None) == (accuracy is None):
        got = "neither" if steps is None else "both"
        raise Refused(f"got {got} of --steps and --accuracy; give exactly one of them.")
    if (t_end is None) != (accuracy is None):
        raise Refused("--accuracy and --t-end go together: the largest error, and the time until which it is kept.")
    if streamed and (error or accuracy is not None):
        option = "--error" if error else "--accuracy"
        raise Refused(f"{option} compares runs that are in memory; give --out with a file that ends in .npz.")
    return streamed


def _compile_clock() -> list[float]:
    """A list to which JAX appends the seconds of every later compilation."""
    seconds: list[float] = []

    def listen(event: str, duration_secs: float, **_) -> None:
        if event.startswith("/jax/core/compile/"):
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    return seconds


def _energy_balance(trajectory: Trajectory | StoredTrajectory) -> dict[str, str]:
    """Work of forces and of moving constraints, and the remainder of their balance; a stored run is read in pieces."""
    pieces = [trajectory] if isinstance(trajectory, Trajectory) else trajectory.chunks()
    works = [piece.work() for piece in pieces]
    forces, constraints, left = (sum(part[-1] for part in parts) for parts in zip(*(w[:3] for w in works), strict=True))
    uncertainty = sum(work.uncertainty for work in works)
    work = {"work of forces": forces, "work of moving constraints": constraints}
    words = {name: f"{value:.6g}" for name, value in work.items() if value != 0}
    balance = f"{left:.1e} left at the end; the saved nodes resolve the work to {uncertainty:.1e}"
    return words | {"energy balance": balance}


def default_save_every(steps: int) -> int:
    """The divisor of `steps` whose number of saved nodes is nearest to `DEFAULT_SAVED_NODES`; 1 for short runs."""
    if steps <= DEFAULT_SAVED_NODES:
        return 1
    small = [d for d in range(1, math.isqrt(steps) + 1) if steps % d == 0]
    divisors = [*small, *(steps // d for d in reversed(small))]
    return min(divisors, key=lambda d: abs(np.log(steps / d / DEFAULT_SAVED_NODES)))
