"""What a scheme promises and what its macro steps cost, in numbers and as a table."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

TERMS = ("T", "V", "W", "F", "g", "g_s")
"""What has a rule: the kinetic energy, the slow and the fast potential, forces, constraints."""


@dataclass(frozen=True)
class Description:
    """What a scheme promises and what a macro step costs. Evaluations are per pass where equations are solved.

    order, symmetric: of convergence; whether time-reversible.
    rules: in words, by what they integrate or where it is held: one of `TERMS`, or the name of a potential.
    stages, num_micro, degree: steps of the scheme per macro step, micro steps per macro step, degree of the path.
    slow_evaluations, fast_evaluations: gradients of V and of W, and products of their Hessians with a vector, which cost about
        as much; at a node that two macro steps share, once.
    solves: systems of equations with constant masses and no constraint or force: none for explicit schemes, one per
        micro step (of the fast variables of one micro step) where V only kicks, else one per stage. Further potentials on the micro grid
        are taken to be functions of fast variables alone.
    constrained_solves: the same with constraints on slow and fast variables together.
    evaluations: gradients of the further potentials by name, as those of V and W.
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
        """Of a composition of so many stages."""
        counts = ("num_micro", "slow_evaluations", "fast_evaluations", "solves", "constrained_solves")
        more = {name: stages * getattr(self, name) for name in counts}
        more |= {"evaluations": {name: stages * count for name, count in self.evaluations.items()}}
        return replace(self, order=order, symmetric=symmetric, stages=stages, **more)

    def __str__(self) -> str:
        per = "per macro step"
        gradients = {"V": self.slow_evaluations, "W": self.fast_evaluations, **self.evaluations}
        rows = {
            "order": f"{self.order}, {'symmetric' if self.symmetric else 'not symmetric'}",
            "path": f"{self.num_micro} micro steps of degree {self.degree} {per}"
            + (f", in {self.stages} stages" if self.stages > 1 else ""),
            **self.rules,
            **{f"gradients of {name}": f"{count} {per}" for name, count in gradients.items() if name in self.rules},
            "solves": f"{self.solves or 'none'} {per}; with constraints {self.constrained_solves}",
        }
        width = max(16, *(len(name) + 2 for name in rows))
        return "\n".join(f"{name:<{width}}{value}" for name, value in rows.items())
