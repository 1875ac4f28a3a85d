"""Variational multirate integrators in JAX: write the physics, pick quadrature rules, get structure-preserving
trajectories.

The physics
    System, ConstantMass, Rheonomic     energies, constraints and forces as functions
    Problem, Names                      a system with its start
    State, initial_state                time, positions and momenta; a consistent one from positions and velocities
    scene                               bodies, joints and effects instead of functions
    systems                             the systems of the reference study

Schemes
    fully_implicit, explicit_slow, fully_explicit, galerkin, mollified_impulse, takahashi_imada
    compose                             of higher order from one of these
    Scheme, Composition, macro, micro, quadrature       schemes of one's own, from quadrature rules

Runs
    simulate                            steps or an accuracy in, a Trajectory out; RunError, Settings
    simulate_batch                      many starts, steps or parameters side by side
    prepare                             the same run again and again, a Simulation
    stream                              long runs on disk, a StoredTrajectory
    ensemble, open_ensemble             many runs, by workers, into a store
    Save                                the nodes that are kept, the states for derivatives, a bar
    Solver                              how implicit equations are solved

Questions
    tune                                the cheapest scheme and steps for an error
    advise                              stable steps, resonances, what is slow and what is fast
    check                               hard cases put to a system
    fit                                 parameters from measurements
    minimize                            optimal control

Subpackages and modules
    plots, animation                    figures, films and pages
    diagnostics, stability              invariants and defects of a step, maps of stable steps
    study, hard_cases                   convergence, work and precision; cases
    fitting, control, ensembles         measurements, optimal control, designs of many runs
    textbook                            the whole method on one page

Inside of a step
    plan, macro_step, discrete_lagrangian, discrete_legendre, Plan, StepInfo, Method, Result

Settings, errors and warnings
    configure, __version__
    Refused, SimulationError, AccuracyNotReached, Interrupted
    CompiledAgainWarning, FailedLanesWarning, LostEnergyWarning, NotConfiguredWarning, SingularCoordinatesWarning,
    UncertifiedWarning
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from vmri_jax import diagnostics
from vmri_jax.accuracy.companions import UncertifiedWarning
from vmri_jax.accuracy.simulate import AccuracyNotReached, FailedLanesWarning, simulate, simulate_batch
from vmri_jax.configure import NotConfiguredWarning, configure
from vmri_jax.mechanics.functions import CompiledAgainWarning
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Save
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.macro_step import macro_step
from vmri_jax.running.observables import LostEnergyWarning, SingularCoordinatesWarning
from vmri_jax.running.origin import Settings
from vmri_jax.running.prepare import prepare
from vmri_jax.running.run_error import RunError
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.store.stored import StoredTrajectory
from vmri_jax.running.store.stream import stream
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes import quadrature
from vmri_jax.schemes.composition import Composition, compose
from vmri_jax.schemes.quadrature import macro, micro
from vmri_jax.schemes.scheme import (
    Scheme,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    galerkin,
    mollified_impulse,
    takahashi_imada,
)
from vmri_jax.steppers.plan import Plan, plan
from vmri_jax.steppers.results import Method, Result, SimulationError
from vmri_jax.steppers.solver import Solver
from vmri_jax.steppers.stepper import StepInfo
from vmri_jax.textbook import discrete_lagrangian, discrete_legendre

from vmri_jax import systems  # isort: skip  (last: its modules use the names imported above)

try:
    __version__ = version("vmri_jax")
except PackageNotFoundError:  # a checkout on PYTHONPATH, as on a machine where nothing can be installed
    __version__ = "unknown"


if TYPE_CHECKING:
    from vmri_jax import animation, control, ensembles, fitting, hard_cases, plots, scene, stability, study, textbook
    from vmri_jax.control.minimize import minimize
    from vmri_jax.ensembles import ensemble, open_ensemble
    from vmri_jax.fitting import fit
    from vmri_jax.hard_cases import check
    from vmri_jax.stability import advise
    from vmri_jax.study import tune

_PACKAGE_OF = {
    "advise": "stability",
    "check": "hard_cases",
    "ensemble": "ensembles",
    "fit": "fitting",
    "minimize": "control",
    "open_ensemble": "ensembles",
    "tune": "study",
}
"""Functions that are imported with their packages when they are asked for. matplotlib and scipy.stats take half a
second."""


def __getattr__(name: str) -> Any:
    """Import a public package or module, or a function of one."""
    if name not in __all__:
        raise AttributeError(f"module 'vmri_jax' has no attribute {name!r}")
    module = import_module(f"vmri_jax.{_PACKAGE_OF.get(name, name)}")
    value = getattr(module, name) if name in _PACKAGE_OF else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, and no others."""
    return sorted(__all__)


__all__ = [
    "AccuracyNotReached",
    "CompiledAgainWarning",
    "Composition",
    "ConstantMass",
    "FailedLanesWarning",
    "Interrupted",
    "LostEnergyWarning",
    "Method",
    "Names",
    "NotConfiguredWarning",
    "Plan",
    "Problem",
    "Refused",
    "Result",
    "Rheonomic",
    "RunError",
    "Save",
    "Scheme",
    "Settings",
    "Simulation",
    "SimulationError",
    "SingularCoordinatesWarning",
    "Solver",
    "State",
    "StepInfo",
    "StoredTrajectory",
    "System",
    "Trajectory",
    "UncertifiedWarning",
    "__version__",
    "advise",
    "animation",
    "check",
    "compose",
    "configure",
    "control",
    "diagnostics",
    "discrete_lagrangian",
    "discrete_legendre",
    "ensemble",
    "ensembles",
    "explicit_slow",
    "fit",
    "fitting",
    "fully_explicit",
    "fully_implicit",
    "galerkin",
    "hard_cases",
    "initial_state",
    "macro",
    "macro_step",
    "micro",
    "minimize",
    "mollified_impulse",
    "open_ensemble",
    "plan",
    "plots",
    "prepare",
    "quadrature",
    "scene",
    "simulate",
    "simulate_batch",
    "stability",
    "stream",
    "study",
    "systems",
    "takahashi_imada",
    "textbook",
    "tune",
]
