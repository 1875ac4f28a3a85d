"""Properties of a scheme and the cost of its macro steps, in numbers and as a table."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import numpy as np

from vmri_jax.mechanics.summary import has_values

RULES = {"T": "kinetic", "V": "slow", "W": "fast", "F": "force", "g": "constraint", "g_s": "slow_constraint"}
"""The arguments of `Scheme` for the rules of terms: of the kinetic energy, the slow and the fast potential, forces,
constraints."""


@dataclass(frozen=True)
class Description:
    """Properties of a scheme and the cost of a macro step. Evaluations of implicit schemes are per iteration.

    order, symmetric: order of convergence; whether the scheme is time-reversible.
    rules: rules in words, by the term: one of `RULES`, or the name of a potential.
    stages, num_micro, degree: steps of the scheme per macro step, micro steps per macro step, degree of the path.
    slow_evaluations, fast_evaluations: number of gradients of V and of W, and of products of their Hessians with a
        vector, which cost about as much; a node that two macro steps share counts once.
    solves: number of systems of equations to solve, with constant masses and without constraints and forces: none for
        explicit schemes, one per micro step (for its fast variables) if V only kicks, else one per stage. Further
        potentials on the micro grid count as functions of fast variables alone.
    constrained_solves: number of systems with constraints on slow and fast variables together.
    evaluations: number of gradients of the further potentials, by name.
    """

    order: int
    symmetric: bool
    rules: dict[str, str]
    stages: int
    num_micro: int
    degree: int
    slow_evaluations: int
    fast_evaluations: int
    solves: int
    constrained_solves: int
    evaluations: Mapping[str, int] = field(default_factory=dict)

    def repeated(self, stages: int, order: int, symmetric: bool) -> "Description":
        """The description of a composition with this number of stages."""
        counts = ("num_micro", "slow_evaluations", "fast_evaluations", "solves", "constrained_solves")
        totals = {name: stages * getattr(self, name) for name in counts}
        totals |= {"evaluations": {name: stages * count for name, count in self.evaluations.items()}}
        return replace(self, order=order, symmetric=symmetric, stages=stages, **totals)

    def __str__(self) -> str:
        per = "per macro step"
        gradients = {"V": self.slow_evaluations, "W": self.fast_evaluations, **self.evaluations}
        rows = {
            "order": f"{self.order}, {'symmetric' if self.symmetric else 'not symmetric'}",
            "path": f"{self.num_micro} micro steps of degree {self.degree} {per}"
            + (f", in {self.stages} stages" if self.stages > 1 else ""),
            **self.rules,
            **{f"gradients of {name}": f"{count} {per}" for name, count in gradients.items() if name in self.rules},
            "solves": (f"{self.solves} {per}" if self.solves else "none without constraints and forces")
            + f"; {self.constrained_solves} {per} with constraints between slow and fast",
        }
        width = max(16, *(len(name) + 2 for name in rows))
        return "\n".join(f"{name:<{width}}{value}" for name, value in rows.items())


def printed(scheme) -> str:
    """The text that a scheme or composition prints: its class and its description; its fields where weights are traced
    or have lanes."""
    if not has_values(scheme) or any(np.ndim(leaf) > 1 for leaf in jax.tree.leaves(scheme)):
        return eqx.Module.__repr__(scheme)
    return "\n".join([type(scheme).__name__, *(f"  {line}" for line in str(scheme.describe()).splitlines())])
