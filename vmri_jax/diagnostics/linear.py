"""The macro step as a map of phase space, ``z -> Phi(z)`` with ``z = (q_s, q_f, p_s, p_f)``: its derivative, and the
condition of its equations."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from vmri_jax.mechanics.arrays import library, split_at
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.state import Movable, State, start_of
from vmri_jax.mechanics.system import System
from vmri_jax.running.arguments import check_run
from vmri_jax.running.macro_step import macro_step
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.schemes.intervals import Intervals
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solver import Solver

SWEEPS = 10
"""Scalings of the rows and columns of a Newton matrix.

With fewer their lengths are not one to round-off, with more nothing changes.
"""


def phase_vector(state: State):
    """``z = (q_s, q_f, p_s, p_f)``, joined, (2 n,), or (k, 2 n) for k states."""
    return library(state).concatenate([state.q_s, state.q_f, state.p_s, state.p_f], axis=-1)


def state_of(z, t, like: State) -> State:
    """The state of a phase vector (2 n,) at time t; `like` is any state of the system."""
    n_s, n = like.q_s.size, like.q_s.size + like.q_f.size
    return State(t, *split_at(z, n_s, n, n + n_s))


def phase_step(system: System, scheme: SchemeLike, like: State, t, z, *, macro_dt, solver: Solver | None):
    """The end (2 n,) of a macro step from z (2 n,) at time t, and the `StepStatus` of the step; `like` is any state of
    the system."""
    end, info = macro_step(system, scheme, state_of(z, t, like), macro_dt, solver)
    return phase_vector(end), info.status


def with_slopes(function: Callable, x, directions):
    """``function(x) -> (y, more)`` with its derivative along k directions d (k, n): y, more and ``dy/dx d`` (k, m)."""

    def along(direction):
        y, slope, more = jax.jvp(function, (x,), (direction,), has_aux=True)
        return y, more, slope

    return jax.vmap(along, out_axes=(None, None, 0))(directions)


def step_condition(system: Movable, scheme: Scheme, state: State | None = None, *, macro_dt) -> float:
    """Condition number of the Newton matrix of a macro step, rows and columns scaled to length one.

    The Newton matrix of the first iteration, which starts from straight motion, is formed as a dense matrix: take few
    micro steps. Each sweep divides rows and columns by the square roots of their lengths (Ruiz 2001).

    Args:
        system, scheme, state, macro_dt: as in `simulate`.
    """
    system, state = start_of("step_condition", system, state)
    check_run(system, scheme, state, None, macro_dt, num_steps=1, t_end=None, save=1)
    a = np.asarray(newton_matrix(system, scheme, state, macro_dt))
    for _ in range(SWEEPS):
        rows, columns = np.linalg.norm(a, axis=1), np.linalg.norm(a, axis=0)
        if not (np.isfinite(a).all() and rows.all() and columns.all()):
            return np.inf
        a = a / np.sqrt(rows[:, None] * columns)
    return float(np.linalg.cond(a))


@jax.jit
def newton_matrix(system: System, scheme: Scheme, state: State, macro_dt):
    """The dense Newton matrix of a macro step in the first iteration, which starts from straight motion."""
    equations = StepEquations.of(system, scheme, state, macro_dt)
    intervals = Intervals(equations)
    v_s, v_f = velocity(system, state.q_s, state.q_f, state.p_s, state.p_f)
    n_g, n_gs = system.num_constraints(state.q_s, state.q_f)
    x, unravel = ravel_pytree(equations.guess(v_s, v_f, jnp.zeros(n_g), jnp.zeros(n_gs)))
    return jax.jacfwd(lambda x: ravel_pytree(intervals.residual(unravel(x))[0])[0])(x)
