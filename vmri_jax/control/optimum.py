"""The result of an optimisation of controls."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.state import Problem
from vmri_jax.running.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Optimum:
    """Controls at the end of the search, and the motion that they make.

    Attributes:
        controls: (N, m), or (N, num_micro, m) for controls on the micro grid.
        t: (N,) or (N, num_micro) starts of the intervals over which each control is constant.
        labels: names of the m controls.
        bounds: (m,) lower and upper bounds of the controls.
        trajectory: the motion at all macro nodes.
        cost: of the motion.
        multipliers: (e,) derivatives of the least cost with respect to the values that the goal is set to.
        miss: largest absolute value of the goal equations.
        over: largest violation of a limit, 0 for none.
        gap: largest distance between the end of a step and the next node, relative to the largest node.
        iterations: number of linear-quadratic problems that were solved.
        success: whether update, gap, miss and over are all below the tolerance.
        problem: the problem with the forces of these controls: ``vm.simulate(optimum.problem, ...)`` runs it again.
        history: of every iteration cost, gap, miss, over, the largest update, and the part of it that was taken.
    """

    controls: Float[np.ndarray, "N ..."]
    t: Float[np.ndarray, "N ..."]
    labels: tuple[str, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    trajectory: Trajectory
    cost: float
    multipliers: Float[np.ndarray, "e"]
    miss: float
    over: float
    gap: float
    iterations: int
    success: bool
    problem: Problem
    history: list[dict] = field(repr=False, default_factory=list)

    def __repr__(self) -> str:
        status = "converged" if self.success else "not converged: the best that was found"
        over = f", limits by {self.over:.1e}" if self.over > 0 else ""
        missed = f"goal missed by {self.miss:.1e}{over}, steps by {self.gap:.1e}"
        return f"cost {self.cost:.8g} after {self.iterations} iterations, {status}; {missed}"
