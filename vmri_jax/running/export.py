"""A run for readers and for other programs: a summary in a few lines; tables of named columns, CSV, pandas, Parquet,
xarray."""

import csv
import importlib
import io
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.summary import coordinates, listed
from vmri_jax.refusals import NotInstalled, Refused
from vmri_jax.running.files import replaced
from vmri_jax.running.origin import SavedRun
from vmri_jax.running.quantities import Quantities
from vmri_jax.steppers.results import Result

DIMENSIONS = {
    "t": ("t",),
    "q_s": ("t", "slow"),
    "q_f": ("t", "fast"),
    "p_s": ("t", "slow"),
    "p_f": ("t", "fast"),
    "energy": ("t",),
    "constraint_residual": ("t", "level"),
    "method": ("t",),
    "iterations": ("t",),
    "residual": ("t",),
    "error_q_s": ("t", "slow"),
    "error_q_f": ("t", "fast"),
    "error_slow": ("t",),
    "error_fast": ("t",),
    "t_micro": ("t", "micro"),
    "q_f_micro": ("t", "micro", "fast"),
}
"""Names of the axes of every array that has a row for each saved node."""
NODES = tuple(DIMENSIONS)[:7]
"""Arrays that a run has for each saved node, the start included; it has all others of `DIMENSIONS` for the intervals
between them, or none of them."""
INFO = ("method", "iterations", "residual")
MICRO = ("t_micro", "q_f_micro")
STATUS = ("result", "failed_at")
"""Arrays with one value for the run."""
FILL = {"f": np.nan, "i": -1}
"""Fill values of floats and of integers: for the solver's work before the start, and for rows not yet written."""


def named_arrays(run: SavedRun) -> dict:
    """All arrays of a run by name, positions as vectors, as far as it has them."""
    arrays = vars(run.states) | {name: getattr(run, name) for name in ("energy", "constraint_residual", *STATUS)}
    arrays |= run.info._asdict() | dict(zip(MICRO, run.micro or (), strict=False))
    error = {} if run.error is None else {f"error_{name}": value for name, value in run.error._asdict().items()}
    return {name: value for name, value in (arrays | error).items() if value is not None}


def rows_of(run: SavedRun) -> dict[str, np.ndarray]:
    """The arrays of a run or a batch by name, a row for each saved node; row k has the work since node k - 1."""
    arrays = {name: np.asarray(value) for name, value in named_arrays(run).items() if name in DIMENSIONS}
    axis = arrays["t"].ndim - 1
    for name, array in arrays.items():
        if array.shape[axis] < len(run):
            widths = [(int(i == axis), 0) for i in range(array.ndim)]
            arrays[name] = np.pad(array, widths, constant_values=FILL[array.dtype.kind])
    return arrays


