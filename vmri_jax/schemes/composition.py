"""Compositions: higher order from several steps of one symmetric scheme, some of them backwards.

A composition runs a scheme Phi over parts of the macro step,

    Psi_H = Phi_{c_s H} o ... o Phi_{c_1 H},        c_1 + ... + c_s = 1,

and chooses the c_i such that the leading errors cancel. It keeps the properties of the scheme (symplecticity, momentum
maps, constraints), needs no new equations, and stays explicit if the scheme is. Beyond order 2 some c_i are negative
(Sheng 1989, Suzuki 1991). Source of the coefficients and of the theory: Hairer, Lubich, Wanner, *Geometric Numerical
Integration* (2006), V.3.2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers, is_concrete, library, real_array
from vmri_jax.refusals import Refused
from vmri_jax.schemes.description import Description, printed
from vmri_jax.schemes.scheme import Scheme


@dataclass(frozen=True)
class NamedComposition:
    """Coefficients of a symmetric composition, the first half and the middle one, with order and source."""

    half: tuple[float, ...]
    order: int
    source: str

    @property
    def coefficients(self) -> tuple[float, ...]:
        """All coefficients, ``c_i = c_{s+1-i}``."""
        return (*self.half, *self.half[-2::-1])


def _jump(num_stages: int) -> tuple[float, ...]:
    """First half of s coefficients, all equal to c but c_mid in the middle: ``(s - 1) c + c_mid = 1`` and
    ``(s - 1) c^3 + c_mid^3 = 0``."""
    outer = 1 / (num_stages - 1 - (num_stages - 1) ** (1 / 3))
    return (outer,) * (num_stages // 2) + (1 - (num_stages - 1) * outer,)


COMPOSITIONS = {
    "yoshida4": NamedComposition(_jump(3), 4, "triple jump; Forest and Ruth (1989), Suzuki (1990), Yoshida (1990)"),
    "suzuki4": NamedComposition(_jump(5), 4, "Suzuki (1990)"),
    "yoshida6": NamedComposition(
        (0.78451361047755726382, 0.23557321335935813368, -1.17767998417887100695, 1.31518632068391121888),
        6,
        "Yoshida (1990), solution A",
    ),
    "kahan-li6": NamedComposition(
        (
            0.39216144400731413928,
            0.33259913678935943860,
            -0.70624617255763935981,
            0.08221359629355080023,
            0.79854399093482996340,
        ),
        6,
        "Kahan and Li (1997)",
    ),
    "suzuki-umeno8": NamedComposition(
        (
            0.74167036435061295345,
            -0.40910082580003159400,
            0.19075471029623837995,
            -0.57386247111608226666,
            0.29906418130365592384,
            0.33462491824529818378,
            0.31529309239676659663,
            -0.79688793935291635402,
        ),
        8,
        "Suzuki and Umeno (1993), McLachlan (1995)",
    ),
    "kahan-li8": NamedComposition(
        (
            0.13020248308889008088,
            0.56116298177510838456,
            -0.38947496264484728641,
            0.15884190655515560090,
            -0.39590389413323757734,
            0.18453964097831570709,
            0.25837438768632204729,
            0.29501172360931029887,
            -0.60550853383003451170,
        ),
        8,
        "Kahan and Li (1997)",
    ),
}
"""Symmetric compositions by name. The number in the name is their order with a symmetric scheme of order 2."""


class Composition(eqx.Module):
    """Several steps of a scheme over parts of the macro step; use it wherever a `Scheme` is accepted.

    Make one with `compose`. A macro step counts all micro steps of all stages: ``num_micro = stages scheme.num_micro``.

    Args:
        scheme: the scheme of every stage.
        coefficients: parts c_i of the macro step, sum 1; may be traced.
    """

    scheme: Scheme
    coefficients: Float[Numbers, "s"]

    @property
    def num_stages(self) -> int:
        """Steps of the scheme per macro step."""
        return self.coefficients.shape[0]

    @property
    def num_micro(self) -> int:
        """Micro steps per macro step, those backwards included."""
        return self.num_stages * self.scheme.num_micro

    @property
    def degree(self) -> int:
        """Polynomial degree of the path within a stage."""
        return self.scheme.degree

    @property
    def micro_times(self):
        """(num_micro,) ends of the micro steps in units of the macro step; they decrease in stages that go
        backwards."""
        ends = library(self.coefficients).cumsum(self.coefficients)
        return (ends[:, None] - self.coefficients[:, None] * (1 - self.scheme.micro_times)).reshape(-1)

    @property
    def is_symmetric(self) -> bool:
        """Whether a step forward and a step back with -H lead back to the start."""
        c = np.asarray(self.coefficients)
        return self.scheme.is_symmetric and bool(np.allclose(c, c[::-1], rtol=0, atol=1e-12))

    @property
    def order(self) -> int:
        """Order of convergence, from the order conditions; needs concrete coefficients and weights.

        The steps of the scheme are flows of ``h A + h^(p+1) B_1 + h^(p+2) B_2 + ...`` for some fields that do not
        commute; the conditions are those of the product of their exponentials, compared with exp(H A) for random
        matrices.
        """
        return _order(np.asarray(self.coefficients), self.scheme.order, self.scheme.is_symmetric)

    def with_num_micro(self, num_micro: int) -> "Composition":
        """The same composition of a scheme with another number of micro steps in every stage."""
        return Composition(self.scheme.with_num_micro(num_micro), self.coefficients)

    def __repr__(self) -> str:
        return printed(self)

    def describe(self) -> Description:
        """As `Scheme.describe`, for all stages; the rules are the rules of a stage."""
        return self.scheme.describe().repeated(self.num_stages, self.order, self.is_symmetric)


SchemeLike = Scheme | Composition
"""A scheme, or a composition of its steps: the argument `scheme` of runs."""


def compose(scheme: SchemeLike, coefficients: str | Sequence[float]) -> Composition:
    """Run `scheme` over parts of the macro step, for higher order.

    Args:
        scheme: best a symmetric one, e.g. ``fully_explicit(10)``; a composition is composed again.
        coefficients: a name in `COMPOSITIONS` ("yoshida4", "suzuki4", "yoshida6", "kahan-li6", "suzuki-umeno8",
            "kahan-li8"), or the parts c_i themselves, which must sum to 1 and not be zero.

    Raises:
        TypeError: not a scheme.
        ValueError: an unknown name; a name for a scheme that is not symmetric or not of order 2, whose error it would
            not cancel; coefficients that do not sum to 1, or zeros among them.
    """
    if not isinstance(scheme, Scheme | Composition):
        raise Refused(f"compose: scheme is {type(scheme).__name__}; give a Scheme, e.g. fully_explicit(10).")
    if isinstance(coefficients, str):
        if coefficients not in COMPOSITIONS:
            raise Refused(f"compose: there is no composition {coefficients!r}; there are {', '.join(COMPOSITIONS)}.")
        if is_concrete(scheme) and not (scheme.is_symmetric and scheme.order == 2):
            kind = "symmetric" if scheme.is_symmetric else "not symmetric"
            raise Refused(
                f"compose: {coefficients} is made for symmetric schemes of order 2; this one has order {scheme.order} "
                f"and is {kind}. Take e.g. fully_explicit(num_micro, alpha=0.5), or give coefficients of your own."
            )
        coefficients = COMPOSITIONS[coefficients].coefficients
    c = real_array("compose: coefficients", coefficients)
    c = np.asarray(c) if is_concrete(c) else c
    if c.ndim != 1 or not c.size:
        raise Refused(f"compose: coefficients have shape {c.shape}; give a sequence of parts of the macro step.")
    if is_concrete(c) and not (np.all(np.isfinite(c)) and np.all(c != 0) and abs(c.sum() - 1) < 1e-10):
        raise Refused(f"compose: coefficients {c.tolist()} sum to {c.sum():.15g}; give numbers, none zero, of sum 1.")
    if isinstance(scheme, Composition):
        return Composition(scheme.scheme, (c[:, None] * scheme.coefficients).reshape(-1))
    return Composition(scheme, c)


def stage_scheme(scheme: SchemeLike) -> Scheme:
    """The scheme of every stage of a composition; a scheme itself."""
    return scheme.scheme if isinstance(scheme, Composition) else scheme


def stage_lengths(scheme: SchemeLike):
    """(s,) lengths of the stages of a macro step, in macro steps; ``[1]`` of a scheme."""
    return scheme.coefficients if isinstance(scheme, Composition) else np.ones(1)


def _order(coefficients: np.ndarray, order: int, symmetric: bool) -> int:
    """Order of the composition of a generic scheme of this order, by power series in H with matrix coefficients.

    A stage with the step c H is ``exp(c H A + (c H)^(p+1) B_1 + ...)`` for random matrices A, B_i (for a symmetric
    scheme only odd powers). The product of the stages agrees with exp(H A) up to the order of the composition.
    """
    size, powers = 4, range(order + 10)  # no composition here gains more than 8 orders
    random = np.random.default_rng(0)
    errors = [k for k in powers if k > order and (k % 2 == 1 or not symmetric)]
    fields = {k: random.normal(size=(size, size)) for k in [1, *errors]}
    unit = np.array([np.eye(size) * (k == 0) for k in powers])

    def product(a, b):
        """The product of two series, ``(a b)_k = sum_j a_j b_(k-j)``, up to the last power."""
        return np.array([np.sum(a[: k + 1] @ b[k::-1], axis=0) for k in powers])

    def flow(c):
        field = np.array([c**k * fields.get(k, 0 * unit[0]) for k in powers])
        total = term = unit
        for k in powers[1:]:
            term = product(term, field) / k
            total = total + term
        return total

    whole, exact = unit, unit[0]
    for c in coefficients:
        whole = product(flow(c), whole)
    for k in powers[1:]:
        exact = exact @ fields[1] / k
        if np.abs(whole[k] - exact).max() > 1e-9:
            return k - 1
    return powers[-1]
