"""`vmri simulate`: one run and how it went."""

import time
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

import vmri_jax as vm
from vmri_jax import plots
from vmri_jax.catalogue import find_problem, find_scheme
from vmri_jax.cli.common import BadInput, check_target_file, console, print_failure

SAVED_NODES = 1000
"""About as many nodes are saved by default."""

app = typer.Typer()


@app.command(
    epilog="Examples:\n\n"
    "vmri simulate fpu --macro-dt 0.1 --steps 2000 --out run.npz --plot run.png\n\n"
    "vmri simulate tsp --scheme fully-explicit --alpha 0.5 --num-micro 5 --micro-dt 0.002 --steps 1000\n\n"
    "vmri simulate my_file.py:my_problem --scheme galerkin --degree 2 --macro-dt 0.05 --steps 400"
)
def simulate(
    system: Annotated[str, typer.Argument(help="fpu, tsp, sam, or my_file.py:my_problem.")],
    steps: Annotated[int, typer.Option(help="Number of macro steps.")],
    macro_dt: Annotated[float | None, typer.Option(help="Macro step H; or give --micro-dt.")] = None,
    micro_dt: Annotated[float | None, typer.Option(help="Micro step h = H / num_micro.")] = None,
    scheme: Annotated[str, typer.Option(help="See [bold]vmri schemes[/bold].")] = "fully-implicit",
    num_micro: Annotated[int, typer.Option(help="Micro steps per macro step.")] = 10,
    alpha: Annotated[
        float | None, typer.Option(help="Weight of the left node, explicit schemes. [dim]0.5[/dim]")
    ] = None,
    degree: Annotated[int | None, typer.Option(help="Degree of the path, galerkin.")] = None,
    rule: Annotated[str | None, typer.Option(help="gauss or lobatto, galerkin. [dim]gauss[/dim]")] = None,
    compose: Annotated[
        str | None, typer.Option(help="Compose the scheme to a higher order, e.g. suzuki4, kahan-li8.")
    ] = None,
    save_every: Annotated[
        int | None, typer.Option(help=f"Macro steps between saved nodes. [dim]about {SAVED_NODES} nodes[/dim]")
    ] = None,
    method: Annotated[str, typer.Option(help="auto, march, frozen, decoupled, arrowhead or dense.")] = "auto",
    out: Annotated[Path | None, typer.Option(help="Write the trajectory here, .npz.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw it here: .png, .svg or .pdf.")] = None,
) -> None:
    """Simulate a system and say how it went."""
    try:
        check_target_file("--out", out, (".npz",))
        check_target_file("--plot", plot, (".png", ".svg", ".pdf"))
        problem = find_problem(system)
        chosen = find_scheme(scheme, num_micro, compose, alpha=alpha, degree=degree, rule=rule)
        newton = vm.Newton(method=method)  # pyright: ignore[reportArgumentType]
        save_every = default_save_every(steps) if save_every is None else save_every
        compiling = _compile_clock()
        start = time.perf_counter()
        trajectory, failure = _run(problem, chosen, macro_dt, micro_dt, steps, save_every, newton)
        seconds = time.perf_counter() - start
    except (ValueError, TypeError) as error:
        raise BadInput(str(error)) from error
    saved = []
    if out is not None:
        trajectory.save(out)
        saved.append(str(out))
    if plot is not None:
        title = f"{system}, {scheme}, {num_micro} micro steps"
        plots.save(plots.plot_trajectory(trajectory, title), plot)
        saved.append(str(plot))
    if failure is not None:
        kept = f"\n\nThe trajectory up to there is in {' and '.join(saved)}." if saved else ""
        reason = f"Macro step {failure.step} at t = {failure.time:.6g}: {failure.result.message}{kept}"
        print_failure("The run failed", reason)
        raise typer.Exit(1)
    console.print(_summary(trajectory, steps, chosen.num_micro, seconds, sum(compiling), saved))


def _run(
    problem, scheme, macro_dt, micro_dt, steps, save_every, newton
) -> tuple[vm.Trajectory, vm.SimulationError | None]:
    """The trajectory and, if the run failed, why."""
    state = problem.state()
    try:
        trajectory = vm.simulate(
            problem.system,
            scheme,
            state,
            macro_dt=macro_dt,
            micro_dt=micro_dt,
            num_steps=steps,
            save_every=save_every,
            newton=newton,
            progress=True,
        )
    except vm.SimulationError as error:
        return error.trajectory, error
    return jax.block_until_ready(trajectory), None


def _compile_clock() -> list[float]:
    """A list to which JAX adds the seconds of every compilation from now on."""
    seconds: list[float] = []

    def listen(event: str, duration_secs: float, **_) -> None:
        if event.startswith("/jax/core/compile/"):
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    return seconds


def _summary(
    trajectory: vm.Trajectory, steps: int, num_micro: int, seconds: float, compiling: float, saved: list[str]
) -> Table:
    energy = np.asarray(trajectory.energy)
    absolute = abs(energy[0]) <= 1e-12
    error = np.abs(energy - energy[0]).max() / (1.0 if absolute else abs(energy[0]))
    position, velocity = np.max(np.asarray(trajectory.constraint_residual), axis=0)
    rows = {
        "macro steps": f"{steps}, of {num_micro} micro steps each",
        "simulated time": f"{float(trajectory.t[0]):g} to {float(trajectory.t[-1]):g}",
        "wall time": f"{seconds:.2f} s, of which {compiling:.2f} s compiling",
        "per micro step": f"{1e6 * max(seconds - compiling, 0.0) / (steps * num_micro):.3g} µs",
        "Newton iterations": f"at most {int(np.max(trajectory.info.iterations))} per step, "
        f"{vm.Method(int(np.max(trajectory.info.method))).name.lower()}",
        "energy error": f"{error:.2e}{'' if absolute else ' of the energy at the start'}",
    }
    if position > 0:
        rows["constraint residual"] = f"{position:.2e} in positions, {velocity:.2e} in velocities"
    rows["saved"] = ", ".join(saved) if saved else "nothing; give --out run.npz or --plot run.png"
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in rows.items():
        table.add_row(f"[dim]{name}[/dim]", escape(value))
    return table


def default_save_every(steps: int) -> int:
    """The divisor of `steps` that saves a number of nodes nearest to SAVED_NODES, every node of a short run."""
    if steps <= SAVED_NODES:
        return 1
    divisors = [d for d in range(1, steps + 1) if steps % d == 0]
    return min(divisors, key=lambda d: abs(np.log(steps / d / SAVED_NODES)))
