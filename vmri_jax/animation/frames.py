"""Pictures for papers: several moments side by side, and a moving GIF."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from vmri_jax import plots
from vmri_jax.animation import curves
from vmri_jax.animation.motion import Motion
from vmri_jax.animation.shapes import Stage
from vmri_jax.refusals import Refused

FRAMES_PER_SECOND = 20
"""Pictures of a GIF in a second; more make a larger file."""
MOST_COLUMNS = 6
"""Largest number of pictures side by side; with more, names and times are too small to read."""
WIDTH = 9.0
"""Width of a strip, in inches."""
TITLE_HEIGHT = 0.3
"""Height of a line of title or caption, in inches."""
GIF_WIDTH = 640
"""Width of a GIF, in pixels; the file grows with its square."""


def plot_strip(
    motion: Motion, times: int | Sequence[float] = 5, title: str = "", theme: plots.Theme = plots.LIGHT
) -> plots.NotebookFigure:
    """Pictures of several moments side by side, from one point of view; wide scenes one below the other.

    Rows have equal numbers of pictures, or differ by one; the shorter rows are centred. Below the pictures are two
    curves: the slow motion along the whole run, with the moments as dots, and some periods of the fast motion.

    Args:
        motion: from `vmri_jax.animation.motion`.
        times: the moments, or the number of moments, which are then spread evenly.
        title: over the figure.
        theme: colours.

    Raises:
        ValueError: no moments.
    """
    moments = np.linspace(motion.t[0], motion.t[-1], times) if isinstance(times, int) else np.asarray(times, float)
    if moments.ndim != 1 or not moments.size:
        raise Refused(f"plot_strip: times is {times!r}; give at least one moment.")
    stage = Stage.of(motion, theme)
    aspect = stage.aspect
    most = MOST_COLUMNS if aspect < 1.3 else 3 if aspect < 3.5 else 1
    sizes = [len(row) for row in np.array_split(moments, -(-len(moments) // most))]  # the longer rows first
    rows, columns = len(sizes), max(sizes)
    trail = 0.5 * (motion.t[-1] - motion.t[0]) / max(len(moments), 4)
    panels = curves.panels_of(motion)
    below = curves.HEIGHT if panels else 0.0
    with plots.style(theme):
        width = WIDTH / columns
        head = TITLE_HEIGHT * (1 + bool(motion.drawing.caption))
        height = rows * width / aspect + head + below
        figure = plots.NotebookFigure(figsize=(WIDTH, height))
        figure.set_layout_engine("none")
        cells = [(row, (columns - size) / 2 + column) for row, size in enumerate(sizes) for column in range(size)]
        for k, (time, (row, column)) in enumerate(zip(moments, cells, strict=True)):
            bottom = (below + (rows - 1 - row) * width / aspect) / height
            place = (column / columns, bottom, 1 / columns, width / aspect / height)
            stage.draw(figure, place, time, trail, names=k == 0)
        curves.draw(figure, motion, panels, moments, theme)
        _write_head(figure, title, stage)
    return figure


def _write_head(figure: Figure, title: str, stage: Stage) -> None:
    """Title, legend of the colours and caption."""
    width, height = figure.get_size_inches()
    for text, top, size in ((title, 0.1, 11), (stage.motion.drawing.caption, 0.1 + TITLE_HEIGHT, 9)):
        if text:
            figure.text(0.1 / width, 1 - top / height, text, va="top", color=stage.theme.ink, fontsize=size)
    handles = [
        Line2D([], [], color=color, marker="o", linestyle="none", markersize=8, label=pace)
        for pace, color in stage.paces.items()
        if pace in stage.motion.drawing.paces
    ]
    corner = (1 - 0.05 / width, 1 - 0.02 / height)
    figure.legend(handles=handles, loc="upper right", bbox_to_anchor=corner, ncols=2, handletextpad=0.1)


def write_gif(
    motion: Motion,
    path: str | Path,
    seconds: float = 6.0,
    theme: plots.Theme = plots.LIGHT,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a GIF that shows the whole motion in `seconds`, again and again.

    Args:
        motion: from `vmri_jax.animation.motion`.
        path: of the file.
        seconds: duration of the GIF.
        theme: colours.
        progress: ``progress(done, total)``, called after each picture.

    Raises:
        ValueError: seconds that are not positive.
        OSError: the file cannot be written.
    """
    if not 0 < seconds < np.inf:
        raise Refused(f"write_gif: seconds is {seconds}; it must be a positive number.")
    count = max(2, round(FRAMES_PER_SECOND * seconds))
    times = np.linspace(motion.t[0], motion.t[-1], count)
    trail = 1.2 * (motion.t[-1] - motion.t[0]) / seconds
    stage = Stage.of(motion, theme)
    width = GIF_WIDTH / 100
    images = []
    with plots.style(theme):
        for i, time in enumerate(times):
            figure = Figure(figsize=(width, width / stage.aspect), dpi=100)
            stage.draw(figure, (0.0, 0.0, 1.0, 1.0), time, trail)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
            progress(i + 1, count)
    palette = images[count // 2].quantize(255)  # one palette for all pictures, else colours flicker
    first, *later_images = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(
        path, save_all=True, append_images=later_images, duration=1000 // FRAMES_PER_SECOND, loop=0, optimize=True
    )
