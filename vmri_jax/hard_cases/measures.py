"""Measurements of several cases: runs that may fail, energy, constraints, refusals, derivatives of functions."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.accuracy.simulate import simulate
from vmri_jax.diagnostics.shadow import ShadowEnergy
from vmri_jax.hard_cases.case import Outcome
from vmri_jax.mechanics.arrays import split_at
from vmri_jax.mechanics.state import Problem, State
from vmri_jax.refusals import Refused
from vmri_jax.running.observables import LostEnergyWarning
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Result, SimulationError

SAVED_NODES = 10_000
"""Approximate number of saved nodes of a long run; a larger value takes more memory."""
DIRECTIONS = 6
"""Random directions in which derivatives are compared; more of them find errors in more coordinates and take longer."""
STEPS = 10.0 ** -np.arange(2, 7)
"""Values of h, in units of the largest position."""
DISPLACEMENT = 1e-4
"""Largest random displacement of the points, as a part of the largest position: a function with a bend exactly at a
point has no derivative there. A larger value leaves the states of the run."""
WRONG = 1e-4
"""Relative difference from which a derivative is wrong; right ones differ by 1e-7. A larger value overlooks errors."""
ROUND_OFF = 1e-14
"""Round-off of a difference of values, as a part of the value; a larger value hides errors of small derivatives."""


def run(problem: Problem, scheme, macro_dt, num_steps: int, state: State | None = None, **options: Any) -> Trajectory:
    """`vmri_jax.simulate` from a state, by default the start of the problem; a failure is in the trajectory and not
    raised."""
    start = problem.state() if state is None else state
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LostEnergyWarning)  # the cases measure it
        try:
            return simulate(problem.system, scheme, start, macro_dt=macro_dt, num_steps=num_steps, **options)
        except SimulationError as failure:
            return failure.trajectory


def long_run(problem: Problem, scheme, macro_dt, num_steps: int, **options) -> Trajectory:
    """`run` that saves about `SAVED_NODES` nodes."""
    return run(problem, scheme, macro_dt, num_steps, save=max(1, num_steps // SAVED_NODES), **options)


def status(trajectory: Trajectory) -> str:
    """The status of a run in words."""
    name = Result(int(trajectory.result)).name
    return name if trajectory.success else f"{name} at step {int(trajectory.failed_at)}"


@dataclass(frozen=True)
class Energy:
    """Change of the energy of a run since its start.

    band: largest deviation from the start.
    drift: slope of a straight line, per 1e5 steps.
    share: change along that line over the whole run, as a share of the band.
    """

    band: float
    drift: float
    share: float

    @property
    def drifts(self) -> bool:
        """Whether the linear trend is more than half of the band: chaotic motion moves the mean by a tenth or two."""
        return not self.share <= 0.5


def energy(trajectory: Trajectory, num_steps: int, scale: float = 1.0) -> Energy:
    """Band and drift of the energy over a run of `num_steps` steps, in units of `scale`; infinite if it failed."""
    e = (np.asarray(trajectory.energy) - float(trajectory.energy[0])) / scale
    if not np.isfinite(e).all():
        return Energy(np.inf, np.inf, np.inf)
    band = float(np.abs(e).max())
    change = float(np.polyfit(np.linspace(0.0, 1.0, len(e)), e, 1)[0])
    share = abs(change) / band if band else 0.0
    return Energy(band, change / num_steps * 1e5, share)


def energy_scale(problem: Problem, trajectory: Trajectory) -> float:
    """Size of the energies of a run: the larger of ``|E_0|`` and the largest kinetic energy, at least 1e-300."""
    still = problem.system.only(lambda term: term.kind != "potential")
    kinetic = jax.vmap(partial(diagnostics.energy, still))
    _, *phase = vars(trajectory.states).values()
    return max(float(np.nanmax(kinetic(*phase))), float(abs(trajectory.energy[0])), 1e-300)


def drift_meter(problem: Problem, scheme, macro_dt, num_steps: int) -> ShadowEnergy | None:
    """The shadow energy of the first steps; None with forces, moving constraints, or a run that failed."""
    try:
        return diagnostics.shadow_energy(problem, scheme, run(problem, scheme, macro_dt, num_steps))
    except Refused:
        return None


def constraints(trajectory: Trajectory) -> tuple[float, float]:
    """Largest ``|g|`` and ``|G v|`` of a run; infinite where it failed."""
    if not trajectory.success:
        return np.inf, np.inf
    position, velocity = np.asarray(trajectory.constraint_residual).max(axis=0)
    return float(position), float(velocity)


def difference(a, b) -> float:
    """Largest difference of two arrays over the largest value in b; infinite if one is not finite."""
    largest = np.max(np.nan_to_num(np.abs(np.asarray(a) - np.asarray(b)), nan=np.inf), initial=0.0)
    return float(largest / np.abs(b).max(initial=1e-300))


def refusal(call) -> str:
    """The message of the refusal of a call; empty if the call is not refused."""
    try:
        call()
    except Refused as error:
        return str(error)
    return ""


def derivatives(problem: Problem, scheme: Scheme, macro_dt: float) -> Outcome:
    """The largest relative difference of derivatives, and the functions whose derivatives are wrong.

    With s(z) a function of positions (and velocities), or a weighted sum of its components, and d a direction,

        grad s(z) . d = (8 (s(z + h d) - s(z - h d)) - (s(z + 2 h d) - s(z - 2 h d))) / (12 h) + O(h^4)

    must hold for at least one h: higher derivatives spoil a large h, round-off a small one. The second derivative of a
    potential is compared with differences of the gradient in the same way; then it is symmetric, too.
    """
    worst = {}
    for name, function, points in _terms(problem, scheme, macro_dt):
        first, second = _differences(function, points)
        worst[f"the gradient of {name} from differences of its values"] = first
        if "potential" in name:
            worst[f"the second derivative of {name} from differences of its gradient"] = second
    wrong = {comparison: difference for comparison, difference in worst.items() if not difference < WRONG}
    largest = max(worst.values(), default=0.0)
    if not wrong:
        return Outcome(f"at most {largest:.0e} from differences", True, {"apart": largest})
    words = "; ".join(f"{comparison} differs by {difference:.2g}" for comparison, difference in wrong.items())
    return Outcome(
        f"relative to its size, {words}. Likely cause: a custom derivative (jax.custom_jvp, custom_vjp) that differs "
        "from the derivative of the function, or jax.lax.stop_gradient, which hides a part of it. Forces without a "
        "potential belong into force.",
        False,
        {"apart": largest},
    )


def _terms(problem: Problem, scheme: Scheme, macro_dt: float) -> Iterator[tuple[str, Callable, np.ndarray]]:
    """The functions of the system by name, as functions of a vector, ``function(z) -> (m,)``, with (k, n) points z: the
    start and nodes of a short run."""
    system, n_s = problem.system, problem.q_s.size
    along = run(problem, scheme, macro_dt, 20, save=5)
    points = np.concatenate([along.q_s, along.q_f, *along.velocities], axis=1)
    points, t = points[np.isfinite(points).all(axis=1)], along.t[0]
    n = points.shape[1] // 2
    for term in system.of_kind("potential"):
        values = partial(lambda term, q: term.at(split_at(q, n_s), system.params)[None], term)
        yield term.place, values, points[:, :n]
    if not system.has_constant_mass:
        yield "kinetic", lambda z: system.kinetic_energy(*split_at(z, n_s, n, n + n_s))[None], points
    if system.is_constrained:
        yield "the constraints", lambda q: system.constraints(t, *split_at(q, n_s)), points[:, :n]


def _differences(function: Callable, points: np.ndarray) -> tuple[float, float]:
    """Largest relative differences over all points, of the gradient and of the second derivative from differences."""
    random = np.random.default_rng(0)
    size = float(np.abs(points).max(initial=0.0)) or 1.0
    points = points + DISPLACEMENT * size * random.uniform(-1, 1, points.shape)
    directions = random.uniform(-1, 1, (DIRECTIONS, points.shape[1]))

    if not points.shape[1]:
        return 0.0, 0.0

    def value(z):
        values = function(z)
        return jnp.sum(values * jnp.linspace(1.0, 2.0, values.size))

    @jax.jit
    @jax.vmap
    def compared(z):
        d, gradient = jnp.asarray(directions), jax.grad(value)
        gradients, second_derivatives = jax.lax.map(lambda x: jax.jvp(gradient, (z,), (x,)), d)  # grad s and s'' d
        first = _from_quotients(value, z, d, jnp.sum(gradients * d, axis=1), size)
        return first, _from_quotients(gradient, z, d, second_derivatives, size)

    first, second = (float(np.max(np.asarray(x))) for x in compared(jnp.asarray(points)))
    return first, second


def _from_quotients(f: Callable, z, directions, derivatives, size: float):
    """Relative difference of the derivatives (DIRECTIONS, ...) of f from its quotients of order 4, less round-off, for
    the h with the smallest one."""

    def quotient(h, d):
        near, far = (f(z + k * h * d) - f(z - k * h * d) for k in (1, 2))
        return (8 * near - far) / (12 * h)

    quotients = jax.lax.map(lambda h: jax.lax.map(lambda d: quotient(h, d), directions), jnp.asarray(STEPS * size))
    difference = jnp.abs(quotients - derivatives).reshape(len(STEPS), -1).max(axis=1)
    difference = jnp.where(jnp.isfinite(difference), difference, jnp.inf)
    difference = jnp.maximum(difference - ROUND_OFF * jnp.abs(f(z)).max() / size / STEPS, 0.0)
    scale = jnp.maximum(jnp.abs(derivatives).max(), jnp.abs(quotients[2]).max())
    return jnp.min(difference) / jnp.where(scale > 0, scale, 1.0)
