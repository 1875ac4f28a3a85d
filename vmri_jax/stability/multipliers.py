"""Multipliers of a macro step, the eigenvalues of its derivative, and their Krein signatures; the derivative of many steps.

The multipliers of a symplectic map come in pairs (a, 1/a). They stay on the unit circle, and the motion stays bounded, until two multipliers
of opposite Krein signature meet; multipliers of equal signature pass through each other (Krein, Gelfand and Lidskii; Arnold,
*Mathematical Methods of Classical Mechanics*, 42). Therefore the sequence of the signatures, in the order of the angles, changes only across
such a meeting, however narrow the unstable window is.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.diagnostics.linear import change_of_form, derivative_along, phase_splits, phase_vector
from vmri_jax.mechanics.arrays import QUICK, is_concrete, whole_number
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.macro_step import macro_step
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.stability.linear import SmallMotions
from vmri_jax.steppers.march import MarchEquations, exact_pass
from vmri_jax.steppers.results import Method, Result
from vmri_jax.steppers.solved import Solution, StepSolver
from vmri_jax.steppers.solver import Solver
from vmri_jax.steppers.stepper import StepStatus

LANES = 64
"""Step sizes that a compiled call computes side by side for up to 18 degrees of freedom; larger systems get fewer, at least 4, to limit memory. With
more lanes a call for a single step size, which is padded to this number, takes longer."""
CONSTRAINED_ITERATIONS = 3
"""Newton iterations of a step at rest with constraints. Without constraints the iteration starts at the solution, and one iteration is enough;
kicks towards the constraints move its start away from the solution. More iterations take more time."""
FREE_MOTION_ANGLE = 1e-5
"""Angle in radians up to which a multiplier belongs to a free motion, which has no signature; a larger value leaves slow vibrations out."""


@dataclass(frozen=True)
class Multipliers:
    """Multipliers of small motions at k step sizes.

    values: (k, 2 d) eigenvalues of the derivative of the step; NaN where the step itself failed.
    vectors: (k, 2 d, 2 d) eigenvectors in the coordinates of `SmallMotions`, one per column.
    growing: (k, 2 d) whether the multiplier belongs to a motion of the system that grows, whatever the scheme.
    """

    values: np.ndarray
    vectors: np.ndarray
    growing: np.ndarray

    @property
    def radius(self) -> np.ndarray:
        """(k,) largest modulus of the multipliers that are not `growing`; infinite where the step failed."""
        sizes = np.where(self.growing, 0.0, np.abs(self.values))
        return np.where(np.isnan(sizes).any(axis=1), np.inf, sizes.max(axis=1, initial=0.0))

    def krein_signatures(self, tolerance: float) -> list[bytes | None]:
        """Krein signatures along the upper half circle, by angle, for each of the k steps; None for an unstable step.

        The signature of the eigenvector (eta, pi) is the sign of ``Im(conj(eta) . pi)``.
        """
        d = self.values.shape[1] // 2
        signatures: list[bytes | None] = []
        for values, x, radius in zip(self.values, self.vectors, self.radius, strict=True):
            if radius > 1 + tolerance:
                signatures.append(None)
                continue
            signs = np.sign(np.imag(np.sum(np.conj(x[:d]) * x[d:], axis=0)))
            angles = np.angle(values)
            upper = np.flatnonzero((angles > FREE_MOTION_ANGLE) & (np.abs(np.abs(values) - 1) <= tolerance))
            signatures.append(np.take(signs, upper[np.argsort(angles[upper])]).tobytes())
        return signatures


def multipliers(motions: SmallMotions, scheme: Scheme | Composition, macro_dt) -> Multipliers:
    """Multipliers of a macro step for k lengths of the step.

    The derivative of the step is exact, ``jax.jacfwd(macro_step)`` of the expansion at rest on the tangent space of the
    constraint manifold.

    Args:
        motions: of `small_motions`.
        scheme: any scheme or composition.
        macro_dt: (k,) macro steps.
    """
    macro_dt = np.asarray(macro_dt, dtype=float)
    size = motions.read.shape[0]
    lanes = int(np.clip(LANES * 36 // max(size, 1), 4, LANES))
    padded = np.pad(macro_dt, (0, -len(macro_dt) % lanes), mode="edge").reshape(-1, lanes)
    fixed = motions.system, scheme, motions.rest, motions.embed, motions.read
    matrices = np.concatenate([_step_matrices(*fixed, part) for part in padded])[: len(macro_dt)]
    failed = ~np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    values, vectors = np.linalg.eig(np.where(failed[:, None, None], np.eye(size), matrices))
    values = np.where(failed[:, None], np.nan, values.astype(complex))
    # The multiplier nearest to exp(s H) belongs to the growing motion of rate s.
    growing = np.zeros(values.shape, dtype=bool)
    for rate in motions.growing:
        distance = np.where(growing, np.inf, np.abs(values - np.exp(rate * macro_dt)[:, None]))
        growing[np.arange(len(growing)), np.argmin(distance, axis=1)] = True
    return Multipliers(values, vectors.astype(complex), growing)


@dataclass(frozen=True)
class AtRest(StepSolver):
    """Some exact passes, without a test of corrections, which at rest have no motion to be compared with."""

    passes: int

    def solve(self, equations: StepEquations, guess: Unknowns, memory) -> tuple[Solution, tuple]:
        march = MarchEquations(equations)

        def corrected(_, last):
            z, x, *_ = last
            _, now = exact_pass(march, z, x, x[-1], from_last=False)
            return now.z + now.dz, now.x + now.dx, now.end, now.p_s

        start = *march.flat(guess), march.start(), equations.p_s
        z, x, end, p_s = jax.lax.fori_loop(0, self.passes, corrected, start)
        end = end.position, p_s, end.gradients[: march.n_f] / equations.micro_dt
        return Solution(march.by_name(z, x), end, StepStatus.direct(Method.EXACT)), memory

    def describe(self) -> list[str]:
        return [f"exact: {self.passes} passes at rest"]


def at_rest(system: System, scheme: Scheme) -> AtRest:
    """Solves the equations of a step at rest."""
    return AtRest(CONSTRAINED_ITERATIONS if system.is_constrained else 1)


@partial(jax.jit, compiler_options=QUICK)
def _step_matrices(system: System, scheme, rest: State, embed, read, macro_dt):
    """(k, 2 d, 2 d) derivatives of the macro step at rest, for k lengths of the step."""
    solver = Solver(stepper=at_rest)

    def step(coordinates, macro_dt):
        state = State(rest.t, *jnp.split(embed @ coordinates, phase_splits(rest)))
        return read @ phase_vector(macro_step(system, scheme, state, macro_dt, solver)[0])

    return jax.vmap(lambda dt: jax.jacfwd(step)(jnp.zeros(embed.shape[1]), dt))(macro_dt)


@dataclass(frozen=True)
class Monodromy:
    """Derivative of the end of a trajectory with respect to its start, between the tangent spaces of the constraint manifold at both.

    matrix: M, (k, k) with k = 2 (n_s + n_f - n_g - n_gs), in the orthonormal bases `start_basis` and `end_basis`.
    start_basis, end_basis: (k, 2 n) tangent vectors (q_s, q_f, p_s, p_f), one per row.
    start, end: states.
    closure: distance of the end from the start, relative to the larger norm of the two.
    symplectic_defect: largest entry of ``M^T J M - J`` on the tangent spaces, relative to the larger of 1 and the largest ``|M_ij|^2``.
    """

    matrix: np.ndarray
    start_basis: np.ndarray
    end_basis: np.ndarray
    start: State
    end: State
    closure: float
    symplectic_defect: float

    @property
    def multipliers(self) -> np.ndarray:
        """(k,) Floquet multipliers, the largest first.

        They are meaningful only for a trajectory that closes, or ends near its start (small `closure`): then both ends
        share a tangent space.
        """
        values = np.linalg.eigvals(self.start_basis @ self.end_basis.T @ self.matrix)
        return values[np.argsort(-np.abs(values), kind="stable")]

    @property
    def stretch(self) -> np.ndarray:
        """(k,) singular values of M, the largest first: the growth of disturbances of the start, for closed and open trajectories."""
        return np.linalg.svd(self.matrix, compute_uv=False)


def monodromy(
    system: Movable,
    scheme: Scheme | Composition,
    state: State | None = None,
    *,
    macro_dt,
    num_steps: int,
    solver: Solver | None = None,
) -> Monodromy:
    """Product of the step's derivatives along a trajectory, ``M = DPhi(z_(N-1)) ... DPhi(z_0)``.

    With constraints, every factor maps between the tangent spaces of the constraint manifold at the two ends of its step.

    Args:
        system, scheme, macro_dt, solver: as in `macro_step`.
        state: consistent start; None for the start of the problem or scene.
        num_steps: macro steps; one period of a periodic orbit gives its Floquet multipliers.

    Raises:
        ValueError: num_steps below 1, a macro step that is not positive.
        RuntimeError: a step failed; with its number and reason.
    """
    system, state = start_of("monodromy", system, state)
    whole_number("monodromy: num_steps", num_steps)
    if is_concrete(macro_dt) and not (np.ndim(macro_dt) == 0 and np.isfinite(macro_dt) and macro_dt > 0):
        raise ValueError(f"monodromy: macro_dt is {macro_dt}; it must be a positive number.")
    start = State(*(jnp.asarray(a, dtype=float) for a in (state.t, state.q_s, state.q_f, state.p_s, state.p_f)))
    product = derivative_along(system, scheme, start, macro_dt, solver, num_steps)
    last, M, at_start, at_end, steps, result = (np.asarray(a) for a in product)
    if result > Result.CONVERGED_AT_ROUNDOFF:
        raise RuntimeError(f"monodromy: macro step {steps - 1} failed: {Result(int(result)).message}")
    first = np.asarray(phase_vector(start))
    defect = change_of_form(M, at_start, at_end)
    return Monodromy(
        matrix=M,
        start_basis=at_start,
        end_basis=at_end,
        start=start,
        end=State(start.t + num_steps * macro_dt, *jnp.split(last, phase_splits(start))),
        closure=float(np.linalg.norm(last - first) / max(np.linalg.norm(first), np.linalg.norm(last), 1e-300)),
        symplectic_defect=float(np.abs(defect).max() / max(1.0, np.abs(M).max() ** 2)),
    )
