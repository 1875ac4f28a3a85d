"""Linear models: two coupled oscillators, and the small motions of any system about a configuration.

A step is linearly stable if all powers of its derivative stay bounded. At an equilibrium the derivative of the step is exactly the step of the second-order
expansion of the system; elsewhere the expansion describes the *frozen* problem: constant forces hold the configuration at rest.
In both cases the expansion is a `System`, to which every scheme applies unchanged.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import null_space

from vmri_jax.diagnostics.linear import frequencies_of, phase_splits
from vmri_jax.mechanics.arrays import QUICK
from vmri_jax.mechanics.driving import driven
from vmri_jax.mechanics.invariants import potential_energy, velocity
from vmri_jax.mechanics.masses import correlation
from vmri_jax.mechanics.state import Movable, Problem, State, start_of
from vmri_jax.mechanics.system import ConstantMass, System

LEAST_GROWTH = 1e-6
"""Growth rate up to which a motion does not grow, as a part of the largest rate: round-off of the eigenvalues. A larger value takes slowly
growing motions for instabilities of the step."""
LEAST_MOTION = 1e-8
"""Velocity v and acceleration a up to which a state is an equilibrium, in units of omega |q| and omega^2 |q|, with the largest rate omega and norms
of the kinetic energy: round-off, and residuals of solved equilibria. A larger value takes slow motions for equilibria."""


def soft_spring(q_s, q_f, params):
    """``V = kappa / 2 |q_s - q_f|^2``."""
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2)


def stiff_spring(q_f, params):
    """``W = omega^2 / 2 |q_f|^2``."""
    return params["omega"] ** 2 / 2 * jnp.sum(q_f**2)


def linear_model(omega=50.0, kappa=25.0) -> Problem:
    """One slow and one fast variable of unit mass, ``V = kappa/2 (q_s - q_f)^2`` and ``W = omega^2/2 q_f^2``.

    Starts at ``q_s = 1, q_f = 1 / omega`` with unit velocity of the fast variable.

    Args:
        omega: frequency of the fast variable alone.
        kappa: stiffness of the spring between the two.
    """
    system = System(
        ConstantMass([1.0], [1.0]),
        soft_spring,
        stiff_spring,
        params={"omega": jnp.asarray(omega, dtype=float), "kappa": jnp.asarray(kappa, dtype=float)},
    )
    one = jnp.ones(1)
    return Problem(system, one, one / omega, 0 * one, one)


@dataclass(frozen=True)
class SmallMotions:
    """Small motions about a configuration, in d canonical coordinates (eta, pi) of the constraint manifold.

    Displacements are ``N eta`` with ``N^T M N = 1`` and ``G N = 0``.

    system: the expansion to second order; its equilibrium is zero, its `params` are the coefficients.
    shapes: N, (n_s + n_f, d).
    embed, read: matrices (2 n, 2 d) from (eta, pi) to (q_s, q_f, p_s, p_f), and (2 d, 2 n) back.
    hessians: (d, d) Hessians of the potentials: of V with its share of the constraint forces ("slow"), of W ("fast"), of each further
        potential ("potential " and its name), and minus the derivative of F in eta ("force").
    stiffness: (d, d) minus the derivative of all forces in eta: of potentials, constraints, the kinetic energy, and F.
    damping: (d, d) matrix of the velocities, gyroscopic and dissipative.
    slow_force: (d,) force of V at the state, which is constant in the expansion.
    rest: the state of zero displacement and momentum of the expansion.
    driven: names of the terms that depend on time.
    moves: whether the state is no equilibrium.
    """

    system: System
    shapes: np.ndarray
    embed: np.ndarray
    read: np.ndarray
    hessians: dict[str, np.ndarray]
    stiffness: np.ndarray
    damping: np.ndarray
    slow_force: np.ndarray
    rest: State
    driven: tuple[str, ...] = ()
    moves: bool = False

    @cached_property
    def rates(self) -> np.ndarray:
        """(2 d,) rates s of the motions ``exp(s t)``: imaginary for vibrations."""
        # eta' = v, v' = -K eta - D v
        zero, identity = np.zeros_like(self.stiffness), np.eye(len(self.stiffness))
        return np.linalg.eigvals(np.block([[zero, identity], [-self.stiffness, -self.damping]]))

    @property
    def growing(self) -> np.ndarray:
        """The rates of motions of the expansion that grow, whatever the scheme."""
        return self.rates[np.real(self.rates) > LEAST_GROWTH * np.abs(self.rates).max(initial=0.0)]

    @property
    def frozen(self) -> str:
        """Why the expansion does not tell whether the motion is stable, in sentences; empty at an equilibrium."""
        if self.driven:
            terms = f"{' and the '.join(self.driven)} depend{'s' if len(self.driven) == 1 else ''}".replace("_", " ")
            return (
                f"The {terms} on time: the motion is linearised at t = {float(self.rest.t):.4g} alone, as if time stood still there. Whether "
                "it is stable, a run over many periods of the drive decides."
            )
        if self.moves:
            return (
                "The state is no equilibrium: the motion is linearised there as if constant forces held it at rest. Whether it is stable, its "
                "multipliers over a period decide, vm.stability.monodromy(..., num_steps=...), or a long run."
            )
        return ""

    def frequencies(self, name: str) -> np.ndarray:
        """(d,) frequencies of a single potential, a key of `hessians`, the largest first; zero where it is not convex."""
        return frequencies_of(self.hessians[name])

    @cached_property
    def modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies (d,) of all potentials together, the largest first, and mode shapes (d, d), one per column."""
        values, vectors = np.linalg.eigh((self.stiffness + self.stiffness.T) / 2)
        return np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1]

    @property
    def kinetic_shares(self) -> np.ndarray:
        """(n_s + n_f, d) share ``u_i (M u)_i`` of coordinate i in the kinetic energy of each mode u, with ``u^T M u = 1``."""
        n, d = self.shapes.shape
        _, modes = self.modes
        return (self.shapes @ modes) * (self.embed[n:, d:] @ modes)  # `embed` has M N in its block of momenta

    @property
    def omega(self) -> float:
        """The largest frequency of W alone; if W has none, the largest rate of all motions."""
        fast = self.frequencies("fast").max(initial=0.0)
        return float(fast if fast > 0 else np.abs(self.rates).max(initial=0.0))

    def only(self, name: str) -> "SmallMotions":
        """The small motions under one potential or the force alone, a key of `hessians`."""
        removed = {key: hessian for key, hessian in self.hessians.items() if key != name}
        zeros = {key: jax.tree.map(np.zeros_like, self.system.params[key]) for key in removed}
        return replace(
            self,
            system=self.system.replace(params=self.system.params | zeros),
            stiffness=self.stiffness - sum(removed.values()),
            hessians=self.hessians | {key: np.zeros_like(hessian) for key, hessian in removed.items()},
        )


