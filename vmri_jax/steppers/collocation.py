"""One interval with a path of degree r > 1: all variables at once, by simplified Newton steps in modes of time.

With the Hessian of the potentials by the fast variables and the Jacobian of the constraints taken at one point, in the middle of
the step, the Newton matrix is

    [A x M - h^2 B x W'',  -I x G^T;  I x G,  0]

with A, B (r, r) the stiffness and the mass matrix of the polynomials in time, rows of the nodes 0..r-1, columns of 1..r. In the
eigenvectors of A^-1 B, which are known once and for all, it falls apart into one complex saddle per pair of eigenvalues gamma,

    [M - h^2 gamma W'',  -G^T;  G,  0],

so that matrices are of the size of the system, whatever the degree (Butcher 1976; Hairer, Wanner, Solving
Ordinary Differential Equations II, IV.8). Of these only as many rows are solved as there are combinations of variables that the
potentials are curved along. Forces are exact, so that all of this decides only how many steps there are.
"""

from dataclasses import dataclass
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import inverse, matmul, max_abs, regularized
from vmri_jax.mechanics.structure import curved_directions
from vmri_jax.schemes.discrete_lagrangian import Term, lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.path import control_nodes, lagrange_basis
from vmri_jax.steppers.accept import Accepted, expected
from vmri_jax.steppers.interval import constant_mass
from vmri_jax.steppers.results import RUNNING, Method
from vmri_jax.steppers.solved import Solution, Solver, status_of
from vmri_jax.steppers.solvers import Newton
from vmri_jax.steppers.time_modes import TimeModes, product, taken, times_i


