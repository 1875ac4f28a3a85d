"""The linearisation of a system at a state: the one that frequencies, advice, maps of stable steps and choices of steps
read.

Every term is expanded to second order in its variables: ``c . x + x^T H x / 2`` with the slope c and the curvature H;
constraints have one of each per row. Displacements that fit the constraints are ``N eta`` with ``G N = 0`` and
``N^T M N = 1``, and they obey

    eta'' + D eta' + K eta = 0

At an equilibrium the expansion is the linearised system. Elsewhere it describes the *frozen* problem: constant forces
hold the configuration at rest. In both cases it is a `System`, to which every scheme applies unchanged.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.kernels.saddle import least_norm
from vmri_jax.mechanics.arrays import quickly_compiled, split_at
from vmri_jax.mechanics.constraints import decomposed
from vmri_jax.mechanics.driving import driven
from vmri_jax.mechanics.motion import motion
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import Movable, State, opened, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.mechanics.terms import Term
from vmri_jax.refusals import Refused

LEAST_GROWTH = 1e-6
"""Growth rate up to which a motion does not grow, as a part of the largest rate: round-off of the eigenvalues. A larger
value takes slowly growing motions for instabilities of the step."""
LEAST_MOTION = 1e-8
"""Velocity v and acceleration a up to which a state is an equilibrium, in units of omega |q| and omega^2 |q|, with the
largest rate omega and norms of the kinetic energy: round-off, and residuals of solved equilibria. A larger value takes
slow motions for equilibria."""
ROWS_SHOWN, MOST_NAMED, LEAST_PART = 12, 3, 0.05
"""Vibrations in the printed table, coordinates named for each of them, and the least part of the kinetic energy of a
named coordinate. With more rows the table is longer than a screen; with more names, or a smaller part, its lines are
longer."""
SWAPPED_RATIO = 2.0
"""Ratio of the highest frequency of slow variables to the highest frequency of fast variables, above which their labels
are probably swapped; a larger value overlooks more swapped labels."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A system linearised at a state, in d coordinates eta of the constraint manifold; printed, a table of its
    vibrations.

    state: the point of linearisation.
    system: the expansion; its equilibrium is zero, its `params` are the slope and the curvature of each term.
    shapes: N, (n_s + n_f, d).
    mass, coupling: (n, n) derivatives ``d2T/dv2`` and ``d2T/dv dq`` at rest.
    hessians: (d, d) Hessians of the potentials: of V with its share of the constraint forces ("slow"), of W ("fast"),
        of each further potential ("potential " and its name), and minus the derivative of F in eta ("force").
    stiffness: K, (d, d) minus the derivative of all forces in eta: of potentials, constraints, the kinetic energy, and
        F.
    damping: D, (d, d) matrix of the velocities, gyroscopic and dissipative.
    slow_force: (d,) force of V at the state, which is constant in the expansion.
    driven: names of the terms that depend on time.
    moves: whether the state is no equilibrium.
    names: of the coordinates.
    """

    state: State
    system: System
    shapes: np.ndarray
    mass: np.ndarray
    coupling: np.ndarray
    hessians: dict[str, np.ndarray]
    stiffness: np.ndarray
    damping: np.ndarray
    slow_force: np.ndarray
    driven: tuple[str, ...]
    moves: bool
    names: Names

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

    @cached_property
    def _vibrations(self) -> tuple[np.ndarray, np.ndarray]:
        """Squares (d,) of the frequencies, the largest first, and the shapes (d, d), one per column, of all forces
        without D."""
        values, vectors = np.linalg.eigh((self.stiffness + self.stiffness.T) / 2)
        return values[::-1], vectors[:, ::-1]

    @property
    def frequencies(self) -> np.ndarray:
        """(d,) angular frequencies of the vibrations under all forces that depend on positions, the largest first; zero
        for other motions."""
        return np.sqrt(np.maximum(self._vibrations[0], 0.0))

    @property
    def modes(self) -> np.ndarray:
        """(d, d) vibrations in the coordinates eta, one per column, in the order of `frequencies`."""
        return self._vibrations[1]

    def frequencies_of(self, name: str) -> np.ndarray:
        """(d,) frequencies of a single potential, a key of `hessians`, the largest first; zero where it is not
        convex."""
        hessian = self.hessians[name]
        return np.sqrt(np.maximum(np.linalg.eigvalsh((hessian + hessian.T) / 2)[::-1], 0.0))

    @property
    def kinetic_shares(self) -> np.ndarray:
        """(n_s + n_f, d) share ``u_i (M u)_i`` of coordinate i in the kinetic energy of each vibration u, with
        ``u^T M u = 1``."""
        u = self.shapes @ self.modes
        return u * (self.mass @ u)

    @property
    def rest(self) -> State:
        """The state of zero displacement and momentum of the expansion."""
        return State(
            jnp.asarray(self.state.t, dtype=float), *(jnp.zeros(q.size) for q in 2 * [self.state.q_s, self.state.q_f])
        )

    @property
    def embed(self) -> np.ndarray:
        """(2 n, 2 d) matrix from (eta, pi) to (q_s, q_f, p_s, p_f), with the momenta pi of eta."""
        M, N, C = self.mass, self.shapes, self.coupling
        return np.block([[N, np.zeros_like(N)], [C @ N - M @ N @ (N.T @ C @ N), M @ N]])

    @property
    def read(self) -> np.ndarray:
        """(2 d, 2 n) matrix from (q_s, q_f, p_s, p_f) to (eta, pi)."""
        N = self.shapes
        return np.block([[N.T @ self.mass, np.zeros_like(N.T)], [np.zeros_like(N.T), N.T]])

    @property
    def frozen(self) -> str:
        """Why the expansion does not tell whether the motion is stable, in sentences; empty at an equilibrium."""
        if self.driven:
            terms = f"{' and the '.join(self.driven)} depend{'s' if len(self.driven) == 1 else ''}".replace("_", " ")
            return (
                f"The {terms} on time: the motion is linearised at t = {float(self.state.t):.4g} alone, as if time "
                "stood still there. Whether it is stable, a run over many periods of the drive decides."
            )
        if self.moves:
            return (
                "The state is no equilibrium: the motion is linearised there as if constant forces held it at rest. "
                "Whether it is stable, its multipliers over a period decide, vm.stability.monodromy(..., "
                "num_steps=...), or a long run."
            )
        return ""

    def only(self, name: str) -> "Linearisation":
        """The linearisation under one potential or the force alone, a key of `hessians`."""
        removed = {key: hessian for key, hessian in self.hessians.items() if key != name}
        zeros = {key: jax.tree.map(np.zeros_like, self.system.params[key]) for key in removed}
        return replace(
            self,
            system=self.system.replace(params=self.system.params | zeros),
            stiffness=self.stiffness - sum(removed.values()),
            hessians=self.hessians | {key: np.zeros_like(hessian) for key, hessian in removed.items()},
        )

    def swapped(self) -> tuple[str, float] | None:
        """Advice if slow variables vibrate faster than fast ones, and the ratio of their highest frequencies; else
        None."""
        n_s, shares, frequencies = self.state.q_s.size, self.kinetic_shares, self.frequencies
        slow = shares[:n_s].sum(axis=0) > 0.5
        slow_highest, fast_highest = frequencies[slow].max(initial=0.0), frequencies[~slow].max(initial=0.0)
        if n_s == len(shares) or slow_highest <= SWAPPED_RATIO * fast_highest or slow_highest == 0:
            return None
        carried = shares[:n_s, frequencies > slow_highest / SWAPPED_RATIO].sum(axis=1)
        sentence = (
            f"The fastest vibration, of frequency {slow_highest:.4g}, is one of the slow variables "
            f"{', '.join(self._labels[i] for i in np.flatnonzero(carried > 0.1))}; vibrations of the fast variables "
            f"reach {fast_highest:.4g}. Swap the labels: make these variables fast and put their energy into "
            "fast_potential, and the soft ones slow."
        )
        return sentence, float(slow_highest / fast_highest) if fast_highest else np.inf

    @property
    def _labels(self) -> list[str]:
        names = self.names.of_coordinates(self.state.q_s.size, self.state.q_f.size)
        return [*names.slow_coordinates, *names.fast_coordinates]

    def __repr__(self) -> str:
        lines, n_s = ["frequency    period  in fast coordinates  kinetic energy in"], self.state.q_s.size
        for frequency, parts in list(zip(self.frequencies, self.kinetic_shares.T, strict=True))[:ROWS_SHOWN]:
            largest = [f"{self._labels[i]} {parts[i]:.0%}" for i in np.argsort(-parts) if parts[i] >= LEAST_PART]
            period = f"{2 * np.pi / frequency:.4g}" if frequency > 0 else "-"
            carriers = ", ".join(largest[:MOST_NAMED]) or "spread over many"
            lines.append(f"{frequency:9.5g}  {period:>8}  {parts[n_s:].sum():>19.0%}  {carriers}")
        slower, rate = len(self.frequencies) - ROWS_SHOWN, np.real(self.growing).max(initial=0.0)
        notes = [f"{slower} slower ones are in .frequencies."] if slower > 0 else []
        if self.frozen and (rate or self.driven):
            notes.append(self.frozen)
        elif rate:
            notes.append(f"Motion about this state grows by itself, like exp({rate:.3g} t).")
        return "\n".join(lines + notes)


def linearise(system: Movable, state: State | None = None, names: Names | None = None) -> Linearisation:
    """Second-order expansion of a system about the configuration of a state, held at rest there.

        vm.diagnostics.linearise(problem).frequencies  # rad/s

    Every term is expanded separately, ``V(q + d) ~ d^T V'' d / 2`` and so on, and keeps its quadrature rule in the
    scheme. Constraints become ``G d + d^T g'' d / 2``. Their multipliers ``lambda`` are taken from the moving state, so
    that a swinging rod is under tension, and act through ``lambda . g''``. A linear term in the expanded V balances the
    constraint forces due to dV/dq, on the grid of V; a constant force on the micro grid balances all other constraint
    forces. At an equilibrium this reproduces the original terms. The kinetic energy is expanded at rest, forces at the
    velocity of the state.

    Args:
        system: a system, problem or scene whose potentials, constraints, kinetic energy and forces have second
            derivatives at the state.
        state: point of expansion, None for the start of the problem; its velocity enters through lambda and the
            derivatives of the force.
        names: of the coordinates; None for the names of the problem.

    Raises:
        TypeError: `system` is none of the three, or a System without a state.
        ValueError: derivatives that are not finite at the state.
    """
    system = opened(system)
    coordinates = names or getattr(system, "names", None) or Names()
    system, state = start_of("linearise", system, state)
    terms = jax.tree.map(np.asarray, _expansion(system, state))
    broken = [name for name, term in terms.items() if not all(np.isfinite(part).all() for part in term)]
    if broken:
        raise Refused(
            f"linearise: the expansion of {', '.join(broken)} is not finite at the state (a norm at zero, a point "
            "outside a function's domain?). Give a state where second derivatives exist."
        )
    (_, kinetic), (G, curvature), (force_q, force_v) = (terms[name] for name in ("kinetic", "constraint", "force"))
    v, a, multipliers, slow_multipliers = terms["motion"]
    n = len(v)
    mass, coupling = kinetic[n:, n:], kinetic[n:, :n]
    N = mass_orthonormal(mass, G)
    # lambda . g'', the stiffness of the constraint forces
    bending, slow_bending = (np.tensordot(x, curvature, 1) for x in (multipliers, slow_multipliers))
    hessians = {name: terms[name][1] for name in ("slow", "fast", *map(_key, system.of_kind("potential")))}
    potentials = sum(hessians.values())
    hessians |= {"slow": hessians["slow"] + slow_bending, "force": -force_q}
    linear = Linearisation(
        state=state,
        system=_expanded_system(system, state, terms),
        shapes=N,
        mass=mass,
        coupling=coupling,
        hessians={name: N.T @ hessian @ N for name, hessian in hessians.items()},
        stiffness=N.T @ (potentials + bending - kinetic[:n, :n] - force_q) @ N,
        damping=N.T @ (coupling - coupling.T - force_v) @ N,
        slow_force=-N.T @ terms["slow"][0],
        driven=driven(system, state),
        moves=False,
        names=coordinates,
    )
    omega, q = np.abs(linear.rates).max(initial=0.0), np.concatenate([state.q_s, state.q_f])
    size, speed = (np.sqrt(np.abs(x @ mass @ x)) for x in (q, v))
    acceleration = np.linalg.norm(N.T @ mass @ a)
    moves = speed > LEAST_MOTION * omega * size or acceleration > LEAST_MOTION * omega**2 * size
    return replace(linear, moves=bool(moves))


def tangents(rows: np.ndarray) -> np.ndarray:
    """Orthonormal basis (n, k), one vector per column, of the space orthogonal to rows (m, n); dependent rows count
    once."""
    _, rank, directions = decomposed(rows)
    return directions[rank:].T


def mass_orthonormal(mass: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
    """N (n, d) with ``N^T M N = 1`` and ``G N = 0`` for rows G (m, n); None for no rows.

    It is a basis T of the null space of G, divided by the Cholesky factor of ``T^T M T``.
    """
    rows = np.zeros((0, len(mass))) if rows is None else rows
    root = np.sqrt(np.diagonal(mass))  # in units of it, coordinates of different units are compared
    T = tangents(rows / root) / root[:, None]
    return np.linalg.solve(np.linalg.cholesky(T.T @ mass @ T), T.T).T


def _key(term: Term) -> str:
    """The key of a term: "slow" and "fast" of V and W, "potential " and the name of a further potential, else its
    field."""
    return f"potential {term.name}" if term.field == "potentials" else term.field.removesuffix("_potential")


@quickly_compiled
def _expansion(system: System, state: State) -> dict[str, tuple]:
    """Slope and curvature of the kinetic energy in (q, v) at rest, and of potentials and constraints in q = (q_s, q_f).

    Also the derivatives of F by q and v ("force"); and velocity, acceleration, multipliers and the share of V in the
    multipliers ("motion").
    """
    n_s, q, now = state.q_s.size, jnp.concatenate([state.q_s, state.q_f]), motion(system, state)
    v, a = jnp.concatenate([now.v_s, now.v_f]), jnp.concatenate([now.a_s, now.a_f])

    def kinetic(z):
        q, v = jnp.split(z, 2)
        return system.kinetic_energy(*split_at(q, n_s), *split_at(v, n_s))

    def force(q, v):
        return jnp.concatenate(system.forces(state.t, *split_at(q, n_s), *split_at(v, n_s)))

    def second_order(function, x):
        slope = jax.jacrev(function)
        return slope(x), jax.jacfwd(slope)(x)

    terms = {
        "kinetic": second_order(kinetic, jnp.concatenate([q, jnp.zeros_like(q)])),
        "constraint": second_order(lambda q: system.constraints(state.t, *split_at(q, n_s)), q),
        "force": jax.jacfwd(force, argnums=(0, 1))(q, v),
    }
    terms["slow"] = terms["fast"] = jnp.zeros_like(q), jnp.zeros((q.size, q.size))  # without V or W
    for term in system.of_kind("potential"):
        terms[_key(term)] = second_order(lambda q, V=term: V.at(split_at(q, n_s), system.params), q)
    # lambda = (G M^-1 G^T)^+ G M^-1 f of the force f = -dV/dq alone
    G = terms["constraint"][0]
    responses = jnp.linalg.solve(terms["kinetic"][1][q.size :, q.size :], G.T)
    share = least_norm(G @ responses, -responses.T @ terms["slow"][0])
    return {**terms, "motion": (v, a, now.multipliers, share)}


def _expanded_system(system: System, state: State, terms: dict) -> System:
    """The terms of a system as quadratic functions of the displacement; absent terms stay absent."""
    n_s, n_g = state.q_s.size, system.num_constraints(state.q_s, state.q_f)[0]
    (_, kinetic), (G, curvature), (force_q, force_v) = (terms[name] for name in ("kinetic", "constraint", "force"))
    *_, multipliers, slow_multipliers = terms["motion"]
    constant_force = G.T @ (multipliers - slow_multipliers)  # balances the constraint forces that V does not
    has_constant_force = np.any(np.abs(constant_force) > 1e-12 * (np.abs(G.T) @ np.abs(multipliers)))
    expanded = {term: _Quadratic(_key(term)) for term in system.terms if term.kind in ("potential", "constraint")}
    further = [term for term in expanded if term.field == "potentials"]
    return System(
        system.kinetic if system.has_constant_mass else _Quadratic("kinetic"),
        force=_force if has_constant_force or force_q.any() or force_v.any() else None,
        params={
            **{_key(term): (np.zeros(len(G.T)), terms[_key(term)][1]) for term in further},
            "kinetic": (np.zeros(len(kinetic)), kinetic),
            "slow": (-G.T @ slow_multipliers, terms["slow"][1]),
            "fast": (np.zeros(state.q_f.size), terms["fast"][1][n_s:, n_s:]),
            "constraint": (G[:n_g], curvature[:n_g]),
            "slow_constraint": (G[n_g:, :n_s], curvature[n_g:, :n_s, :n_s]),
            "force": force_q,
            "other_force": (constant_force, force_v),
        },
        potentials=[(term.name, expanded[term]) for term in further],
        **{term.field: function for term, function in expanded.items() if term not in further},
    )


@dataclass(frozen=True)
class _Quadratic:
    """A term ``c . x + x^T H x / 2`` of its variables x, joined; `name` is the key of (c, H) in the params."""

    name: str

    def __call__(self, *variables_and_params):
        *variables, params = variables_and_params
        slope, curvature = params[self.name]
        x = jnp.concatenate(variables)
        return slope @ x + curvature @ x @ x / 2


def _force(t, q_s, q_f, v_s, v_f, params):
    constant, by_v = params["other_force"]
    force = constant + params["force"] @ jnp.concatenate([q_s, q_f]) + by_v @ jnp.concatenate([v_s, v_f])
    return split_at(force, q_s.size)