def small_motions(system: Movable, state: State | None = None) -> SmallMotions:
    """Second-order expansion of a system about the configuration of a state, held at rest there.

    Every term is expanded separately, ``V(q + d) ~ d^T V'' d / 2`` and so on, and keeps its quadrature rule in the scheme. Constraints
    become ``G d + d^T g'' d / 2``. Their multipliers ``lambda`` are taken from the moving state, so that a swinging rod is under tension,
    and act through ``lambda . g''``. A linear term in the expanded V balances the constraint forces due to dV/dq, on the grid of V; a
    constant force on the micro grid balances all other constraint forces. At an equilibrium this reproduces the original terms. The
    kinetic energy is expanded at rest, forces at the velocity of the state.

    Args:
        system: a system, problem or scene whose potentials, constraints, kinetic energy and forces have second derivatives at the state.
        state: point of expansion, None for the start of the problem; its velocity enters through lambda and the derivatives of the force.

    Raises:
        TypeError: `system` is none of the three, or a System without a state.
        ValueError: derivatives that are not finite at the state; constraints that leave no motion.
    """
    system, state = start_of("small_motions", system, state)
    terms = {name: np.asarray(value) for name, value in _expansion(system, state).items()}
    broken = [name for name, value in terms.items() if not np.isfinite(value).all()]
    if broken:
        raise ValueError(
            f"small_motions: the expansion of {', '.join(broken)} is not finite at the state (a norm at zero, a point "
            "outside a function's domain?). Give a state where second derivatives exist."
        )

    n = len(terms["slow_gradient"])
    mass, coupling = terms["kinetic"][n:, n:], terms["kinetic"][n:, :n]
    shapes = _shapes(mass, terms["jacobian"])
    multiplier, slow_multiplier = _multipliers_at_rest(terms, mass)
    # lambda . g'', the stiffness of the constraint forces
    bending, slow_bending = (np.tensordot(x, terms["curvature"], 1) for x in (multiplier, slow_multiplier))

    def reduced(matrix):
        return shapes.T @ matrix @ shapes

    hessians = {name: terms[name] for name in _potentials(system)}
    potentials = sum(hessians.values())
    gyroscopic = reduced(coupling)
    zero = np.zeros_like(shapes)
    motions = SmallMotions(
        system=_expanded_system(system, state, terms, multiplier, slow_multiplier),
        shapes=shapes,
        embed=np.block([[shapes, zero], [coupling @ shapes - mass @ shapes @ gyroscopic, mass @ shapes]]),
        read=np.block([[shapes.T @ mass, zero.T], [zero.T, shapes.T]]),
        hessians={
            name: reduced(hessian)
            for name, hessian in (hessians | {"slow": terms["slow"] + slow_bending, "force": -terms["force_q"]}).items()
        },
        stiffness=reduced(potentials + bending - terms["kinetic"][:n, :n] - terms["force_q"]),
        damping=gyroscopic - gyroscopic.T - reduced(terms["force_v"]),
        slow_force=-shapes.T @ terms["slow_gradient"],
        rest=State(jnp.asarray(state.t, dtype=float), *np.split(np.zeros(2 * n), phase_splits(state))),
    )
    q, v = (np.sqrt(np.abs(x @ mass @ x)) for x in (np.concatenate([state.q_s, state.q_f]), terms["velocity"]))
    omega, acceleration = np.abs(motions.rates).max(initial=0.0), np.linalg.norm(shapes.T @ terms["impetus"])
    moves = v > LEAST_MOTION * omega * q or acceleration > LEAST_MOTION * omega**2 * q
    return replace(motions, driven=driven(system, state), moves=bool(moves))


