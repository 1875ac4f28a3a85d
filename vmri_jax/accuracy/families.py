"""The schemes that a search may choose from, families that differ only in num_micro; and the seconds of their steps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vmri_jax.mechanics.system import System
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.timing import least_seconds
from vmri_jax.schemes.composition import SchemeLike, compose, stage_scheme
from vmri_jax.schemes.scheme import Scheme, explicit_slow, fully_explicit, fully_implicit, galerkin, takahashi_imada

COMPOSED = ((2.5, None), (5.0, "suzuki4"), (8.0, "kahan-li6"), (np.inf, "kahan-li8"))
"""(most digits, composition): the composition for an accuracy of at most this number of digits. Higher orders need
fewer steps for many digits, and more steps for few."""
LEAST_TIME = 0.02
"""Least seconds a and b N in ``a + b N``, as a part of the seconds of a macro step, and of the steps of a run, as a
part of its seconds, since the noise of the clock may make them zero. A larger value changes the number of
micro steps less."""
FEWEST_SAMPLES = 4
"""Least samples of the seconds of a run, of which the least counts. With fewer of them other programs on the machine
distort the prices of the steps."""
MOST_SAMPLES = 24
"""Most samples, of short runs, whose time is mostly the call; with fewer its noise hides the time of the steps."""
SAMPLED_SECONDS = 0.1
"""Seconds of all samples, unless their number ends them; a larger value makes searches longer and prices surer."""
TIMED_SECONDS = 0.02
"""Seconds of a run after which its timing ends; with a larger value searches with long runs take longer."""


@dataclass(frozen=True)
class Family:
    """Schemes that differ only in num_micro.

    name: name in tables and figures.
    make: the scheme with a number of micro steps (per stage, in a composition).
    options: options of the scheme on the command line.
    python: Python expression of the scheme, with ``{}`` for num_micro.
    first: the num_micro that a search tries first; each trial has a family of its own, whose first is its num_micro.
        One far from the best number makes trials take longer.
    """

    name: str
    make: Callable[[int], SchemeLike]
    options: str
    python: str
    first: int = 5

    @property
    def scheme(self) -> SchemeLike:
        """The scheme with the first number of micro steps."""
        return self.make(self.first)

    @property
    def expression(self) -> str:
        """The Python expression of this scheme, which identifies it in a search."""
        return self.python.format(self.first)

    def composed(self, coefficients: str) -> "Family":
        """The family of compositions of its schemes, by the name of their coefficients."""
        options, python = f"{self.options} --compose {coefficients}", f'vm.compose({self.python}, "{coefficients}")'
        name = f"{self.name}, {coefficients}"
        return Family(name, lambda num_micro: compose(self.make(num_micro), coefficients), options, python)

    def label(self, num_micro: int) -> str:
        """Name with num_micro, for progress and tables."""
        return f"{self.name}, {num_micro} micro"


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


def two_families(system: System, degrees_of_freedom: int, digits: float, most_single: int) -> list[Family]:
    """The usual menu for an accuracy of a number of digits: kicks, composed to an order of about this number, or the
    midpoint rule where masses depend on the configuration; and a single interval of high degree, which carries no rule
    on every k-th micro node, for at most `most_single` degrees of freedom."""
    base = of_order_2(fully_explicit if system.has_constant_mass else fully_implicit)
    name = next((name for most, name in COMPOSED if digits <= most), None)
    kicks = base if name is None else base.composed(name)
    single = replace(of_degree(int(np.clip(np.ceil(digits), 2, 8))), first=1)
    has_single = unit_of(system, base.make(1)) == 1 and degrees_of_freedom <= most_single
    return [kicks, single] if has_single else [kicks]


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


def of_scheme(scheme: SchemeLike) -> Family:
    """The family of a scheme of the user, with its rules; the search begins with its num_micro."""
    return Family("own", scheme.with_num_micro, "", "scheme.with_num_micro({})", stage_scheme(scheme).num_micro)


def for_system(menu: Sequence[Family], system: System, has_two_rates: bool) -> list[Family]:
    """The families with a first num_micro that the rates of the potentials divide, the least one without two rates."""
    units = ((family, unit_of(system, family.scheme)) for family in menu)
    return [replace(family, first=unit * -(-family.first // unit) if has_two_rates else unit) for family, unit in units]


def by_promise(menu: Sequence[Family], digits: float) -> list[Family]:
    """The menu, first the families whose order is near the number of digits of the accuracy: lower orders take many
    steps, and higher orders long to compile."""
    return sorted(menu, key=lambda family: abs(np.log(family.scheme.order / max(digits, 2.0))))


def unit_of(system: System, scheme: SchemeLike) -> int:
    """The number whose multiples are allowed as num_micro: least common multiple of k of rules on every k-th node."""
    return math.lcm(stage_scheme(scheme).unit, *(name for name in system.potentials if isinstance(name, int)))


def seconds_of_steps(*runs: Simulation) -> np.ndarray:
    """Seconds of a macro step of each run, ``(T(2 n) - T(n)) / n``: the difference cancels the fixed cost of a call."""
    parts = np.divide(TIMED_SECONDS, least_seconds([run.in_pieces for run in runs], 1))  # the begin of longer runs
    saves = [int(np.clip(run.num_saves * part, 1, run.num_saves)) for run, part in zip(runs, parts, strict=True)]
    timed = [replace(run, num_steps=run.save_every * number) for run, number in zip(runs, saves, strict=True)]
    doubles = [replace(run, num_steps=2 * run.num_steps, save_every=2 * run.save_every) for run in timed]
    calls = [run.in_pieces for run in (*timed, *doubles)]
    samples = int(np.clip(SAMPLED_SECONDS / (sum(least_seconds(calls, 1)) or np.inf), FEWEST_SAMPLES, MOST_SAMPLES))
    single, double = np.reshape(least_seconds(calls, samples), (2, -1))
    num_steps = [run.num_steps for run in timed]
    return np.maximum(double - single, LEAST_TIME * double) / num_steps  # noise may make the difference negative
