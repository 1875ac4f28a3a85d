"""Observables of a run at its saved nodes, and the one place that looks at them: failures, and warnings about the
motion.

An observable is a function of the system and the state, evaluated after the steps, in the same program. All roads look
at the same `Observables`: `Saved.marked` ends a run that has left its constraints or its domain, `concerns` says what
is wrong with the motion of a run whose steps all succeeded.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers, library
from vmri_jax.mechanics.constraints import are_kept
from vmri_jax.mechanics.invariants import energy_parts
from vmri_jax.mechanics.projection import project_momentum
from vmri_jax.mechanics.slopes import slopes_at, weights_of
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.steppers.results import Result


class LostEnergyWarning(UserWarning):
    """The energy of a system that keeps it has changed by more than half of the largest kinetic energy of a run, or the
    energy of a system that forces or drives move by `GROWN` times its size at the start."""

    sentence = (
        "the computed motion is wrong: the energy{which} has changed by {change:.3g} at t = {t:.4g}, "
        "and the largest kinetic energy is {kinetic:.3g}. Take smaller steps, where slow forces are kicks below half "
        "a period of the fastest vibration; vmri_jax.stability.advise(problem, scheme, macro_dt=...) says which are "
        "stable for small motions."
    )


class SingularCoordinatesWarning(LostEnergyWarning):
    """A run has changed its energy where its coordinates are nearly singular, as angles near a pole are."""

    sentence = (
        "the coordinates are singular near t = {t:.4g}: the mass matrix changes by a factor from one saved node to the "
        "next, and the energy by {change:.3g}, with a largest kinetic energy of {kinetic:.3g}. Take other "
        "coordinates, or accuracy=."
    )


REPORTED_CHANGE = 0.5
"""Change of the energy, as a part of the largest kinetic energy, above which the user is warned; a larger value misses
slower instabilities."""
GROWN = 1e6
"""Change of the energy of a system that forces or drives move, as a part of the terms of the energy at the start, or
of the kinetic energy of velocities ``q / H`` there if that is larger, above which the user is warned. A larger value
misses short explosions; a smaller one warns of motion that forces begin from rest."""
ROUNDOFF_OF_ENERGY = 1e-9
"""Change of the energy, as a part of the sum of the moduli of its terms, up to which it is round-off. A larger value
hides losses in systems whose terms cancel."""
ROUNDOFF_OF_STEP = 10 * np.finfo(float).eps
"""Round-off of a position in a step, as a part of the position; a larger value hides slower motions."""
UNRESOLVED = 2.0
"""Change of log det M from one saved node to the next, above which the steps do not resolve the mass matrix M. Steps
across a pole, where det M goes to zero with the square of the distance, change it by 2 log 3 = 2.2 or more. A larger
value misses poles between two nodes."""
CHANGE_AT_POLE = 1e-2
"""Change of the energy between two saved nodes next to a pole, as a part of the largest kinetic energy, above which the
user is warned. A larger value misses runs whose angles are wrong after the pole."""


class Observables(NamedTuple):
    """Numbers of a system and a state.

    energy: Hamiltonian.
    position, velocity: largest |g| and largest |G v + dg/dt|, implied rows included.
    solved, implied: 1 where the rows that are solved for, and the implied rows, are kept, see `are_kept`; else 0.
    kinetic: ``v . M v / 2``: T may have terms of lower degree in v, as in a frame that turns, and ``p . v - T`` is then
        no size.
    terms: ``|T| + |V| + |W| + sum_i |V_i|``, and the kinetic energy of the momenta that constraints take from a step.
    rounding: ``q . M q / 2``, whose part eps^2 / H^2 is the kinetic energy of velocities that come from round-off of
        the positions.
    volume: log det M of a mass matrix M that depends on positions; 0 for constant masses.
    """

    energy: Float[Numbers, "*k"]
    position: Float[Numbers, "*k"]
    velocity: Float[Numbers, "*k"]
    solved: Float[Numbers, "*k"]
    implied: Float[Numbers, "*k"]
    kinetic: Float[Numbers, "*k"]
    terms: Float[Numbers, "*k"]
    rounding: Float[Numbers, "*k"]
    volume: Float[Numbers, "*k"]

    @classmethod
    def of(cls, table) -> "Observables":
        """The columns of a table (..., k, 9)."""
        return cls(*(table[..., i] for i in range(len(cls._fields))))

    def so_far(self) -> np.ndarray:
        """(1, 9) the energy of the first node of a run, and the largest of all other columns: a node in place of all
        nodes."""
        return np.array([[self.energy[0], *(column.max() for column in self[1:-1]), self.volume[-1]]])


def observed(system: System, state: State, macro_dt: Any = 0.0, tolerance: Any = 0.0) -> tuple[State, Any]:
    """A state as it is saved, with momenta projected onto the hidden constraints, ``G v + dg/dt = 0``, and its
    `Observables` as an array (9,).

    A step depends on the momentum through ``h p - G_0^T mu`` alone. A projection ``p - G_0^T nu`` at its start changes
    mu, and not the motion: only momenta that are saved are projected. `macro_dt` is H of the step that ends in the
    state, `tolerance` of its solver; both are zero of a saved state.
    """
    slopes = slopes_at(system, state.t, state.q_s, state.q_f)
    solved = sum(system.num_constraints(state.q_s, state.q_f))
    constraints = slopes.jacobian[:solved], slopes.rates[:solved]
    p_s, p_f, *velocities, masses = project_momentum(system, state, constraints=constraints)
    phase, v = (state.q_s, state.q_f, p_s, p_f), jnp.concatenate(velocities)
    parts = list(energy_parts(system, *phase, velocities, masses).values())
    if masses is None:
        kinetic, volume, diagonal = parts[0], 0.0, jnp.concatenate(system.kinetic.diagonal)
        rounding = system.kinetic_energy(state.q_s, state.q_f, state.q_s, state.q_f)
    else:
        q, diagonal = jnp.concatenate([state.q_s, state.q_f]), jnp.diagonal(masses)
        kinetic, rounding = v @ masses @ v / 2, q @ masses @ q / 2
        volume = 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(masses))))
    weights = weights_of(diagonal)
    # M^-1/2 G^T nu: times H the displacement that constraints take from a step, with its weights
    taken = (jnp.concatenate([state.p_s, state.p_f]) - jnp.concatenate([p_s, p_f])) / weights
    kept = are_kept(slopes.scaled(weights, macro_dt * taken), solved, tolerance)
    terms = sum(map(jnp.abs, parts)) + taken @ taken / 2
    values = sum(parts), *slopes.residual(v), *kept, kinetic, terms, rounding, volume
    return State(state.t, *phase), jnp.stack([jnp.asarray(value, dtype=float) for value in values])


def is_right(now: Observables) -> Any:
    """Whether nodes may be right.

    A node may be wrong although its steps succeeded, for four reasons: the energy is not finite although its gradient
    is (a logarithm beyond its pole); a lane of a batch started off its constraints; the rows of ``system.implied``,
    redundant constraints that the solver leaves out, are violated; or a stepper of the user leaves the constraints.
    """
    return library(now.energy).isfinite(now.energy) & (now.solved > 0) & (now.implied > 0)


def fault(now: Observables) -> Any:
    """The `Result` of nodes that are not right; if the solved rows are kept, the implied rows are to blame."""
    module = library(now.energy)
    violated = module.where(now.solved > 0, int(Result.NOT_IMPLIED), int(Result.CONSTRAINT_VIOLATED))
    return module.where(module.isfinite(now.energy), violated, int(Result.NON_FINITE))


def concerns(table: np.ndarray, t, system: System, macro_dt, save_every: int) -> list[LostEnergyWarning]:
    """What is wrong with the motion of a run, or of the lanes of a batch, whose steps all succeeded: warnings to be
    given; failed lanes are left out.

    *Lost energy*: the system keeps its energy, and the energy has changed by more than half of the largest kinetic
    energy. A system at rest moves by round-off: n steps H change velocities by up to
    ``sqrt(n) ROUNDOFF_OF_STEP |q| / H``, in random directions; changes below the kinetic energy of these velocities, or
    below the round-off of the energy's terms, do not count. Where forces or drives change the energy, only a change by
    `GROWN` of the energy of the start tells; systems that start without energy at the origin are not judged.

    *Singular coordinates*: the mass matrix changes by a factor between two nodes, and the energy changes beside them.
    Forces change the energy, too: where they do, only steps that are all saved tell.

    `table` has the `Observables` (..., k, 9) at the times t (..., k); of the system only the structure counts.
    """
    energy, kinetic, terms = (table[..., Observables._fields.index(name)] for name in ("energy", "kinetic", "terms"))
    keeps, sees_poles = system.keeps_energy, not system.has_constant_mass and save_every == 1
    least = (
        min(CHANGE_AT_POLE, REPORTED_CHANGE) * kinetic.max(axis=-1) if keeps or sees_poles else GROWN * terms[..., 0]
    )
    if not np.any(np.ptp(energy, axis=-1) > least):
        return []  # the usual case, within microseconds
    t, nodes = np.atleast_2d(t), Observables.of(table.reshape(-1, *table.shape[-2:]))
    kinetic, change = nodes.kinetic.max(axis=1), np.abs(nodes.energy - nodes.energy[:, :1])
    of_a_step = (ROUNDOFF_OF_STEP / np.asarray(macro_dt)) ** 2 * nodes.rounding.max(axis=1)
    roundoff_of_steps = (t.shape[1] - 1) * save_every * of_a_step
    roundoff = np.maximum(ROUNDOFF_OF_ENERGY * nodes.terms.max(axis=1), roundoff_of_steps)
    jumps = np.pad(np.abs(np.diff(nodes.volume)) > UNRESOLVED, ((0, 0), (1, 1)))
    beside = jumps[:, 1:-1] | jumps[:, :-2] | jumps[:, 2:]
    change_at_pole = np.where(beside, np.abs(np.diff(nodes.energy)), 0.0)
    is_singular = change_at_pole.max(axis=1) > np.maximum(CHANGE_AT_POLE * kinetic, roundoff)
    is_singular &= keeps or save_every == 1
    of_start = np.maximum(nodes.terms[:, 0], nodes.rounding[:, 0] / np.asarray(macro_dt) ** 2)
    largest = REPORTED_CHANGE * kinetic if keeps else GROWN * np.where(of_start > 0, of_start, np.inf)
    is_lost = ~is_singular & (change.max(axis=1) > np.maximum(largest, roundoff))
    warnings_of_lanes: list[LostEnergyWarning] = []
    for warning, wrong, sizes in (
        (SingularCoordinatesWarning, is_singular, change_at_pole),
        (LostEnergyWarning, is_lost, change),
    ):
        if wrong.any():
            lane = int(wrong.argmax())
            node = sizes[lane].argmax()
            lanes = f"in {wrong.sum()} of {len(wrong)} lanes, the first of them lane {lane}, " if table.ndim > 2 else ""
            which = ", which the system keeps," if keeps else f", {of_start[lane]:.3g} or less at the start,"
            numbers = {"which": which, "t": t[lane, node], "change": sizes[lane, node], "kinetic": kinetic[lane]}
            warnings_of_lanes.append(warning(lanes + warning.sentence.format(**numbers)))
    return warnings_of_lanes
