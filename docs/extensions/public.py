"""The reference: a page for every public name, and one for every room of the package that lists them."""

import inspect
from importlib import import_module
from pathlib import Path

from extensions.docstrings import with_bars
from extensions.files import keep
from vmri_jax.running.quantities import Quantities
from vmri_jax.study import ResultTable

ROOMS = {
    "vmri_jax": "Problems, schemes and runs",
    "vmri_jax.scene": "Scenes: bodies and effects",
    "vmri_jax.schemes.quadrature": "Quadrature rules",
    "vmri_jax.systems": "Systems of the reference study",
    "vmri_jax.diagnostics": "Diagnostics",
    "vmri_jax.stability": "Stability",
    "vmri_jax.study": "What accuracy costs",
    "vmri_jax.hard_cases": "Checks of a system",
    "vmri_jax.fitting": "Parameters from measurements",
    "vmri_jax.control": "Optimal control",
    "vmri_jax.ensembles": "Ensembles",
    "vmri_jax.plots": "Figures",
    "vmri_jax.animation": "Animations",
}


SHARED = (Quantities, ResultTable)
"""Bases whose members stand on the pages of their subclasses."""


def names(room: str) -> list[str]:
    """The public names of a room: classes and functions."""
    module = import_module(room)
    own = [name for name, thing in vars(module).items() if name[0] != "_" and getattr(thing, "__module__", "") == room]
    found = getattr(module, "__all__", own)
    return [
        name for name in found if inspect.isclass(getattr(module, name)) or inspect.isroutine(getattr(module, name))
    ]


def undocumented() -> list[str]:
    """Public names without a docstring of their own."""
    things = [(f"{room}.{name}", getattr(import_module(room), name)) for room in ROOMS for name in names(room)]
    return [name for name, thing in things if not (thing.__doc__ or "").strip()]


def write(folder: Path) -> None:
    """All pages.

    Args:
        folder: where they go.
    """
    (folder / "api").mkdir(parents=True, exist_ok=True)
    for room, title in ROOMS.items():
        module, listed, pages = import_module(room), [], []
        for name in names(room):
            thing = getattr(module, name)
            first = with_bars((inspect.getdoc(thing) or "").split("\n")[0])
            listed.append(f"   * - :doc:`{name} <api/{room}.{name}>`\n     - {first}")
            pages.append(f"   api/{room}.{name}")
            kind = "autoclass" if inspect.isclass(thing) else "autofunction"
            members = "   :members:\n   :exclude-members: set\n" if inspect.isclass(thing) else ""
            if inspect.isclass(thing) and issubclass(thing, SHARED):
                members += "   :inherited-members: Module\n"
            keep(
                folder / "api" / f"{room}.{name}.rst",
                f"{_titled(name)}.. currentmodule:: {room}\n\n.. {kind}:: {name}\n{members}",
            )
        table = ".. list-table::\n   :widths: 1 3\n\n" + "\n".join(listed)
        hidden = ".. toctree::\n   :hidden:\n\n" + "\n".join(pages)
        keep(folder / f"{room}.rst", f"{_titled(title)}``{room}``\n\n{table}\n\n{hidden}\n")


def _titled(text: str) -> str:
    return f"{text}\n{'=' * len(text)}\n\n"
