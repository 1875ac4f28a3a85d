"""The linear-quadratic problem of N stages, solved by one sweep back and one forward: time O(N).

    min  sum_k (1/2 (dz, du) H_k (dz, du) + h_k . (dz, du))_k + 1/2 dz_N S dz_N + s . dz_N
    dz_{k+1} = A_k dz_k + B_k du_k + c_k        dz_0 = 0        G dz_N + g = 0

The cost from a stage on is quadratic in dz and in the multipliers nu of the goal,
``1/2 dz S dz + s . dz + nu . (M^T dz + m) - 1/2 nu W nu``; the sweep back carries its coefficients, W is the Gramian of
the goal.

Source: A. E. Bryson, Y.-C. Ho, Applied Optimal Control, Hemisphere (1975), section 5.3.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from vmri_jax.mechanics.arrays import Numbers


class Stages(NamedTuple):
    """The N stages; a state has n numbers, a control m."""

    hessian: Float[Numbers, "N n+m n+m"]
    gradient: Float[Numbers, "N n+m"]
    A: Float[Numbers, "N n n"]
    B: Float[Numbers, "N n m"]
    c: Float[Numbers, "N n"]


class Final(NamedTuple):
    """Conditions on the last state: the cost ``1/2 dz S dz + s . dz`` and the goal ``G dz + g = 0``."""

    S: Float[Numbers, "n n"]
    s: Float[Numbers, "n"]
    G: Float[Numbers, "e n"]
    g: Float[Numbers, "e"]


class Solution(NamedTuple):
    """Changes of the states after the first one, of the controls, and the multipliers of the goal."""

    dz: Float[Numbers, "N n"]
    du: Float[Numbers, "N m"]
    nu: Float[Numbers, "e"]


@jax.jit
def solve(stages: Stages, final: Final) -> Solution:
    """The solution of the linear-quadratic problem.

    A goal that cannot be reached is missed by as little as possible, in least squares.
    """
    n, e = final.S.shape[0], len(final.g)

    def back(value, stage: Stages):
        S, s, M, m, W = value  # the coefficients of the cost from the next stage on, see the head of this file
        A, B, c = stage.A, stage.B, stage.c
        Q, N, R = stage.hessian[:n, :n], stage.hessian[n:, :n], stage.hessian[n:, n:]
        q, r = stage.gradient[:n], stage.gradient[n:]
        # du = K dz + k + K_nu nu minimises the cost of the stage plus the cost from the next stage on, at  dz' = A dz +
        # B du + c:
        #     (R + B^T S B) du = -(H_ux dz + r + B^T (S c + s) + B^T M nu)    with    H_ux = N + B^T S A
        ahead = S @ c + s
        H_ux = N + B.T @ S @ A
        right = jnp.concatenate([H_ux, (r + B.T @ ahead)[:, None], B.T @ M], axis=1)
        gains = -jnp.linalg.solve(R + B.T @ S @ B, right)
        K, k, K_nu = gains[:, :n], gains[:, n], gains[:, n + 1 :]
        # The coefficients before the stage follow by insertion of du.
        S_before = Q + A.T @ S @ A + H_ux.T @ K
        before = (
            (S_before + S_before.T) / 2,  # symmetric in spite of round-off
            q + A.T @ ahead + H_ux.T @ k,
            A.T @ M + H_ux.T @ K_nu,
            m + M.T @ (c + B @ k),
            W - M.T @ B @ K_nu,
        )
        return before, (K, k, K_nu)

    last = final.S, final.s, final.G.T, final.g, jnp.zeros((e, e))
    (*_, m, W), gains = jax.lax.scan(back, last, stages, reverse=True)
    # dz_0 = 0, and the cost is stationary by nu:  m - W nu = 0
    nu = jnp.linalg.lstsq(W, m)[0] if e else m

    def forward(dz, stage_and_gains):
        stage, (K, k, K_nu) = stage_and_gains
        du = K @ dz + k + K_nu @ nu
        dz = stage.A @ dz + stage.B @ du + stage.c
        return dz, (dz, du)

    _, (dz, du) = jax.lax.scan(forward, jnp.zeros(n), (stages, gains))
    return Solution(dz, du, nu)
