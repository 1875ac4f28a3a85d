"""Newton matrix of a macro step as local blocks, one set per micro interval; never a dense matrix.

Second derivatives are taken at single nodes, ``vmap(jacfwd(grad(term)))``, and chained with the constant
interpolation matrices of the path. Row bases are the slots (Lagrange basis l_0..l_r), column bases the unknowns
(start of the interval and increments), so that a block maps changes of the unknowns to changes of ``h D_j A``.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.discrete_lagrangian import QuadraticKinetic, lagrangian
from vmri_jax.equations import StepEquations, Unknowns, slow_basis_at_control_nodes
from vmri_jax.path import Nodes, control_node_groups, lagrange_basis, lagrange_derivative


class Blocks(eqx.Module):
    """Local blocks of the Newton matrix (index order: row slot, row coordinate, column slot, column coordinate).

    ff (num_micro, r+1, n_f, r+1, n_f): fast slots against [start, increments 1..r] of the same micro interval
    fs (num_micro, r+1, n_f, r, n_s): fast slots against slow increments
    sf (num_micro, r+1, n_s, r+1, n_f): slow slots against [start, increments] of each micro interval
    ss (r+1, n_s, r, n_s): slow slots against slow increments
    g_s, g_f (num_micro, r+1, n_g, n): constraint Jacobian at the control nodes 0..r of each micro interval
    g_slow (r+1, n_gs, n_s): slow constraint Jacobian at the slow control nodes
    basis (num_micro, r+1, r+1): slow Lagrange basis l_i at the control nodes
    """

    ff: Any
    fs: Any
    sf: Any
    ss: Any
    g_s: Any
    g_f: Any
    g_slow: Any
    basis: Any


def linearize(equations: StepEquations, x: Unknowns) -> Blocks:
    """Local blocks of the derivative of ``equations.residual`` at x."""
    system, scheme, path = equations.system, equations.scheme, equations.path(x)
    n, r, n_f = x.fast.shape
    n_s = x.slow.shape[1]
    ff, fs = jnp.zeros((n, r + 1, n_f, r + 1, n_f)), jnp.zeros((n, r + 1, n_f, r + 1, n_s))
    sf, ss = jnp.zeros((n, r + 1, n_s, r + 1, n_f)), jnp.zeros((r + 1, n_s, r + 1, n_s))
    blocks = [ff, fs, sf, ss]

    def add(nodes: Nodes, hessian: dict, weights):
        for i, pulled in enumerate(_pull_back(nodes, hessian, weights, path.macro_dt)):
            if pulled is not None:
                blocks[i] = blocks[i] + pulled

    for term in lagrangian(system, scheme).terms:
        if isinstance(term, QuadraticKinetic):
            for i, constant in ((0, _fast_mass(term)), (3, _slow_mass(term))):
                blocks[i] = blocks[i] + constant
        elif term.inside.groups:
            sample = term.inside.sample(path)
            z = {a: getattr(sample, a) for a in term.arguments}
            hessian = jax.vmap(
                jax.jacfwd(jax.grad(lambda z, term=term: term.integrand(*(z[a] for a in term.arguments))))
            )(z)
            add(term.inside, hessian, term.sign * path.macro_dt * equations.micro_dt * term.inside.weights)

    if system.force is not None:
        nodes = equations.force_nodes()
        sample = nodes.sample(path)
        arguments = ("q_s", "q_f", "v_s", "v_f")
        z = {a: getattr(sample, a) for a in arguments}
        force = lambda z, t: dict(zip(arguments, equations.force(t, *(z[a] for a in arguments)), strict=False))
        jacobian = jax.vmap(jax.jacfwd(force))
        add(nodes, jacobian(z, sample.t), path.macro_dt * equations.micro_dt * nodes.weights)

    g_s, g_f = jnp.zeros((n, r + 1, 0, n_s)), jnp.zeros((n, r + 1, 0, n_f))
    if system.constraint is not None:
        q_s, q_f = path.control_points()
        jacobians = jax.vmap(jax.jacrev(equations.constraint, argnums=(0, 1)))(q_s, q_f)
        g_s, g_f = (_per_interval(jacobian, n, r) for jacobian in jacobians)
        mu = x.multiplier.reshape(n * r, x.multiplier.shape[2])
        curvature = jax.jacfwd(jax.grad(lambda z, mu: -mu @ equations.constraint(z["q_s"], z["q_f"])))
        hessian = jax.vmap(curvature)({"q_s": q_s[:-1], "q_f": q_f[:-1]}, mu)
        by_group = jax.tree.map(lambda a: jnp.swapaxes(a.reshape(n, r, *a.shape[1:]), 0, 1).reshape(a.shape), hessian)
        add(control_node_groups(n, r), by_group, jnp.ones(n * r))

    g_slow = jnp.zeros((r + 1, 0, n_s))
    if system.slow_constraint is not None:
        q = path.slow_control_points()
        g_slow = jax.vmap(jax.jacrev(equations.slow_constraint))(q)
        curvature = jax.jacfwd(jax.grad(lambda q, nu: -nu @ equations.slow_constraint(q) / n))
        # the curvature at node i acts on slot i: l_i = 1 there and the increment i alone moves it
        hessian = jax.vmap(curvature)(q[1:-1], x.slow_multiplier[1:])
        i = np.arange(1, r)
        blocks[3] = blocks[3].at[i, :, i].add(hessian)

    ff, fs, sf, ss = blocks
    basis = jnp.asarray(slow_basis_at_control_nodes(n, r))
    return Blocks(ff, fs[..., 1:, :], sf, ss[:, :, 1:], g_s, g_f, g_slow, basis)


def _per_interval(at_nodes, num_micro: int, degree: int):
    """(num_micro r + 1, ...) values at control nodes as (num_micro, r + 1, ...), shared ones repeated."""
    starts = at_nodes[:-1].reshape(num_micro, degree, *at_nodes.shape[1:])
    ends = at_nodes[degree::degree]
    return jnp.concatenate([starts, ends[:, None]], axis=1)


def _fast_mass(term: QuadraticKinetic):
    return jnp.einsum("ij,ab->iajb", _from_increments(term.fast_form), _matrix(term.mass.fast))[None]


def _slow_mass(term: QuadraticKinetic):
    form = _from_increments(term.slow_form) / term.nodes.num_micro
    return jnp.einsum("ij,ab->iajb", form, _matrix(term.mass.slow))


def _from_increments(form):
    """Columns of a Lagrange-basis form for [start, increments]: the start moves all points, hence nothing."""
    return form.at[:, 0].set(0.0)


def _matrix(mass):
    return jnp.diag(mass) if mass.ndim == 1 else mass


def _pull_back(nodes: Nodes, hessian: dict, weights, macro_dt):
    """Contributions of node derivatives ``hessian[row][column]`` (k, n_row, n_column) to ff, fs, sf, ss."""
    out: list[Any] = [None] * 4
    for row, columns in hessian.items():
        for column, h in columns.items():
            block = 2 * (row[2] == "s") + (column[2] == "s")
            first = 0
            for g in nodes.groups:
                k = slice(first, first + g.size)
                first += g.size
                rows = _coefficients(nodes, g, row, macro_dt)
                cols = _coefficients(nodes, g, column, macro_dt)
                cols = cols.at[:, 0].set(1.0 if column[0] == "q" else 0.0)
                local = jnp.einsum("k,ki,kj,kab->kiajb", weights[k], rows, cols, h[k])
                if block == 3:
                    local = local.sum(0)
                else:
                    pad = [(g.first, nodes.num_micro - g.stop)] + [(0, 0)] * 4
                    local = jnp.pad(local, pad)
                out[block] = local if out[block] is None else out[block] + local
    return out


def _coefficients(nodes: Nodes, group, name: str, macro_dt):
    """How ``q_s``, ``q_f``, ``v_s`` or ``v_f`` at a group's nodes depends on the slots 0..r, shape (k, r + 1)."""
    slow, velocity = name[2] == "s", name[0] == "v"
    at = nodes.theta(group) if slow else np.full(group.size, group.c)
    if not velocity:
        return jnp.asarray(lagrange_basis(nodes.degree, at))
    return jnp.asarray(lagrange_derivative(nodes.degree, at)) / (macro_dt if slow else macro_dt / nodes.num_micro)


