"""Outcome of a step: a status code whose message names the failure, its likely causes and a remedy."""

from enum import IntEnum
from functools import partial

import numpy as np


class Result(IntEnum):
    """Status of a macro step. `CONVERGED` and `CONVERGED_AT_ROUNDOFF` are successes."""

    CONVERGED = 0
    CONVERGED_AT_ROUNDOFF = 1
    STAGNATED = 2
    DIVERGED = 3
    NON_FINITE = 4
    SINGULAR = 5
    RANK_DEFICIENT = 6
    CONSTRAINT_VIOLATED = 7
    NOT_IMPLIED = 8

    @property
    def success(self) -> bool:
        """Whether the step can be used."""
        return self <= Result.CONVERGED_AT_ROUNDOFF

    @property
    def message(self) -> str:
        """The failure, its likely causes, and a remedy."""
        return _MESSAGES[self]


_MESSAGES = {
    Result.CONVERGED: "the step converged to the Newton tolerance.",
    Result.CONVERGED_AT_ROUNDOFF: (
        "the step converged to the round-off floor of its own numbers, which lies above the Newton tolerance."
    ),
    Result.STAGNATED: (
        "the iteration of the step used up its iterations without converging. Likely causes: the step is too large for "
        "the motion or for the fast forces, or the constraints are nearly dependent. Try a smaller macro_dt or a "
        "larger num_micro, or raise max_iterations of the solver."
    ),
    Result.DIVERGED: (
        "Newton's iteration moved away from a solution, and following the solution of shorter steps ended before the "
        "whole step: there may be none. Likely causes: the step is too large for the curvature of the potentials or "
        "constraints, or the run is unstable and its energy has grown. Forces of constraints act at the nodes in "
        "implicit schemes too: a light link that is pulled tight swings with omega = 2 sqrt(force / (mass length)), "
        "with mass the sum of two equal masses at its ends, and needs steps below 2 / omega with any scheme. Try a "
        "smaller macro_dt, and look at the energy before the failure."
    ),
    Result.NON_FINITE: (
        "a NaN or infinity appeared. Likely causes: an explicit scheme beyond its stability limit (omega h < 2), a "
        "function evaluated outside its domain (a norm at zero, a logarithm or root of a negative number), an angle "
        "of directors near half a turn, which a spring, a limit or a gear cannot tell from another turn (give the"
        ' scene coordinates="joint"), or, in the first step of a lane or of a run in a transformation of JAX,'
        " velocities of the start against the constraints. Try a smaller macro_dt, or look at the state just before "
        "the failure."
    ),
    Result.SINGULAR: (
        "the Newton matrix is singular although the functions are finite. Likely causes: a kinetic energy that does "
        "not see every velocity (a mass that is or becomes zero), or a potential whose curvature cancels the mass at "
        "this step. Look at the mass matrix at the last state, or change macro_dt."
    ),
    Result.RANK_DEFICIENT: (
        "the constraints have become dependent: the rank of their Jacobian in the fast variables (of slow_constraint: "
        "in the slow ones) is less than their number. Likely causes: redundant rows that contradict each other, a "
        "singular configuration (links in line, a closed loop folded flat), or a constraint whose fast variables no "
        "longer enter. Remove rows, make the variables they need fast, or start elsewhere."
    ),
    Result.CONSTRAINT_VIOLATED: (
        "the increments converged, but the constraints are not kept. Likely causes: in the first step, a start off the "
        "constraints, as of a lane or a call with other params; rows that contradict each other; or a stepper of your "
        "own that does not hold them."
    ),
    Result.NOT_IMPLIED: (
        'the constraints that are solved for are kept, but rows that were left out as redundant (redundant="drop" of a'
        " scene, implied= of a System) are violated. Likely causes: the rows follow only at the start, where links lie "
        "in line or a loop lies flat, or only for other parameters. Start elsewhere, take the parameters for which "
        "they follow, or hold these rows instead of others."
    ),
}


class Status(np.int64):
    """The `Result` of a run as a NumPy integer: a trajectory stays a pytree of arrays, and its status prints as a
    sentence."""

    def __str__(self) -> str:
        result = Result(int(self))
        return result.name if result.success else f"{result.name}: {result.message}"

    def __repr__(self) -> str:
        return repr(Result(int(self)))

    def __format__(self, form: str) -> str:
        return format(int(self), form) if form else str(self)


RUNNING = -1
"""Status of an iteration that goes on."""


class Method(IntEnum):
    """How a step was solved; of several ways in a step, the one with the largest number, mostly the most expensive one.

    EXPLICIT: nothing to solve. LINEAR: linear equations, solved directly. MASSES, MODES, EXACT, NULL_SPACE: the matrix
    of the iteration, see `vmri_jax.steppers.solver`.
    """

    EXPLICIT = 0
    LINEAR = 1
    MASSES = 3  # files keep the numbers: 2 and 6 were other methods
    MODES = 4
    EXACT = 5
    NULL_SPACE = 7


class SimulationError(RuntimeError):
    """A run failed at some macro step; the trajectory up to there is in `.trajectory`.

    Attributes:
        result: the `Result` of the failing step.
        step: index of the failing macro step (0 = the first).
        time: time at the start of that step.
        iterations, residual: the most Newton iterations and the largest residual of a step between the last saved node
            and the failure.
        trajectory: the `Trajectory` up to the failure (NaN after it).
        moved: sentence on the body or coordinate that moved most before the failure; empty if it is not known.
        labels: sentence on variables that are slow but move fast, or the other way round; empty if there are none.
    """

    def __init__(
        self, result: Result, step: int, time: float, iterations: int, residual: float, trajectory, *, moved: str = ""
    ):
        self.result, self.step, self.time, self.moved = result, step, time, moved
        self.iterations, self.residual, self.trajectory, self.labels = iterations, residual, trajectory, ""
        explanation = f"{result.message} {moved}".strip()
        super().__init__(
            f"macro step {step} at t = {time:.6g} failed ({result.name}) after {iterations} Newton iterations with "
            f"residual {residual:.2e}: {explanation} This exception's .trajectory has the run up to there."
        )

    def advised(self, macro_dt: float, labels: str = "", jump: str = "") -> "SimulationError":
        """This exception with notes on likely causes and on `vmri_jax.stability.advise`.

        Args:
            macro_dt: of the run.
            labels: as of the attribute.
            jump: sentence on a force that jumps at the failure; empty if none does.
        """
        self.labels = labels
        for cause in filter(None, (jump, labels)):
            self.add_note(cause)
        self.add_note(
            f"vmri_jax.stability.advise(problem, scheme, macro_dt={macro_dt:g}), or vmri advise on the command line, "
            "says whether this step is stable, which one near it is, and whether slow and fast variables are "
            "swapped."
        )
        return self

    def __reduce__(self):
        fields = self.result, self.step, self.time, self.iterations, self.residual, self.trajectory
        return partial(type(self), moved=self.moved), fields
