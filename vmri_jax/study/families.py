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

    def composed(self, coefficients: str) -> "Family":
        """Compositions of its schemes."""

        def make(num_micro: int) -> Composition:
            return compose(self.make(num_micro), coefficients)

        return Family(f"{self.name}, {coefficients}", make, f"{self.options} --compose {coefficients}")

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


def families(
    compositions: tuple[str, ...] = ("suzuki4", "kahan-li6", "kahan-li8"), degrees: tuple[int, ...] = (2, 4, 12)
) -> list[Family]:
    """The schemes of order 2, compositions of the first two of them, and Galerkin schemes.

    Args:
        compositions: their names, see `vmri_jax.compose`.
        degrees: of the Galerkin schemes, which have Lobatto quadrature.
    """
    bases = [
        Family("fully explicit", fully_explicit, "--scheme fully-explicit"),
        Family("explicit slow", explicit_slow, "--scheme explicit-slow"),
        Family("fully implicit", fully_implicit, "--scheme fully-implicit"),
        Family("takahashi imada", takahashi_imada, "--scheme takahashi-imada"),
    ]
    menu = bases + [base.composed(name) for base in bases[:2] for name in compositions]
    for degree in degrees:
        make = partial(galerkin, degree=degree, rule="lobatto")
        first = 1 if degree > 2 else Family.first  # high degrees resolve the fast variables with a single interval
        menu.append(Family(f"galerkin {degree}", make, f"--scheme galerkin --degree {degree} --rule lobatto", first))
    return menu