def apply(blocks: Blocks, x: Unknowns) -> Unknowns:
    """The Newton matrix times a vector, from the blocks."""
    n = x.fast.shape[0]
    start = jnp.concatenate([jnp.zeros_like(x.fast[:1, -1]), jnp.cumsum(x.fast[:-1, -1], axis=0)])
    fast = jnp.concatenate([start[:, None], x.fast], axis=1)  # [start, increments] of each micro interval
    increments = fast.at[:, 0].set(0.0)
    slow_at = jnp.einsum("mji,ia->mja", blocks.basis[..., 1:], x.slow)  # slow change at each control node

    fast_slots = jnp.einsum("miajb,mjb->mia", blocks.ff, fast) + jnp.einsum("miajb,jb->mia", blocks.fs, x.slow)
    fast_slots -= jnp.pad(jnp.einsum("mjga,mjg->mja", blocks.g_f[:, :-1], x.multiplier), [(0, 0), (0, 1), (0, 0)])
    incoming = jnp.concatenate([jnp.zeros_like(fast_slots[:1, -1]), fast_slots[:-1, -1]])

    slow_slots = jnp.einsum("miajb,mjb->ia", blocks.sf, fast) + jnp.einsum("iajb,jb->ia", blocks.ss, x.slow)
    slow_slots -= jnp.einsum("mji,mjga,mjg->ia", blocks.basis[:, :-1], blocks.g_s[:, :-1], x.multiplier)
    slow_slots -= jnp.pad(jnp.einsum("iga,ig->ia", blocks.g_slow[:-1], x.slow_multiplier) / n, [(0, 1), (0, 0)])

    return Unknowns(
        slow=slow_slots[:-1],
        slow_multiplier=jnp.einsum("iga,ia->ig", blocks.g_slow[1:], x.slow),
        fast=fast_slots[:, :-1].at[:, 0].add(incoming),
        multiplier=jnp.einsum("mjga,mja->mjg", blocks.g_f[:, 1:], start[:, None] + increments[:, 1:])
        + jnp.einsum("mjga,mja->mjg", blocks.g_s[:, 1:], slow_at[:, 1:]),
    )