class JoinedEquations:
    """The equations of the step, with the variables joined, q = (q_s, q_f), and nodes as the last axis.

    num_curved: how many variables, the last ones, the Hessian is taken by: the fast ones where there are any.
    directions, along: (d, n) the combinations of these that the potentials are curved along, and (n, d) changes of the variables
        that change one of them each.
    """

    def __init__(self, equations: StepEquations):
        self.system, self.h = equations.system, equations.macro_dt
        self.n_s, self.r = equations.q_s.size, equations.scheme.degree
        self.q = jnp.concatenate([equations.q_s, equations.q_f])
        self.p = jnp.concatenate([equations.p_s, equations.p_f])
        self.times = equations.t + self.h * control_nodes(self.r)
        terms = lagrangian(self.system, equations.scheme)
        self.form = terms.kinetic.fast_form[1:]
        self.potentials = [term for term in terms.potentials.terms if term.inside.groups]
        kinetic = constant_mass(self.system)
        self.masses = kinetic.slow_mass, kinetic.fast_mass
        self.inverse_masses = kinetic.slow_mass.inverse(), kinetic.fast_mass.inverse()
        self.num_curved = equations.q_f.size or self.q.size
        directions = curved_directions(partial(self.potential_of_curved, self.q), self.q[-self.num_curved :])
        self.directions = np.pad(directions, ((0, 0), (self.q.size - self.num_curved, 0)))
        self.along = np.linalg.pinv(self.directions)
        self.at_start = self.jacobian(self.times[0], self.q)

    def constraints(self, t, q):
        """All constraints (n_c,) at one point."""
        return self.system.constraints(t, q[: self.n_s], q[self.n_s :])

    def jacobian(self, t, q):
        """Their Jacobian G (n_c, n)."""
        return jax.jacrev(self.constraints, argnums=1)(t, q)

    def times_mass(self, x):
        """``M x`` for (n, m)."""
        parts = zip(self.masses, (x[: self.n_s], x[self.n_s :]), strict=True)
        return jnp.concatenate([mass.times(part.T).T for mass, part in parts])

    def over_mass(self, x):
        """``M^-1 x`` for (n, m)."""
        parts = zip(self.inverse_masses, (x[: self.n_s], x[self.n_s :]), strict=True)
        return jnp.concatenate([inverse.times(part.T).T for inverse, part in parts])

    def by_name(self, term: Term, q) -> tuple:
        """What a term takes of (n, ...) joined variables."""
        at = {"q_s": q[: self.n_s], "q_f": q[self.n_s :]}
        return tuple(at[name] for name in term.arguments)

    def potential(self, q):
        """All potentials at one point."""
        return sum((-term.sign * term.integrand(*self.by_name(term, q)) for term in self.potentials), jnp.zeros(()))

    def potential_of_curved(self, q, curved):
        """The same with the last `num_curved` variables apart."""
        return self.potential(jnp.concatenate([q[: -self.num_curved], curved]))

    def curvature(self, q):
        """Hessian of the potentials by these variables times the changes `along` (n, d)."""
        curved, gradient = q[-self.num_curved :], jax.grad(partial(self.potential_of_curved, q))
        changes = self.along.T[:, -self.num_curved :]
        columns = jax.vmap(lambda change: jax.jvp(gradient, (curved,), (change,))[1], out_axes=1)(changes)
        return jnp.pad(columns, ((self.q.size - self.num_curved, 0), (0, 0)))

    def forces(self, x, mu) -> "Forces":
        """Of potentials and constraints.

        Args:
            x, mu: increments (n, r) and multipliers (n_c, r).
        """
        q = self.q[:, None] + x  # at the nodes 1..r

        def at_node(at):
            t, q, mu = at
            g, pull = jax.vjp(lambda q: self.constraints(t, q), q)
            return g, -pull(mu)[0]

        later = jnp.concatenate([mu[:, 1:], jnp.zeros_like(mu[:, :1])], axis=1)
        g, total = at_nodes(at_node)((self.times[1:], q, later))
        first = -jnp.sum(mu[:, :1] * self.at_start, axis=0)
        for term in self.potentials:
            theta = np.concatenate([term.inside.theta(group) for group in term.inside.groups])
            basis, weights = lagrange_basis(self.r, theta), self.h**2 * term.inside.weights
            gradient = jax.grad(lambda q, term=term: term.sign * term.integrand(*self.by_name(term, q)))
            before, k = int(np.argmax(basis[0, 1:])), len(theta)
            consecutive = np.eye(self.r + 1)[before + 1 : before + 1 + k]
            if np.array_equal(basis, consecutive):  # nodes of the path: nothing to interpolate
                d = at_nodes(gradient)(q[:, before : before + k])
                total += jnp.pad(weights * d, ((0, 0), (before, self.r - before - k)))
            else:
                d = at_nodes(gradient)(self.q[:, None] + matmul(x, basis[:, 1:].T))
                first += d @ (weights * basis[:, 0])
                total += matmul(d, weights[:, None] * basis[:, 1:])
        inside = jnp.concatenate([(self.h * self.p + first)[:, None], total[:, :-1]], axis=1)
        return Forces(inside, total[:, -1], g)

    def residual(self, x, forces: "Forces"):
        """Of the momentum equations of the nodes 0..r-1, times h, (n, r)."""
        return self.times_mass(matmul(x, self.form[:, :-1])) + forces.inside

    def momentum(self, x, forces: "Forces"):
        """At the end of the step (n,)."""
        return (self.times_mass(matmul(x, self.form[:, -1:]))[:, 0] + forces.last) / self.h


class Forces(NamedTuple):
    """What increments and multipliers make of a step.

    inside: forces at the nodes 0..r-1, times h, at node 0 with the momentum that arrives.
    last: forces at the end of the step, times h.
    g: constraints at the nodes 1..r.
    """

    inside: Float[Array, "n r"]
    last: Float[Array, "n"]
    g: Float[Array, "n_c r"]