def _shapes(mass: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """N (n, d) with ``N^T M N = 1`` and ``G N = 0``: a basis T of the null space of G, divided by the Cholesky factor of ``T^T M T``."""
    # dependent constraints count once
    root = np.sqrt(np.diagonal(mass))[:, None]  # rows of one unit and length one
    scaled = jacobian / root.T
    lengths = np.linalg.norm(scaled, axis=1, keepdims=True)
    scaled = scaled / np.where(lengths > 0, lengths, 1.0)
    tangents = null_space(scaled, rcond=1e-10) / root if len(jacobian) else np.eye(len(mass))
    if not tangents.shape[1]:
        raise ValueError(
            f"small_motions: the {len(jacobian)} constraints leave none of the {len(mass)} coordinates free; nothing moves."
        )
    return np.linalg.solve(np.linalg.cholesky(tangents.T @ mass @ tangents), tangents.T).T


def _multipliers_at_rest(terms: dict, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of the constraint forces ``-G^T lambda``, and the share of the slow potential in them.

    ``lambda = (G M^-1 G^T)^+ (G M^-1 f + v^T g'' v)`` with the other forces f; the share of V has ``f = -dV/dq`` alone.
    """
    G = terms["jacobian"]
    weighted = G @ np.linalg.inv(mass)
    gram = weighted @ G.T
    diagonal = np.diagonal(gram)
    root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))[:, None]
    gram = np.linalg.pinv(correlation(gram), rcond=1e-12, hermitian=True) / root / root.T
    multiplier = gram @ (weighted @ terms["impetus"] + terms["centripetal"])
    return multiplier, -gram @ (weighted @ terms["slow_gradient"])


def _expanded_system(system: System, state: State, terms: dict, multiplier, slow_multiplier) -> System:
    """The terms of a system as quadratic functions of the displacement; absent terms stay absent."""
    n_s, n_g = state.q_s.size, system.num_constraints(state.q_s, state.q_f)[0]
    G, curvature = terms["jacobian"], terms["curvature"]
    constant_force = G.T @ (multiplier - slow_multiplier)  # balances the constraint forces that V does not
    has_constant_force = np.any(np.abs(constant_force) > 1e-12 * (np.abs(G.T) @ np.abs(multiplier)))
    return System(
        system.kinetic if system.has_constant_mass else _kinetic,
        None if system.slow_potential is None else _Potential("slow"),
        None if system.fast_potential is None else _fast_potential,
        None if system.constraint is None else _constraint,
        None if system.slow_constraint is None else _slow_constraint,
        _force if has_constant_force or terms["force_q"].any() or terms["force_v"].any() else None,
        params={
            "kinetic": terms["kinetic"],
            "slow": (-G.T @ slow_multiplier, terms["slow"]),
            "fast": terms["fast"][n_s:, n_s:],
            "constraint": (G[:n_g], curvature[:n_g]),
            "slow_constraint": (G[n_g:, :n_s], curvature[n_g:, :n_s, :n_s]),
            "force": terms["force_q"],
            "other_force": (constant_force, terms["force_v"]),
            **{name: (np.zeros(len(G.T)), terms[name]) for name in list(_potentials(system))[2:]},
        },
        potentials=[(name, _Potential(f"potential {name}")) for name, _ in system.potentials],
    )


def _potentials(system: System) -> dict[str, Callable]:
    """V, W and the further potentials as functions of (q_s, q_f, params), by their keys among the terms; zero without V or W."""
    V, W = system.slow_potential, system.fast_potential
    return {
        "slow": lambda q_s, q_f, params: jnp.zeros(()) if V is None else V(q_s, q_f, params),
        "fast": lambda q_s, q_f, params: jnp.zeros(()) if W is None else W(q_f, params),
        **{f"potential {name}": function for name, function in system.potentials},
    }


@partial(jax.jit, compiler_options=QUICK)
def _expansion(system: System, state: State) -> dict:
    """Derivatives of every term with respect to the positions (n,), slow first, and the velocities.

    Among them "impetus": ``dT/dq - d/dt(dT/dv) - dU/dq + F``, all forces but the constraint forces, at constant v; and "centripetal":
    ``v^T g'' v``, the second time derivative of g at constant v.
    """
    n_s = state.q_s.size
    q = jnp.concatenate([state.q_s, state.q_f])
    v = jnp.concatenate(velocity(system, state.q_s, state.q_f, state.p_s, state.p_f))

    def of_positions(potential):
        return lambda q: potential(q[:n_s], q[n_s:], system.params)

    def energy(q):
        return potential_energy(system, q[:n_s], q[n_s:])

    def kinetic(z):
        q, v = jnp.split(z, 2)
        return system.kinetic_energy(q[:n_s], q[n_s:], v[:n_s], v[n_s:])

    def constraints(q):
        return system.constraints(state.t, q[:n_s], q[n_s:])

    def constraints_in_motion(s):  # straight motion through the state
        return system.constraints(state.t + s, q[:n_s] + s * v[:n_s], q[n_s:] + s * v[n_s:])

    def force(q, v):
        return jnp.concatenate(system.forces(state.t, q[:n_s], q[n_s:], v[:n_s], v[n_s:]))

    z = jnp.concatenate([q, v])
    potentials = {name: of_positions(potential) for name, potential in _potentials(system).items()}
    # The gradient (dT/dq, dT/dv) and its rate of change along q' = v, v' = 0.
    gradient, rate = jax.jvp(jax.grad(kinetic), (z,), (jnp.concatenate([v, jnp.zeros_like(v)]),))
    force_q, force_v = jax.jacfwd(force, argnums=(0, 1))(q, v)
    return {
        "kinetic": jax.hessian(kinetic)(z.at[q.size :].set(0.0)),
        **{name: jax.hessian(potential)(q) for name, potential in potentials.items()},
        "slow_gradient": jax.grad(potentials["slow"])(q),
        "jacobian": jax.jacrev(constraints)(q),
        "curvature": jax.jacfwd(jax.jacrev(constraints))(q),
        "centripetal": jax.jacfwd(jax.jacfwd(constraints_in_motion))(0.0),
        "velocity": v,
        "force_q": force_q,
        "force_v": force_v,
        "impetus": gradient[: q.size] - rate[q.size :] - jax.grad(energy)(q) + force(q, v),
    }


def _kinetic(q_s, q_f, v_s, v_f, params):
    z = jnp.concatenate([q_s, q_f, v_s, v_f])
    return z @ params["kinetic"] @ z / 2


def _fast_potential(q_f, params):
    return q_f @ params["fast"] @ q_f / 2


@dataclass(frozen=True)
class _Potential:
    """A potential ``gradient . q + q^T H q / 2``; `name` is the key of its gradient and Hessian H in the params."""

    name: str

    def __call__(self, q_s, q_f, params):
        q = jnp.concatenate([q_s, q_f])
        gradient, hessian = params[self.name]
        return gradient @ q + q @ hessian @ q / 2


def _constraint(q_s, q_f, params):
    return _quadratic(jnp.concatenate([q_s, q_f]), *params["constraint"])


def _slow_constraint(q_s, params):
    return _quadratic(q_s, *params["slow_constraint"])


def _quadratic(q, jacobian, curvature):
    return jacobian @ q + jnp.einsum("gij,i,j->g", curvature, q, q) / 2


def _force(t, q_s, q_f, v_s, v_f, params):
    constant, by_v = params["other_force"]
    n_s = q_s.size
    force = constant + params["force"] @ jnp.concatenate([q_s, q_f]) + by_v @ jnp.concatenate([v_s, v_f])
    return force[:n_s], force[n_s:]
