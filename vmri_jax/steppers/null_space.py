"""Null space method: the equations of constrained variables without their multipliers.

In Newton's equations of a micro interval, or of the slow variables,

    A dq - G_0^T dmu = -r        G_1 dq = -g

multipliers act along the rows of G_0, the Jacobian at the start of the interval, and G_1, the Jacobian at its end,
holds the increments. With bases P_0, P_1 of the null spaces, ``G_0 P_0 = 0`` and ``G_1 P_1 = 0``, and right inverses
``G W = 1``, the increment is ``dq = P_1 z - W_1 g`` with as few unknowns z as there are free motions,

    (P_0^T A P_1) z = -P_0^T (r - A W_1 g)        dmu = W_0^T (A dq + r)

The multipliers follow afterwards, and are no unknowns of the linear system. A is a mass matrix up to order h^2, and so
is its projection: its condition number does not depend on the step. With multipliers it grows like 1 / h^2, unless they
are scaled as they are in `vmri_jax.schemes.equations`. At the root ``P_0^T r = 0``: the discrete null space method.

P and W come from a complete QR decomposition of G^T at each node.

Source: P. Betsch, The discrete null space method for the energy consistent integration of constrained mechanical
systems, part I, Comput. Methods Appl. Mech. Engng 194 (2005); S. Leyendecker, J. E. Marsden, M. Ortiz, Variational
integrators for constrained dynamical systems, ZAMM 88 (2008).
"""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag

from vmri_jax.kernels import inverse
from vmri_jax.kernels.saddle import saddle


def motions(jacobian):
    """Bases P (..., n, n - n_g) of the null space, and right inverses W (..., n, n_g), of independent rows G
    (..., n_g, n).

    The columns of P are orthonormal, and orthogonal to the columns of W.
    """
    n_g, n = jacobian.shape[-2:]
    if n_g == 0:
        eye = jnp.broadcast_to(jnp.eye(n), (*jacobian.shape[:-2], n, n))
        return eye, eye[..., :0]
    q, triangle = jnp.linalg.qr(jnp.swapaxes(jacobian, -1, -2), mode="complete")
    # G^T = (Y, P) (R; 0): G = R^T Y^T with the first n_g columns Y, and W = Y R^-T, since Y^T Y = 1
    square = jnp.swapaxes(triangle[..., :n_g, :], -1, -2)
    eye = jnp.broadcast_to(jnp.eye(n_g), square.shape)
    return q[..., n_g:], q[..., :n_g] @ jax.scipy.linalg.solve_triangular(square, eye, lower=True)


def inverse_with_multipliers(a, b, c, nodes: int, inverted=inverse):
    """The inverse of ``[[A, B], [C, 0]]`` by elimination, regularised for dependent constraints
    (`vmri_jax.kernels.saddle`); `inverted` inverts a matrix."""
    return inverted(saddle(a, b, c) if b.shape[-1] else a)


def inverse_without_multipliers(a, b, c, nodes: int):
    """Inverse of ``[[A, B], [C, 0]]`` with ``B = -G_0^T`` and ``C = G_1``, block diagonal with one block for each of
    the nodes."""
    if not b.shape[-1]:
        return jnp.linalg.inv(a)
    # unknowns times the square roots of masses: bases of free motions compare numbers of one unit
    root = 1 / jnp.sqrt(jnp.abs(jnp.diagonal(a)))
    scale = jnp.append(root, jnp.ones(b.shape[-1]))
    a, b, c = root[:, None] * a * root, root[:, None] * b, c * root
    at_nodes = (motions(_diagonal_blocks(g, nodes)) for g in (-b.T, c))
    (p_0, w_0), (p_1, w_1) = ([block_diag(*blocks) for blocks in of_g] for of_g in at_nodes)
    p_0, w_0 = p_0.T, w_0.T
    # For the right-hand sides (b, c): dq = free b + held c with free = P_1 (P_0^T A P_1)^-1 P_0^T, and dmu = W_0^T
    # (A dq - b)
    free = p_1 @ jnp.linalg.inv(p_0 @ a @ p_1) @ p_0
    held = w_1 - free @ (a @ w_1)
    top = jnp.concatenate([free, held], axis=-1)
    bottom = jnp.concatenate([w_0 @ (a @ free) - w_0, w_0 @ (a @ held)], axis=-1)
    return scale[:, None] * jnp.concatenate([top, bottom], axis=-2) * scale


def _diagonal_blocks(whole, nodes: int):
    """(r, n, m) blocks on the diagonal of a matrix (r n, r m)."""
    n, m = (size // nodes for size in whole.shape)
    return jnp.stack([whole[i * n : (i + 1) * n, i * m : (i + 1) * m] for i in range(nodes)])
