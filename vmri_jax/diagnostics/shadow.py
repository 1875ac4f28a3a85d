"""The shadow energy, which a symplectic scheme conserves, computed from the nodes of a run; it measures the drift of a
run.

The nodes of a symplectic scheme lie on a motion of a modified Hamiltonian, whose action over a step is the discrete
Lagrangian ``L_d``. Along any motion the energy is ``E = p . q' - (action)'``. Therefore, with

    b_n = 2 L_d(n) + p_n . q_n - p_{n+1} . q_{n+1}        beta_{n+1} = beta_n + b_n
    E_n = (q' . p - q . p' - beta') / 2

and derivatives by central differences over 2 k + 1 nodes, the modified Hamiltonian is known up to ``O(H^{2k})`` without
its formula. The energy of the system itself oscillates by ``O(H^r)``, r the order of the scheme; the shadow energy does
not, so that it shows drifts smaller by many digits.

Source: R. D. Skeel, D. J. Hardy, Practical construction of modified Hamiltonians, SIAM J. Sci. Comput. 23 (2001).
"""

from dataclasses import dataclass, replace
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import whole_number
from vmri_jax.mechanics.invariants import velocity_and_masses
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.trajectory import Trajectory
from vmri_jax.schemes.composition import SchemeLike, stage_lengths, stage_scheme
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.kicked import kicked
from vmri_jax.steppers.marched import Marched
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver
from vmri_jax.textbook import discrete_lagrangian

BLOCKS = 20
"""Parts of a run to whose means the drift is fitted; with more parts neighbouring means are correlated, with fewer the
standard error of the slope is uncertain."""
LARGEST_MISS = 1e-6
"""Largest distance between a recomputed node and the node of the run, as a part of the length of the step; a larger
value accepts runs of another system or scheme."""


@dataclass(frozen=True)
class ShadowEnergy:
    """The shadow energy of a run, and its drift.

    Attributes:
        t: (m,) times of the nodes that have k nodes on either side.
        energy: (m,) shadow energy at these nodes.
        band: largest minus smallest shadow energy.
        energy_band: largest minus smallest energy of the system at these nodes.
        drift, drift_error: slope of a straight line through the means of 20 parts of the run, and its standard error,
            in energy per time.
        rounding: drift of a run in which every step changes the energy by a unit of round-off in the same direction.
    """

    t: Float[np.ndarray, "m"]
    energy: Float[np.ndarray, "m"]
    band: float
    energy_band: float
    drift: float
    drift_error: float
    rounding: float

    @property
    def drifts(self) -> bool:
        """Whether the drift exceeds four standard errors and the drift by round-off."""
        return abs(self.drift) > max(4 * self.drift_error, self.rounding)

    @property
    def ratio(self) -> float:
        """Band of the energy of the system divided by the band of the shadow energy."""
        return self.energy_band / self.band if self.band else np.inf

    def __repr__(self) -> str:
        verdict = "it drifts" if self.drifts else "no drift is seen"
        drift = f"drift {self.drift:.1e} +- {self.drift_error:.0e} per time: {verdict}"
        return f"shadow energy: band {self.band:.1e} (energy of the system: {self.energy_band:.1e}), {drift}"


