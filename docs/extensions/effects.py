"""The page of effects: for each of them its docstring, with formula, parameters and units, and a picture where it draws
something."""

from dataclasses import replace
from pathlib import Path

from extensions.files import keep
from tests.scene.effect_scenes import BASE, EFFECTS, RIGID, RIGID_EFFECTS, scene_with
from vmri_jax import fully_implicit, plots, scene
from vmri_jax.accuracy.companions import resting
from vmri_jax.animation import motion, plot_strip
from vmri_jax.running.origin import Origin
from vmri_jax.running.simulation import simulation

KINDS = {
    "potential": "Potentials",
    "force": "Forces",
    "constraint": "Constraints and joints",
    "kinetic": "Kinetic energies",
    "control": "Controls",
}
"""Titles of the sections, by the kind of an effect."""
EXAMPLES = {
    type(effect): (effect, base) for base, all_of in ((BASE, EFFECTS), (RIGID, RIGID_EFFECTS)) for effect in all_of
}
"""An effect of each class, and the scene that it is put into."""
BASES = (scene.Effect, scene.CustomEffect, scene.Joint)
"""Classes that effects derive from."""
INTRODUCTION = "Every effect that a scene can have: its formula, its parameters with their units, and how it is drawn."


def write(folder: Path) -> None:
    """The page ``effects.rst`` and its pictures.

    Args:
        folder: where they go.
    """
    (folder / "effects").mkdir(parents=True, exist_ok=True)
    classes = [thing for name in scene.__all__ if isinstance(thing := getattr(scene, name), type)]
    effects = [cls for cls in classes if issubclass(cls, scene.Effect) and cls not in BASES]
    parts = [_titled("Effects", "="), f"{INTRODUCTION}\n\n.. currentmodule:: vmri_jax.scene\n"]
    for kind, title in KINDS.items():
        parts.append(_titled(title, "-"))
        parts += [_entry(cls, folder) for cls in effects if cls.kind == kind]
    keep(folder / "effects.rst", "\n".join(parts))


def _entry(cls: type[scene.Effect], folder: Path) -> str:
    """An effect: its name, a picture of its example if that draws something, its docstring."""
    title = _titled(cls.__name__, "~")
    effect, base = EXAMPLES.get(cls, (None, BASE))
    path = folder / "effects" / f"{cls.__name__}.png"
    image = ""
    shown = None if effect is None else scene_with(effect, base)
    if shown is not None and shown.bound[1].drawing():
        image = f".. image:: effects/{path.name}\n   :width: 45%\n   :alt: {cls.__name__} in a small scene\n\n"
        if not path.exists():
            run = resting(simulation(shown, fully_implicit(1), None, None, 0.01, num_steps=2))
            run = replace(run, origin=Origin())  # without its system, whose energy a resting run does not have
            plots.save(plot_strip(motion(run, shown), 1), path)
    return f"{title}{image}.. autoclass:: {cls.__name__}\n   :no-index:\n"


def _titled(text: str, line: str) -> str:
    return f"{text}\n{line * len(text)}\n\n"
