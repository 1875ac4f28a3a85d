"""Seeing a run: a self-contained page, strips of pictures and GIFs from a trajectory and a drawing of its bodies."""

from vmri_jax.animation.drawing import Drawing, bars
from vmri_jax.animation.frames import plot_strip, write_gif
from vmri_jax.animation.html import write_html
from vmri_jax.animation.motion import Motion, motion
from vmri_jax.animation.parts import Block, Body, Joint, Plane, Sphere
from vmri_jax.animation.vtk import write_vtk

__all__ = [
    "Block",
    "Body",
    "Drawing",
    "Joint",
    "Motion",
    "Plane",
    "Sphere",
    "bars",
    "motion",
    "plot_strip",
    "write_gif",
    "write_html",
    "write_vtk",
]
