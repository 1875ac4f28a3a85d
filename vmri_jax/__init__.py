"""Variational multirate integrators in JAX: write the physics, pick quadrature rules, get structure-preserving trajectories."""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from vmri_jax import diagnostics
from vmri_jax.accuracy.companions import UncertifiedWarning
from vmri_jax.accuracy.simulate import simulate
from vmri_jax.accuracy.steps import AccuracyNotReached
from vmri_jax.configure import NotConfiguredWarning, configure
from vmri_jax.mechanics.functions import CompiledAgainWarning
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.mechanics.system import ConstantMass, Rheonomic, System
from vmri_jax.running.batch import FailedLanesWarning, simulate_batch
from vmri_jax.running.interrupts import Interrupted
from vmri_jax.running.lost_energy import LostEnergyWarning
from vmri_jax.running.macro_step import macro_step
from vmri_jax.running.run_error import RunError
from vmri_jax.running.settings import Settings
from vmri_jax.running.simulation import Simulation, prepare
from vmri_jax.running.store import StoredTrajectory, stream
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes import quadrature
from vmri_jax.schemes.composition import Composition, compose
from vmri_jax.schemes.discrete_lagrangian import discrete_lagrangian, discrete_legendre
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
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.plan import Plan, plan
from vmri_jax.steppers.results import Method, Result, SimulationError
from vmri_jax.steppers.stepper import StepInfo

from vmri_jax import systems  # isort: skip  (written with the names above)

try:
    __version__ = version("vmri_jax")
except PackageNotFoundError:  # a checkout on PYTHONPATH, as on a machine where nothing can be installed
    __version__ = "unknown"


if TYPE_CHECKING:
    from vmri_jax.ensembles import ensemble, open_ensemble
    from vmri_jax.fitting import fit

LATER = {
    "plots": ("vmri_jax.plots", None),
    "ensembles": ("vmri_jax.ensembles", None),
    "ensemble": ("vmri_jax.ensembles.run", "ensemble"),
    "control": ("vmri_jax.control", None),
    "fit": ("vmri_jax.fitting.fit", "fit"),
    "fitting": ("vmri_jax.fitting", None),
    "open_ensemble": ("vmri_jax.ensembles.reading", "open_ensemble"),
}
"""Names that are imported when they are asked for: the module, and the name in it. matplotlib and scipy.stats take half a second."""


def __getattr__(name: str) -> Any:
    """What is in `LATER`."""
    if name in LATER:
        module, attribute = LATER[name]
        found = import_module(module)
        return found if attribute is None else getattr(found, attribute)
    raise AttributeError(f"module 'vmri_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    """All names, those of `LATER` too."""
    return sorted({*globals(), *LATER})


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
    "Newton",
    "NotConfiguredWarning",
    "Plan",
    "Problem",
    "Result",
    "Rheonomic",
    "RunError",
    "Scheme",
    "Settings",
    "Simulation",
    "SimulationError",
    "State",
    "StepInfo",
    "StoredTrajectory",
    "System",
    "Trajectory",
    "UncertifiedWarning",
    "__version__",
    "compose",
    "configure",
    "diagnostics",
    "discrete_lagrangian",
    "discrete_legendre",
    "ensemble",
    "explicit_slow",
    "fit",
    "fully_explicit",
    "fully_implicit",
    "galerkin",
    "initial_state",
    "macro",
    "macro_step",
    "micro",
    "mollified_impulse",
    "open_ensemble",
    "plan",
    "prepare",
    "quadrature",
    "simulate",
    "simulate_batch",
    "stream",
    "systems",
    "takahashi_imada",
]
