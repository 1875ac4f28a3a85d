"""The schemes that a search may choose from: families of schemes that differ only in num_micro."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from vmri_jax.schemes.composition import Composition, compose, stage_lengths
from vmri_jax.schemes.scheme import Scheme, explicit_slow, fully_explicit, fully_implicit, galerkin, takahashi_imada


@dataclass(frozen=True)
class Family:
    """Schemes that differ only in num_micro.

    name: name in tables and figures.
    make: the scheme with a number of micro steps (per stage, in a composition).
    options: options of the scheme on the command line.
    python: Python expression of the scheme, with ``{}`` for num_micro.
    first: the num_micro that a search tries first.
    """

    name: str
    make: Callable[[int], Scheme | Composition]
    options: str
    python: str
    first: int = 5

    def composed(self, coefficients: str) -> "Family":
        """The family of compositions of its schemes, by the name of their coefficients."""

        def make(num_micro: int) -> Composition:
            return compose(self.make(num_micro), coefficients)

        options, python = f"{self.options} --compose {coefficients}", f'vm.compose({self.python}, "{coefficients}")'
        return Family(f"{self.name}, {coefficients}", make, options, python)

    def label(self, num_micro: int) -> str:
        """Name with num_micro, for progress and tables."""
        return f"{self.name}, {num_micro} micro"

    def coarsest(self, num_micro: int, frequency: float, t_end: float) -> int:
        """Fewest macro steps up to `t_end` worth a trial: their micro steps h just resolve the fastest vibration, ``omega h`` = degree."""
        scheme = self.make(num_micro)
        longest = float(np.abs(stage_lengths(scheme)).max())
        return max(1, int(frequency * t_end * longest / (num_micro * scheme.degree)))


def families(
    compositions: tuple[str, ...] = ("suzuki4", "kahan-li6", "kahan-li8"), degrees: tuple[int, ...] = (2, 4, 12)
) -> list[Family]:
    """The schemes of order 2, compositions of the first two of them, and Galerkin schemes.

    Args:
        compositions: names of coefficients, see `vmri_jax.compose`.
        degrees: degrees of the Galerkin schemes, which have Lobatto quadrature.
    """
    bases = [of_order_2(make) for make in (fully_explicit, explicit_slow, fully_implicit, takahashi_imada)]
    menu = bases + [base.composed(name) for base in bases[:2] for name in compositions]
    return menu + [of_degree(degree) for degree in degrees]


def of_order_2(make: Callable[[int], Scheme]) -> Family:
    """The family of a scheme of order 2 whose only argument is num_micro."""
    name = make.__name__
    return Family(name.replace("_", " "), make, f"--scheme {name.replace('_', '-')}", f"vm.{name}({{}})")


def of_degree(degree: int) -> Family:
    """The Galerkin schemes of a degree, with Lobatto quadrature."""
    return Family(
        f"galerkin {degree}",
        partial(galerkin, degree=degree, rule="lobatto"),
        f"--scheme galerkin --degree {degree} --rule lobatto",
        f'vm.galerkin({{}}, {degree}, "lobatto")',
        1 if degree > 2 else Family.first,  # a single interval of high degree resolves the fast variables
    )
