"""The schemes a search may choose from: families with num_micro open."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from vmri_jax.schemes.composition import Composition, compose
from vmri_jax.schemes.scheme import Scheme, explicit_slow, fully_explicit, fully_implicit, galerkin, takahashi_imada


@dataclass(frozen=True)
class Family:
    """Schemes that differ only in num_micro.

    name: in tables and figures.
    make: the scheme with so many micro steps (per stage, in a composition).
    options: the same on the command line.
    first: the num_micro that a search tries first.
    """

    name: str
    make: Callable[[int], Scheme | Composition]
    options: str
    first: int = 5

    def label(self, num_micro: int) -> str:
        """With num_micro."""
        return f"{self.name}, {num_micro} micro"

    def coarsest(self, num_micro: int, frequency: float, t_end: float) -> int:
        """Macro steps up to `t_end` at which the fastest vibration begins to be seen: ``omega h`` about the degree."""
        scheme = self.make(num_micro)
        longest = 1.0
        if isinstance(scheme, Composition):
            longest = float(np.abs(scheme.coefficients).max())
        return max(1, int(frequency * t_end * longest / (num_micro * scheme.degree)))


def _composed(base: Callable[[int], Scheme], coefficients: str, num_micro: int) -> Composition:
    return compose(base(num_micro), coefficients)


BASES = {
    "fully explicit": fully_explicit,
    "explicit slow": explicit_slow,
    "fully implicit": fully_implicit,
    "takahashi imada": takahashi_imada,
}


def families(
    compositions: tuple[str, ...] = ("suzuki4", "kahan-li6", "kahan-li8"), degrees: tuple[int, ...] = (2, 4, 12)
) -> list[Family]:
    """The schemes of order 2, compositions of the first two of them, and Galerkin schemes."""
    menu = [Family(name, make, f"--scheme {name.replace(' ', '-')}") for name, make in BASES.items()]
    for base in menu[:2]:
        for name in compositions:
            make = partial(_composed, BASES[base.name], name)
            menu.append(Family(f"{base.name}, {name}", make, f"{base.options} --compose {name}"))
    for degree in degrees:
        make = partial(galerkin, degree=degree, rule="lobatto")
        first = 1 if degree > 2 else Family.first  # high degrees resolve the fast variables with a single interval
        menu.append(Family(f"galerkin {degree}", make, f"--scheme galerkin --degree {degree} --rule lobatto", first))
    return menu
