"""The reference: a page for every public name, and one for every package and module that lists them."""

import inspect
from importlib import import_module
from pathlib import Path

from extensions.docstrings import with_bars
from extensions.files import keep
from vmri_jax.running.quantities import Quantities
from vmri_jax.study import ResultTable

PLACES = {
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


def names(place: str) -> list[str]:
    """The public names of a package or module: classes and functions."""
    module = import_module(place)
    own = [name for name, thing in vars(module).items() if name[0] != "_" and getattr(thing, "__module__", "") == place]
    found = getattr(module, "__all__", own)
    return [
        name for name in found if inspect.isclass(getattr(module, name)) or inspect.isroutine(getattr(module, name))
    ]


def undocumented() -> list[str]:
    """Public names without a docstring of their own."""
    things = [(f"{place}.{name}", getattr(import_module(place), name)) for place in PLACES for name in names(place)]
    return [name for name, thing in things if not (thing.__doc__ or "").strip()]


def write(folder: Path) -> None:
    """All pages.

    Args:
        folder: where they go.
    """
    (folder / "api").mkdir(parents=True, exist_ok=True)
    for place, title in PLACES.items():
        module, listed, pages = import_module(place), [], []
        for name in names(place):
            thing = getattr(module, name)
            first = with_bars(" ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split()))
            listed.append(f"   * - :doc:`{name} <api/{place}.{name}>`\n     - {first}")
            pages.append(f"   api/{place}.{name}")
            kind = "autoclass" if inspect.isclass(thing) else "autofunction"
            members = "   :members:\n   :exclude-members: set\n" if inspect.isclass(thing) else ""
            if inspect.isclass(thing) and issubclass(thing, SHARED):
                members += "   :inherited-members: Module\n"
            keep(
                folder / "api" / f"{place}.{name}.rst",
                f"{_titled(name)}.. currentmodule:: {place}\n\n.. {kind}:: {name}\n{members}",
            )
        table = ".. list-table::\n   :widths: 1 3\n\n" + "\n".join(listed)
        hidden = ".. toctree::\n   :hidden:\n\n" + "\n".join(pages)
        keep(folder / f"{place}.rst", f"{_titled(title)}``{place}``\n\n{table}\n\n{hidden}\n")


def _titled(text: str) -> str:
    return f"{text}\n{'=' * len(text)}\n\n"
