"""Pictures for papers: several moments side by side, with curves below them, and a moving GIF.

The curves are the slow motion along the whole run, and some periods of the fast one: coordinates of bodies and lengths
of springs, of which the motion chooses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from PIL import Image

from vmri_jax import plots
from vmri_jax.animation.motion import Motion
from vmri_jax.animation.shapes import Stage
from vmri_jax.mechanics.names import AXES
from vmri_jax.refusals import Refused

CURVES_HEIGHT = 1.65
"""Height of the panels with their labels, in inches."""
FEWEST_POINTS = 2000
"""Smallest number of points of a curve: about one per pixel of a figure, so that the interpolation between nodes is
seen as a curve."""
LEFT, RIGHT, BELOW, ABOVE = 0.62, 0.12, 0.42, 0.3
"""Margins of a panel for its labels, in inches."""
MOST_RADIANS_PER_NODE = 1.5
"""Largest phase change from node to node, in radians, of a signal that is drawn. Above pi the drawn curve would have a
false, lower frequency; half of that leaves a margin, since frequencies are estimates."""
LEAST_RELATIVE_SIZE = 0.02
"""Smallest size of a signal, over the largest size of the signals of its kind; a smaller part would also draw motion
that nobody sees in the pictures."""
PERIODS = 8
"""Number of periods in the window of a fast signal; with more they run together."""
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


@dataclass(frozen=True)
class Signal:
    """A function `of` positions of bodies, from points (k, n_bodies, 3) to values (k,), with the title of its panel.

    size, speed: standard deviations along the motion of the values and of their rate, as large as they are drawn.
    """

    label: str
    pace: str
    of: Callable[[np.ndarray], np.ndarray]
    size: float
    speed: float

    @property
    def frequency(self) -> float:
        """Mean angular frequency: of a sine, rate over size."""
        return self.speed / self.size


Panel = tuple[Signal, tuple[float, float], str]
"""A signal, the times between which it is drawn, and the label of its axis of time."""


def panels_of(motion: Motion) -> list[Panel]:
    """Panels of the slow and of the fast signal; a panel is left out if its signal does not move."""
    slow, fast = slow_signal(motion), fast_signal(motion)
    panels: list[Panel] = [] if slow is None else [(slow, (float(motion.t[0]), float(motion.t[-1])), "t")]
    return panels if fast is None else [*panels, (fast, window(motion, fast), "t, the shaded time")]


def draw(figure: Figure, motion: Motion, panels: Sequence[Panel], moments: np.ndarray, theme: plots.Theme) -> None:
    """Draw the panels side by side at the lower end of a figure in the style of the theme; dots mark the moments of the
    pictures."""
    width, height = figure.get_size_inches()
    panel_width = width / max(len(panels), 1)
    size = (panel_width - LEFT - RIGHT) / width, (CURVES_HEIGHT - BELOW - ABOVE) / height
    for k, (signal, (start, end), time) in enumerate(panels):
        axes = figure.add_axes(((k * panel_width + LEFT) / width, BELOW / height, *size))
        nodes = motion.between(start, end).t
        times = np.linspace(start, end, FEWEST_POINTS) if len(nodes) < FEWEST_POINTS else nodes
        color = theme.curves[0 if signal.pace == "slow" else 1]
        axes.plot(times, signal.of(motion.at(times)), color=color, linewidth=1.1)
        axes.margins(x=0)
        axes.tick_params(labelsize=8)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.set_title(signal.label, fontsize=9)
        axes.set_xlabel(time, labelpad=1)
        if time == "t":  # the whole run
            values = signal.of(motion.at(moments))
            axes.plot(moments, values, "o", color=theme.ink, markersize=4, clip_on=False)
            for _, shaded, _ in panels[1:]:
                axes.axvspan(*shaded, color=theme.curves[1], alpha=0.35, zorder=0)


def slow_signal(motion: Motion) -> Signal | None:
    """The coordinate of a slow body with the largest size over frequency; of a fast body if no slow body moves."""
    signals = _seen(_coordinates(motion))
    signals = [signal for signal in signals if signal.pace == "slow"] or signals
    return max(signals, key=lambda signal: signal.size / signal.frequency, default=None)


def fast_signal(motion: Motion) -> Signal | None:
    """The length of a fast spring that moves most: of those whose frequency the nodes resolve, the largest speed times
    frequency.

    Without such a spring, a coordinate of a fast body, chosen likewise.
    """
    step = float(np.median(np.diff(motion.t))) if len(motion.t) > 1 else 0.0  # one node: a run that failed at once
    for signals in (_lengths(motion), _coordinates(motion)):
        fast = [s for s in signals if s.pace == "fast" and s.frequency * step < MOST_RADIANS_PER_NODE]
        if fast:
            return max(_seen(fast), key=lambda signal: signal.speed * signal.frequency)
    return None


def window(motion: Motion, signal: Signal) -> tuple[float, float]:
    """First and last time of some periods of a signal, where it moves fastest."""
    first, last = float(motion.t[0]), float(motion.t[-1])
    rates = np.gradient(signal.of(motion.points), motion.t)
    frequency = np.std(np.gradient(rates, motion.t)) / np.std(rates)  # of the fastest part: a drift has no curvature
    length = min(last - first, PERIODS * 2 * np.pi / max(float(frequency), signal.frequency))
    start = float(np.clip(motion.t[int(np.argmax(np.abs(rates)))] - length / 2, first, last - length))
    return start, start + length


def _seen(signals: list[Signal]) -> list[Signal]:
    largest = max((signal.size for signal in signals), default=0.0)
    return [signal for signal in signals if signal.size >= LEAST_RELATIVE_SIZE * largest]


def _coordinates(motion: Motion) -> list[Signal]:
    """Signals of the moving coordinates of all bodies, in coordinates of the drawing.

    Points on the axes of a solid, which are not shown, count only where no body of the same pace that is shown moves: a
    reader knows where the centre is, and not how long the axis is.
    """
    drawing, signals, hidden = motion.drawing, [], []
    frame = drawing.frame()
    for i, body in enumerate(drawing.bodies):
        moved = [axis for axis, form in enumerate(body.forms) if form]
        for axis in moved:
            label, form = body.name if len(moved) == 1 else f"{body.name} {AXES[axis]}", body.forms[axis]
            # a bar is drawn at foot + scale q: its curve is q
            foot, scale = (body.offset[axis], form[0][0]) if len(form) == 1 and form[0][0] != 1.0 else (0.0, 1.0)

            def along(points, i=i, axis=frame[:, axis], foot=foot, scale=scale):
                return (points[:, i] @ axis - foot) / scale

            (signals if body.shown else hidden).extend(_signal(motion, label, body.pace, along, abs(scale)))
    return signals + [signal for signal in hidden if signal.pace not in {shown.pace for shown in signals}]


def _lengths(motion: Motion) -> list[Signal]:
    """Signals of the lengths of all springs."""
    drawing, signals = motion.drawing, []
    for joint in drawing.joints:
        if joint.kind == "spring":
            label = f"length of spring {' to '.join(joint.bodies)}"
            signals += _signal(motion, label, drawing.pace(joint), partial(drawing.length, joint))
    return signals


def _signal(motion: Motion, label: str, pace: str, of: Callable, scale: float = 1.0) -> list[Signal]:
    """A list of the signal, which is drawn `scale` times as large as its values; empty if it does not move."""
    values = of(motion.points)
    if len(values) < 3 or np.ptp(values) <= 1e-9 * np.abs(values).max():
        return []
    # differences from node to node: central differences would be zero for a signal that turns by pi between nodes
    rates = np.diff(values) / np.diff(motion.t)
    return [Signal(label, pace, of, scale * float(np.std(values)), scale * float(np.std(rates)))]


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
    panels = panels_of(motion)
    below = CURVES_HEIGHT if panels else 0.0
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
        draw(figure, motion, panels, moments, theme)
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
