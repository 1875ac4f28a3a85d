"""Pictures for papers: several moments side by side, and a moving GIF."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from vmri_jax import plots
from vmri_jax.animation.motion import Motion
from vmri_jax.animation.shapes import Stage

FRAMES_PER_SECOND = 20
WIDTH = 9.0
"""Of a strip, in inches."""
TITLE = 0.3
GIF_WIDTH = 640


def plot_strip(
    motion: Motion, times: int | Sequence[float] = 5, title: str = "", theme: plots.Theme = plots.LIGHT
) -> plots.NotebookFigure:
    """Several moments side by side, from one point of view; wide scenes one below the other.

    Args:
        motion: from `vmri_jax.animation.motion`.
        times: the moments, or how many of them, spread evenly.
        title: over the figure.
        theme: colours.

    Raises:
        ValueError: no moment.
    """
    moments = np.linspace(motion.t[0], motion.t[-1], times) if isinstance(times, int) else np.asarray(times, float)
    if moments.ndim != 1 or not moments.size:
        raise ValueError(f"plot_strip: times is {times!r}; give at least one.")
    stage = Stage.of(motion, theme)
    aspect = stage.aspect
    columns = len(moments) if aspect < 1.3 else 3 if aspect < 3.5 else 1
    columns = min(columns, len(moments), 6)
    rows = -(-len(moments) // columns)
    trail = 0.5 * (motion.t[-1] - motion.t[0]) / max(len(moments), 4)
    caption = motion.drawing.caption
    with plots.style(theme):
        width = WIDTH / columns
        height = rows * width / aspect + TITLE * (bool(title) + bool(caption))
        figure = plots.NotebookFigure(figsize=(WIDTH, height))
        for k, time in enumerate(moments):
            row, column = divmod(k, columns)
            bottom = (rows - 1 - row) * width / aspect / height
            stage.draw(figure, (column / columns, bottom, 1 / columns, width / aspect / height), time, trail)
        if title:
            figure.text(0.1 / WIDTH, 1 - 0.1 / height, title, va="top", fontsize=11, color=theme.ink)
        if caption:
            top = 0.1 + TITLE * bool(title)
            figure.text(0.1 / WIDTH, 1 - top / height, caption, va="top", fontsize=9, color=theme.ink)
    return figure


def write_gif(
    motion: Motion,
    path: str | Path,
    seconds: float = 6.0,
    theme: plots.Theme = plots.LIGHT,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a GIF that shows the whole motion in so many seconds, again and again.

    Args:
        motion: from `vmri_jax.animation.motion`.
        path: of the file.
        seconds: how long it takes.
        theme: colours.
        progress: told (pictures done, of how many).

    Raises:
        ValueError: seconds that are not positive.
        OSError: the file cannot be written.
    """
    if not 0 < seconds < np.inf:
        raise ValueError(f"write_gif: seconds is {seconds}; it must be a positive number.")
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
    palette = images[count // 2].quantize(255)  # one for all: colours must not flicker
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(path, save_all=True, append_images=others, duration=1000 // FRAMES_PER_SECOND, loop=0, optimize=True)
