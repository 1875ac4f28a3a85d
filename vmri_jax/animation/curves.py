"""Curves under the pictures of a strip: the slow motion along the whole run, and some periods of the fast one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vmri_jax import plots
from vmri_jax.animation.motion import Motion
from vmri_jax.animation.signals import Signal, fast_signal, slow_signal, window

HEIGHT = 1.65
"""Height of the panels with their labels, in inches."""
FEWEST_POINTS = 2000
"""Smallest number of points of a curve: about one per pixel of a figure, so that the interpolation between nodes is
seen as a curve."""
LEFT, RIGHT, BELOW, ABOVE = 0.62, 0.12, 0.42, 0.3
"""Margins of a panel for its labels, in inches."""


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
    size = (panel_width - LEFT - RIGHT) / width, (HEIGHT - BELOW - ABOVE) / height
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
