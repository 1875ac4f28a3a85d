"""One interval of fast variables with a path of degree r > 1, by simplified Newton steps in modes of time.

With the Hessian of the potentials and the Jacobian of the constraints taken at one point, in the middle of the step,
the Newton matrix is

    [A (x) M - h^2 B (x) W'',  -1 (x) G^T;  1 (x) G,  0]        (x): Kronecker product

with A, B (r, r) the stiffness and the mass matrix of the polynomials in time, rows of the nodes 0..r-1, columns of
1..r. Multiply the first rows by ``A^-1 (x) 1``, and take ``nu = (A^-1 (x) 1) mu`` for the multipliers. In the
eigenvectors of A^-1 B, which depend on the degree alone, the matrix then decouples into one complex saddle per pair of
eigenvalues gamma,

    [M - h^2 gamma W'',  -G^T;  G,  0],

so that matrices have the size of the system for every degree (Butcher 1976; Hairer, Wanner, Solving Ordinary
Differential Equations II, IV.8). The Hessian has the form ``L^T w L`` with a (d, n) matrix L, where d may be much
smaller than n: each saddle is eliminated down to d rows and the constraints (`Saddles`). Where slow variables are
joined to the fast ones, it leaves out their curvature, which a macro step resolves. The residual is exact, so that
these approximations change only the number of iterations.
"""

from dataclasses import dataclass
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vmri_jax.kernels import inverse, matmul, max_abs
from vmri_jax.kernels.saddle import regularized
from vmri_jax.mechanics.structure import curved_directions
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns
from vmri_jax.schemes.path import control_nodes, lagrange_basis
from vmri_jax.steppers.accept import Accepted, expected
from vmri_jax.steppers.interval import implicit_terms
from vmri_jax.steppers.results import RUNNING, Method
from vmri_jax.steppers.solved import Solution, StepSolver, status_of
from vmri_jax.steppers.solver import Solver, iterated, only_if
from vmri_jax.steppers.time_modes import TimeModes, product, times_i


