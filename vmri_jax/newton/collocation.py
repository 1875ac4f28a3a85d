"""One interval with a path of degree r > 1: all variables at once, by simplified Newton steps in modes of time.

With the Hessian of the potentials by the fast variables and the Jacobian of the constraints taken at one point, in the middle of
the step, the Newton matrix is

    [A x M - h^2 B x W'',  -I x G^T;  I x G,  0]

with A, B (r, r) the stiffness and the mass matrix of the polynomials in time, rows of the nodes 0..r-1, columns of 1..r. In the
eigenvectors of A^-1 B, which are known once and for all, it falls apart into one complex saddle per pair of eigenvalues gamma,

    [M - h^2 gamma W'',  -G^T;  G,  0],

so that matrices are of the size of the system, whatever the degree (Butcher 1976; Hairer, Wanner, Solving
Ordinary Differential Equations II, IV.8). The residual is exact, so that all of this decides only how many steps there are.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.algebra import ELEMENTWISE, inverse, largest, matmul, regularized
from vmri_jax.discrete_lagrangian import Term, lagrangian
from vmri_jax.equations import StepEquations, Unknowns
from vmri_jax.lanes import over_lanes
from vmri_jax.newton.interval import (
    Accepted,
    constant_mass,
    expected,
    inverse_mass,
    is_linear,
    is_per_coordinate,
)
from vmri_jax.path import control_nodes, lagrange_basis, lagrange_derivative
from vmri_jax.quadrature import interpolatory_weights
from vmri_jax.results import RUNNING
from vmri_jax.scheme import Scheme
from vmri_jax.structure import has_curvature
from vmri_jax.system import System

FEW_MODES = 4
"""Parts of no mode are added to more pairs of modes than that, if they are odd: half a vector register costs as much as a full one."""


def is_collocation(system: System, scheme: Scheme, q_s, q_f) -> bool:
    """Whether a step is a single interval of degree above one, with a small full matrix of the fast variables.

    A large one is better kept for many steps, which the march does.
    """
    small = (q_f.size or q_s.size) <= ELEMENTWISE
    if scheme.num_micro > 1 or scheme.degree == 1 or system.force is not None or not small:
        return False
    return not is_per_coordinate(system, scheme, q_f) and not is_linear(system, scheme, q_s, q_f)


class TimeModes(NamedTuple):
    """Eigenvectors of ``A^-1 B``, one of every complex pair.

    What has one entry per part of a mode has all real parts before all imaginary ones. Two real modes share what a complex one
    takes, and parts of no mode fill vector registers.

    gamma (2, modes): eigenvalues.
    mode (k,): which mode it is a part of.
    of_rows, of_values: (r, k) from the rows of the momentum equations (through A^-1) and from values at the nodes to modes.
    increments, multipliers: (k, r) from modes to increments, and (through A) to multipliers.
    """

    gamma: Any
    mode: Any
    of_rows: Any
    of_values: Any
    increments: Any
    multipliers: Any

    @classmethod
    def of(cls, scheme: Scheme) -> "TimeModes":
        """Of the polynomials and the nodes of the rules for T and W."""
        a, b = (
            _form(basis, scheme.degree, placed.rule.nodes)[:-1, 1:]
            for basis, placed in ((lagrange_derivative, scheme.kinetic), (lagrange_basis, scheme.fast))
        )
        gamma, vectors = np.linalg.eig(np.linalg.solve(a, b))
        order = np.argsort(-np.sign(np.imag(gamma)), kind="stable")  # of pairs, real ones, the others of pairs
        gamma, vectors = gamma[order], vectors[:, order]
        pairs, distinct = int(np.sum(np.imag(gamma) > 0)), int(np.sum(np.imag(gamma) >= 0))
        half = (pairs + distinct + 1) // 2
        first, second = np.arange(half), np.concatenate([np.arange(pairs), np.arange(half, distinct)])
        width = half + (half % 2 if half > FEW_MODES else 0)

        def parts(z):
            """Of modes (r, m), those of no mode zero."""
            imaginary = np.where(np.imag(gamma)[:, None] == 0, z.real, z.imag)
            some = z.real[first], imaginary[second]
            return np.concatenate([np.pad(a, [(0, width - len(a)), (0, 0)]) for a in some])

        to = np.linalg.inv(vectors)
        back = (np.where(np.imag(gamma) > 0, 2.0, 1.0) * vectors.conj()).T  # a mode and its conjugate: the real part
        mode = np.concatenate([np.pad(a, (0, width - len(a)), mode="edge") for a in (first, second)])
        eigenvalues = np.stack([np.real(gamma), np.imag(gamma)])[:, :distinct]
        return cls(eigenvalues, mode, parts(to @ np.linalg.inv(a)).T, parts(to).T, parts(back), parts(back @ a.T))


def _form(basis, degree: int, nodes) -> np.ndarray:
    """``sum_n w_n l_i(c_n) l_j(c_n)`` (r + 1, r + 1) of the interpolatory rule on these nodes."""
    at = basis(degree, np.array(nodes))
    return at.T @ (interpolatory_weights(nodes)[:, None] * at)


class Interval:
    """The equations of the step, with the variables joined, q = (q_s, q_f), and nodes as the last axis.

    soft, stiff: variables without curvature in the matrix, which are the slow ones, where there are others, and those that no
        potential bends; and all others.
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
        mass = constant_mass(self.system)
        self.velocities = inverse_mass(mass.slow), inverse_mass(mass.fast)
        self.soft, self.stiff = self._soft_and_stiff(separate=mass.slow.ndim == mass.fast.ndim == 1)
        self.at_start = self.jacobian(self.times[0], self.q)

    def _soft_and_stiff(self, separate: bool) -> tuple[np.ndarray, np.ndarray]:
        """Which variables these are; those that no potential bends are soft where masses are `separate`, not a matrix."""
        stiff = np.arange(self.q.size) >= (self.n_s if self.q.size > self.n_s else 0)
        bent = stiff & has_curvature(self.potential, self.q)
        stiff = bent if separate and bent.any() else stiff
        return np.flatnonzero(~stiff), np.flatnonzero(stiff)

    def constraints(self, t, q):
        """All constraints (n_c,) at one point."""
        return self.system.constraints(t, q[: self.n_s], q[self.n_s :])

    def jacobian(self, t, q):
        """Their Jacobian G (n_c, n)."""
        return jax.jacrev(self.constraints, argnums=1)(t, q)

    def times_mass(self, x):
        """``M x`` for (n, m)."""
        mass, parts = constant_mass(self.system), (x[: self.n_s], x[self.n_s :])
        return jnp.concatenate(
            [
                m[:, None] * a if m.ndim == 1 else matmul(m, a)
                for m, a in zip((mass.slow, mass.fast), parts, strict=True)
            ]
        )

    def over_mass(self, x):
        """``M^-1 x`` for (n, m)."""
        parts = x[: self.n_s], x[self.n_s :]
        return jnp.concatenate([velocity(a.T).T for velocity, a in zip(self.velocities, parts, strict=True)])

    def by_name(self, term: Term, q) -> tuple:
        """What a term takes of (n, ...) joined variables."""
        at = {"q_s": q[: self.n_s], "q_f": q[self.n_s :]}
        return tuple(at[name] for name in term.arguments)

    def potential(self, q):
        """All potentials at one point."""
        return sum((-term.sign * term.integrand(*self.by_name(term, q)) for term in self.potentials), jnp.zeros(()))

    def curvature(self, q):
        """``M^-1`` times the Hessian of the potentials (m, m) by the stiff variables."""
        soft = taken(q, self.soft)
        hessian = jax.hessian(lambda stiff: self.potential(self.joined(soft, stiff)))(taken(q, self.stiff))
        return taken(self.over_mass(self.joined(jnp.zeros((self.soft.size, self.stiff.size)), hessian)), self.stiff)

    def joined(self, soft, stiff):
        """All variables from the soft and the stiff ones."""
        return taken(jnp.concatenate([soft, stiff]), np.argsort(np.concatenate([self.soft, self.stiff])))

    def forces(self, x, mu):
        """Of potentials and constraints, times h: (n,) at the start of the step and (n, r) at the nodes 1..r, and constraints (n_c, r).

        Args:
            x, mu: increments (n, r) and multipliers (n_c, r).
        """
        q = self.q[:, None] + x  # at the nodes 1..r

        def at_node(at):
            t, q, mu = at
            g, pull = jax.vjp(lambda q: self.constraints(t, q), q)
            return g, -pull(mu)[0]

        later = jnp.concatenate([mu[:, 1:], jnp.zeros_like(mu[:, :1])], axis=1)
        g, total = over_lanes(at_node, self.r)((self.times[1:], q, later))
        first = -jnp.sum(mu[:, :1] * self.at_start, axis=0)
        for term in self.potentials:
            theta = np.concatenate([term.inside.theta(group) for group in term.inside.groups])
            basis, weights = lagrange_basis(self.r, theta), self.h**2 * term.inside.weights
            gradient = jax.grad(lambda q, term=term: term.sign * term.integrand(*self.by_name(term, q)))
            before, k = int(np.argmax(basis[0, 1:])), len(theta)
            consecutive = np.eye(self.r + 1)[before + 1 : before + 1 + k]
            if np.array_equal(basis, consecutive):  # nodes of the path: nothing to interpolate
                d = over_lanes(gradient, k)(q[:, before : before + k])
                total += jnp.pad(weights * d, ((0, 0), (before, self.r - before - k)))
            else:
                d = over_lanes(gradient, k)(self.q[:, None] + x @ basis[:, 1:].T)
                first += d @ (weights * basis[:, 0])
                total += d @ (weights[:, None] * basis[:, 1:])
        return first, total, g

    def residual(self, x, mu) -> "Residual":
        """Of increments (n, r) and multipliers (n_c, r)."""
        first, later, g = self.forces(x, mu)
        others = jnp.concatenate([(self.h * self.p + first)[:, None], later[:, :-1]], axis=1)
        rows = self.times_mass(x @ self.form[:, :-1]) + others
        return Residual(rows, g, later[:, -1])

    def momentum(self, x, residual: "Residual"):
        """At the end of the step (n,)."""
        return (self.times_mass(x @ self.form[:, -1:])[:, 0] + residual.last) / self.h


