"""The command ``vmri animate``: a run as a page, a strip of pictures or a GIF."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.markup import escape
from typer import Argument, Option

from vmri_jax import plots
from vmri_jax.animation.drawing import bars
from vmri_jax.animation.frames import plot_strip, write_gif
from vmri_jax.animation.html import write_html
from vmri_jax.animation.motion import Motion, motion
from vmri_jax.animation.parts import angles
from vmri_jax.animation.vtk import write_vtk
from vmri_jax.catalogue import SYSTEMS, find_problem
from vmri_jax.cli.common import PICTURES, check_target, console
from vmri_jax.running.progress import progress_shown
from vmri_jax.running.store.stored import StoredTrajectory
from vmri_jax.running.trajectory import Trajectory

MOST_VTK_NODES = 500
"""Largest number of nodes for ParaView, each in a file of its own; more files take long to open."""
MOST_STORE_NODES = 100_000
"""Largest number of nodes that are read from a store into memory; of longer runs every k-th node is read."""


def animate(
    run: Annotated[Path, Argument(help="A saved trajectory, run.npz or run.zarr.")],
    out: Annotated[
        Path | None, Option(help=".html, a strip .png/.svg/.pdf, .gif or .pvd. [dim]default: run.html[/dim]")
    ] = None,
    system: Annotated[str | None, Option(help="System of the run: fpu, tsp, sam, or my_file.py:my_problem.")] = None,
    drawing: Annotated[Path | None, Option(help="A .json in place of the drawing in the run.", exists=True)] = None,
    title: Annotated[
        str | None, Option(help="Over the picture. [dim]default: name of the system or file[/dim]")
    ] = None,
    start: Annotated[float | None, Option("--from", help="Start at this time.")] = None,
    end: Annotated[float | None, Option("--to", help="Stop at this time.")] = None,
    view: Annotated[str | None, Option(help="Azimuth and elevation in degrees, e.g. -90,90 from above.")] = None,
    frames: Annotated[int, Option(min=1, max=60, help="Pictures in a strip.")] = 5,
    seconds: Annotated[float, Option(min=0.1, max=60, help="How long a GIF takes.")] = 6.0,
    dark: Annotated[bool, Option("--dark", help="Dark colours; a page has both.")] = False,
) -> None:
    """Show a run: a page to open in a browser, a strip of pictures, or a GIF.

    The drawing is the one stored with the run, else the drawing of --system; without one coordinates are bars.
    """
    out = run.with_suffix(".html") if out is None else out
    check_target("--out", out, ".html", *PICTURES, ".gif", ".pvd")
    shown = _motion(run, system, drawing).between(start, end)
    if view is not None:
        shown = replace(shown, drawing=replace(shown.drawing, view=angles(view.split(","), "--view")))
    name = title or (system if system in SYSTEMS else run.stem)
    _write(shown, out, name, frames, seconds, plots.DARK if dark else plots.LIGHT)
    if shown.ending:
        console.print(f"[yellow]{escape(shown.ending)}[/yellow]")
    console.print(f"[bold]{escape(str(out))}[/bold]  {out.stat().st_size / 1e6:.2g} MB", soft_wrap=True)


def _motion(run: Path, system: str | None, drawing: Path | None) -> Motion:
    """The motion of a saved run, with the drawing of --drawing, of the run or of --system, else with bars."""
    trajectory, description = _load(run)
    problem = None if system is None else find_problem(system)
    if drawing is not None:
        description = drawing.read_text(encoding="utf-8")
    return motion(trajectory, description or problem or bars(trajectory), None if problem is None else problem.system)


def _load(run: Path) -> tuple[Trajectory, str | dict]:
    """A saved run, every k-th node of a long store, and the drawing in it, empty if it has none."""
    if run.suffix.lower() == ".zarr":
        stored = StoredTrajectory(run)
        return stored[:: -(-len(stored) // MOST_STORE_NODES)], stored.attributes.get("drawing", "")
    trajectory = Trajectory.load(run)
    with np.load(run, allow_pickle=False) as arrays:
        return trajectory, str(arrays["drawing"]) if "drawing" in arrays else ""


def _write(shown: Motion, out: Path, title: str, frames: int, seconds: float, theme: plots.Theme) -> None:
    suffix = out.suffix.lower()
    if suffix == ".html":
        write_html(shown, out, title)
    elif suffix == ".pvd":
        write_vtk(shown.thinned(MOST_VTK_NODES), out)
    elif suffix == ".gif":
        with progress_shown() as tell:
            write_gif(shown, out, seconds, theme, lambda done, total: tell("drawing", done, total))
    else:
        plots.save(plot_strip(shown, frames, title, theme), out, theme)