class IntervalEquations:
    """The equations of the step, with the nodes as the last axis.

    num_slow: of the variables, whose curvature the Hessian leaves out; they come first.
    directions, along: L (d, n), the combinations of variables along which the potentials are curved, and its
        pseudo-inverse (n, d).
    """

    def __init__(self, equations: StepEquations, num_slow: int):
        assert not equations.q_s.size, "slow variables would not move"
        self.system, self.h, self.r = equations.system, equations.macro_dt, equations.scheme.degree
        self.q_s, self.q, self.p = equations.q_s, equations.q_f, equations.p_f
        self.times = equations.t + self.h * control_nodes(self.r)
        self.form = lagrangian(self.system, equations.scheme).kinetic.fast_form[1:]
        self.potentials = implicit_terms(self.system, equations.scheme)
        self.mass = self.system.kinetic.fast_mass
        self.inverse_mass = self.mass.inverse()
        self.num_slow = num_slow
        directions = curved_directions(partial(self.potential_of_fast, self.q), self.q[num_slow:])
        self.directions = np.pad(directions, ((0, 0), (num_slow, 0)))
        self.along = np.linalg.pinv(self.directions)
        self.at_start = self.jacobian(self.times[0], self.q)

    def constraints(self, t, q):
        """All constraints (n_g,) at one point."""
        return self.system.g(t, self.q_s, q)

    def jacobian(self, t, q):
        """The Jacobian G (n_g, n) of the constraints."""
        return jax.jacrev(self.constraints, argnums=1)(t, q)

    def times_mass(self, x):
        """``M x`` for (n, m)."""
        return self.mass.times(x.T).T

    def over_mass(self, x):
        """``M^-1 x`` for (n, m)."""
        return self.inverse_mass.times(x.T).T

    def potential(self, q):
        """All potentials at one point."""
        return -sum((term.sign * term.at(self.q_s, q) for term in self.potentials), jnp.zeros(()))

    def potential_of_fast(self, q, fast):
        """`potential` with the fast variables as an argument of their own."""
        return self.potential(jnp.concatenate([q[: self.num_slow], fast]))

    def curvature(self, q):
        """(n, d) the product of W'' with `along`, zero in the rows of slow variables."""
        gradient, fast = jax.grad(partial(self.potential_of_fast, q)), q[self.num_slow :]
        changes = self.along.T[:, self.num_slow :]
        columns = jax.vmap(lambda change: jax.jvp(gradient, (fast,), (change,))[1], out_axes=1)(changes)
        return jnp.pad(columns, ((self.num_slow, 0), (0, 0)))

    def forces(self, x, mu) -> "Forces":
        """Forces of potentials and constraints for the increments x (n, r) and multipliers mu (n_g, r)."""
        q = self.q[:, None] + x  # at the nodes 1..r

        def at_node(t_q_mu):
            t, q, mu = t_q_mu
            g, pull = jax.vjp(lambda q: self.constraints(t, q), q)
            return g, -pull(mu)[0]

        # constraint forces -G(q_j)^T mu_j at the nodes 0..r-1: `first` at node 0, the others in `total`; no multiplier
        # at node r
        later = jnp.concatenate([mu[:, 1:], jnp.zeros_like(mu[:, :1])], axis=1)
        g, total = at_nodes(at_node)((self.times[1:], q, later))
        first = -jnp.sum(mu[:, :1] * self.at_start, axis=0)
        # forces of the potentials, h^2 sum_k w_k l_j(c_k) (-dW/dq)(q(c_k)), at node j
        for term in self.potentials:
            theta = term.inside.theta
            basis, weights = lagrange_basis(self.r, theta), self.h**2 * term.inside.weights
            gradient = jax.grad(lambda q, term=term: term.sign * term.at(self.q_s, q))
            before, k = int(np.argmax(basis[0, 1:])), len(theta)
            consecutive = np.eye(self.r + 1)[before + 1 : before + 1 + k]
            if np.array_equal(basis, consecutive):  # quadrature nodes are control nodes: no interpolation
                d = at_nodes(gradient)(q[:, before : before + k])
                total += jnp.pad(weights * d, ((0, 0), (before, self.r - before - k)))
            else:
                d = at_nodes(gradient)(self.q[:, None] + matmul(x, basis[:, 1:].T))
                first += d @ (weights * basis[:, 0])
                total += matmul(d, weights[:, None] * basis[:, 1:])
        inside = jnp.concatenate([(self.h * self.p + first)[:, None], total[:, :-1]], axis=1)
        return Forces(inside, total[:, -1], g)

    def residual(self, x, forces: "Forces"):
        """Residual (n, r) of the momentum equations at the nodes 0..r-1, times h."""
        return self.times_mass(matmul(x, self.form[:, :-1])) + forces.inside

    def momentum(self, x, forces: "Forces"):
        """Momentum (n,) at the end of the step."""
        return (self.times_mass(matmul(x, self.form[:, -1:]))[:, 0] + forces.last) / self.h


class Forces(NamedTuple):
    """Forces and constraint values for some increments and multipliers.

    inside: forces at the nodes 0..r-1, times h, at node 0 with the momentum that arrives.
    last: forces at the end of the step, times h.
    g: constraints at the nodes 1..r.
    """

    inside: Float[Array, "n r"]
    last: Float[Array, "n"]
    g: Float[Array, "n_g r"]