def taken(a, index: np.ndarray, axis: int = 0):
    """Known rows, or what is at an index of another axis, as slices."""
    runs = np.split(index, np.flatnonzero(np.diff(index) != 1) + 1)
    ends = ((int(run[0]), int(run[-1]) + 1) if run.size else (0, 0) for run in runs)
    return jnp.concatenate([jax.lax.slice_in_dim(a, *end, axis=axis) for end in ends], axis)


class Residual(NamedTuple):
    """Of the equations of a step.

    rows (n, r): momentum equations of the nodes 0..r-1, times h.
    g (n_c, r): constraints at the nodes 1..r.
    last (n,): forces at the end of the step, times h.
    """

    rows: Any
    g: Any
    last: Any


class Saddles(NamedTuple):
    """The saddles of all modes, eliminated: the n variables first (m of them with curvature), then the n_c constraints.

    interval: which variables are soft and which are stiff.
    gamma (2, k): eigenvalues, for every part of a mode as in `TimeModes`, as all that has k.
    curvature (m, m): ``w = h^2 M^-1 W''``.
    denominator (m, m, k): inverses of ``|1 - gamma w|^2``.
    push: G by the soft (n_c, n - m) and by the stiff variables (n_c, m).
    pull_soft (n - m, n_c), pull two of (n_c, m, k): G^T through the inverses of ``M`` and ``M - h^2 gamma W''``.
    schur two of (n_c, n_c, k): inverse of G times these.
    """

    interval: Interval
    gamma: Any
    curvature: Any
    denominator: Any
    push: Any
    pull_soft: Any
    pull: Any
    schur: Any

    @classmethod
    def at(cls, interval: Interval, modes: TimeModes, t, q) -> "Saddles":
        """With Hessian and Jacobian at a point."""
        w, push = interval.h**2 * interval.curvature(q), interval.jacobian(t, q)
        push_soft, push_stiff = taken(push.T, interval.soft).T, taken(push.T, interval.stiff).T
        k, m, n_c = modes.gamma.shape[1], len(w), len(push)
        re, im = modes.gamma[:, :, None, None]  # modes are the first axis until the end

        def of_parts(z):
            """(modes, rows, columns) as (columns, rows, k)."""
            return taken(jnp.swapaxes(z, 0, 2), modes.mode, axis=2)

        denominator = inverse(np.eye(m) - 2 * re * w + (re**2 + im**2) * matmul(w, w))

        over_mass = interval.over_mass(push.T)
        pull_soft, straight = taken(over_mass, interval.soft), taken(over_mass, interval.stiff)
        columns = jnp.concatenate([straight, matmul(w, straight)], axis=1)
        through = (denominator.reshape(k * m, m) @ columns).reshape(k, m, 2 * n_c)

        def parts(z):
            """Real and imaginary part of ``(1 - conj(gamma) w) / |1 - gamma w|^2``, from the columns without and with w."""
            return z[..., :n_c] - re * z[..., n_c:], im * z[..., n_c:]

        real, imaginary = parts(matmul(push_stiff, through))
        real += matmul(push_soft, pull_soft)
        schur = inverse(regularized(jax.lax.complex(real, imaginary)))

        gamma = modes.gamma[:, modes.mode]
        pull, schur = ([of_parts(a) for a in both] for both in (parts(through), (schur.real, schur.imag)))
        return cls(interval, gamma, w, of_parts(denominator), (push_soft, push_stiff), pull_soft, pull, schur)

    def solve(self, y, g):
        """x (n, k) and nu (n_c, k) with ``(M - h^2 gamma W'') x - G^T nu = M y`` and ``G x = g``."""
        push_soft, push_stiff = self.push
        x_soft, y = taken(y, self.interval.soft), taken(y, self.interval.stiff)
        bent, (re, im) = matmul(self.curvature, y), self.gamma
        y = y - (re * bent - im * times_i(bent))
        products = (a * row for a, row in zip(self.denominator, y, strict=True))
        x = reduce(jnp.add, products)  # written out: within a sum y would be made anew for every row

        nu = product(self.schur, g - matmul(push_soft, x_soft) - matmul(push_stiff, x))
        x += product(self.pull, nu)
        return self.interval.joined(x_soft + matmul(self.pull_soft, nu), x), nu


