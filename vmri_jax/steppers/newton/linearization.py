"""Newton matrix of a macro step as local blocks, one set per micro interval; never a dense matrix.

Second derivatives are taken at single nodes, ``vmap(jacfwd(grad(term)))``, and chained with the constant
interpolation matrices of the path. Row bases are the slots (Lagrange basis l_0..l_r), column bases the unknowns
(start of the interval and increments), so that a block maps changes of the unknowns to changes of ``h D_j A``.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vmri_jax.schemes.discrete_lagrangian import QuadraticKinetic, lagrangian
from vmri_jax.schemes.equations import StepEquations, Unknowns, slow_basis_at_control_nodes
from vmri_jax.schemes.path import NodeGroup, Nodes, control_node_groups, lagrange_basis, lagrange_derivative


class Blocks(NamedTuple):
    """Local blocks of the Newton matrix (index order: row slot, row coordinate, column slot, column coordinate).

    ff: fast slots against [start, increments 1..r] of the same micro interval
    fs: fast slots against slow increments
    sf: slow slots against [start, increments] of each micro interval
    ss: slow slots against slow increments
    g_s, g_f: constraint Jacobian at the control nodes 0..r of each micro interval
    g_slow: slow constraint Jacobian at the slow control nodes
    basis: slow Lagrange basis l_i at the control nodes
    """

    ff: Float[Array, "num_micro r+1 n_f r+1 n_f"]
    fs: Float[Array, "num_micro r+1 n_f r n_s"]
    sf: Float[Array, "num_micro r+1 n_s r+1 n_f"]
    ss: Float[Array, "r+1 n_s r n_s"]
    g_s: Float[Array, "num_micro r+1 n_g n_s"]
    g_f: Float[Array, "num_micro r+1 n_g n_f"]
    g_slow: Float[Array, "r+1 n_gs n_s"]
    basis: Float[Array, "num_micro r+1 r+1"]


def linearize(equations: StepEquations, x: Unknowns) -> Blocks:
    """Local blocks of the derivative of ``equations.residual`` at x."""
    system, scheme, path = equations.system, equations.scheme, equations.path(x)
    n, r, n_f = x.fast.shape
    n_s = x.slow.shape[1]
    blocks = {
        "ff": jnp.zeros((n, r + 1, n_f, r + 1, n_f)),
        "fs": jnp.zeros((n, r + 1, n_f, r + 1, n_s)),
        "sf": jnp.zeros((n, r + 1, n_s, r + 1, n_f)),
        "ss": jnp.zeros((r + 1, n_s, r + 1, n_s)),
    }

    def add(nodes: Nodes, derivatives: dict, weights):
        for row, columns in derivatives.items():
            for column, derivative in columns.items():
                pulled = _pull_back(nodes, row, column, derivative, weights, path.macro_dt)
                blocks[row[2] + column[2]] += pulled

    for term in lagrangian(system, scheme).terms:
        if isinstance(term, QuadraticKinetic):
            blocks["ff"] += _constant_block(term.fast_form, term.mass.fast_mass.matrix)
            blocks["ss"] += _constant_block(term.slow_form / n, term.mass.slow_mass.matrix)
        elif term.inside.groups:
            z = term.inside.sample(path, term.arguments)
            hessian = jax.vmap(jax.jacfwd(jax.grad(_of_dict(term.integrand, term.arguments))))(z)
            factor = term.sign * term.times_step(path.macro_dt) * equations.micro_dt
            add(term.inside, hessian, factor * term.inside.weights)

    if system.force is not None:
        nodes = equations.force_nodes
        z = nodes.sample(path, ("t", "q_s", "q_f", "v_s", "v_f"))
        force = _of_dict(system.forces, tuple(z))
        jacobian = jax.vmap(jax.jacfwd(lambda z: dict(zip(("q_s", "q_f"), force(z), strict=True))))(z)
        jacobian = {row: {c: d for c, d in columns.items() if c != "t"} for row, columns in jacobian.items()}
        add(nodes, jacobian, path.macro_dt * equations.micro_dt * nodes.weights)

    q_s, q_f = path.control_points()
    t = path.control_times()
    g_s, g_f = (_per_interval(d, n, r) for d in jax.vmap(jax.jacrev(system.g, argnums=(1, 2)))(t, q_s, q_f))
    if system.constraint is not None:
        nodes = control_node_groups(n, r)
        mu = x.multiplier.reshape(n * r, x.multiplier.shape[2])
        curvature = jax.jacfwd(jax.grad(lambda z, t, mu: -mu @ system.g(t, z["q_s"], z["q_f"])))
        hessian = jax.vmap(curvature)({"q_s": q_s[:-1], "q_f": q_f[:-1]}, t[:-1], mu)
        add(nodes, jax.tree.map(lambda d: _group_by_node(d, n, r), hessian), nodes.weights)

    t, q = path.slow_control_times(), path.slow_control_points()
    g_slow = jax.vmap(jax.jacrev(system.g_slow, argnums=1))(t, q)
    if system.slow_constraint is not None and r > 1:
        # the slow control point i moves with increment i alone, and node 0 does not move
        curvature = jax.jacfwd(jax.grad(lambda q, t, nu: -nu @ system.g_slow(t, q) / n))
        i = np.arange(1, r)
        blocks["ss"] = blocks["ss"].at[i, :, i].add(jax.vmap(curvature)(q[1:-1], t[1:-1], x.slow_multiplier[1:]))

    return Blocks(
        blocks["ff"],
        blocks["fs"][..., 1:, :],
        blocks["sf"],
        blocks["ss"][:, :, 1:],
        g_s,
        g_f,
        g_slow,
        jnp.asarray(slow_basis_at_control_nodes(n, r)),
    )


def _of_dict(function, arguments: tuple[str, ...]):
    """A function of a dict of named arguments, so that its derivatives come out by name."""
    return lambda z: function(*(z[a] for a in arguments))


def _per_interval(at_nodes, num_micro: int, degree: int):
    """(num_micro r + 1, ...) values at control nodes as (num_micro, r + 1, ...), shared ones repeated."""
    starts = at_nodes[:-1].reshape(num_micro, degree, *at_nodes.shape[1:])
    ends = at_nodes[degree::degree]
    return jnp.concatenate([starts, ends[:, None]], axis=1)


def _group_by_node(at_nodes, num_micro: int, degree: int):
    """(num_micro r, ...) values interval by interval, reordered as `control_node_groups` has them."""
    by_interval = at_nodes.reshape(num_micro, degree, *at_nodes.shape[1:])
    return jnp.swapaxes(by_interval, 0, 1).reshape(at_nodes.shape)


def _constant_block(form, matrix):
    """Mass times a quadratic form in the increments: the start moves all points alike, hence nothing."""
    return jnp.einsum("ij,ab->iajb", form.at[:, 0].set(0.0), matrix)


def _pull_back(nodes: Nodes, row: str, column: str, derivative, weights, macro_dt):
    """Node derivatives (k, n_row, n_column) by ``row`` and ``column``, as a block of slots against unknowns."""
    total, first = 0.0, 0
    for group in nodes.groups:
        k = slice(first, first + group.size)
        first += group.size
        rows = _dependence(nodes, group, row, macro_dt)
        columns = _dependence(nodes, group, column, macro_dt)
        columns = columns.at[:, 0].set(1.0 if column[0] == "q" else 0.0)  # of the start, at fixed increments
        block = jnp.einsum("k,ki,kj,kab->kiajb", weights[k], rows, columns, derivative[k])
        if row[2] == column[2] == "s":
            total += block.sum(0)
        else:
            total += jnp.pad(block, [(group.first, nodes.num_micro - group.stop)] + [(0, 0)] * 4)
    return total


def _dependence(nodes: Nodes, group: NodeGroup, name: str, macro_dt):
    """How ``q_s``, ``q_f``, ``v_s`` or ``v_f`` at a group's nodes depends on the slots 0..r, shape (k, r + 1)."""
    slow, velocity = name[2] == "s", name[0] == "v"
    at = nodes.theta(group) if slow else np.full(group.size, group.c)
    if not velocity:
        return jnp.asarray(lagrange_basis(nodes.degree, at))
    return jnp.asarray(lagrange_derivative(nodes.degree, at)) / (macro_dt if slow else macro_dt / nodes.num_micro)
