"""The command line ``vmri``: systems, schemes, one run, what accuracy costs, the reference study."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

import vmri_jax as vm
from vmri_jax import plots, runtime
from vmri_jax.catalogue import SCHEMES, SYSTEMS, find_problem, find_scheme
from vmri_jax.composition import COMPOSITIONS
from vmri_jax.study import (
    Recommendation,
    WorkPrecision,
    WorkRow,
    choose_figures,
    cost_page,
    recommend,
    reference_figures,
    reproduce,
)
from vmri_jax.study.advisor import NothingReached, check_target
from vmri_jax.study.table import Progress as StudyProgress
from vmri_jax.study.work import rows_table

SAVED_NODES = 1000
"""About as many nodes are saved by default."""

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
console = Console()


class BadInput(typer.BadParameter):
    """Something the user typed: shown in a panel, exit code 2."""

    def format_message(self) -> str:
        return self.message


def main() -> None:
    """Entry point."""
    runtime.configure(cache=runtime.cache_folder())
    app()


@app.callback()
def start() -> None:
    """Variational multirate integrators: simulate stiff mechanical systems, slow and fast parts at their own step."""
    jax.config.update("jax_enable_x64", True)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices here are small: threads only make times scatter


@app.command()
def systems() -> None:
    """List the built-in systems."""
    table = Table("name", "system", "slow", "fast", "constraints", "parameters", box=None, pad_edge=False)
    for name, entry in SYSTEMS.items():
        problem = entry.factory()
        n_g, n_gs = problem.system.num_constraints(problem.q_s, problem.q_f)
        parameters = ", ".join(f"{key} = {_short(value)}" for key, value in problem.system.params.items())
        table.add_row(
            f"[bold]{name}[/bold]",
            entry.title,
            f"{problem.q_s.size}: {entry.slow}",
            f"{problem.q_f.size}: {entry.fast}",
            f"{n_g + n_gs}" if n_g + n_gs else "none",
            parameters,
        )
    console.print(table)
    console.print("\nYour own: [bold]vmri simulate my_file.py:my_problem[/bold], a vmri_jax.Problem in that file.")


@app.command()
def schemes() -> None:
    """List the built-in schemes."""
    table = Table("name", "order", "options", "what", box=None, pad_edge=False)
    for name, entry in SCHEMES.items():
        options = " ".join(f"--{option}" for option in entry.options)
        table.add_row(f"[bold]{name}[/bold]", entry.order, options, entry.title)
    console.print(table)
    console.print(
        "\nOf higher order, [bold]--compose[/bold] NAME: several steps of a scheme of order 2, some backwards.\n"
    )
    table = Table("name", "order", "stages", "source", box=None, pad_edge=False)
    for name, entry in COMPOSITIONS.items():
        table.add_row(f"[bold]{name}[/bold]", f"{entry.order}", f"{len(entry.coefficients)}", entry.source)
    console.print(table)


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
        _check_target("--out", out, (".npz",))
        _check_target("--plot", plot, (".png", ".svg", ".pdf"))
        problem = find_problem(system)
        chosen = find_scheme(scheme, num_micro, compose, alpha=alpha, degree=degree, rule=rule)
        newton = vm.Newton(method=method)  # pyright: ignore[reportArgumentType]
        save_every = _default_save_every(steps) if save_every is None else save_every
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
        _print_failure("The run failed", reason)
        raise typer.Exit(1)
    console.print(_summary(trajectory, steps, chosen.num_micro, seconds, sum(compiling), saved))


@app.command(
    epilog="Examples:\n\nvmri tune fpu --error 1e-4 --t-end 10\n\nvmri tune my_file.py:my_problem --error 1e-3 --t-end 2"
)
def tune(
    system: Annotated[str, typer.Argument(help="fpu, tsp, sam, or my_file.py:my_problem.")],
    error: Annotated[float, typer.Option(help="Largest accepted error of a position at the end, in its unit.")],
    t_end: Annotated[float, typer.Option(help="Simulated time.")],
    exhaustive: Annotated[bool, typer.Option("--exhaustive", help="Search without shortcuts.")] = False,
    out: Annotated[Path | None, typer.Option(help="Write all runs of the search here, .csv or .json.")] = None,
) -> None:
    """Find the scheme, num_micro and macro step that reach an error in the least time on this machine."""
    try:
        _check_target("--out", out, (".csv", ".json"))
        problem = find_problem(system)
        check_target(error, t_end, problem)
        with _progress() as tell:
            found = recommend(problem, error, t_end, exhaustive=exhaustive, progress=tell)
    except NothingReached as failure:
        _write_runs(failure.runs, out)
        console.print(failure.runs.table())
        _print_failure("Nothing reached the error", f"{failure} The best runs are above.")
        raise typer.Exit(1) from failure
    except vm.SimulationError as failure:
        _print_failure("No reference solution", str(failure))
        raise typer.Exit(1) from failure
    except (ValueError, TypeError) as wrong:
        raise BadInput(str(wrong)) from wrong
    _write_runs(found.runs, out)
    console.print("[bold]Errors against time[/bold], the best of all runs\n", found.runs.table())
    console.print(f"\n[bold]For an error of {error:g}[/bold], the fastest\n", rows_table(_rows_of(found)))
    seen = found.verification
    if seen is not None:
        console.print(
            f"\nFrom another start the first of them has {seen.error_ratio:.2g} times this error and takes "
            f"{seen.time_ratio:.2g} times as long."
        )
    console.print(f"\n[bold]{escape(found.setting.command(system))}[/bold]", soft_wrap=True)


@app.command(epilog="Examples:\n\nvmri cost tsp --out out/tsp\n\nvmri cost my_file.py:my_problem --t-end 5")
def cost(
    system: Annotated[str, typer.Argument(help="fpu, tsp, sam, or my_file.py:my_problem.")],
    t_end: Annotated[
        float | None, typer.Option(help="Simulated time. [dim]8 periods of the fastest vibration[/dim]")
    ] = None,
    error: Annotated[
        list[float] | None, typer.Option(help="Error asked for; may be repeated. [dim]1e-2 to 1e-8 of the motion[/dim]")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("out/cost"),
) -> None:
    """One page: what accuracy costs, which scheme to take for which error, where the time goes."""
    try:
        problem = find_problem(system)
        for asked in error or [np.finfo(float).max]:
            check_target(asked, 1.0 if t_end is None else t_end, problem)
        out.mkdir(parents=True, exist_ok=True)
        with _progress() as tell:
            page = cost_page(problem, system, out, t_end=t_end, errors=error, progress=tell)
    except OSError as wrong:
        raise BadInput(f"--out {out}: {wrong.strerror}; give a folder that can be written.") from wrong
    except vm.SimulationError as failure:
        _print_failure("No reference solution", str(failure))
        raise typer.Exit(1) from failure
    except (ValueError, TypeError) as wrong:
        raise BadInput(str(wrong)) from wrong
    console.print(rows_table([answer.setting.row for answer in page.answers if answer.setting is not None]))
    console.print(f"\nPage: [bold]{escape(str(page.path))}[/bold]", soft_wrap=True)


@app.command(
    name="reproduce",
    epilog="Examples:\n\nvmri reproduce\n\nvmri reproduce --only fig6 --only fig9 --out study\n\nvmri reproduce --full",
)
def reproduce_command(
    full: Annotated[
        bool, typer.Option("--full/--quick", help="The lists of the paper (an hour), or few values.")
    ] = False,
    only: Annotated[list[str] | None, typer.Option(help="Only this figure, e.g. fig6; may be repeated.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for figures, tables and the report.")] = Path("out"),
) -> None:
    """Run the reference study: figures, tables and out/report.html."""
    size = "full" if full else "quick"
    try:
        choose_figures(reference_figures(size), only or [])
    except ValueError as error:
        raise BadInput(str(error)) from error
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"--out {out}: {error.strerror}; give a folder that can be written.") from error
    with _progress() as show:

        def figure_done(result) -> None:
            mark = (
                "[red]failed[/red]"
                if result.error
                else f"{sum(c.agrees for c in result.checks)} of {len(result.checks)}"
            )
            console.print(f"{result.name:<11} {mark}  {result.title}  [dim]{result.seconds:.0f} s[/dim]")

        report = reproduce(out, size, only or [], show, figure_done)
    console.print(f"\nReport: [bold]{escape(str(report.path))}[/bold]", soft_wrap=True)
    if report.failed:
        reasons = "\n".join(f"{figure.name}: {figure.error}" for figure in report.failed)
        _print_failure("Figures that failed", reasons)
        raise typer.Exit(1)


@contextmanager
def _progress() -> Iterator[StudyProgress]:
    """A bar; yields the function that moves it."""
    columns = (BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("starting")
        yield lambda what, done, total: bars.update(task, description=what, completed=done, total=total)


def _rows_of(found: Recommendation, count: int = 5) -> list[WorkRow]:
    """The setting recommended and the next ones."""
    return [setting.row for setting in (found.setting, *found.others)[:count]]


def _write_runs(runs: WorkPrecision, out: Path | None) -> None:
    if out is not None:
        runs.to_csv(out) if out.suffix == ".csv" else runs.to_json(out)


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


def _print_failure(title: str, text: str) -> None:
    Console(stderr=True).print(Panel(Text(text), title=title, title_align="left", border_style="red"))


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


def _default_save_every(steps: int) -> int:
    """The divisor of `steps` that saves a number of nodes nearest to SAVED_NODES, every node of a short run."""
    if steps <= SAVED_NODES:
        return 1
    divisors = [d for d in range(1, steps + 1) if steps % d == 0]
    return min(divisors, key=lambda d: abs(np.log(steps / d / SAVED_NODES)))


def _check_target(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    if path is None:
        return
    if path.suffix not in endings:
        raise ValueError(f"{option} {path}: the file must end in {' or '.join(endings)}.")
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{option} {path}: the folder {path.parent} does not exist; make it first.")
    if path.is_dir() or not os.access(path if path.exists() else path.resolve().parent, os.W_OK):
        raise ValueError(f"{option} {path} cannot be written; give another file.")


def _short(value) -> str:
    return (
        ", ".join(f"{x:g}" for x in np.ravel(value))
        if np.ndim(value) == 0
        else f"({', '.join(f'{x:g}' for x in value)})"
    )


if __name__ == "__main__":
    main()