def shadow_energy(system: Movable, scheme: SchemeLike, trajectory: Trajectory, k: int = 5) -> ShadowEnergy:
    """The shadow energy of a symplectic scheme along a run, and its drift.

        run = vm.simulate(problem, scheme, macro_dt=0.01, num_steps=10_000)
        print(vm.diagnostics.shadow_energy(problem, scheme, run))

    The macro nodes must resolve the fast motion: the band shrinks with k if ``omega H`` is below about 2, fast below
    1/2. From ``omega H = 0.9 pi`` on the band grows with k: a sign of the resonance of kicks at pi, which the energy
    shows only from 0.95 pi on.

    Args:
        system, scheme: as of the run. The system has neither forces nor constraints that depend on time, since it must
            conserve its energy.
        trajectory: a run with every macro node saved, at least 2 k + 21 of them.
        k: nodes on either side of the central differences, whose order is 2 k.

    Raises:
        ValueError: forces, rheonomic constraints, a mollified scheme; nodes left out; too few nodes; a failed run.
    """
    whole_number("shadow_energy: k", k)
    system = _checked(system, scheme, trajectory, k)
    t = np.asarray(trajectory.t)
    nodes = jax.tree.map(jnp.asarray, trajectory.states)
    macro_dt = (t[-1] - t[0]) / (len(t) - 1)
    actions, miss, result = _actions(system, scheme, nodes, macro_dt)
    if int(result) > Result.CONVERGED_AT_ROUNDOFF or not float(miss) < LARGEST_MISS:
        far = (
            f"steps of {macro_dt:.6g} from the nodes of the trajectory miss the next ones by {float(miss):.1e} of a "
            "step"
        )
        raise Refused(f"shadow_energy: {far}. Give a run of this system and scheme with every macro node saved.")
    q, p = (np.concatenate(pair, axis=1) for pair in ((nodes.q_s, nodes.q_f), (nodes.p_s, nodes.p_f)))
    energy = _energy(q, p, np.asarray(actions), macro_dt, k)
    inner = slice(k, len(t) - k)
    drift, error = _slope(t[inner], energy)
    rounding = float(np.finfo(float).eps * np.abs(trajectory.energy).max() / macro_dt)
    bands = float(np.ptp(energy)), float(np.ptp(trajectory.energy[inner]))
    return ShadowEnergy(t[inner], energy, *bands, drift, error, rounding)


def _checked(system: Movable, scheme: SchemeLike, trajectory: Trajectory, k: int) -> System:
    """The system; refuses runs that conserve no energy, failed or have too few nodes."""
    system, _ = start_of("shadow_energy", system, trajectory[0])
    if system.force is not None or system.is_rheonomic:
        cause = "forces" if system.force is not None else "constraints that depend on time"
        raise Refused(f"shadow_energy: the system has {cause}: no energy is kept. Leave them out.")
    if stage_scheme(scheme).slow.mollified:
        raise Refused("shadow_energy: the action of a mollified scheme depends on more than the nodes of a step.")
    if int(np.max(trajectory.failed_at)) >= 0 or not np.isfinite(trajectory.energy).all():
        raise Refused("shadow_energy: the run failed; take its first part, trajectory[:n].")
    fewest = 2 * k + BLOCKS + 1
    if np.ndim(trajectory.t) != 1 or len(trajectory.t) < fewest:
        expected = f"with k = {k} give one run of at least {fewest} nodes, or a smaller k"
        raise Refused(f"shadow_energy: the times have shape {np.shape(trajectory.t)}; {expected}.")
    return system


@jax.jit
def _actions(system: System, scheme: SchemeLike, nodes: State, macro_dt):
    """Discrete Lagrangian of every step, largest distance of a step from the next node relative to its length, worst
    `Result`."""

    def step(nodes):
        start, end = nodes

        def stage(carry, part):
            state, action = carry
            state, action_of_stage, result = _stage(system, stage_scheme(scheme), state, part * macro_dt)
            return (state, action + action_of_stage), result

        (reached, action), results = jax.lax.scan(stage, (start, jnp.zeros(())), jnp.asarray(stage_lengths(scheme)))
        q, q_end, q_start = (jnp.concatenate([s.q_s, s.q_f]) for s in (reached, end, start))
        # Positive for a system at rest, too.
        length = jnp.max(jnp.abs(q_end - q_start)) + 1e-9 * jnp.max(jnp.abs(q_end))
        return action, jnp.max(jnp.abs(q - q_end)) / length, jnp.max(results)

    starts, ends = (jax.tree.map(lambda a, part=part: a[part], nodes) for part in (slice(-1), slice(1, None)))
    actions, misses, results = jax.lax.map(step, (starts, ends))
    return actions, jnp.max(misses), jnp.max(results)


