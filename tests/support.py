"""Data files and measures that tests share."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import SimulationError, Solver, State, Trajectory, initial_state, macro_step, plan, simulate, systems
from vmri_jax.running.export import NODES, named_arrays
from vmri_jax.running.simulation import simulation

DATA = Path(__file__).parent / "data"
PROBLEMS = {
    "fpu": systems.fermi_pasta_ulam,
    "tsp": systems.triple_spherical_pendulum,
    "sam": systems.simple_atomic_model,
}


NUM_SAVES = 50
"""Saved intervals of most runs: of one number, so that tests share compiled runs."""


compiled_step = jax.jit(macro_step)
"""``(system, scheme, state, macro_dt, solver) -> (state, info)``, compiled once per structure."""


@jax.jit
def step_matrix(system, scheme, macro_dt):
    """Derivative of a macro step of one slow and one fast variable by ``(q_s, q_f, p_s, p_f)``, at rest."""

    def step(z):
        state = State(jnp.zeros(()), *jnp.split(z, 4))
        end, _ = macro_step(system, scheme, state, macro_dt, without_fallback(system, scheme, state))
        return jnp.concatenate([end.q_s, end.q_f, end.p_s, end.p_f])

    return jax.jacfwd(step)(jnp.zeros(4))


def set_up(moving, scheme, macro_dt: float, num_steps: int):
    """A run of a problem or a scene that nobody computes."""
    return simulation(moving, scheme, None, None, macro_dt, num_steps)


def until_failure(*arguments, **options) -> Trajectory:
    """`simulate` of a run that may fail: its trajectory, NaN from the failure on."""
    try:
        return simulate(*arguments, **options)
    except SimulationError as failure:
        return failure.trajectory


def joined(runs) -> Trajectory:
    """One run of runs each of which goes on from the one before, with the worst of their statuses."""
    first, *others = map(named_arrays, runs)

    def join(name: str):
        arrays = [run[name] for run in (first, *others)]
        if not np.ndim(arrays[0]):
            return np.max(arrays)
        return np.concatenate([arrays[0], *(array[name in NODES :] for array in arrays[1:])])

    return runs[0].with_arrays(**{name: join(name) for name in first})


def without_fallback(moving, scheme, state=None) -> Solver:
    """The default solver without the exact one behind it, which takes long to compile."""
    return plan(moving, scheme, state).first


STENCIL = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
"""Weights of central differences of order 8."""


def slopes(function, directions: np.ndarray, step: float = 0.01) -> np.ndarray:
    """Derivatives at zero of a function along directions, the last axis, by differences of order 8, which compile
    nothing."""

    def slope(direction):
        differences = ((k, function(k * step * direction) - function(-k * step * direction)) for k in STENCIL)
        return sum(STENCIL[k] / step * difference for k, difference in differences)

    return np.stack([slope(direction) for direction in directions], axis=-1)


NAMES = "q_s", "q_f", "p_s", "p_f"


def node(run, k: int) -> State:
    """The state at a saved node of a run."""
    return jax.tree.map(lambda a: np.asarray(a)[k], State(run.t, run.q_s, run.q_f, run.p_s, run.p_f))


def phase(states) -> np.ndarray:
    """Positions and momenta of a state, or of all nodes of a run, side by side."""
    return np.concatenate([getattr(states, name) for name in NAMES], axis=-1)


def area_change(ends, dimension: int) -> float:
    """Relative change of ``omega(u, v)``, the symplectic form of one pair of random directions, between two states.

    The states are ``ends(x)``, with x of `dimension` coordinates near zero. Where any other pair of directions changes,
    this one does.
    """
    pair = np.random.default_rng(0).standard_normal((2, dimension))
    pair /= np.linalg.norm(pair, axis=1, keepdims=True)
    # steps of 0.03: round-off of the positions, over the step, is three times as small as with steps of 0.01
    tangents = slopes(lambda x: np.stack([phase(state) for state in ends(x)]), pair, step=0.03)
    (dq_u, dp_u), (dq_v, dp_v) = (np.split(tangents[..., i], 2, axis=1) for i in (0, 1))
    start, end = np.sum(dq_u * dp_v - dp_u * dq_v, axis=1)
    return float(abs(end / start - 1))


def states_near(problem, dimension: int):
    """``state(x)`` on the constraints: positions and velocities moved by x along tangents, then projected."""
    system, n_s = problem.system, problem.q_s.size
    q, v = np.concatenate([problem.q_s, problem.q_f]), np.concatenate([problem.v_s, problem.v_f])
    jacobian = jax.jit(jax.jacrev(lambda q: system.constraints(0.0, q[:n_s], q[n_s:])))(q)
    rows = np.asarray(jacobian).reshape(-1, q.size)
    tangents = np.linalg.svd(rows)[2][len(rows) :]
    assert dimension == 2 * len(tangents)

    def state(x) -> State:
        moved_q, moved_v = (z + dx @ tangents for z, dx in zip((q, v), np.split(np.asarray(x), 2), strict=True))
        return initial_state(system, *np.split(moved_q, [n_s]), *np.split(moved_v, [n_s]), project=True)

    return state


def relative_difference(value, expected) -> float:
    """Largest difference over the largest size of what is expected."""
    return float(np.max(np.abs(np.asarray(value) - expected)) / np.max(np.abs(expected)))


def largest_difference(a, b) -> float:
    """Largest absolute difference."""
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))


def ground_truth(name: str) -> dict:
    """Times t, positions q and velocities v (slow first, then fast), energy: of the continuous equations."""
    with np.load(DATA / "ground_truth" / f"{name}.npz") as file:
        return dict(file)


def masses(problem) -> np.ndarray:
    """Masses per coordinate, slow first, then fast."""
    kinetic = problem.system.kinetic
    return np.concatenate([np.asarray(kinetic.slow), np.asarray(kinetic.fast)])


def convergence(problem, scheme, truth: dict, steps, num_saves: int = NUM_SAVES, only_end: bool = False):
    """Step sizes, and largest errors of the positions and of the momenta over the saved nodes, or at the end alone.

    `steps` are numbers of macro steps up to the end of the truth, multiples of `num_saves`, which divides 100.
    """
    every = 100 // num_saves
    length = truth["t"][-1]
    q_true, p_true = truth["q"][::every], masses(problem) * truth["v"][::every]
    nodes = slice(-1, None) if only_end else slice(None)
    errors = []
    for n in steps:
        run = simulate(problem.system, scheme, problem.state(), macro_dt=length / n, num_steps=n, save=n // num_saves)
        q, p = np.concatenate([run.q_s, run.q_f], axis=1), np.concatenate([run.p_s, run.p_f], axis=1)
        errors.append((np.abs(q - q_true)[nodes].max(), np.abs(p - p_true)[nodes].max()))
    return length / np.asarray(steps), *np.transpose(errors)
