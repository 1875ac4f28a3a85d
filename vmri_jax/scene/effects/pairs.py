"""Forces between all pairs of points: Coulomb, Lennard-Jones."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from vmri_jax.scene.effect import Effect, all_pairs
from vmri_jax.scene.effects.geometry import check_points, require_apart, squeeze


@dataclass(frozen=True, eq=False)
class _Pairs(Effect):
    """What effects between pairs that must stay apart share."""

    kind = "potential"

    def check(self, bodies):
        super().check(bodies)
        check_points(self, bodies)
        require_apart(self, bodies)


def coulomb_energy(q, params):
    """``V = C sum Q_a Q_b / |q_b - q_a|``."""
    a, b = q
    distance = jnp.sqrt(jnp.sum((b - a) ** 2, axis=-1))
    return params["constant"] * jnp.sum(params["charge_a"] * params["charge_b"] / distance)


@dataclass(frozen=True, eq=False)
class Coulomb(_Pairs):
    """Coulomb's law between charges, ``V = C sum_{a<b} Q_a Q_b / |q_b - q_a|``.

    Args:
        charges: Q by name of the body, a dictionary.
        constant: C, in the units of the scene: 8.99e9 N m^2/C^2 in SI units.
        between: a list of pairs; all pairs of the charges by default.

    Raises:
        ValueError: (of the scene) a pair without a charge, bodies that start at one point.
    """

    charges: Any
    constant: Any = 8.9875517862e9
    between: Any = None

    default_name = "coulomb"
    numbers = ("charge_a", "charge_b")
    function = staticmethod(coulomb_energy)

    def elements(self, bodies):
        pairs = all_pairs(tuple(self.charges) if self.between is None else self.between, bodies, self.name)
        for pair in pairs:
            for name in pair:
                if name not in self.charges:
                    raise ValueError(
                        f"{self.name}: {name} has no charge; there are charges of {', '.join(self.charges)}."
                    )
        return pairs

    def parameters(self, bodies):
        pairs = self.elements(bodies)
        charges = [
            squeeze(jnp.stack([jnp.asarray(self.charges[pair[i]], dtype=float) for pair in pairs])) for i in (0, 1)
        ]
        return {"constant": jnp.asarray(self.constant, dtype=float), "charge_a": charges[0], "charge_b": charges[1]}


def lennard_jones_energy(q, params):
    """``V = 4 eps sum ((s/r)^12 - (s/r)^6)``."""
    a, b = q
    sixth = (params["distance"] ** 2 / jnp.sum((b - a) ** 2, axis=-1)) ** 3
    return jnp.sum(4 * params["depth"] * (sixth**2 - sixth))


@dataclass(frozen=True, eq=False)
class LennardJones(_Pairs):
    """Lennard-Jones forces, ``V = 4 eps sum_{a<b} ((s/r)^12 - (s/r)^6)``; the minimum -eps is at ``r = 2^(1/6) s``.

    Args:
        depth: eps, J, positive; one number, or one for each pair.
        distance: s, m, positive; likewise.
        between: names of bodies, every pair of which interacts; or a list of pairs. All bodies by default.

    Raises:
        ValueError: (of the scene) numbers that are not positive, bodies that start at one point.
    """

    depth: Any
    distance: Any
    between: Any = None

    default_name = "lennard_jones"
    numbers = ("depth", "distance")
    function = staticmethod(lennard_jones_energy)

    def elements(self, bodies):
        return all_pairs(self.between, bodies, self.name)

    def parameters(self, bodies):
        return {name: jnp.asarray(getattr(self, name), dtype=float) for name in self.numbers}

    def check(self, bodies):
        super().check(bodies)
        self.require_positive(depth=self.depth, distance=self.distance)
