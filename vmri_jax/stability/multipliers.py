"""Multipliers of a macro step, eigenvalues of its derivative, and their Krein signatures; the derivative of a run.

The multipliers of a symplectic map come in pairs (a, 1/a). They stay on the unit circle, and the motion stays bounded,
until two multipliers of opposite Krein signature meet; multipliers of equal signature pass through each other (Krein,
Gelfand and Lidskii; Arnold, *Mathematical Methods of Classical Mechanics*, 42). Therefore the sequence of the
signatures, in the order of the angles, changes only across such a meeting, however narrow the unstable window is.
"""

from dataclasses import dataclass
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.diagnostics.linear import phase_step, phase_vector, state_of, with_slopes
from vmri_jax.mechanics.arrays import quickly_compiled, whole_number
from vmri_jax.mechanics.invariants import all_constraints
from vmri_jax.mechanics.linearisation import Linearisation, tangents
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import check_step_size
from vmri_jax.schemes.composition import SchemeLike, stage_lengths, stage_scheme
from vmri_jax.steppers.results import Result
from vmri_jax.steppers.solver import Solver

TOLERANCE = 1e-6
"""Growth per step that counts as instability. Round-off alone splits two equal multipliers by its square root, up to
2e-8; a larger value overlooks slow growth."""
LANES = 64
"""Step sizes that a compiled call computes side by side for up to 18 degrees of freedom; larger systems get fewer, at
least 4, to limit memory. With more a call for a single step size takes longer."""
PASSES_AT_REST = 5
"""Exact passes of the step at rest, whose equations are linear: two bring the multipliers to round-off. More take
longer where round-off goes on."""
FREE_MOTION_ANGLE = 1e-5
"""Angle, rad, up to which a multiplier is of a free motion, which has no signature; a larger one drops slow ones."""


