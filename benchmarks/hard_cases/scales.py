"""Cases 23 to 25: three time scales, no coupling, and the known methods that schemes reduce to."""

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax import diagnostics, systems
from vmri_jax.hard.case import Case, Outcome
from vmri_jax.hard.measures import difference, nodes, run, status
from vmri_jax.hard.systems import three_scales
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.system import ConstantMass
from vmri_jax.schemes.scheme import Scheme, explicit_slow, fully_explicit, fully_implicit


def three_time_scales(full: bool) -> Outcome:
    """One frequency far above what the micro steps resolve; the actions of the others against a resolved run."""
    problem, omega = three_scales(), np.array([50.0, 70.0, 5000.0])
    coarse = run(problem, fully_implicit(5), 0.1, 500)  # omega_3 h = 100
    fine = run(problem, fully_explicit(100), 0.01, 5000, save_every=10)  # omega_3 h = 0.5
    actions = [np.asarray(diagnostics.oscillatory_energies(omega, r.q_f, r.p_f)) for r in (coarse, fine)]
    at_end = np.abs(actions[0][-1] - actions[1][-1])
    third = actions[0][:, 2].max()
    return Outcome(
        f"omega_3 h = 100: {status(coarse)}; at t = 50 I_1, I_2 within {at_end[0]:.3f}, {at_end[1]:.3f} of the resolved run, "
        f"I_3 stays below {third:.0e}",
        coarse.success and at_end[:2].max() < 0.05 and third < 0.05,
        {"I_1": at_end[0], "I_2": at_end[1], "I_3": third},
        {"t": coarse.t, "coarse": actions[0], "fine": actions[1]},
    )


def slow_alone(q_s, q_f, params):
    """``V = sum_i s_i^4 / 4 + cos s_i``, without coupling."""
    return jnp.sum(q_s**4) / 4 + jnp.sum(jnp.cos(q_s))


def no_coupling(full: bool) -> Outcome:
    """A slow potential of slow variables alone: the slow motion must not depend on num_micro."""
    problem = systems.fermi_pasta_ulam()
    system = problem.system.replace(slow_potential=slow_alone)
    problem = Problem(system, problem.q_s, problem.q_f, problem.v_s, problem.v_f)
    steps, values = 10_000 if full else 1_000, {}
    for make in (explicit_slow, fully_explicit):
        runs = [run(problem, make(n), 0.03, steps, save_every=steps) for n in (1, 10)]
        values[make.__name__] = max(difference(runs[1].q_s, runs[0].q_s), difference(runs[1].p_s, runs[0].p_s))
    words = ", ".join(f"{name} {value:.0e}" for name, value in values.items())
    return Outcome(f"num_micro 10 against 1, {steps} steps: {words}", max(values.values()) < 1e-13, values)


# --- known methods, written out in numpy -----------------------------------------------------------------------------
class Flat:
    """A problem with slow and fast variables joined: force, its derivative, constraints and their Jacobian."""

    def __init__(self, problem: Problem):
        system, n_s, state = problem.system, problem.q_s.size, problem.state()
        zeros = jnp.zeros_like(state.p_s), jnp.zeros_like(state.p_f)

        def potential(q):
            return diagnostics.energy(system, q[:n_s], q[n_s:], *zeros)

        def rows(q):
            return system.constraints(state.t, q[:n_s], q[n_s:])

        kinetic = system.kinetic
        assert isinstance(kinetic, ConstantMass)
        self.mass = np.concatenate([kinetic.slow, kinetic.fast])
        self.q = np.concatenate([state.q_s, state.q_f])
        self.p = np.concatenate([state.p_s, state.p_f])
        self._force, self._slope = jax.jit(jax.grad(potential)), jax.jit(jax.hessian(potential))
        self._rows, self._jacobian = jax.jit(rows), jax.jit(jax.jacrev(rows))

    def force(self, q):
        return -np.asarray(self._force(q))

    def slope(self, q):
        return -np.asarray(self._slope(q))

    def rows(self, q):
        return np.asarray(self._rows(q))

    def jacobian(self, q):
        return np.asarray(self._jacobian(q))


def midpoint_integrator(flat: Flat, h: float, q, p):
    """``p = M (q+ - q)/h - h/2 F(qm)``, ``p+ = M (q+ - q)/h + h/2 F(qm)``, qm the midpoint."""
    new = q + h * p / flat.mass
    for _ in range(8):
        middle = (q + new) / 2
        residual = flat.mass * (new - q) / h - h / 2 * flat.force(middle) - p
        new = new - np.linalg.solve(np.diag(flat.mass) / h - h / 4 * flat.slope(middle), residual)
    return new, flat.mass * (new - q) / h + h / 2 * flat.force((q + new) / 2)


def rattle(flat: Flat, h: float, q, p):
    """Verlet's step with ``g(q+) = 0`` and ``G M^-1 p+ = 0`` (Andersen 1983); Verlet itself without constraints."""
    free, jacobian = p + h / 2 * flat.force(q), flat.jacobian(q)
    multiplier = np.zeros(len(jacobian))
    for _ in range(12):
        new = q + h / flat.mass * (free - h / 2 * jacobian.T @ multiplier)
        slope = -(h**2) / 2 * flat.jacobian(new) / flat.mass @ jacobian.T
        multiplier = multiplier - np.linalg.solve(slope, flat.rows(new))
    p, jacobian = free - h / 2 * jacobian.T @ multiplier + h / 2 * flat.force(new), flat.jacobian(new)
    return new, p - jacobian.T @ np.linalg.solve(jacobian / flat.mass @ jacobian.T, jacobian @ (p / flat.mass))


def apart_from(method, problem: Problem, scheme: Scheme, h: float, steps: int) -> float:
    """Largest difference of a run from a known method, relative to the positions and momenta."""
    flat, trajectory = Flat(problem), run(problem, scheme, h, steps)
    q, p, found, momenta = flat.q, flat.p, nodes(trajectory), np.concatenate([trajectory.p_s, trajectory.p_f], axis=1)
    worst = 0.0
    for k in range(1, steps + 1):
        q, p = method(flat, h, q, p)
        worst = max(worst, difference(found[k], q) / abs(q).max(), difference(momenta[k], p) / abs(p).max())
    return worst


def reductions(full: bool) -> Outcome:
    """One micro step per macro step gives known integrators."""
    chain, pendulum = systems.fermi_pasta_ulam(), systems.triple_spherical_pendulum()
    steps = 200 if full else 25
    values = {
        "midpoint": apart_from(midpoint_integrator, chain, fully_implicit(1), 0.02, steps),
        "Verlet": apart_from(rattle, chain, fully_explicit(1), 0.02, steps),
        "RATTLE": apart_from(rattle, pendulum, fully_explicit(1), 0.005, steps),
    }
    words = ", ".join(f"{name} {value:.0e}" for name, value in values.items())
    return Outcome(f"from the known method after {steps} steps: {words}", max(values.values()) < 1e-12, values)


SCALES = (
    Case(
        23,
        "three scales",
        "FPU chain with omega = 50, 70, 5000, fully_implicit, h = 0.02, t = 50",
        "stable at omega_3 h = 100; I_1, I_2 within 0.05 of a resolved run",
        three_time_scales,
    ),
    Case(
        24,
        "zero coupling",
        "FPU chain with V = V(q_s)",
        "slow motion independent of num_micro to 1e-13",
        no_coupling,
    ),
    Case(
        25,
        "reductions",
        "num_micro = 1",
        "midpoint variational integrator, Verlet, RATTLE to 1e-12",
        reductions,
    ),
)
