"""What an optimisation of controls hands back."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.state import Problem
from vmri_jax.running.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Optimum:
    """Controls that were found, and the motion that they make.

    Attributes:
        controls: (N, m), or (N, num_micro, m) for controls on the micro grid.
        t: (N,) or (N, num_micro) times from which on they are held.
        labels: m names of the controls.
        bounds: the least and the largest controls that were allowed, (m,) each.
        trajectory: the motion, all macro nodes saved.
        cost: its cost.
        multipliers: (e,) change of the cost with the goal.
        miss: the most that the goal is missed by.
        over: the most that a limit is passed by.
        gap: the most that a step misses the next node by.
        iterations: linear-quadratic problems that were solved.
        converged: whether updates, gaps, the goal and the limits ended below the tolerance.
        problem: what moves, with the forces of these controls: ``vm.simulate(found.problem, ...)`` runs it again, on other
            grids too.
        history: cost, gap, miss, over, update and the part of it that was taken, of every iteration.
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
    converged: bool
    problem: Problem
    history: list[dict] = field(repr=False, default_factory=list)

    def __repr__(self) -> str:
        how = "converged" if self.converged else "not converged: the best that was found"
        over = f", limits by {self.over:.1e}" if self.over > 0 else ""
        return (
            f"cost {self.cost:.8g} after {self.iterations} iterations, {how}; goal missed by {self.miss:.1e}{over}, "
            f"steps by {self.gap:.1e}"
        )
