"""Ensembles: lanes per second and worker, what a task costs, a million runs, and a study of a hundred thousand."""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import psutil

import vmri_jax as vm
from benchmarks.measure import Tell, exactly, ratio, silent
from benchmarks.report import Claim, Report
from vmri_jax import plots
from vmri_jax.ensembles import Axis, Draws, Ensemble, Product
from vmri_jax.ensembles.work import Work, prepared
from vmri_jax.executors.executor import as_done, executor_of, local_workers, submitter
from vmri_jax.running.store.layout import committed

START = {"omega": ("uniform", 20.0, 80.0), "v_s": ("normal", 0.0, 0.1), "v_f": ("normal", 0.0, 0.1)}
"""Frequency of the stiff springs, and velocities of the first slow and of the first fast coordinate."""
RUN: dict[str, Any] = {"t_end": 1.0, "macro_dt": 0.01}
SCHEME = vm.fully_implicit(10)
CHUNK = 4096
"""Runs in a chunk whose tasks are priced."""
MANY, EMPTY = 16, 2000
"""Workers, and tasks without work, which show what a task costs."""


@dataclass(frozen=True)
class Size:
    """How much is run.

    parts: names of `PARTS`.
    chunks: of the ensembles that are timed; repeats: how often.
    million: runs of the large one.
    omega, steps: points of the axes of the study.
    """

    parts: Sequence[str]
    chunks: int
    repeats: int
    million: int
    omega: int
    steps: int


def moved(problem: vm.Problem, row) -> vm.Problem:
    """The chain with the frequency of a row, and the velocities that the row has."""
    system = problem.system.with_params({"omega": row["omega"]})
    firsts = {name: jnp.asarray(getattr(problem, name)).at[0].set(row[name]) for name in ("v_s", "v_f") if name in row}
    return replace(problem, system=system, **firsts)


