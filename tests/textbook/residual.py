"""The textbook's equations at the nodes of a run: one gradient at the solution, in place of solving once more."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.support import NAMES
from vmri_jax import Trajectory, textbook


@jax.jit
def _equations(system, scheme, slow, fast, t, macro_dt):
    """Derivatives of ``L_d`` and the work of forces by all control points, and constraints at them with their
    Jacobian."""

    def action(path):
        free = textbook.discrete_lagrangian(system, scheme)(*path, macro_dt)
        return free + textbook.virtual_work(system, scheme, path, (slow, fast), t, macro_dt)

    def constraints(path):
        rows = textbook.constraints(system, scheme, path[0], path[1], t, macro_dt)
        return jnp.concatenate([jnp.ravel(values) for values in rows])

    path = slow, fast
    return jax.grad(action)(path), constraints(path), jax.jacrev(constraints)(path)


def residual(system, scheme, run: Trajectory, macro_dt) -> float:
    """Largest part, over the largest momentum, of the slots that no constraint forces balance; or largest constraint or
    rate of one, if it is larger.

    With ``d = (p + D_first A, D_inner A, D_last A - p+)`` without multipliers, a step solves ``d = C^T lambda`` for
    some lambda, where C is the Jacobian of all constraints by the control points.

    Args:
        system: what has been simulated.
        scheme: a scheme of degree 1, whose control points are the micro nodes.
        run: with ``vm.Save(micro=True)``, each macro step saved.
        macro_dt: length of the macro steps.
    """
    assert scheme.degree == 1
    q_s, q_f, p_s, p_f = (np.asarray(getattr(run, name)) for name in NAMES)
    worst, largest = float(np.max(run.constraint_residual)), np.abs(np.hstack([p_s, p_f])).max()
    for k, inner in enumerate(np.asarray(run.q_f_micro)):
        (d_slow, d_fast), values, jacobian = jax.device_get(
            _equations(system, scheme, q_s[k : k + 2], np.vstack([q_f[k], inner]), run.t[k], macro_dt)
        )
        d_slow, d_fast = np.array(d_slow), np.array(d_fast)
        d_slow[[0, -1]] += p_s[k], -p_s[k + 1]
        d_fast[[0, -1]] += p_f[k], -p_f[k + 1]
        slots = d_slow, d_fast
        d = np.concatenate([slot.ravel() for slot in slots])
        forces = np.hstack([np.reshape(C, (len(values), slot.size)) for C, slot in zip(jacobian, slots, strict=True)]).T
        d -= forces @ np.linalg.lstsq(forces, d, rcond=None)[0]
        worst = max(worst, np.abs(d).max() / largest, np.abs(values).max(initial=0.0))
    return worst
