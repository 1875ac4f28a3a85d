"""Positions and velocities at the micro nodes between the macro nodes of a run.

A run keeps the fast positions at its micro nodes. Slow positions and velocities there come from the cubic Hermite
polynomial through the positions and velocities of the two macro nodes. Fast velocities come from the cubic spline
through the micro nodes of a macro step with the known velocities at its ends, an approximation of order 4.
"""

from typing import Any, NamedTuple

import numpy as np

ROUND_OFF = 1e-6
"""Relative difference of two times up to which they count as equal.

A larger value takes runs of some hundred micro steps for runs with all nodes.
"""


class Nodes(NamedTuple):
    """Positions and velocities at all nodes in order, macro and micro: t is (k,), positions and velocities are (k,
    n)."""

    t: np.ndarray
    q_s: np.ndarray
    q_f: np.ndarray
    v_s: np.ndarray
    v_f: np.ndarray


def why_not(t, micro) -> str:
    """The reason why `MicroNodes`, or None, do not refine macro nodes (k,); empty if they do."""
    if np.ndim(t) != 1:
        return "it is a batch; take one lane of it"
    if micro is None:
        return "it kept none; simulate with save=vm.Save(micro=True)"
    t, t_micro = np.asarray(t, dtype=float), np.asarray(micro.t, dtype=float)
    if len(t) < 2:
        return "it has a single node"
    if np.any(np.diff(np.append(t[:1], t_micro)) <= 0):
        return "the stages of its composition go back in time"
    # Micro nodes belong to the last macro step of a saved interval. The first of its micro steps is at most half of it:
    # if more time lies before the first micro node than after it, there are further macro steps.
    before, after = t_micro[:, 0] - t[:-1], t[1:] - t_micro[:, 0]
    if t_micro.shape[1] > 1 and np.any(before > after * (1 + ROUND_OFF)):
        return "it kept the micro nodes of some macro steps only; simulate with save=vm.Save(every=1, micro=True)"
    return ""


def with_micro_nodes(nodes: Nodes, t_micro, q_f_micro) -> Nodes:
    """All nodes of a run for which `why_not` is empty, from macro nodes, finite ones, and micro nodes."""
    from scipy.interpolate import CubicHermiteSpline, CubicSpline  # here: its import takes a fifth of a second

    t_micro, q_f_micro = np.asarray(t_micro, dtype=float), np.asarray(q_f_micro, dtype=float)
    steps, num_micro = t_micro.shape
    t = np.append(nodes.t[:1], t_micro)
    slow = CubicHermiteSpline(nodes.t, nodes.q_s, nodes.v_s)
    values = np.concatenate([nodes.q_f[:-1, None], q_f_micro], axis=1)  # (steps, num_micro + 1, n_f)
    within = np.append(0.0, t_micro[0] - nodes.t[0])
    ends: Any = (1, nodes.v_f[:-1]), (1, nodes.v_f[1:])  # first derivatives
    v_f = CubicSpline(within, values, axis=1, bc_type=ends)(within[1:], 1)

    def in_order(first, later):
        return np.concatenate([first, later.reshape(steps * num_micro, -1)])

    return Nodes(t, slow(t), in_order(nodes.q_f[:1], q_f_micro), slow(t, 1), in_order(nodes.v_f[:1], v_f))