def sizes(name: str, only: Sequence[str] = ()) -> Size:
    """ "quick" or "full"; `only` some of `PARTS`."""
    parts = tuple(only) or tuple(PARTS)
    return Size(parts, 8, 3, 100_000, 60, 8) if name == "quick" else Size(parts, 16, 5, 1_000_000, 340, 24)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report of each part."""
    for part in size.parts:
        with TemporaryDirectory() as folder:
            yield PARTS[part](size, name, Path(folder), tell)


def _sweep(out: Path, lanes: int, **how) -> Ensemble:
    shutil.rmtree(out, ignore_errors=True)
    return vm.ensemble("fpu", SCHEME, Draws(lanes, START), vary=moved, **RUN, out=out, **how)


# --- lanes per second ------------------------------------------------------------------------------------------------
def speed(size: Size, name: str, folder: Path, tell: Tell) -> Report:
    """In this process, and by one and two workers; and what the store and the tasks cost on top of `simulate_batch`."""
    tell("compiling")
    chunk = _picked(10**6)
    lanes = size.chunks * chunk
    batches = [_batch(number * chunk, (number + 1) * chunk) for number in range(size.chunks)]
    samples: dict[str, list[float]] = {"simulate_batch": [], "this process": [], "1 worker": [], "2 workers": []}
    problem = vm.systems.fermi_pasta_ulam()

    def alone(states, params):
        return vm.simulate_batch(problem, SCHEME, states, params=params, macro_dt=0.01, num_steps=100, save=100)

    alone(*batches[0])
    with local_workers(1) as one, local_workers(2) as two:
        ways = {"this process": {}, "1 worker": {"executor": one}, "2 workers": {"executor": two}}
        for how in ways.values():
            _sweep(folder / "runs.zarr", 2 * chunk, chunk=chunk, **how)  # compiled, on all workers
        for repeat in range(size.repeats):
            tell(f"speed, {repeat + 1} of {size.repeats}")
            begin = time.perf_counter()
            for batch in batches:
                alone(*batch)
            samples["simulate_batch"].append(lanes / (time.perf_counter() - begin))
            for what, how in ways.items():
                samples[what].append(_sweep(folder / "runs.zarr", lanes, chunk=chunk, **how).runs_per_second)
    rows = [
        {"what": what, "lanes": lanes, "lanes a second": float(np.median(of)), "low": min(of), "high": max(of)}
        for what, of in samples.items()
    ]
    claims = [
        Claim("2 workers over 1", ratio(samples["2 workers"], samples["1 worker"]), at_least=1.8),
        Claim(
            "time over that of simulate_batch", ratio(samples["simulate_batch"], samples["this process"]), at_most=1.05
        ),
    ]
    seconds = chunk / float(np.median(samples["this process"]))
    return Report("ensembles_speed", name, rows, claims, [f"chunks of {chunk} runs, {seconds:.2f} s each"])


def _batch(first: int, last: int):
    """Runs of the ensemble as `simulate_batch` takes them."""
    problem, rows = vm.systems.fermi_pasta_ulam(), Draws(last, START).rows(first, last)
    v_s, v_f = (np.repeat(np.asarray(v)[None], last - first, axis=0) for v in (problem.v_s, problem.v_f))
    v_s[:, 0], v_f[:, 0] = rows["v_s"], rows["v_f"]
    make = jax.vmap(lambda a, b: vm.initial_state(problem.system, problem.q_s, problem.q_f, a, b))
    return make(v_s, v_f), {"omega": rows["omega"]}


# --- what tasks and stores cost --------------------------------------------------------------------------------------
def tasks(size: Size, name: str, folder: Path, tell: Tell) -> Report:
    """Runs a second and worker, bytes and files of a run, and what a task costs: handing it over, the first one, to see
    whether it is done."""
    tell("runs a second")
    _sweep(folder / "runs.zarr", 2**14, chunk=CHUNK)
    runs = _sweep(folder / "runs.zarr", 2**15, chunk=CHUNK)
    files = [file for file in runs.path.rglob("*") if file.is_file()]
    begin = time.perf_counter()
    listing = len(committed(runs.path)) / (time.perf_counter() - begin)
    with local_workers(1) as client:
        tell("compiling in a worker")
        first, again = (_sweep(folder / "runs.zarr", CHUNK, chunk=CHUNK, executor=client).seconds for _ in range(2))
    rows = []
    for workers in (2, MANY):
        tell(f"{workers} workers")
        with local_workers(workers) as client:
            _do_nothing(client, 4 * workers)  # all have imported the package
            handing_over = _do_nothing(client, EMPTY) / EMPTY
        row = {"workers": workers, "ms a task": 1e3 * handing_over, "runs a second and worker": runs.runs_per_second}
        row["workers that chunks are enough for"] = CHUNK / runs.runs_per_second / handing_over
        rows.append(row)
    of_chunks = sum("/c." in str(file) or file.name.isdecimal() for file in files)
    notes = [
        f"{sum(file.stat().st_size for file in files) / len(runs):.0f} bytes and {of_chunks / len(runs):.4f} files a "
        f"run in chunks of {CHUNK}; a worker's first chunk takes {first - again:.1f} s longer; {listing:,.0f} chunks "
        "a second are seen to be done."
    ]
    return Report("ensembles_tasks", name, rows, [], notes)


def _picked(lanes: int) -> int:
    """The chunk that the library takes for so many runs."""
    work = Work("fpu", {"scheme": SCHEME}, tuple(START), RUN, vary=moved)
    *_, chunks = prepared(work, Draws(lanes, START))
    return chunks.size


def _do_nothing(client, count: int) -> float:
    """Seconds that `count` tasks without work take."""
    with executor_of("ensembles", client) as workers:
        submit = submitter("ensembles", workers, time.sleep, 0.0)
        begin = time.perf_counter()
        for _, future in as_done(lambda _: submit(), range(count)):
            future.result()
    return time.perf_counter() - begin


# --- a million runs --------------------------------------------------------------------------------------------------
def million(size: Size, name: str, folder: Path, tell: Tell) -> Report:
    """Many runs through the store in this process, with the memory it takes, and read back without loading them."""
    tell(f"{size.million:,} runs")
    out, memory = folder / "million.zarr", []

    def watch(what: str, done: int, total: int) -> None:
        memory.append((done / total, _memory()))

    design = Draws(size.million, START)
    how = {"vary": moved, "num_micro": 10, **RUN, "out": out, "progress": watch}
    runs = vm.ensemble("fpu", "fully-explicit", design, **how)
    after = _memory()
    mean = float(runs.open().q_s.mean())
    parts, mb = np.array(memory).T
    third, end = (float(np.interp(part, parts, mb)) for part in (1 / 3, 1.0))
    row = {
        "lanes": len(runs),
        "chunks": runs.chunks.count,
        "seconds": runs.seconds,
        "lanes a second": runs.runs_per_second,
        "MB on disk": sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6,
        "RSS MB at a third": third,
        "RSS MB at the end": end,
    }
    notes = [
        f"mean of all q_s, read chunk by chunk: {mean:.6f}; memory {after:.0f} MB before, {_memory():.0f} MB after."
    ]
    claims = [Claim("memory at the end over that at a third", exactly(end / third), at_most=1.02)]
    return Report("ensembles_million", name, [row], claims, notes)


def _memory() -> float:
    """Of this process, MB."""
    return psutil.Process().memory_info().rss / 1e6


# --- the study of the paper, over omega, H and num_micro --------------------------------------------------------------
ACCURATE = 1e-2
"""Largest change of the energy, relative to that at the start, of a run that counts as accurate."""


def relative_energy_error(trajectory: vm.Trajectory):
    """Largest change of the energy, relative to the energy at the start."""
    return jax.numpy.max(jax.numpy.abs(trajectory.energy / trajectory.energy[0] - 1))


def study(size: Size, name: str, folder: Path, tell: Tell) -> Report:
    """Where each scheme is stable and accurate: the FPU chain over omega, H and num_micro, drawn from the store."""
    tell("study")
    schemes = {
        "fully implicit": vm.fully_implicit,
        "explicit slow": vm.explicit_slow,
        "fully explicit": vm.fully_explicit,
    }
    numbers = np.unique(np.round(np.geomspace(40, 4000, size.steps) / 40).astype(int) * 40)[::-1]
    omega = Axis(np.geomspace(10.0, 1000.0, size.omega), "rad/s", "frequency of the stiff springs")
    axes = {"num_micro": [1, 2, 5, 10, 20], "num_steps": numbers, "omega": omega}
    axes = Product({"scheme": list(schemes), **axes})
    save = "benchmarks.ensembles:relative_energy_error"
    how = {"t_end": 40.0, "save": save, "num_saves": 40, "processes": 2}
    runs = vm.ensemble("fpu", schemes, axes, vary=moved, **how, out=folder / "study.zarr")
    data = runs.open().load()
    error = data.relative_energy_error.where(data.result <= 1)
    rows = [
        {
            "scheme": scheme,
            "num_micro": int(n),
            "lanes": error.sel(scheme=scheme, num_micro=n).size,
            "failed": int((data.result.sel(scheme=scheme, num_micro=n) > 1).sum()),
            "accurate": int((error.sel(scheme=scheme, num_micro=n) < ACCURATE).sum()),
        }
        for scheme in schemes
        for n in data.num_micro.values
    ]
    notes = [
        f"{len(runs):,} runs in {runs.seconds:.0f} s, {runs.runs_per_second:,.0f} a second, {runs.failed_runs:,} failed"
    ]
    figure = partial(_draw_study, error, plots.LIGHT)
    return Report("ensembles_study", name, rows, [], notes, {"ensembles_study": figure})


def _draw_study(error, theme: plots.Theme):
    """A row of maps for each scheme, omega against the macro step, a column for each num_micro."""
    from matplotlib.colors import LogNorm

    schemes, numbers = error.scheme.values, error.num_micro.values
    macro_dt = 40.0 / error.num_steps.values
    title = f"FPU chain to t = 40: {error.size:,} runs"
    with plots.new_figure(1.6 + 1.75 * len(numbers), 0.8 + 1.75 * len(schemes), title, theme) as figure:
        grid = figure.subplots(len(schemes), len(numbers), sharex=True, sharey=True, squeeze=False)
        for row, scheme in zip(grid, schemes, strict=True):
            for axes, n in zip(row, numbers, strict=True):
                one = error.sel(scheme=scheme, num_micro=n).transpose("omega", "num_steps")
                axes.set_facecolor(theme.faint)
                mesh = axes.pcolormesh(
                    macro_dt, error.omega, one, norm=LogNorm(1e-6, 1.0, clip=True), cmap="viridis", rasterized=True
                )
                axes.contour(macro_dt, error.omega, one, [ACCURATE], colors=[theme.paper], linewidths=0.9)
                h = np.array([macro_dt.min(), macro_dt.max()])
                axes.plot(h, 2 * n / h, color=theme.ink, linewidth=0.8, linestyle=":")
                axes.set(xscale="log", yscale="log", ylim=(error.omega.min(), error.omega.max()))
                axes.grid(visible=False)
        for axes, n in zip(grid[0], numbers, strict=True):
            axes.set_title(f"num_micro = {n}")
        for axes in grid[-1]:
            axes.set_xlabel("macro step $H$")
        for axes, scheme in zip(grid[:, 0], schemes, strict=True):
            axes.set_ylabel(f"{scheme}\n$\\omega$")
        about = f"largest relative change of the energy; white: {ACCURATE:g}, grey: failed, dotted: $h = 2/\\omega$"
        bar = figure.colorbar(mesh, ax=grid, pad=0.01, label=about)
        bar.outline.set_visible(False)
    return figure


PARTS: dict[str, Callable[[Size, str, Path, Tell], Report]] = {
    "speed": speed,
    "tasks": tasks,
    "million": million,
    "study": study,
}