def times_i(z):
    """Complex numbers, all real parts before all imaginary ones."""
    re, im = jnp.split(z, 2, axis=-1)
    return jnp.concatenate([-im, re], axis=-1)


def product(matrix, z):
    """Of complex matrices, their real and their imaginary parts (columns, rows, k), and vectors (columns, k)."""
    re, im = matrix
    return jnp.sum(re * z[:, None] + im * times_i(z)[:, None], axis=0)


class Iterate(NamedTuple):
    """State of the iteration: increments x (n, r), multipliers mu (n_c, r), their residual, largest corrections, and how it stands."""

    x: Any
    mu: Any
    residual: Residual
    moved: Any
    iterations: Any
    result: Any


def solve(equations: StepEquations, guess: Unknowns, newton) -> tuple[Iterate, Unknowns, Any, Any]:
    """Newton steps until one more would change no increment.

    What it would change them by is known from how the corrections shrink. Accepted are changes of ``newton.tolerance``
    relative to the motion over the step, and round-off of the positions.

    Returns:
        (state of the iteration, unknowns, (q_f, p_s, p_f) at the end of the step, largest row of the momentum equations (times h)
        and largest value of a constraint)
    """
    interval, modes = Interval(equations), TimeModes.of(equations.scheme)
    n_s, (n_g, _) = interval.n_s, equations.system.num_constraints(equations.q_s, equations.q_f)
    x = jnp.concatenate([guess.slow, guess.fast[0]], axis=1).T
    mu = jnp.concatenate([guess.multiplier[0], guess.slow_multiplier], axis=1).T
    saddles = Saddles.at(interval, modes, equations.t + interval.h / 2, interval.q + x[:, -1] / 2)
    accepted = Accepted.of(equations, newton)

    def slow_and_fast(x):
        return largest(x[:n_s]), largest(x[n_s:])

    def step(last: Iterate) -> Iterate:
        rows, g, _ = last.residual
        dx, nu = saddles.solve(-interval.over_mass(rows) @ modes.of_rows, -g @ modes.of_values)
        dx, dmu = dx @ modes.increments, nu @ modes.multipliers
        x, mu, moved, iterations = last.x + dx, last.mu + dmu, slow_and_fast(dx), last.iterations + 1
        left = map(expected, moved, last.moved)
        result = newton.status(accepted.over(left, slow_and_fast(x)), iterations)
        return Iterate(x, mu, interval.residual(x, mu), moved, iterations, result)

    start = Iterate(x, mu, interval.residual(x, mu), (jnp.zeros(()),) * 2, jnp.asarray(0), jnp.asarray(RUNNING))
    done = newton.iterate(step, start)
    p, (rows, g, _) = interval.momentum(done.x, done.residual), done.residual
    x, mu = done.x.T, done.mu.T
    unknowns = Unknowns(x[:, :n_s], mu[:, n_g:], x[None, :, n_s:], mu[None, :, :n_g])
    return done, unknowns, (equations.q_f + x[-1, n_s:], p[:n_s], p[n_s:]), (largest(rows), largest(g))
