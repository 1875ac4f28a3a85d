"""The error of a run and its slow and fast shares, from two companion runs.

A run with macro steps H and micro steps h = H / N has, with a scheme of order p, the error

    x_{H,h}(t) - x(t) = S(t) H^p + F(t) h^p + ...

The slow share ``S H^p`` vanishes with H at fixed h, the fast share ``F h^p`` with h at fixed H. Two companion runs from the same start
separate them: the first halves H and h, the second halves h alone. With ``r = 2^p / (2^p - 1)`` (Richardson's extrapolation)

    half the macro step:        S H^p + F h^p = r (x_{H,h} - x_{H/2,h/2})
    twice the micro steps:              F h^p = r (x_{H,h} - x_{H,h/2})

This is an estimate, not a bound. If the error falls with an order q below p, as for vibrations that the steps do not resolve, the true error
is ``(1 - 2^-p) / (1 - 2^-q)`` times the estimate: 1.5 times for p = 2 and q = 1. Above order 2 an error also has mixed terms ``H^a h^b``,
which count in part to both shares. The error of a node is *certified* if the estimates at this node and at
all nodes before it are small against the extent of the motion.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vmri_jax.mechanics.arrays import of_one_type
from vmri_jax.running.run_error import RunError, largest_of
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.trajectory import Trajectory, from_named_arrays
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.results import Result

LARGEST_CERTIFIED = 0.1
"""Largest certified error, as a part of the extent of the motion; from the first node with a larger one, no error is certified. Above it the
leading term of the error no longer dominates, so that a larger value certifies meaningless numbers."""
CHAOTIC_GROWTH = 32.0
"""Growth of the error in the second half of a time, above which the motion is called chaotic. Errors of regular motions grow like t or t^2, by
2 or 4, errors of chaotic motions like exp(L t). A larger value overlooks chaos that begins late."""


class UncertifiedWarning(UserWarning):
    """The error of a run is not certified over all of its length."""


def with_error(
    run: Simulation,
    trajectory: Trajectory,
    of: Callable | None = None,
    shares: bool = True,
    halved: Trajectory | None = None,
) -> Trajectory:
    """The trajectory with its `RunError`; warns if the error is not certified over the whole run.

    Args:
        trajectory: of the run, without a failed step.
        of: function of a run, whose error is estimated, too.
        shares: whether to estimate the slow and the fast share, too. Their companion has twice the micro steps, another program.
        halved: the companion with half the macro step, if it has been computed.
    """
    scheme, order = run.scheme, run.order
    halved = companion(run, scheme, 2) if halved is None else halved
    if int(halved.failed_at) >= 0:
        failed = float(halved.t[0]) + int(halved.failed_at) * float(run.macro_dt) / 2
        warnings.warn(
            f"simulate: the error is not known; the same run with half the macro step failed at t = {failed:.4g}.",
            UncertifiedWarning,
            stacklevel=3,
        )
        return trajectory
    refined = companion(run, scheme.with_num_micro(2 * stage_scheme(scheme).num_micro), 1) if shares else None
    error = run_error(order, trajectory, halved, refined, of)
    if not error.is_certified:
        warnings.warn(f"simulate: {_uncertified(error, trajectory)}", UncertifiedWarning, stacklevel=3)
    return replace(trajectory, error=error)


def run_error(
    order: int,
    trajectory: Trajectory,
    halved: Trajectory,
    refined: Trajectory | None = None,
    of: Callable | None = None,
) -> RunError:
    """The error of a run of a scheme of this order from its companions; without the shares if there is no refined one.

    Args:
        halved: companion with half the macro step.
        refined: companion with twice the micro steps.
        of: function of a run, whose error is estimated, too.
    """
    total = extrapolated(order, trajectory, halved)
    fast = np.full_like(total, np.nan) if refined is None else extrapolated(order, trajectory, refined)
    certified, growth = certified_nodes(trajectory, total)
    until = np.asarray(trajectory.t)[certified][-1]
    total, slow, fast = (np.where(certified[:, None], a, np.nan) for a in (total, total - fast, fast))
    of_error = None if of is None else _of_error(of, order, trajectory, halved, certified)
    q_s, q_f = np.split(total, [trajectory.states.q_s.shape[-1]], axis=1)
    shares_at_nodes = largest_of(slow), largest_of(fast)
    return RunError(q_s, q_f, *shares_at_nodes, of_error, np.asarray(until), np.asarray(growth))


def ratio(order: int) -> float:
    """``r = 2^p / (2^p - 1)`` of a scheme of order p."""
    return 1.0 / (1.0 - 2.0**-order)


def extrapolated(order: int, trajectory: Trajectory, finer: Trajectory) -> np.ndarray:
    """(k, n_s + n_f) ``r (x - x')``: the part of the error of the positions x that vanishes with the steps halved in the companion x'."""
    return ratio(order) * (_positions(trajectory) - _positions(finer))


def _of_error(
    of: Callable, order: int, trajectory: Trajectory, halved: Trajectory, certified: np.ndarray
) -> np.ndarray:
    """Error of a function of the run.

    A function with a value for each node is NaN at nodes that are not certified; any other function is NaN unless all nodes are certified.
    """
    error = ratio(order) * (np.asarray(of(trajectory)) - np.asarray(of(halved)))
    has_node_values = error.shape[:1] == certified.shape
    shown = certified.reshape(-1, *(1,) * (error.ndim - 1)) if has_node_values else certified.all()
    return np.where(shown, error, np.nan)


def certified_nodes(trajectory: Trajectory, error: np.ndarray) -> tuple[np.ndarray, float]:
    """(k,) whether the error (k, n_s + n_f) of each node is certified, and its growth in the second half of the certified time."""
    t, extent = np.asarray(trajectory.t), extent_of(trajectory)
    envelope = np.maximum.accumulate(largest_of(error))
    certified = envelope <= LARGEST_CERTIFIED * extent if extent > 0 else np.isfinite(envelope)
    certified[0] = True
    last = np.flatnonzero(certified)[-1]
    half = np.searchsorted(t, (t[0] + t[last]) / 2)
    return certified, float(envelope[last] / envelope[half]) if envelope[half] > 0 else 1.0


def extent_of(trajectory: Trajectory) -> float:
    """Largest difference between the largest and the smallest value of a coordinate in a run."""
    return float(np.ptp(_positions(trajectory), axis=0).max(initial=0.0))


def check_function_of_run(of: Callable | None, error: bool, run: Simulation) -> None:
    """Refuse a function `of` that returns no numbers; it is called with a run that rests at the start."""
    if of is None:
        return
    if not error:
        raise ValueError("simulate: of is the function whose error is estimated; give error=True with it.")
    if not callable(of):
        raise TypeError(f"simulate: of is {of!r}; give a function of a run, such as lambda run: run.q_f[:, 0].")
    value = of(resting(run))
    if np.asarray(value).dtype.kind not in "fiu":
        raise TypeError(f"simulate: of returned {value!r} for a run; it must return a number or an array of numbers.")


def resting(run: Simulation) -> Trajectory:
    """A trajectory at the times of a run that stays at the start, without micro nodes: an argument to try functions of runs on."""
    start, k = run.state, run.num_saves + 1
    arrays = {name: np.repeat(np.asarray(value)[None], k, axis=0) for name, value in vars(start).items()}
    arrays["t"] = start.t + np.arange(k) * run.save_every * run.macro_dt
    arrays |= {"energy": np.zeros(k), "constraint_residual": np.zeros((k, 2))}
    arrays |= {"method": np.zeros(k - 1, int), "iterations": np.zeros(k - 1, int), "residual": np.zeros(k - 1)}
    arrays |= {"result": np.asarray(int(Result.CONVERGED)), "failed_at": np.asarray(-1)}
    return replace(from_named_arrays(arrays), origin=run.origin)


def companion(run: Simulation, scheme: Scheme | Composition, parts: int) -> Trajectory:
    """The run with another scheme and every macro step divided into equal parts, at the same saved nodes; it may fail."""
    finer = replace(
        run,
        scheme=scheme if scheme is run.scheme else of_one_type(scheme),
        macro_dt=run.macro_dt / parts,
        num_steps=run.num_steps * parts,
        save_every=run.save_every * parts,
        save_micro=False,
    )
    return finer.in_pieces()


def _positions(trajectory: Trajectory) -> np.ndarray:
    """(k, n_s + n_f) positions, slow first."""
    return np.concatenate([trajectory.states.q_s, trajectory.states.q_f], axis=1)


def _uncertified(error: RunError, trajectory: Trajectory) -> str:
    """The reason why an error is not certified, and advice."""
    t = float(error.certified_until)
    energy = np.asarray(trajectory.energy)
    kept = (
        f" The energy has changed by at most {np.abs(energy - energy[0]).max():.1e}." if trajectory.keeps_energy else ""
    )
    if float(error.growth) > CHAOTIC_GROWTH:
        return (
            f"the motion is chaotic, small errors have grown {float(error.growth):.0f} times in the second half of the time until t = {t:.4g}: "
            f"from there on an error of positions means nothing.{kept}"
        )
    return (
        f"from t = {t:.4g} on positions are wrong by more than {LARGEST_CERTIFIED:.0%} of the extent of the motion, and no error is "
        f"certified; take smaller steps, or a scheme of higher order.{kept}"
    )