class Exports(Quantities):
    """Methods that export a run, with the names of bodies and coordinates."""

    result: Any
    failed_at: Any
    error: Any

    def columns(self) -> dict[str, np.ndarray]:
        """Columns (k,) by name: time, coordinates by their names, velocities "v ..." if the system is known, momenta "p
        ...", energy, constraint residuals, and the work of the solver since the previous node.

        Raises:
            ValueError: this is a batch, or two columns have one name.
        """
        names = self.names
        if np.ndim(self.energy) != 1:
            raise Refused("columns: this is a batch of runs; take one of them, run.lane(i).")
        rows = rows_of(self)
        parts = [("", rows["q_s"], rows["q_f"]), ("p ", rows["p_s"], rows["p_f"])]
        if self.origin.simulated is not None:
            v_s, v_f = map(np.asarray, self.velocities)
            parts.insert(1, ("v ", v_s, v_f))
        columns = [("t", rows["t"])]
        for letter, slow, fast in parts:
            labels = [letter + name for name in (*names.slow_coordinates, *names.fast_coordinates)]
            columns += zip(labels, [*slow.T, *fast.T], strict=True)
        position, velocity = rows["constraint_residual"].T
        columns += [("energy", rows["energy"]), ("constraint residual", position), ("constraint rate", velocity)]
        if self.error is not None:
            shares = ("slow share", rows["error_slow"]), ("fast share", rows["error_fast"])
            columns += [("error", self.error.positions), *((f"error, {name}", share) for name, share in shares)]
        columns += [(name, rows[name]) for name in INFO]
        by_name = dict(columns)
        if len(by_name) < len(columns):
            twice = [name for name, count in Counter(name for name, _ in columns).items() if count > 1]
            raise Refused(
                f"columns: {', '.join(twice)} would be the name of two columns. Give the body or coordinate another "
                "name, or take to_xarray or save."
            )
        return by_name

    def to_csv(self, path) -> None:
        """Write `columns` to a .csv file, with a line of names; an existing file is replaced.

        Raises:
            OSError: the file cannot be written.
        """
        columns, head = self.columns(), io.StringIO()
        csv.writer(head, lineterminator="\n").writerow(columns)
        with replaced(Path(path)) as file:
            file.write(head.getvalue().encode())
            np.savetxt(file, np.stack(list(columns.values()), axis=1), fmt="%.17g", delimiter=",")

    def to_pandas(self):
        """`columns` as a `pandas.DataFrame` over time (pandas comes with the extra ``vmri_jax[xarray]``).

        Raises:
            ImportError: pandas is not installed.
        """
        return extra("pandas", "to_pandas").DataFrame(self.columns()).set_index("t")

    def to_parquet(self, path) -> None:
        """Write `columns` to a .parquet file, time first (needs the extra ``vmri_jax[parquet]``); an existing file is
        replaced.

        Raises:
            ImportError: pyarrow is not installed.
            OSError: the file cannot be written.
        """
        pyarrow, parquet = (extra(name, "to_parquet", "parquet") for name in ("pyarrow", "pyarrow.parquet"))
        with replaced(Path(path)) as file:
            parquet.write_table(pyarrow.table(self.columns()), file)

    def to_xarray(self):
        """The run as an `xarray.Dataset` over time (needs the extra ``vmri_jax[xarray]``), with a dimension of lanes in
        a batch.

        Row k of "method", "iterations", "residual" and of the micro nodes belongs to the steps from node k - 1 to node
        k, so that row 0 is empty (-1 or NaN). The store of `vmri_jax.stream` has the same dimensions.

        Raises:
            ImportError: xarray is not installed.
        """
        xarray = extra("xarray", "to_xarray")
        names, rows = self.names, rows_of(self)
        lanes = ("lane",) * (rows["t"].ndim - 1)
        data = {name: ((*lanes, *DIMENSIONS[name]), array) for name, array in rows.items() if name != "t"}
        coordinates = {
            "t": ("t", rows["t"] if not lanes else rows["t"][0]),
            "slow": names.slow_coordinates,
            "fast": names.fast_coordinates,
            "level": ["position", "velocity"],
        }
        # Each lane has its own macro step: node numbers replace the times.
        if lanes and np.any(rows["t"] != rows["t"][0]):
            coordinates["t"] = ("t", np.arange(rows["t"].shape[1]))
            data["time"] = (("lane", "t"), rows["t"])
        result, failed_at = np.asarray(self.result), np.asarray(self.failed_at)
        status = (result, failed_at) if lanes else (Result(int(result)).name, int(failed_at))
        attributes: dict[str, Any] = dict(zip(STATUS, status, strict=True))
        if self.origin.names is not None:
            attributes["names"] = json.dumps(self.origin.names.to_dict())
        return xarray.Dataset(data, coords=coordinates, attrs=attributes)


def extra(package: str, caller: str, name: str = "xarray"):
    """An optional package that `caller` needs and the extra `name` of vmri_jax installs; ImportError without it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise NotInstalled(f"{caller} needs {package}; install it with pip install 'vmri_jax[{name}]'.") from error


def summary_of(run: SavedRun) -> tuple[str, dict[str, str]]:
    """Title and lines of the summary of a run, or of a batch of runs, of concrete values."""
    t, energy, residual = (np.asarray(a) for a in (run.t, run.energy, run.constraint_residual))
    lanes, (position, velocity) = t.shape[:-1], np.nanmax(residual.reshape(-1, 2), axis=0, initial=0.0)
    batch = f" of a batch of {' x '.join(map(str, lanes))} runs" if lanes else ""
    times = f" from t = {np.nanmin(t):.6g} to {np.nanmax(t):.6g}" if np.isfinite(t).any() else ""
    return f"Trajectory{batch}: {t.shape[-1]} saved nodes{times}", {
        "status": statuses(np.asarray(run.result), np.asarray(run.failed_at)),
        **named_coordinates(run.origin.names, run),
        "energy": energy_in_words(energy, run.keeps_energy),
        "chosen": "" if run.settings is None else str(run.settings),
        "error": "" if run.error is None else run.error.in_words(),
        "constraints": f"kept to {position:.1e} in positions, {velocity:.1e} in velocities"
        if position or velocity
        else "",
        "solver": run.info.in_words(),
        "micro nodes": "" if run.t_micro is None else f"t_micro and q_f_micro, {run.t_micro.shape[-1]} per saved node",
    }


def named_coordinates(names: Names | None, run: SavedRun) -> dict[str, str]:
    """Lines on the slow and the fast coordinates of a run, with their names or else with plain names."""
    names = (names or Names()).of_coordinates(run.states.q_s.shape[-1], run.states.q_f.shape[-1])
    return {"slow": coordinates(names.slow_coordinates), "fast": coordinates(names.fast_coordinates)}


def statuses(result: np.ndarray, failed_at: np.ndarray) -> str:
    """The status of a run by name; of a batch the number of runs of each status, and the numbers of the failed
    lanes."""
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
