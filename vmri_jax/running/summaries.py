"""The summary of a run in a few lines: nodes and times, status, coordinates by name, energy, error, solver."""

from collections import Counter

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.summary import coordinates, listed
from vmri_jax.running.origin import SavedRun
from vmri_jax.steppers.results import Result


def summary_of(run: SavedRun) -> tuple[str, dict[str, str]]:
    """Title and lines of the summary of a run, or of a batch of runs, of concrete values."""
    t, energy, residual = (np.asarray(a) for a in (run.t, run.energy, run.constraint_residual))
    lanes = t.shape[:-1]
    batch = f" of a batch of {' x '.join(map(str, lanes))} runs" if lanes else ""
    times = f" from t = {np.nanmin(t):.6g} to {np.nanmax(t):.6g}" if np.isfinite(t).any() else ""
    return f"Trajectory{batch}: {t.shape[-1]} saved nodes{times}", {
        "status": statuses(np.asarray(run.result), np.asarray(run.failed_at)),
        **named_coordinates(run.origin.names, run),
        "energy": energy_in_words(energy, run.keeps_energy),
        "chosen": "" if run.settings is None else str(run.settings),
        "error": "" if run.error is None else run.error.in_words(),
        "constraints": _constraints(residual.reshape(-1, residual.shape[-1])),
        "solver": run.info.in_words(),
        "micro nodes": "" if run.t_micro is None else f"t_micro and q_f_micro, {run.t_micro.shape[-1]} per saved node",
    }


def named_coordinates(names: Names | None, run: SavedRun) -> dict[str, str]:
    """Lines on the slow and the fast coordinates of a run, with their names or else with plain names."""
    names = (names or Names()).of_coordinates(run.states.q_s.shape[-1], run.states.q_f.shape[-1])
    return {"slow": coordinates(names.slow_coordinates), "fast": coordinates(names.fast_coordinates)}


def statuses(result: np.ndarray, failed_at: np.ndarray) -> str:
    """The status of a run by name; of a batch the number of runs of each status, and the numbers of the failed lanes."""
    if not result.ndim:
        failure = "" if failed_at < 0 else f" at macro step {failed_at}; all saved nodes after it are NaN"
        return f"{Result(int(result)).name}{failure}"
    counts = Counter(Result(int(r)).name for r in result.ravel())
    failed = [str(i) for i in np.flatnonzero(failed_at.ravel() >= 0)]
    lanes = f"; failed: run.lane(i) for i = {listed(failed)}" if failed else ""
    return ", ".join(f"{count} {name}" for name, count in counts.most_common()) + lanes


def energy_in_words(energy: np.ndarray, kept: bool | None) -> str:
    """Energy (..., k) at the start and its change; of a batch the largest change. `kept` is None without a system."""
    start = energy[..., :1]
    change = np.abs(energy - start)
    largest = float(np.nanmax(change, initial=0.0))
    if energy.ndim > 1:
        return f"changed by at most {largest:.2e} in a run"
    if kept is False:
        last = energy[np.isfinite(energy)]
        return f"{start[0]:.6g} at the start, {last[-1] if last.size else np.nan:.6g} at the end; run.work() says why"
    relative = f", {largest / abs(start[0]):.1e} of it" if abs(start[0]) > np.finfo(float).eps * largest else ""
    return f"{start[0]:.6g} at the start, changed by at most {largest:.2e}{relative}"


def _constraints(residual: np.ndarray) -> str:
    if not np.nanmax(residual, initial=0.0) > 0:
        return ""
    position, velocity = np.nanmax(residual, axis=0, initial=0.0)
    return f"kept to {position:.1e} in positions, {velocity:.1e} in velocities"