@dataclass(frozen=True)
class Multipliers:
    """Multipliers of small motions at k step sizes.

    values: (k, 2 d) eigenvalues of the derivative of the step; NaN where the step itself failed.
    vectors: (k, 2 d, 2 d) eigenvectors in the coordinates (eta, pi) of the `Linearisation`, one per column.
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

    @property
    def krein_signatures(self) -> list[bytes | None]:
        """Krein signatures along the upper half circle, by angle, for each of the k steps; None for an unstable step.

        The signature of the eigenvector (eta, pi) is the sign of ``Im(conj(eta) . pi)``.
        """
        d = self.values.shape[1] // 2
        signatures: list[bytes | None] = []
        for values, x, radius in zip(self.values, self.vectors, self.radius, strict=True):
            if radius > 1 + TOLERANCE:
                signatures.append(None)
                continue
            signs = np.sign(np.imag(np.sum(np.conj(x[:d]) * x[d:], axis=0)))
            angles = np.angle(values)
            upper = np.flatnonzero((angles > FREE_MOTION_ANGLE) & (np.abs(np.abs(values) - 1) <= TOLERANCE))
            signatures.append(np.take(signs, upper[np.argsort(angles[upper])]).tobytes())
        return signatures


def multipliers(linear: Linearisation, scheme: SchemeLike, macro_dt) -> Multipliers:
    """Multipliers of a macro step for k lengths of the step.

    The derivative of the step is exact: of `macro_step` of the expansion at rest, on the tangent space of the
    constraint manifold. The derivative of a composition is the product of the derivatives of its stages, which one
    program of the stage computes.

    Args:
        linear: of `linearise`.
        scheme: any scheme or composition.
        macro_dt: (k,) macro steps.

    Raises:
        ValueError: constraints that leave no motion.
    """
    macro_dt, size = np.asarray(macro_dt, dtype=float), 2 * linear.shapes.shape[1]
    if not size:
        raise Refused(f"multipliers: the constraints leave none of the {len(linear.shapes)} coordinates free.")
    lanes = int(np.clip(LANES * 36 // size, 4, LANES))
    # symmetric compositions have equal stages
    lengths, stages = np.unique(np.outer(stage_lengths(scheme), macro_dt), return_inverse=True)
    padded = np.pad(lengths, (0, -lengths.size % lanes), mode="edge").reshape(-1, lanes)
    fixed = linear.system, stage_scheme(scheme), linear.rest, linear.embed, linear.read
    factors = np.concatenate([_step_matrices(*fixed, part) for part in padded])
    matrices = reduce(lambda a, b: b @ a, factors[stages.reshape(-1, macro_dt.size)])
    failed = ~np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    values, vectors = np.linalg.eig(np.where(failed[:, None, None], np.eye(size), matrices))
    values = np.where(failed[:, None], np.nan, values.astype(complex))
    # The multiplier nearest to exp(s H) belongs to the growing motion of rate s.
    growing = np.zeros(values.shape, dtype=bool)
    for rate in linear.growing:
        distance = np.where(growing, np.inf, np.abs(values - np.exp(rate * macro_dt)[:, None]))
        growing[np.arange(len(growing)), np.argmin(distance, axis=1)] = True
    return Multipliers(values, vectors.astype(complex), growing)


@quickly_compiled
def _step_matrices(system: System, scheme, rest: State, embed, read, macro_dt):
    """(k, 2 d, 2 d) derivatives of the macro step at rest, for k lengths of the step."""

    def matrix(macro_dt):
        # The status does not count: corrections of a step at rest are round-off, and are compared with no motion. With
        # all iterations spent on the whole step no part of it is taken for the step.
        solver = Solver("exact", max_iterations=PASSES_AT_REST)
        step = partial(phase_step, system, scheme, rest, rest.t, macro_dt=macro_dt, solver=solver)
        return read @ with_slopes(step, phase_vector(rest), embed.T)[2].T

    return jax.vmap(matrix)(macro_dt)


@dataclass(frozen=True)
class Monodromy:
    """Derivative of the end of a trajectory by its start, between the tangent spaces of the constraint manifold.

    start, end: states.
    tangents: (k, 2 n) orthonormal tangent vectors (q_s, q_f, p_s, p_f) at the start, one per row; k = 2 (n_s + n_f -
        n_g - n_gs).
    images: (k, 2 n) tangent vectors at the end that they become.
    """

    start: State
    end: State
    tangents: np.ndarray
    images: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        """M, (k, k) derivative in the coordinates of `tangents`.

        It has a meaning only where both ends share a tangent space: with a small `closure`.
        """
        return self.tangents @ self.images.T

    @property
    def multipliers(self) -> np.ndarray:
        """(k,) Floquet multipliers, the eigenvalues of M, the largest first."""
        values = np.linalg.eigvals(self.matrix)
        return values[np.argsort(-np.abs(values), kind="stable")]

    @property
    def stretch(self) -> np.ndarray:
        """(k,) singular values of the derivative, the largest first: the growth of disturbances of the start, for
        closed and open trajectories."""
        return np.linalg.svd(self.images, compute_uv=False)

    @property
    def closure(self) -> float:
        """Distance of the end from the start, relative to the larger norm of the two."""
        first, last = (np.asarray(phase_vector(state)) for state in (self.start, self.end))
        return float(np.linalg.norm(last - first) / max(np.linalg.norm(first), np.linalg.norm(last), 1e-300))

    @property
    def symplectic_defect(self) -> float:
        """Largest entry of ``X^T J X - T^T J T``, with ``J = [[0, 1], [-1, 0]]``, tangents T and images X, relative to
        the larger of 1 and the largest ``|X_ij|^2``: round-off of symplectic steps."""
        J = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(self.images.shape[1] // 2))
        before, after = (rows @ J @ rows.T for rows in (self.tangents, self.images))
        return float(np.abs(after - before).max(initial=0.0) / max(1.0, np.abs(self.images).max(initial=0.0) ** 2))


def monodromy(
    system: Movable,
    scheme: SchemeLike,
    state: State | None = None,
    *,
    macro_dt,
    num_steps: int,
    solver: Solver | None = None,
) -> Monodromy:
    """Product of the step's derivatives along a trajectory, ``DPhi(z_(N-1)) ... DPhi(z_0)``, on the tangent spaces.

    Args:
        system, scheme, macro_dt, solver: as in `macro_step`.
        state: consistent start; None for the start of the problem or scene.
        num_steps: macro steps; one period of a periodic orbit gives its Floquet multipliers, one step its symplectic
            defect.

    Raises:
        ValueError: num_steps below 1, a macro step that is not positive.
        RuntimeError: a step failed; with its number and reason.
    """
    system, state = start_of("monodromy", system, state)
    whole_number("monodromy: num_steps", num_steps)
    check_step_size(macro_dt, "monodromy")
    start = State(*(jnp.asarray(a, dtype=float) for a in (state.t, state.q_s, state.q_f, state.p_s, state.p_f)))
    directions = tangents(np.asarray(_constraint_rows(system, start))).T
    z, images, steps, result = _followed(system, scheme, start, macro_dt, solver, num_steps, directions)
    if result > Result.CONVERGED_AT_ROUNDOFF:
        raise RuntimeError(f"monodromy: macro step {steps - 1} failed: {Result(int(result)).message}")
    return Monodromy(start, state_of(z, start.t + num_steps * macro_dt, start), directions, np.asarray(images))


@quickly_compiled
def _constraint_rows(system: System, state: State):
    """Derivatives (2 n_g + 2 n_gs, 2 n) of the constraints and the hidden constraints by z."""
    rows = jax.jacfwd(lambda z: jnp.concatenate(all_constraints(system, state_of(z, state.t, state))))
    return rows(phase_vector(state))


@quickly_compiled
def _followed(system: System, scheme: SchemeLike, start: State, macro_dt, solver, num_steps, directions):
    """The end z_N (2 n,), the images (k, 2 n) of directions at the start, the number of steps that were taken, and the
    result of the last one: a step that fails is the last."""

    def advance(carry):
        z, images, k, _ = carry
        step = partial(phase_step, system, scheme, start, start.t + k * macro_dt, macro_dt=macro_dt, solver=solver)
        z, status, images = with_slopes(step, z, images)
        return z, images, k + 1, jnp.asarray(status.result, int)

    def goes_on(carry):
        *_, k, result = carry
        return (k < num_steps) & (result <= Result.CONVERGED_AT_ROUNDOFF)

    zero = jnp.zeros((), int)
    return jax.lax.while_loop(goes_on, advance, (phase_vector(start), jnp.asarray(directions), zero, zero))
