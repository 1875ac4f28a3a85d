"""Curves under the pictures of a strip: the slow motion along the whole run, and some periods of the fast one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vmri_jax import plots
from vmri_jax.animation.motion import Motion
from vmri_jax.animation.signals import fast_signal, slow_signal, window

HEIGHT = 1.65
"""Height of the panels with their labels, in inches."""
FEWEST_POINTS = 2000
"""Smallest number of points of a curve: about one per pixel of a figure, so that the interpolation between nodes is
seen as a curve."""
LEFT, RIGHT, BELOW, ABOVE = 0.62, 0.12, 0.42, 0.3
"""Margins of a panel for its labels, in inches."""


class Curves:
    """The curves of a motion: two panels side by side; a panel is left out if its signal does not move."""

    def __init__(self, motion: Motion, theme: plots.Theme):
        self.motion, self.theme = motion, theme
        self.slow, self.fast = slow_signal(motion), fast_signal(motion)

    @property
    def height(self) -> float:
        """Height of all curves, in inches."""
        return HEIGHT if self.slow or self.fast else 0.0

    def draw(self, figure: Figure, moments: Sequence[float] | np.ndarray) -> None:
        """Draw the curves at the lower end of a figure in the style of the theme; dots mark the moments of the
        pictures."""
        motion, theme, (width, height) = self.motion, self.theme, figure.get_size_inches()
        span = float(motion.t[0]), float(motion.t[-1])
        panels = [] if self.slow is None else [(self.slow, span, "t")]
        if self.fast is not None:
            panels.append((self.fast, window(motion, self.fast), "t, the shaded time"))
        panel_width = width / len(panels) if panels else width
        size = (panel_width - LEFT - RIGHT) / width, (HEIGHT - BELOW - ABOVE) / height
        for k, (signal, part, time) in enumerate(panels):
            axes = figure.add_axes(((k * panel_width + LEFT) / width, BELOW / height, *size))
            nodes = motion.between(*part)
            times = np.linspace(*part, FEWEST_POINTS) if len(nodes.t) < FEWEST_POINTS else nodes.t
            color = theme.curves[0 if signal.pace == "slow" else 1]
            axes.plot(times, signal.of(motion.at(times)), color=color, linewidth=1.1)
            axes.margins(x=0)
            axes.tick_params(labelsize=8)
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.set_title(signal.label, fontsize=9)
            axes.set_xlabel(time, labelpad=1)
            if signal is self.slow:
                marks = np.asarray(moments)
                axes.plot(marks, signal.of(motion.at(marks)), "o", color=theme.ink, markersize=4, clip_on=False)
                if self.fast is not None:
                    axes.axvspan(*window(motion, self.fast), color=theme.curves[1], alpha=0.35, zorder=0)
