"""Quantities computed from the positions and momenta of a run: velocities, multipliers, reaction forces, work, by
name."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from vmri_jax.mechanics import invariants
from vmri_jax.mechanics.arrays import is_concrete
from vmri_jax.mechanics.checks import check_flags
from vmri_jax.mechanics.kinematics import JOINTS, MASS, Kinematics
from vmri_jax.mechanics.motion import motion, powers, reaction_forces
from vmri_jax.mechanics.names import Names, unknown
from vmri_jax.mechanics.projection import legendre
from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.summary import has_values, summary
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.micro_nodes import Nodes, why_not, with_micro_nodes
from vmri_jax.running.observables import LostEnergyWarning, concerns, observed
from vmri_jax.running.origin import Origin, SavedRun, at_nodes

RANDOM_RATIO = 0.5
"""Von Neumann ratio, mean squared difference of neighbours over variance, above which the values at the nodes count as
random: the nodes do not resolve the function. A larger value trusts the rules of integration on noise."""


class Work(NamedTuple):
    """Work on a system from the start of a run to each of its saved nodes, (k,).

    forces: work of ``force``, the forces without a potential.
    constraints: work of constraints that move with time.
    balance: ``E - E_0 - forces - constraints``: the error of the run plus the error of these integrals.
    uncertainty: error of the integrals: the largest difference between Simpson's and the trapezoidal rule; where the
        power jumps from node to node, the standard deviation of a sum of random numbers of the same scatter.
    """

    forces: np.ndarray
    constraints: np.ndarray
    balance: np.ndarray
    uncertainty: float

    def __repr__(self) -> str:
        if not has_values(self):
            return f"Work({eqx.tree_pformat(self._asdict(), width=1000)})"
        nodes = np.flatnonzero(np.isfinite(self.balance))
        forces, constraints, balance = (float(a[nodes[-1]]) if nodes.size else np.nan for a in self[:3])
        until = "the end" if nodes.size == len(self.balance) else f"node {nodes.size - 1}, after which the run failed"
        return summary(
            f"Work from the start to {until}, and the change of the energy",
            {
                "change of the energy": f"{forces + constraints + balance:.6g}",
                "work of forces": f"{forces:.6g}",
                "work of moving constraints": f"{constraints:.6g}",
                "remainder of the balance": f"{balance:.2g}, the error of the run and of the two works",
                "resolved by the nodes to": f"{float(self.uncertainty):.2g}",
            },
        )


class Quantities:
    """Quantities of a `Trajectory`, by the names of bodies and constraints.

    Velocities, multipliers and work need the system: ``run.of(problem)`` gives it to a run that was read from a file.
    """

    states: State
    energy: Any
    micro: Any
    origin: Origin

    @property
    def names(self) -> Names:
        """Names of bodies, coordinates and constraints, plain ones where none are known."""
        n_s, n_f = self.states.q_s.shape[-1], self.states.q_f.shape[-1]
        names = self.origin.names or Names()
        if self.origin.simulated is None:
            return names.of_coordinates(n_s, n_f)
        return names.of(self.origin.system(np.ndim(self.energy) - 1), n_s, n_f)

    @property
    def keeps_energy(self) -> bool | None:
        """Whether the energy of the system is constant; None if the system is not known."""
        system = self.origin.simulated
        return None if system is None else system.keeps_energy

    @property
    def v_s(self) -> Any:
        """Slow velocities, shaped like q_s."""
        return self.origin.shaped("s", self.velocities[0])

    @property
    def v_f(self) -> Any:
        """Fast velocities, shaped like q_f."""
        return self.origin.shaped("f", self.velocities[1])

    @property
    def velocities(self) -> Any:
        """Vectors (..., k, n_s) and (..., k, n_f) of all velocities."""
        return at_nodes(_velocity, self.origin, self.states)

    def position(self, body: str):
        """Positions (..., k, size) of a body, or of a coordinate that has a name.

        Args:
            body: its name; "q_s" or "q_f" for all coordinates of a system without names.

        Raises:
            ValueError: no body of this name.
        """
        return self._of_body("position", body, body in self.names.carried, (self.states.q_s, self.states.q_f))

    def momentum(self, body: str):
        """Momenta of a body at the saved nodes, (..., k, size); for a rigid body in joint coordinates its own ``M v``,
        without bodies that it carries.

        Args, Raises: as of `position`.
        """
        # The coordinate p of a root includes all bodies that it carries.
        in_joints = self.names.kinematics is not None and body in (*self.names.rigid, *self.names.carried)
        return self._of_body("momentum", body, in_joints, (self.states.p_s, self.states.p_f))

    def velocity(self, body: str):
        """Velocities (..., k, size) of a body, or of a coordinate that has a name.

        Args, Raises: as of `position`; a ValueError, too, if the run does not know its system.
        """
        in_joints = body in self.names.carried
        return self._of_body("velocity", body, in_joints, None if in_joints else self.velocities)

    def _of_body(self, kind: str, body: str, in_joints: bool, values: Any):
        """(..., k, size) of a body: a part of the `values` (slow, fast) of all coordinates, or of `_of_bodies`."""
        if in_joints:
            values = at_nodes(_of_bodies, self.origin, self.states, self.names.kinematics, kind)
        part, start, size = self.names.place_of(body)
        return values[part == "f"][..., start : start + size]

    def multipliers(self, micro: bool = False) -> dict:
        """Lagrange multipliers of the equations of motion at the saved nodes, (..., k, rows) for each constraint by
        name.

        They solve ``M a = -dU/dq + F - G^T lambda`` together with the second time derivative of the constraints,
        ``G a + ... = 0``. For dependent constraints lambda has the least norm.

        Args:
            micro: values at the micro nodes ``t_micro`` instead, (k - 1, num_micro, rows), with velocities from a
                spline through the micro nodes; for runs with ``save=vm.Save(micro=True)``.

        Raises:
            ValueError: the run does not know its system, or did not keep the micro nodes.
        """
        if micro:  # the spline through the nodes is one of SciPy
            self._check_concrete("multipliers")
        values = at_nodes(motion, self.origin, _states(self, micro)).multipliers
        shape = np.shape(self.micro.t if micro else self.states.t)
        return {name: values[..., rows].reshape(*shape, -1) for name, rows in self.names.rows.items()}

    def reaction_forces(self, constraint: str | None = None, micro: bool = False) -> dict:
        """Forces ``-G^T lambda`` of a constraint on the bodies that it touches, (..., k, size) for each of them by
        name.

        Args:
            constraint: its name; "constraint" or "slow_constraint" for all rows of a system without names. None for the
                forces of all constraints, a dictionary of bodies for each constraint by name.
            micro: values at the micro nodes instead, see `multipliers`.

        Raises:
            ValueError: no constraint of this name, or no constraint at all; see also `multipliers`.
        """
        self._check_concrete("reaction_forces")
        names = self.names
        rows = {name: list(rows) for name, rows in names.rows.items() if constraint in (None, name)}
        if not rows:
            hint = " Joints that carry bodies have no rows; scene.by_directors(run) gives the run that has."
            known = "" if constraint is None else unknown("constraint", constraint, names.rows)
            missing = known or "the system has no constraints."
            raise Refused(f"reaction_forces: {missing}{hint if names.carried else ''}")
        states = _states(self, micro)
        chosen = np.zeros((len(rows), sum(map(len, names.rows.values()))), dtype=bool)
        for of_constraint, numbers in zip(chosen, rows.values(), strict=True):
            of_constraint[numbers] = True
        chosen = np.broadcast_to(chosen, (*np.shape(states.t), *chosen.shape))  # at every node
        forces, touched = at_nodes(reaction_forces, self.origin, (states, chosen))
        shape = np.shape(self.micro.t if micro else self.states.t)
        first = {"s": 0, "f": self.states.q_s.shape[-1]}
        by_constraint: dict[str, dict] = {name: {} for name in rows}
        for body, (part, start, size) in names.bodies.items():
            columns = slice(first[part] + start, first[part] + start + size)
            for i, by_body in enumerate(by_constraint.values()):
                if touched[..., i, columns].any():
                    by_body[body] = forces[..., i, columns].reshape(*shape, -1)
        return by_constraint if constraint is None else by_constraint[constraint]

    def work(self) -> Work:
        """Work of forces and of moving constraints since the start, and the balance with the energy.

        The powers ``F . v`` and ``lambda . dg/dt`` are integrated over the saved nodes by Simpson's rule, over micro
        nodes where the run kept all of them.

        Raises:
            ValueError: the run does not know its system, or it is a batch.
        """
        # here: its import takes a fifth of a second
        from scipy.integrate import cumulative_simpson, cumulative_trapezoid

        self._check_concrete("work")
        if np.ndim(self.energy) != 1:
            raise Refused("work: the run is a batch; take one lane of it, run.lane(i).")
        micro = why_not(self.states.t, self.micro) == "" and bool(np.isfinite(self.energy[1]))
        states = _states(self, micro, with_start=True)
        power = at_nodes(powers, self.origin, states)  # (m, 2): F . v and lambda . dg/dt
        t, stride = np.asarray(states.t), self.micro.t.shape[1] if micro else 1
        trapezoidal = cumulative_trapezoid(power, t, axis=0, initial=0.0)
        simpson = cumulative_simpson(power, x=t, axis=0, initial=0.0) if len(t) > 2 else trapezoidal
        difference = np.nanmax(np.abs(simpson - trapezoidal), initial=0.0)
        uncertainty = float(max(difference, *(_deviation_of_integral(t, values) for values in power.T)))
        forces, constraints = simpson[::stride].T
        energy = np.asarray(self.energy)
        return Work(forces, constraints, energy - energy[0] - forces - constraints, uncertainty)

    def concerns(self) -> list[LostEnergyWarning]:
        """What is wrong with the motion: the warnings that `simulate` gives; for a run in a transformation of JAX they
        are asked for afterwards.

        Failures are in the status of the run. Macro steps between saved nodes are not known: they count as one step.

        Raises:
            ValueError: the run does not know its system.
        """
        self._check_concrete("concerns")
        (_, table), t = at_nodes(observed, self.origin, self.states), np.asarray(self.states.t)
        return concerns(table, t, self.origin.system(t.ndim - 1), np.ptp(t, axis=-1) / max(t.shape[-1] - 1, 1), 1)

    def _check_concrete(self, method: str) -> None:
        """Refuse a run whose numbers are tracers of a transformation."""
        if not is_concrete(self.energy):
            raise Refused(
                f"{method}: the run is traced by JAX, inside of jit, grad, vmap or save= of an ensemble. Return the "
                f"run and ask outside, run.of(problem).{method}(...); run.multipliers(), of saved nodes, can be traced."
            )

    def plot(self, title: str = ""):
        """Positions, energy and constraints against time, a matplotlib `Figure` with a title; more in
        `vmri_jax.plots`."""
        from vmri_jax.plots import plot_trajectory  # here: its import takes half a second

        return plot_trajectory(self, title)

    def plot_forces(self, title: str = ""):
        """Reaction forces of all constraints against time, a `Figure` with a title, see
        `vmri_jax.plots.plot_forces`."""
        from vmri_jax.plots import plot_forces

        return plot_forces(self, title)


def _of_bodies(system: System, state: State, kinematics: Kinematics, kind: str):
    """Positions, velocities or momenta (slow, fast) of all bodies of a system in joint coordinates."""
    q = state.q_s, state.q_f
    if kind == "position":
        return kinematics(*q, system.params[JOINTS])
    rates = kinematics.velocities(*q, *_velocity(system, state), system.params[JOINTS])
    if kind == "velocity":
        return rates
    return tuple(system.params[MASS][part] * rate for part, rate in zip(("slow", "fast"), rates, strict=True))


def _states(run: SavedRun, micro: bool, with_start: bool = False) -> State:
    """The states at the saved nodes, or at all micro nodes, with or without the start."""
    check_flags(micro=micro)
    if not micro:
        return run.states
    reason = why_not(run.states.t, run.micro)
    if reason:
        raise Refused(f"micro nodes: they do not fill all intervals of the run: {reason}.")
    nodes = _all_nodes(run)
    p_s, p_f = at_nodes(momenta_at, run.origin, nodes)
    states = State(nodes.t, nodes.q_s, nodes.q_f, p_s, p_f)
    return states if with_start else jax.tree.map(lambda a: a[1:], states)


def _all_nodes(run: SavedRun) -> Nodes:
    """Times, positions and velocities at all nodes, macro and micro, in order; NaN after a failure."""
    nodes = Nodes(*(np.asarray(a) for a in (run.states.t, run.states.q_s, run.states.q_f, *run.velocities)))
    finite = np.isfinite(np.column_stack(nodes)).all(axis=1)
    count = len(nodes.t) if np.all(finite) else int(np.argmin(finite))
    if count < 2:
        raise Refused("micro nodes: the run failed in its first step; there are none.")
    macro_nodes = Nodes(*(a[:count] for a in nodes))  # splines take finite values only
    all_nodes = with_micro_nodes(macro_nodes, run.micro.t[: count - 1], run.micro.q_f[: count - 1])
    missing = (len(nodes.t) - count) * run.micro.t.shape[1]
    return Nodes(*(np.pad(a, [(0, missing)] + [(0, 0)] * (a.ndim - 1), constant_values=np.nan) for a in all_nodes))


def _deviation_of_integral(t: np.ndarray, power: np.ndarray) -> float:
    """Standard deviation of the integral of a power whose values at the nodes look random; zero for a smooth power.

    The von Neumann ratio ``sum (P_{k+1} - P_k)^2 / sum (P_k - mean P)^2`` is 2 for random values and about zero for a
    smooth function.
    """
    power = power[np.isfinite(power)]
    jumps, scatter = np.sum(np.diff(power) ** 2), np.sum((power - np.mean(power)) ** 2)
    if jumps <= RANDOM_RATIO * scatter:
        return 0.0
    # The integral H sum_k P_k of n independent values of variance scatter / n has the variance H^2 scatter.
    return float(np.mean(np.diff(t)) * np.sqrt(scatter))


def _velocity(system: System, state: State):
    return invariants.velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)


def momenta_at(system: System, node: Nodes):
    """Momenta (p_s, p_f) of positions and velocities at a node."""
    return legendre(system, node.q_s, node.q_f, node.v_s, node.v_f)