def _stage(system: System, scheme: Scheme, state: State, macro_dt):
    """A step with all its control points: the state at its end, its discrete Lagrangian and its `Result`."""
    kicks = lagrangian(system, scheme).kicks

    def with_kicks(state: State, **ends: float) -> State:
        gradients = [term.gradient(state.q_s, state.q_f) for term in kicks]
        return kicked(state, kicks, gradients, macro_dt, **ends)

    start = with_kicks(state, start=1.0)
    equations = StepEquations.of(system, scheme, start, macro_dt)
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    (v_s, v_f), masses = velocity_and_masses(system, start.q_s, start.q_f, start.p_s, start.p_f)
    guess = equations.guess(v_s, v_f, jnp.zeros(n_g), jnp.zeros(n_gs))
    solver = Marched(Solver("exact"))
    solution, _ = solver.solve(replace(equations, masses=masses), guess, solver.init(equations))
    q_s, (q_f, p_s, p_f) = state.q_s + solution.x.slow[-1], solution.end
    end = with_kicks(State(state.t + macro_dt, q_s, q_f, p_s, p_f), end=1.0)
    slow, fast = solution.x.slow, solution.x.fast
    starts = jnp.concatenate([state.q_f[None], state.q_f + jnp.cumsum(fast[:, -1], axis=0)])  # of the micro intervals
    points = jnp.concatenate(starts[:-1, None] + fast)
    slow, fast = (
        jnp.concatenate([start[None], a]) for start, a in ((state.q_s, state.q_s + slow), (state.q_f, points))
    )
    return end, discrete_lagrangian(system, scheme)(slow, fast, macro_dt), solution.status.result


def _energy(q, p, actions, macro_dt, k: int):
    """Shadow energy at the nodes that have k nodes on either side.

    Positions are measured from the middle node, q - q_0: products with large positions would lose digits.
    """
    nodes, inner = len(q), slice(k, len(q) - k)
    shifted = [slice(k + j, nodes - k + j) for j in range(-k, k + 1)]
    q_0, p_0 = q[inner], p[inner]

    def momentum_sum(part):
        return np.sum(p[part] * (q[part] - q_0), axis=1)

    # b_n of the 2 k steps about each node
    b = [
        2 * actions[k + j : nodes - k + j] + momentum_sum(shifted[k + j]) - momentum_sum(shifted[k + j + 1])
        for j in range(-k, k)
    ]
    # f' = sum_j w_j (f_j - f_-j) / H with w_j = (-1)^(j+1) k!^2 / (j (k-j)! (k+j)!); q . p' vanishes since q - q_0 is
    # zero in the middle
    twice_energy = np.zeros(len(q_0))
    beta = np.zeros(len(q_0))  # beta_j - beta_-j
    for j in range(1, k + 1):
        beta = beta + b[k - j] + b[k + j - 1]
        weight = (-1) ** (j + 1) * factorial(k) ** 2 / (j * factorial(k - j) * factorial(k + j))
        twice_energy += weight * (np.sum((q[shifted[k + j]] - q[shifted[k - j]]) * p_0, axis=1) - beta)
    return twice_energy / (2 * macro_dt)


def _slope(t, values) -> tuple[float, float]:
    """Slope of a straight line through the means of `BLOCKS` parts, and its standard error.

    If the residuals of neighbouring parts have the correlation rho, the variance of the slope grows by
    ``(1 + rho) / (1 - rho)``.
    """
    means = np.array([[part.mean() for part in np.array_split(a, BLOCKS)] for a in (t - t.mean(), values)])
    x, y = means - means.mean(axis=1, keepdims=True)
    slope = np.sum(x * y) / np.sum(x**2)
    residual = y - slope * x
    squares = float(np.sum(residual**2))
    rho = np.clip(np.sum(residual[1:] * residual[:-1]) / squares, 0.0, 0.9) if squares else 0.0
    error = np.sqrt(squares / (BLOCKS - 2) / np.sum(x**2) * (1 + rho) / (1 - rho))
    return float(slope), float(error)
