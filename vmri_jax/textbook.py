"""The whole method on one page: variational multirate integration as in a textbook, written for reading, not for speed.

A macro step of length H carries a slow polynomial of degree r, and one fast polynomial of degree r on each of its
``num_micro`` micro intervals. Both go through control points at Gauss-Lobatto nodes, S_0..S_r and F_0..F_{num_micro r}.
The discrete Lagrangian is a sum over the terms of the Lagrangian, each at the nodes of its own quadrature rule,

    L_d(S, F) = sum over terms, over nodes i:  H w_i term(q(theta_i), qdot(theta_i)),

and multipliers hold the constraints at the control nodes. With the quadrature weights absorbed in the multipliers the
augmented action is

    A = L_d - sum_j lambda_j . g(node j) - sum_i nu_i . g_s(S_i)              (all control nodes but the last).

A step solves, from the momenta p at its start,

    p + D_first A = 0,    D_inner A = 0,    g = 0 and g_s = 0 at all control nodes but the first,

and ends with ``p+ = D_last A``, projected onto the hidden constraints ``G v + dg/dt = 0``. Kicks are rules with nodes
at the ends of the step; forces enter by their virtual work, and a composition is a sequence of steps. The steppers of
`vmri_jax.simulate` solve the same equations faster; tests compare them with this page. Source: Ober-Bloebaum, Wenger,
Gail, Leyendecker 2024, arXiv:2406.12991.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpy.polynomial import Polynomial

from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.path import velocity_nodes
from vmri_jax.schemes.quadrature import NODE_TOLERANCE, PlacedRule, macro
from vmri_jax.schemes.scheme import Scheme


class Unknowns(NamedTuple):
    """Unknowns of a step: all control points but the first, and the multipliers at all control nodes but the last.

    slow, fast: (r, n_s) and (num_micro r, n_f).
    multiplier, slow_multiplier: (num_micro r, n_g) and (r, n_gs).
    """

    slow: Any
    fast: Any
    multiplier: Any
    slow_multiplier: Any


class Samples(NamedTuple):
    """Positions and velocities (k, n) of the path at the k nodes theta of a rule, and the weights (k,) of the nodes."""

    theta: Any
    q_s: Any
    q_f: Any
    v_s: Any
    v_f: Any
    weights: Any


def lagrange_polynomials(scheme: Scheme) -> list[Polynomial]:
    """The polynomials l_j of degree r with ``l_j(c_k) = delta_jk`` at the control nodes c_k of [0, 1]."""
    nodes = np.array(scheme.slow_constraint.rule.nodes)
    products = [Polynomial.fromroots(np.delete(nodes, j)) for j in range(len(nodes))]
    return [product / product(c) for product, c in zip(products, nodes, strict=True)]


def quadrature_nodes(placed: PlacedRule, num_micro: int):
    """Nodes theta_i in [0, 1], the micro interval in which each lies, and weights.

    Where two micro intervals meet, each copy of a rule on the micro grid has a node of its own, because the fast
    velocity has two values there.
    """
    nodes = np.array(placed.rule.nodes)
    if placed.grid == "macro":
        interval = np.minimum(np.floor(nodes * num_micro + NODE_TOLERANCE).astype(int), num_micro - 1)
        return nodes, interval, jnp.asarray(placed.rule.weights)
    copies = num_micro // placed.every  # of the rule, each over `every` micro intervals
    first = np.repeat(np.arange(copies), len(nodes)) * placed.every
    inside = np.tile(nodes, copies) * placed.every
    interval = first + np.minimum(np.floor(inside + NODE_TOLERANCE).astype(int), placed.every - 1)
    return (first + inside) / num_micro, interval, jnp.tile(placed.rule.weights, copies) / copies


def sample(scheme: Scheme, placed: PlacedRule, slow, fast, macro_dt) -> Samples:
    """The path through the control points at the nodes of a rule."""
    r, n, basis = scheme.degree, scheme.num_micro, lagrange_polynomials(scheme)
    theta, interval, weights = quadrature_nodes(placed, n)
    local = theta * n - interval
    # (k, r + 1, n_f): fast control points of the micro interval in which each node lies
    points = fast[interval[:, None] * r + np.arange(r + 1)]
    slopes = [polynomial.deriv() for polynomial in basis]

    def values(polynomials, arguments):
        return np.stack([polynomial(arguments) for polynomial in polynomials], axis=1)

    # q_s(theta) = sum_j l_j(theta) S_j and its derivative with respect to t = H theta; the fast path alike, on
    # intervals of length H / num_micro
    return Samples(
        theta,
        values(basis, theta) @ slow,
        jnp.einsum("kj,kjn->kn", values(basis, local), points),
        values(slopes, theta) @ slow / macro_dt,
        jnp.einsum("kj,kjn->kn", values(slopes, local), points) / (macro_dt / n),
        weights,
    )


def discrete_lagrangian(system: System, scheme: Scheme) -> Callable:
    """The discrete Lagrangian ``L_d = sum H w_i (T - V - W - sum_j V_j)`` of a macro step,
    ``L_d(slow, fast, macro_dt) -> ()``.

    Arguments of L_d: (r + 1, n_s) slow and (num_micro r + 1, n_f) fast control points, shared ones once, and the length
    H of the step. Its derivatives by the control points are ``jax.grad(L_d, argnums=(0, 1))``; the first and the last
    of them are the `discrete_legendre` transforms.

    Raises:
        ValueError: mollified kicks, corrected kicks without a ConstantMass, velocities on the border of two micro
            intervals; of L_d, other numbers of control points.
    """
    check("discrete_lagrangian", system, scheme)

    def L_d(slow, fast, macro_dt):
        expected = (scheme.degree + 1, scheme.num_micro * scheme.degree + 1)
        if (slow.shape[0], fast.shape[0]) != expected:
            raise Refused(
                f"L_d: got {slow.shape[0]} slow and {fast.shape[0]} fast control points; this scheme has {expected[0]} "
                f"and {expected[1]}."
            )

        def action(placed, term):
            path = sample(scheme, placed, slow, fast, macro_dt)
            return macro_dt * jnp.sum(path.weights * jax.vmap(term)(path.q_s, path.q_f, path.v_s, path.v_f))

        slow_potential, fast_potential = potentials(system, scheme, macro_dt)
        T, T_s = system.kinetic, system.slow_kinetic
        total = action(scheme.kinetic, lambda q_s, q_f, v_s, v_f: T(q_s, q_f, v_s, v_f, system.params))
        if T_s is not None:  # has a rule on the macro grid
            total += action(macro(scheme.kinetic.rule), lambda q_s, q_f, v_s, v_f: T_s(q_s, v_s, system.params))
        total -= action(scheme.slow, lambda q_s, q_f, v_s, v_f: slow_potential(q_s, q_f))
        total -= action(scheme.fast, lambda q_s, q_f, v_s, v_f: fast_potential(q_s, q_f))
        for name, V in system.potentials.items():
            total -= action(scheme.rule_of(name), lambda q_s, q_f, v_s, v_f, V=V: V(q_s, q_f, system.params))
        return total

    return L_d


def discrete_legendre(system: System, scheme: Scheme) -> Callable:
    """Discrete Legendre transforms ``(slow, fast, macro_dt) -> ((p_s, p_f) at the start, (p_s, p_f) at the end)``.

    ``p = -D_first L_d`` and ``p+ = D_last L_d`` (without constraint forces). Arguments as of `discrete_lagrangian`.
    """
    slots = jax.grad(discrete_lagrangian(system, scheme), argnums=(0, 1))

    def transforms(slow, fast, macro_dt):
        d_slow, d_fast = slots(slow, fast, macro_dt)
        return (-d_slow[0], -d_fast[0]), (d_slow[-1], d_fast[-1])

    return transforms


def potentials(system: System, scheme: Scheme, macro_dt) -> tuple[Callable, Callable]:
    """V and W as functions of (q_s, q_f), corrected where their rules are, see `quadrature.gradient_corrected`:

        V - H^2 / 24 V_q M^-1 V_q - h^2 / 12 V_q M^-1 W_q,    W - h^2 / 24 W_q M^-1 W_q,

    where the mixed term appears only if both rules are corrected.
    """
    micro_dt = macro_dt / scheme.num_micro
    mass: Any = system.kinetic

    def V(q_s, q_f):
        return system.slow_potential(q_s, q_f, system.params) if system.slow_potential else 0.0 * jnp.sum(q_s)

    def W(q_s, q_f):
        return system.fast_potential(q_f, system.params) if system.fast_potential else 0.0 * jnp.sum(q_f)

    def product(A, B, q_s, q_f):
        a, b = (jax.grad(potential, argnums=(0, 1))(q_s, q_f) for potential in (A, B))
        return sum(jnp.sum(x * y) for x, y in zip(a, mass.velocity(*b), strict=True))

    def corrected_V(q_s, q_f):
        mixed = micro_dt**2 / 12 * product(V, W, q_s, q_f) if scheme.fast.gradient_corrected else 0.0
        return V(q_s, q_f) - macro_dt**2 / 24 * product(V, V, q_s, q_f) - mixed

    def corrected_W(q_s, q_f):
        return W(q_s, q_f) - micro_dt**2 / 24 * product(W, W, q_s, q_f)

    return corrected_V if scheme.slow.gradient_corrected else V, corrected_W if scheme.fast.gradient_corrected else W


def virtual_work(system: System, scheme: Scheme, path, along, t, macro_dt):
    """Lagrange-d'Alembert: ``sum H w_i F(t_i, q_i, v_i) . Q_i``, with q_i and v_i on the path `along`, which is not
    varied, and Q_i on `path`."""
    known, varied = (sample(scheme, scheme.force, slow, fast, macro_dt) for slow, fast in (along, path))
    f_s, f_f = jax.vmap(system.forces)(t + macro_dt * known.theta, known.q_s, known.q_f, known.v_s, known.v_f)
    weights = varied.weights[:, None]
    return macro_dt * (jnp.sum(weights * f_s * varied.q_s) + jnp.sum(weights * f_f * varied.q_f))


def constraints(system: System, scheme: Scheme, slow, fast, t, macro_dt):
    """g at all micro control nodes (num_micro r + 1, n_g), and g_s at all macro control nodes (r + 1, n_gs)."""
    theta = np.array(scheme.constraint.composite(scheme.num_micro).nodes)
    q_s = np.stack([polynomial(theta) for polynomial in lagrange_polynomials(scheme)], axis=1) @ slow
    slow_theta = np.array(scheme.slow_constraint.rule.nodes)
    return jax.vmap(system.g)(t + macro_dt * theta, q_s, fast), jax.vmap(system.g_slow)(t + macro_dt * slow_theta, slow)


def solver(residual: Callable, guess, max_iterations: int = 50):
    """The root of ``residual(x)``, with the shapes of `guess`, by Newton's method; NaN where the method does not
    converge.

    The method iterates until a change is below 1e-9 of x, and then once more, which reaches round-off. The root can be
    differentiated, by the implicit function theorem.
    """
    start, unravel = ravel_pytree(guess)

    def flat_residual(x):
        return ravel_pytree(residual(unravel(x)))[0]

    def solve(residual, x):
        def iteration(carry):
            x, _, last_change, k = carry
            change = jnp.linalg.solve(jax.jacfwd(residual)(x), residual(x))  # full Jacobian, at every x
            size = jnp.max(jnp.abs(change)) / (jnp.max(jnp.abs(x)) + 1e-300)
            return x - change, last_change, size, k + 1

        def goes_on(carry):
            return (carry[1] > 1e-9) & (carry[3] < max_iterations)

        x, last_but_one, _, _ = jax.lax.while_loop(goes_on, iteration, (x, jnp.inf, jnp.inf, 0))
        return jnp.where(last_but_one <= 1e-9, x, jnp.nan)

    def solve_linear(product, y):
        return jnp.linalg.solve(jax.jacfwd(product)(jnp.zeros_like(y)), y)

    return unravel(jax.lax.custom_root(flat_residual, start, solve, solve_linear))


def project(system: System, state: State, v_s, v_f):
    """The state with its momenta on the hidden constraints, ``p - G^T mu = dT/dv`` with ``G v + dg/dt = 0``, and v.

    Args:
        v_s, v_f: velocities from which Newton's method starts.
    """
    t, q_s, q_f = state.t, state.q_s, state.q_f
    values, pull = jax.vjp(lambda q_s, q_f: system.constraints(t, q_s, q_f), q_s, q_f)

    # unknowns v and mu:  dT/dv(q, v) + G^T mu = p,    G v + dg/dt = 0
    def residual(x):
        v_s, v_f, mu = x
        p_s, p_f = jax.grad(system.kinetic_energy, argnums=(2, 3))(q_s, q_f, v_s, v_f)
        force_s, force_f = pull(mu)
        rates = system.constraint_rates(t, q_s, q_f, v_s, v_f)
        return p_s + force_s - state.p_s, p_f + force_f - state.p_f, rates

    v_s, v_f, mu = solver(residual, (v_s, v_f, jnp.zeros_like(values)))
    force_s, force_f = pull(mu)
    return State(t, q_s, q_f, state.p_s - force_s, state.p_f - force_f), (v_s, v_f)


def step(system: System, scheme: Scheme | Composition, state: State, macro_dt) -> State:
    """One macro step; the state is NaN where Newton's method does not converge.

    Args:
        system: the mechanical system.
        scheme: the scheme, or a composition, whose stages are steps one after the other.
        state: a consistent state, from `vmri_jax.initial_state` or an earlier step.
        macro_dt: length H of the macro step.

    Raises:
        ValueError: a scheme with mollified kicks, or corrected kicks without a ConstantMass.
    """
    if isinstance(scheme, Composition):
        stages = macro_dt * jnp.asarray(scheme.coefficients)
        return jax.lax.scan(lambda state, dt: (step(system, scheme.scheme, state, dt), None), state, stages)[0]
    check("textbook.step", system, scheme)
    L_d = discrete_lagrangian(system, scheme)
    n, r, t = scheme.num_micro, scheme.degree, state.t
    micro_dt = macro_dt / n

    def path(x: Unknowns):
        return jnp.concatenate([state.q_s[None], x.slow]), jnp.concatenate([state.q_f[None], x.fast])

    def action(path, along, x: Unknowns):
        """A times h: Newton's matrix then has entries of the size of masses and constraint Jacobians at every step
        size."""
        slow, fast = path
        g, g_slow = constraints(system, scheme, slow, fast, t, macro_dt)
        free = L_d(slow, fast, macro_dt) + virtual_work(system, scheme, path, along, t, macro_dt)
        return micro_dt * free - jnp.sum(x.multiplier * g[:-1]) - jnp.sum(x.slow_multiplier * g_slow[:-1])

    def slots(x: Unknowns):
        """h D A: derivatives with respect to every slow and every fast control point, with the forces of the path held
        fixed."""
        return jax.grad(action)(path(x), path(x), x)

    # h (p + D_first A) = 0,    h D_inner A = 0,    g = 0 and g_s = 0 at all control nodes but the first
    def residual(x: Unknowns) -> Unknowns:
        d_slow, d_fast = slots(x)
        g, g_slow = constraints(system, scheme, *path(x), t, macro_dt)
        d_slow, d_fast = d_slow.at[0].add(micro_dt * state.p_s), d_fast.at[0].add(micro_dt * state.p_f)
        return Unknowns(d_slow[:-1], d_fast[:-1], g[1:], g_slow[1:])

    _, (v_s, v_f) = project(system, state, jnp.zeros_like(state.q_s), jnp.zeros_like(state.q_f))
    theta, slow_theta = (
        np.array(rule.nodes)[1:, None] for rule in (scheme.constraint.composite(n), scheme.slow_constraint.rule)
    )
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    # Newton's method starts from uniform motion, with the velocity that belongs to p
    straight = state.q_s + macro_dt * slow_theta * v_s, state.q_f + macro_dt * theta * v_f
    x = solver(residual, Unknowns(*straight, jnp.zeros((n * r, n_g)), jnp.zeros((r, n_gs))))
    d_slow, d_fast = slots(x)
    end = State(t + macro_dt, x.slow[-1], x.fast[-1], d_slow[-1] / micro_dt, d_fast[-1] / micro_dt)
    return project(system, end, v_s, v_f)[0]


def check(caller: str, system: System, scheme: Scheme) -> None:
    """Refuse schemes that this page leaves out, or that have no meaning."""
    if scheme.slow.mollified:
        raise Refused(
            f"{caller}: the slow potential of this scheme is mollified, it depends on more than the control points of "
            "a step; take macro_step or simulate, or a scheme without mollified kicks, e.g. "
            "explicit_slow(num_micro)."
        )
    if (scheme.slow.gradient_corrected or scheme.fast.gradient_corrected) and not system.has_constant_mass:
        raise Refused(f"{caller}: corrected kicks need a System whose kinetic is a ConstantMass.")
    if system.force is not None:
        velocity_nodes(scheme.force, scheme.num_micro, scheme.degree)  # raises


def simulate(system: System, scheme: Scheme | Composition, state: State, macro_dt, num_steps: int) -> State:
    """The states after 0, 1, ..., num_steps macro steps, stacked along a first axis."""

    def go_on(state, _):
        state = step(system, scheme, state, macro_dt)
        return state, state

    later = jax.lax.scan(go_on, state, length=num_steps)[1]
    return jax.tree.map(lambda start, ends: jnp.concatenate([jnp.asarray(start)[None], ends]), state, later)