class Saddles(NamedTuple):
    """The saddles of all modes, eliminated; with z = L x for the d combinations of variables that the potentials are curved along.

    ``M x - gamma L^T w z - G^T nu = M y`` is ``x = y + gamma Q z + M^-1 G^T nu`` and ``(1 - gamma L Q) z = L y + L M^-1 G^T nu``, so
    that only d rows, and those of the constraints, are solved for each mode.

    modes: of time; everything below except `push` and `pull` is given for each of their parts.
    gamma: eigenvalues, for every part of a mode.
    push: L and G, of the variables.
    pull: ``Q = M^-1 L^T w`` and ``M^-1 G^T``, with ``w = h^2 W''``.
    bend: ``L Q``.
    denominator: inverses of ``|1 - gamma L Q|^2``.
    push_bend: ``G Q``.
    pull_bend: real and imaginary part of ``(1 - gamma L Q)^-1 L M^-1 G^T``.
    schur: of the inverse of G times x for every multiplier.
    """

    modes: TimeModes
    gamma: Float[np.ndarray, "2 k"]
    push: Float[Array, "d+n_c n"]
    pull: Float[Array, "n d+n_c"]
    bend: Float[Array, "d d"]
    denominator: Float[Array, "d d k"]
    push_bend: Float[Array, "n_c d"]
    pull_bend: list[Float[Array, "d n_c k"]]
    schur: list[Float[Array, "n_c n_c k"]]

    @classmethod
    def at(cls, joined: JoinedEquations, modes: TimeModes, t, q) -> "Saddles":
        """With Hessian and Jacobian at a point."""
        along, jacobian = joined.directions, joined.jacobian(t, q)
        bend, pull = joined.over_mass(joined.h**2 * joined.curvature(q)), joined.over_mass(jacobian.T)
        k, d, n_c = modes.gamma.shape[1], len(along), len(jacobian)
        re, im = modes.gamma[:, :, None, None]  # modes are the first axis until the end

        def of_parts(z):
            """(modes, rows, columns) as (columns, rows, k)."""
            return taken(jnp.swapaxes(z, 0, 2), modes.mode)

        bent = matmul(along, bend)
        denominator = inverse(np.eye(d) - 2 * re * bent + (re**2 + im**2) * matmul(bent, bent))

        straight = matmul(along, pull)
        columns = jnp.concatenate([straight, matmul(bent, straight)], axis=1)
        through = (matmul(denominator.reshape(k * d, d), columns)).reshape(k, d, 2 * n_c)
        # real and imaginary part of (1 - conj(gamma) L Q) / |1 - gamma L Q|^2 times the columns
        real, imaginary = through[..., :n_c] - re * through[..., n_c:], im * through[..., n_c:]

        push_bend = matmul(jacobian, bend)
        a, b = (matmul(push_bend, z) for z in (re * real - im * imaginary, re * imaginary + im * real))
        schur = inverse(regularized(jax.lax.complex(a + matmul(jacobian, pull), b)))

        push, pull = jnp.concatenate([along, jacobian]), jnp.concatenate([bend, pull], axis=1)
        pull_bend, schur = ([of_parts(a) for a in both] for both in ((real, imaginary), (schur.real, schur.imag)))
        return cls(
            modes, modes.gamma[:, modes.mode], push, pull, bent, of_parts(denominator), push_bend, pull_bend, schur
        )

    def solve(self, y, g):
        """x (n, r) and mu (n_c, r) with ``M x - h^2 W'' x (A^-1 B)^T - G^T mu A^-T = M y`` and ``G x = g``."""
        d = len(self.bend)
        pushed = matmul(self.push, y)
        pushed = matmul(jnp.concatenate([pushed[:d], g - pushed[d:]]), self.modes.of_values)
        z, g = pushed[:d], pushed[d:]
        z = z - self._times_gamma(matmul(self.bend, z), -1)
        products = (a * row for a, row in zip(self.denominator, z, strict=True))
        z = reduce(jnp.add, products, jnp.zeros_like(z))  # written out: within a sum z would be made anew for every row
        nu = product(self.schur, g - matmul(self.push_bend, self._times_gamma(z)))
        z = self._times_gamma(z + product(self.pull_bend, nu))
        return y + matmul(self.pull, matmul(jnp.concatenate([z, nu]), self.modes.increments)), matmul(
            nu, self.modes.multipliers
        )

    def _times_gamma(self, z, sign=1):
        """Or times the conjugate of gamma."""
        re, im = self.gamma
        return re * z + sign * im * times_i(z)