class Saddles(NamedTuple):
    """The saddles of all modes after elimination, with z = L x for the d combinations of variables along which the
    potentials are curved.

    With ``h^2 W'' = L^T w L`` and ``Q = M^-1 L^T w``, the equation ``M x - gamma L^T w z - G^T nu = M y`` gives

        x = y + gamma Q z + M^-1 G^T nu        (1 - gamma L Q) z = L y + L M^-1 G^T nu

    so that each mode needs a solve for d rows and one for the constraints.

    modes: of time; k is the number of real and imaginary parts of modes, see `TimeModes`.
    gamma: eigenvalues, for every part of a mode.
    push: L and G.
    pull: Q and ``M^-1 G^T``.
    bend: ``L Q``.
    denominator: inverses of ``|1 - gamma L Q|^2``.
    push_bend: ``G Q``.
    pull_bend: real and imaginary part of ``(1 - gamma L Q)^-1 L M^-1 G^T``.
    schur: real and imaginary part of the inverse of ``G M^-1 G^T + gamma G Q (1 - gamma L Q)^-1 L M^-1 G^T``.
    """

    modes: TimeModes
    gamma: Float[np.ndarray, "2 k"]
    push: Float[Array, "d+n_g n"]
    pull: Float[Array, "n d+n_g"]
    bend: Float[Array, "d d"]
    denominator: Float[Array, "d d k"]
    push_bend: Float[Array, "n_g d"]
    pull_bend: list[Float[Array, "d n_g k"]]
    schur: list[Float[Array, "n_g n_g k"]]

    @classmethod
    def at(cls, interval: IntervalEquations, modes: TimeModes, t, q) -> "Saddles":
        """The saddles with Hessian and Jacobian at one point."""
        along, jacobian = interval.directions, interval.jacobian(t, q)
        bend, pull = interval.over_mass(interval.h**2 * interval.curvature(q)), interval.over_mass(jacobian.T)
        k, d, n_g = modes.gamma.shape[1], len(along), len(jacobian)
        re, im = modes.gamma[:, :, None, None]  # modes are the first axis until the end

        def of_parts(z):
            """(modes, rows, columns) as (columns, rows, k)."""
            return jnp.swapaxes(z, 0, 2)[..., modes.mode]

        bent = matmul(along, bend)
        denominator = inverse(np.eye(d) - 2 * re * bent + (re**2 + im**2) * matmul(bent, bent))

        # (1 - gamma L Q)^-1 L M^-1 G^T = |1 - gamma L Q|^-2 (1 - conj(gamma) L Q) L M^-1 G^T, by real and imaginary
        # part
        pulled = matmul(along, pull)
        columns = jnp.concatenate([pulled, matmul(bent, pulled)], axis=1)
        products = (matmul(denominator.reshape(k * d, d), columns)).reshape(k, d, 2 * n_g)
        real, imaginary = products[..., :n_g] - re * products[..., n_g:], im * products[..., n_g:]

        # G M^-1 G^T + gamma G Q (real + i imaginary)
        push_bend = matmul(jacobian, bend)
        a, b = (matmul(push_bend, z) for z in (re * real - im * imaginary, re * imaginary + im * real))
        schur = inverse(regularized(jax.lax.complex(a + matmul(jacobian, pull), b)))

        push, pull = jnp.concatenate([along, jacobian]), jnp.concatenate([bend, pull], axis=1)
        pull_bend, schur = ([of_parts(a) for a in both] for both in ((real, imaginary), (schur.real, schur.imag)))
        return cls(
            modes, modes.gamma[:, modes.mode], push, pull, bent, of_parts(denominator), push_bend, pull_bend, schur
        )

    def solve(self, y, g):
        """x (n, r) and mu (n_g, r) with ``M x - h^2 W'' x (A^-1 B)^T - G^T mu A^-T = M y`` and ``G x = g``."""
        d = len(self.bend)
        pushed = matmul(self.push, y)
        pushed = matmul(jnp.concatenate([pushed[:d], g - pushed[d:]]), self.modes.of_values)
        z, g = pushed[:d], pushed[d:]
        # (1 - gamma L Q)^-1 z = |1 - gamma L Q|^-2 (1 - conj(gamma) L Q) z
        z = z - self._times_gamma(matmul(self.bend, z), -1)
        products = (a * row for a, row in zip(self.denominator, z, strict=True))
        # written out: inside jnp.sum XLA would recompute z for every row
        z = reduce(jnp.add, products, jnp.zeros_like(z))
        # nu = schur (g - G y - gamma G Q z), then gamma z with the part of nu, then x = y + Q gamma z + M^-1 G^T nu
        nu = product(self.schur, g - matmul(self.push_bend, self._times_gamma(z)))
        z = self._times_gamma(z + product(self.pull_bend, nu))
        return y + matmul(self.pull, matmul(jnp.concatenate([z, nu]), self.modes.increments)), matmul(
            nu, self.modes.multipliers
        )

    def _times_gamma(self, z, sign=1):
        """``gamma z``, or with the sign -1 ``conj(gamma) z``."""
        re, im = self.gamma
        return re * z + sign * im * times_i(z)


