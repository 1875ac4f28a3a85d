"""Who is slow and who is fast: bodies by pace, effects by what they touch and how stiff they are.

A potential that touches a slow body is part of V. One that touches only fast bodies is part of W if it is stiff, else of
V, where it is evaluated less often. A constraint that touches a fast body is held on the micro grid, one between slow
bodies on the macro grid: on the micro grid it would be over-determined.

Stiffness is measured by frequencies at the start: of an element of a potential, the largest w with ``det(K - w^2 M) = 0``
for its Hessian K and the masses M of its bodies. What has no curvature has a rate all the same, ``sqrt(a / L)``, for the
acceleration a that it gives and the size L of the scene. The border between slow and fast is the middle of the widest gap
between all these rates, on a logarithmic scale; where no gap is as wide as SEPARATION, one rate is enough for all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal, NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.quadrature import is_concrete
from vmri_jax.scene.body import Body
from vmri_jax.scene.effect import Effect

SEPARATION = 3.0
"""Smallest ratio of two neighbouring rates that separates slow from fast."""
SPAN = 1e3
"""Rates slower than the fastest one by more than this count as slower by this: they are slow in any case."""

Home = Literal["kinetic", "slow_potential", "fast_potential", "constraint", "slow_constraint", "force"]


class Pace(NamedTuple):
    """Whether a body is slow or fast, and why."""

    value: Literal["slow", "fast"]
    reason: str


@dataclass(frozen=True)
class Placed:
    """Some elements of an effect, the argument of `System` that they are part of, and why (the first of them)."""

    effect: Effect
    elements: tuple[int, ...]
    home: Home
    reason: str


class Sorting(NamedTuple):
    """Paces by the name of the body, and where every effect lives."""

    paces: dict[str, Pace]
    placed: tuple[Placed, ...]


class Stiffness(NamedTuple):
    """Of every element of a potential: frequency of its curvature and rate of its change, rad/s."""

    frequency: np.ndarray
    rate: np.ndarray


def sort(bodies: Mapping[str, Body], effects: Sequence[Effect]) -> Sorting:
    """Paces of all bodies and homes of all effects.

    Raises:
        ValueError: a potential that is to be fast but touches a slow body; something to be decided by numbers that are traced.
    """
    potentials = [effect for effect in effects if effect.kind == "potential"]
    measured = _measure(bodies, potentials)
    border = _border([stiffness.rate for stiffness in measured.values()])
    paces = _paces(bodies, potentials, measured, border)
    placed = []
    for effect in effects:
        homes: dict[Home, list[int]] = {}
        reasons: dict[Home, str] = {}
        for i, element in enumerate(effect.elements(bodies)):
            slow = [name for name in element if paces[name].value == "slow"]
            home, reason = _home(effect, i, slow, len(element), measured, border)
            homes.setdefault(home, []).append(i)
            reasons.setdefault(home, reason)
        placed += [Placed(effect, tuple(some), home, reasons[home]) for home, some in homes.items()]
    return Sorting(paces, tuple(placed))


def _measure(bodies, potentials) -> dict[str, Stiffness]:
    """Stiffness of the potentials on which a decision depends."""
    auto = any(body.pace == "auto" for body in bodies.values())

    def matters(effect: Effect) -> bool:
        elements = effect.elements(bodies)
        return effect.rate == "auto" and any(all(bodies[name].pace != "slow" for name in e) for e in elements)

    undecided = [effect.name for effect in potentials if matters(effect)]
    if not undecided and not auto:
        return {}
    if not is_concrete([(body.mass, body.position) for body in bodies.values()]):
        raise ValueError(
            f"Scene: whether {', '.join(undecided or bodies)} is slow or fast depends on numbers that are traced. Give every body a "
            "pace and every potential between fast bodies a rate, or build the system outside of jit and vary its params."
        )
    return {effect.name: stiffness(effect, bodies) for effect in potentials}


def stiffness(effect: Effect, bodies: Mapping[str, Body]) -> Stiffness:
    """Frequencies and rates of every element of a potential at the start.

    Raises:
        ValueError: an energy that is not smooth there.
    """
    elements, params = effect.elements(bodies), effect.parameters(bodies)
    known = effect.curvature(bodies)
    size = max(float(np.ptp(_positions(bodies), axis=0).max(initial=0.0)), float(np.abs(_positions(bodies)).max()))
    frequency, rate = np.zeros(len(elements)), np.zeros(len(elements))
    for i, element in enumerate(elements):
        own = effect.one(params, i, bodies)
        force, matrix = _derivatives(effect.function, tuple(bodies[name].position for name in element), own)
        if not (np.isfinite(force).all() and np.isfinite(matrix).all()):
            raise ValueError(
                f"{effect.name}: its energy between {', '.join(element)} has no finite derivatives at the start; move them, or smooth it."
            )
        mass = np.concatenate([np.broadcast_to(bodies[name].mass, (bodies[name].size,)) for name in element])
        matrix = np.asarray(matrix) / np.sqrt(np.outer(mass, mass))
        largest = np.linalg.eigvalsh(matrix).max()
        if known is not None:
            largest = max(largest, np.broadcast_to(known, len(elements))[i] / mass.min())
        largest = max(largest, 0.0) if largest > 1e-12 * np.abs(matrix).max(initial=0.0) else 0.0
        frequency[i] = np.sqrt(largest)
        rate[i] = max(frequency[i], np.sqrt(np.max(np.abs(force) / mass) / (size or 1.0)))
    return Stiffness(frequency, rate)


@partial(jax.jit, static_argnames="function")
def _derivatives(function, q, params):
    """Gradient and Hessian of the energy of one element."""
    flat, unravel = ravel_pytree(q)

    def energy(flat):
        return function(unravel(flat), params)

    return jax.grad(energy)(flat), jax.hessian(energy)(flat)


def _positions(bodies) -> np.ndarray:
    """Coordinates of all points in one array, blocks left out where there are points; padded with zeros."""
    points = [np.asarray(body.position) for body in bodies.values() if body.size <= 3] or [np.zeros(1)]
    return np.stack([np.pad(point, (0, 3 - point.size)) for point in points])


def _border(rates) -> float | None:
    """The middle of the widest gap between rates, None where there is none."""
    found = np.concatenate([*rates, np.zeros(0)])
    found = np.sort(found[found > 0])
    if not found.size:
        return None
    found = np.maximum(found, found[-1] / SPAN)
    gaps = [(high / low, np.sqrt(high * low)) for low, high in pairwise(found)]
    widest, middle = max(gaps, default=(1.0, 0.0))
    return float(middle) if widest >= SEPARATION else None


def _paces(bodies, potentials, measured, border) -> dict[str, Pace]:
    paces = {}
    for name, body in bodies.items():
        if body.pace != "auto":
            paces[name] = Pace(body.pace, "as given")
        elif border is None:
            paces[name] = Pace("slow", f"no gap of a factor {SEPARATION:g} between the rates of the potentials")
        else:
            paces[name] = Pace("slow", f"touched by nothing stiff, above {border:.3g} rad/s")
    for effect in potentials:
        for i, element in enumerate(effect.elements(bodies)):
            if any(bodies[name].pace == "slow" for name in element):
                continue
            stiff = border is not None and effect.name in measured and measured[effect.name].frequency[i] > border
            if effect.rate == "fast" or (effect.rate == "auto" and stiff):
                why = "declared fast" if effect.rate == "fast" else f"{measured[effect.name].frequency[i]:.3g} rad/s"
                limit = "" if effect.rate == "fast" else f", above {border:.3g}"
                for name in element:
                    if paces[name].value == "slow":
                        paces[name] = Pace("fast", f"touched by {effect.name}, {why}{limit}")
    return paces


def _home(effect: Effect, i: int, slow: list[str], size: int, measured, border) -> tuple[Home, str]:
    """Where an element of an effect belongs that touches these slow bodies, and why."""
    if effect.kind in ("kinetic", "force"):
        return effect.kind, "depends on velocities" if effect.kind == "kinetic" else "not derived from a potential"
    if effect.kind == "constraint":
        return (
            ("slow_constraint", "between slow bodies") if len(slow) == size else ("constraint", "touches a fast body")
        )
    if slow:
        if effect.rate == "fast":
            raise ValueError(
                f"{effect.name}: its rate is 'fast' but it touches {slow[0]}, which is slow; W sees fast bodies alone. Make "
                f"{slow[0]} fast, or leave the rate to the scene."
            )
        return "slow_potential", f"touches {slow[0]}, which is slow"
    if effect.rate != "auto":
        return ("fast_potential" if effect.rate == "fast" else "slow_potential"), "as given"
    frequency, limit = measured[effect.name].frequency[i], border or 0.0
    if frequency > limit:
        return "fast_potential", f"between fast bodies and stiff, above {limit:.3g} rad/s"
    return "slow_potential", f"between fast bodies but soft, below {limit:.3g} rad/s"
