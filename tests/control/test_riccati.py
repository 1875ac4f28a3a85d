"""The sweep, and the solver with limits, against the dense equations of the same linear-quadratic problem."""

import jax.numpy as jnp
import numpy as np

from vmri_jax.control import bounded
from vmri_jax.control.riccati import Final, Stages, solve

N, STATES, CONTROLS, GOALS = 6, 4, 2, 3


def positive(rng, size: int):
    a = rng.standard_normal((size, size))
    return a @ a.T + 0.1 * np.eye(size)


def random_problem(seed: int) -> tuple[Stages, Final]:
    rng = np.random.default_rng(seed)
    hessian = np.stack([positive(rng, STATES + CONTROLS) for _ in range(N)])
    shapes = (STATES + CONTROLS,), (STATES, STATES), (STATES, CONTROLS), (STATES,)
    stages = Stages(*map(jnp.asarray, (hessian, *(rng.standard_normal((N, *shape)) for shape in shapes))))
    rest = rng.standard_normal(STATES), rng.standard_normal((GOALS, STATES)), rng.standard_normal(GOALS)
    return stages, Final(*map(jnp.asarray, (positive(rng, STATES), *rest)))


def dense(stages: Stages, final: Final):
    """dz, du and nu from the whole matrix of the optimality conditions."""
    states, total = N * STATES, N * (STATES + CONTROLS)
    matrix, right = np.zeros((total, total)), np.zeros(total)
    rows, gaps = np.zeros((states + GOALS, total)), np.zeros(states + GOALS)
    for k in range(N):
        z, z_next = np.arange((k - 1) * STATES, k * STATES), np.arange(k * STATES, (k + 1) * STATES)
        u = np.arange(states + k * CONTROLS, states + (k + 1) * CONTROLS)
        here = np.concatenate([z, u]) if k else u
        inside = slice(0 if k else STATES, None)
        matrix[np.ix_(here, here)] += stages.hessian[k][inside, inside]
        right[here] += stages.gradient[k][inside]
        rows[np.ix_(z_next, z_next)] = np.eye(STATES)
        if k:
            rows[np.ix_(z_next, z)] = -stages.A[k]
        rows[np.ix_(z_next, u)] = -stages.B[k]
        gaps[z_next] = stages.c[k]
    last = np.arange(states - STATES, states)
    matrix[np.ix_(last, last)] += final.S
    right[last] += final.s
    rows[np.ix_(states + np.arange(GOALS), last)], gaps[states:] = final.G, -final.g
    whole = np.block([[matrix, rows.T], [rows, np.zeros((len(rows), len(rows)))]])
    x = np.linalg.solve(whole, np.concatenate([-right, gaps]))
    return x[:states].reshape(N, -1), x[states:total].reshape(N, -1), x[-GOALS:]


def test_the_sweep_solves_the_whole_problem():
    """Measured: 1e-13."""
    for seed in range(3):
        stages, final = random_problem(seed)
        for found, expected in zip(solve(stages, final), dense(stages, final), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    far, row = np.full((N, CONTROLS), 1e4), np.random.default_rng(3).normal(size=(N, 1, STATES + CONTROLS))
    limits = bounded.Limits(row[..., :STATES], row[..., STATES:], np.full((N, 1), -1e5), -far, far)
    for a, b in zip(bounded.solve(stages, final, limits)[0], dense(stages, final), strict=True):  # none of them holds
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


def test_a_goal_that_cannot_be_reached_is_missed_by_the_least():
    """Without controls nothing can be done about it."""
    stages, final = random_problem(0)
    stages = stages._replace(B=jnp.zeros_like(stages.B))
    found = solve(stages, final)
    assert np.isfinite(np.asarray(found.du)).all()
    np.testing.assert_allclose(found.nu, 0.0, atol=1e-12)