class Increments(NamedTuple):
    """Increments x, multipliers mu, largest last correction, number of corrections, and `Result` or RUNNING."""

    x: Float[Array, "n r"]
    mu: Float[Array, "n_g r"]
    moved: Float[Array, ""]
    iterations: Int[Array, ""]
    result: Int[Array, ""]


class Evaluated(NamedTuple):
    """An iterate with forces. `result` is `last.result` if the forces belong to this iterate, else RUNNING."""

    last: Increments
    forces: Forces
    result: Int[Array, ""]


at_nodes = partial(jax.vmap, in_axes=-1, out_axes=-1)
"""Maps a function over the nodes, the last axis."""


@dataclass(frozen=True)
class Collocation(StepSolver):
    """Newton steps until the next one would change no increment (`Accepted`); its correction is extrapolated from the
    last two.

    settings: of the iteration.
    num_slow: of `IntervalEquations`.
    """

    settings: Solver
    num_slow: int

    def solve(self, equations: StepEquations, guess: Unknowns, memory: tuple) -> tuple[Solution, tuple]:
        settings, interval = self.settings, IntervalEquations(equations, self.num_slow)
        modes = TimeModes.of(equations.scheme)
        x, mu = guess.fast[0].T, guess.multiplier[0].T
        saddles = Saddles.at(interval, modes, equations.t + interval.h / 2, interval.q + x[:, -1] / 2)
        accepted = Accepted.of(equations, settings)

        def corrected(last: Increments, forces: Forces) -> Increments:
            # (A (x) M)^-1 R. Its equal x + M^-1 forces A^-T has the round-off of A^-1 in every step, always the same.
            residual = matmul(interval.over_mass(interval.residual(last.x, forces)), modes.of_rows)
            dx, dmu = saddles.solve(-residual, -forces.g)
            x, mu, moved, iterations = last.x + dx, last.mu + dmu, max_abs(dx), last.iterations + 1
            ratio = accepted.ratio((0.0, expected(moved, last.moved)), (0.0, max_abs(x)), iterations)
            result = settings.status(ratio, iterations)
            return Increments(x, mu, moved, iterations, result)

        def step(iterate: Evaluated) -> Evaluated:
            """Forces of the last iterate, then a correction unless it has converged: one place for the forces compiles
            them once."""
            last = iterate.last
            forces = interval.forces(last.x, last.mu)
            return Evaluated(
                only_if(last.result == RUNNING, lambda last: corrected(last, forces), last), forces, last.result
            )

        running, none = jnp.asarray(RUNNING), Forces(jnp.zeros_like(x), jnp.zeros_like(interval.q), jnp.zeros_like(mu))
        start = Increments(x, mu, jnp.zeros(()), jnp.asarray(0), running)
        last, forces, _ = iterated(step, Evaluated(start, none, running))

        p, rows = interval.momentum(last.x, forces), interval.residual(last.x, forces)
        unknowns = guess._replace(fast=last.x.T[None], multiplier=last.mu.T[None])
        end = interval.q + last.x[:, -1], equations.p_s, p
        status = status_of(equations, last.result, Method.MODES, last.iterations, rows=max_abs(rows), end=end)
        return Solution(unknowns, end, status), memory

    def describe(self) -> list[str]:
        return ["modes: all variables of the interval at once, in modes of time"]
