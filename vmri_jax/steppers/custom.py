"""Whole steps from a user's stepper or solver: kicks around a solver, a projection where a stepper has none, and checks of shapes."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np

from vmri_jax.mechanics.checks import check_type
from vmri_jax.mechanics.constraint_pattern import all_rows
from vmri_jax.mechanics.projection import project_momentum
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.kicked import Kicked, KickedState
from vmri_jax.steppers.solved import Solved, Solver
from vmri_jax.steppers.stepper import Stepper


@dataclass(frozen=True, kw_only=True)
class Projecting(Kicked):
    """Kicks around a stepper without a method `project`, with the projection of momenta onto the hidden constraints added."""

    system: System

    def project(self, state: State, memory: KickedState) -> tuple[State, KickedState]:
        p_s, p_f, _, _ = project_momentum(self.system, state)
        return State(state.t, state.q_s, state.q_f, p_s, p_f), memory


def whole_step(
    made: Stepper | Solver, system: System, scheme: Scheme, state: State, average: Callable | None, reverse_only: bool
) -> Kicked:
    """The stepper of a run, made of a user's stepper or solver.

    A `Solver` or a `Solved` stepper solves the equations between the kicks, so that the kicks of the scheme are added before and after; any
    other stepper takes the whole step. With constraints every step ends with a projection of the momenta onto the hidden constraints.

    Args:
        made: value of the function of `Custom`.
        system: of the run.
        scheme: of a stage.
        state: only its shapes matter.
        average: of mollified kicks, see `Kicked`.
        reverse_only: see `Solved`.

    Raises:
        TypeError: `made` is neither a stepper nor a solver.
        ValueError: shapes of the end state or of the record that do not fit the system and the scheme.
    """
    if isinstance(made, Solver):
        made = Solved(system, scheme, made, all_rows(system, state.q_s, state.q_f), reverse_only)
    check_type("plan: the stepper of solvers.Custom", made, Stepper, "a vmri_jax.steppers.stepper.Stepper")
    if isinstance(made, Solved):
        made = Kicked(lagrangian(system, scheme).kicks, made, average)
    if type(made) is not Kicked:  # a subclass may have an `advance` of its own
        made = Kicked((), made)
    if system.is_constrained and not _projects(made.inner):
        made = Projecting(made.kicks, made.inner, made.average, system=system)
    made = replace(made, projects=system.is_constrained)
    _check_shapes(made, system, scheme, state)
    return made


def _projects(stepper: Stepper) -> bool:
    """Whether a stepper projects momenta itself: by a method `project` of its class, or of the stepper between its kicks."""
    if type(stepper).project is Kicked.project:
        return _projects(stepper.inner)  # pyright: ignore[reportAttributeAccessIssue]
    return type(stepper).project is not Stepper.project


def _check_shapes(stepper: Stepper, system: System, scheme: Scheme, state: State) -> None:
    """Refuse a stepper whose end state or record has wrong shapes."""
    (n_g, n_gs), n_f, r = system.num_constraints(state.q_s, state.q_f), state.q_f.size, scheme.degree

    def step(state: State):
        end, info, _ = stepper.step(state, stepper.init(state, 1.0), 1.0)
        return end, info

    end, info = jax.eval_shape(step, state)
    micro = scheme.num_micro
    of_info = {"q_f_micro": (micro, n_f), "multiplier": (micro, r, n_g), "slow_multiplier": (r, n_gs)}
    expected = [(end, name, np.shape(value)) for name, value in vars(state).items()]
    expected += [(info, name, shape) for name, shape in of_info.items()]
    for owner, name, shape in expected:
        returned = np.shape(getattr(owner, name))
        if returned != shape:
            raise ValueError(
                f"plan: advance of the stepper of solvers.Custom returns {type(owner).__name__}.{name} of shape {returned}; it must be {shape} for num_micro = {micro}, "
                f"degree = {r}, {n_g} constraints and {n_gs} slow ones."
            )