class Increments(NamedTuple):
    """Increments x, multipliers mu, largest corrections (slow, fast), how many there were, and what the last one tells."""

    x: Float[Array, "n r"]
    mu: Float[Array, "n_c r"]
    moved: tuple[Float[Array, ""], ...]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


class Evaluated(NamedTuple):
    """An iterate with forces; `result` is final only if the forces belong to this iterate, else RUNNING."""

    last: Increments
    forces: Forces
    result: Int[Array, ""]


def at_nodes(function):
    """`function` at all nodes, which are the last axis."""
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def only_if(wanted, function, x):
    """``function(x)``, or x itself. As a loop of at most one pass: of two branches, lanes would always compute both."""
    return jax.lax.while_loop(lambda a: a[0], lambda a: (jnp.asarray(False), function(a[1])), (wanted, x))[1]


@dataclass(frozen=True)
class Collocation(Solver):
    """Newton steps until one more would change no increment.

    What it would change them by is known from how the corrections shrink. Accepted are changes of ``newton.tolerance``
    relative to the motion over the step, and round-off of the positions.
    """

    newton: Newton

    def solve(self, equations: StepEquations, guess: Unknowns, memory: tuple) -> tuple[Solution, tuple]:
        newton = self.newton
        joined, modes = JoinedEquations(equations), TimeModes.of(equations.scheme)
        n_s, (n_g, _) = joined.n_s, equations.system.num_constraints(equations.q_s, equations.q_f)
        x = jnp.concatenate([guess.slow, guess.fast[0]], axis=1).T
        mu = jnp.concatenate([guess.multiplier[0], guess.slow_multiplier], axis=1).T
        saddles = Saddles.at(joined, modes, equations.t + joined.h / 2, joined.q + x[:, -1] / 2)
        accepted = Accepted.of(equations, newton)

        def slow_and_fast(x):
            return max_abs(x[:n_s]), max_abs(x[n_s:])

        def corrected(last: Increments, forces: Forces) -> Increments:
            moves = matmul(joined.over_mass(forces.inside), modes.of_rows)
            missing = last.x + moves  # what these forces do not bring about
            dx, dmu = saddles.solve(-missing, -forces.g)
            x, mu, moved, iterations = last.x + dx, last.mu + dmu, slow_and_fast(dx), last.iterations + 1
            left = map(expected, moved, last.moved)
            result = newton.status(accepted.over(left, slow_and_fast(x), iterations), iterations)
            return Increments(x, mu, moved, iterations, result)

        def step(at: Evaluated) -> Evaluated:
            """Forces first: evaluated in one place, they are compiled once."""
            last, fixed = at.last, newton.fixed_iterations
            forces = joined.forces(last.x, last.mu)
            goes_on = last.result == RUNNING if fixed is None else last.iterations < fixed
            return Evaluated(only_if(goes_on, lambda last: corrected(last, forces), last), forces, last.result)

        running, none = jnp.asarray(RUNNING), Forces(jnp.zeros_like(x), jnp.zeros_like(joined.q), jnp.zeros_like(mu))
        start = Increments(x, mu, (jnp.zeros(()),) * 2, jnp.asarray(0), running)
        last, forces, _ = newton.iterate(step, Evaluated(start, none, running), -1)  # forces once more than corrections

        p, rows = joined.momentum(last.x, forces), joined.residual(last.x, forces)
        x, mu = last.x.T, last.mu.T
        unknowns = Unknowns(x[:, :n_s], mu[:, n_g:], x[None, :, n_s:], mu[None, :, :n_g])
        end = equations.q_f + x[-1, n_s:], p[:n_s], p[n_s:]
        left = max_abs(rows), max_abs(forces.g)
        status = status_of(equations, last.result, Method.COLLOCATION, last.iterations, *left, newton.tolerance)
        return Solution(unknowns, end, status), memory

    def describe(self) -> list[str]:
        return ["one interval of high degree: all variables at once, in modes of time"]
