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
    make: the scheme with a number of micro steps (per stage, in a composition).
    options: the same on the command line.
    python: the same in a program, with ``{}`` for num_micro.
    first: the num_micro that a search tries first.
    """

    name: str
    make: Callable[[int], Scheme | Composition]
    options: str
    python: str
    first: int = 5

    def composed(self, coefficients: str) -> "Family":
        """Compositions of its schemes."""

        def make(num_micro: int) -> Composition:
            return compose(self.make(num_micro), coefficients)

        options, python = f"{self.options} --compose {coefficients}", f'vm.compose({self.python}, "{coefficients}")'
        return Family(f"{self.name}, {coefficients}", make, options, python)

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
    bases = [of_order_2(make) for make in (fully_explicit, explicit_slow, fully_implicit, takahashi_imada)]
    menu = bases + [base.composed(name) for base in bases[:2] for name in compositions]
    return menu + [of_degree(degree) for degree in degrees]


def of_order_2(make: Callable[[int], Scheme]) -> Family:
    """The family of one of the schemes of order 2, which are made from num_micro alone."""
    name = make.__name__
    return Family(name.replace("_", " "), make, f"--scheme {name.replace('_', '-')}", f"vm.{name}({{}})")


def of_degree(degree: int) -> Family:
    """The Galerkin schemes of a degree, with Lobatto quadrature."""
    return Family(
        f"galerkin {degree}",
        partial(galerkin, degree=degree, rule="lobatto"),
        f"--scheme galerkin --degree {degree} --rule lobatto",
        f'vm.galerkin({{}}, {degree}, "lobatto")',
        1 if degree > 2 else Family.first,  # high degrees resolve the fast variables with a single interval
    )
