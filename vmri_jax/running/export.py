"""Export of a run to other programs: tables of named columns, CSV, pandas, Parquet, xarray."""

import csv
import importlib
import io
import json
from pathlib import Path

import numpy as np

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
MICRO = "t_micro", "q_f_micro"
"""Names of the arrays of micro nodes."""
FILL = {"f": np.nan, "i": -1}
"""Fill values of floats and of integers: for the solver's work before the start, and for rows not yet written."""


def rows_of(run: SavedRun) -> dict[str, np.ndarray]:
    """The arrays of a run with a row for each saved node; row k has the work of the solver from node k - 1 to node k.

    Args:
        run: one run, or a batch.
    """
    micro = {} if run.micro is None else dict(zip(MICRO, run.micro, strict=True))
    fields = dict(vars(run.states)) | run.info._asdict() | micro
    fields |= {"energy": run.energy, "constraint_residual": run.constraint_residual}
    if run.error is not None:
        fields |= {
            name: getattr(run.error, name.removeprefix("error_")) for name in DIMENSIONS if name.startswith("error_")
        }
    arrays = {name: np.asarray(value) for name, value in fields.items() if value is not None}
    axis = arrays["t"].ndim - 1
    for name, array in arrays.items():
        missing = len(run) - array.shape[axis]
        if missing:
            widths = [(missing if i == axis else 0, 0) for i in range(array.ndim)]
            arrays[name] = np.pad(array, widths, constant_values=FILL[array.dtype.kind])
    return arrays


class Exports(Quantities):
    """Methods that export a run, with the names of bodies and coordinates."""

    def columns(self) -> dict[str, np.ndarray]:
        """Columns (k,) by name: time, coordinates by their names, velocities "v ..." if the system is known, momenta "p ...",
        energy, constraint residuals, and the work of the solver since the previous node.

        Raises:
            ValueError: this is a batch.
        """
        run = self.whole()
        names = run.names
        if np.ndim(run.t) != 1:
            raise Refused("columns: this is a batch of runs; take one of them, run.lane(i).")
        rows = rows_of(run)
        parts = [("", rows["q_s"], rows["q_f"]), ("p ", rows["p_s"], rows["p_f"])]
        if run.origin.knows_system:
            v_s, v_f = map(np.asarray, run.velocities)
            parts.insert(1, ("v ", v_s, v_f))
        columns = {"t": rows["t"]}
        for letter, slow, fast in parts:
            labels = [*names.slow_coordinates, *names.fast_coordinates]
            columns |= {letter + name: column for name, column in zip(labels, [*slow.T, *fast.T], strict=True)}
        position, velocity = rows["constraint_residual"].T
        columns |= {"energy": rows["energy"], "constraint residual": position, "constraint rate": velocity}
        if run.error is not None:
            shares = {"slow share": rows["error_slow"], "fast share": rows["error_fast"]}
            columns |= {"error": run.error.positions} | {f"error, {name}": share for name, share in shares.items()}
        return columns | {name: rows[name] for name in ("method", "iterations", "residual")}

    def to_csv(self, path) -> None:
        """Write `columns` to a .csv file, with a line of names; an existing file is replaced.

        Args:
            path: of the file.

        Raises:
            ValueError: this is a batch.
            OSError: the file cannot be written.
        """
        columns = self.columns()
        head = io.StringIO()
        csv.writer(head, lineterminator="\n").writerow(columns)
        with replaced(Path(path)) as file:
            file.write(head.getvalue().encode())
            np.savetxt(file, np.stack(list(columns.values()), axis=1), fmt="%.17g", delimiter=",")

    def to_pandas(self):
        """`columns` as a `pandas.DataFrame` over time (pandas comes with the extra ``vmri_jax[xarray]``).

        Raises:
            ValueError: this is a batch.
            ImportError: pandas is not installed.
        """
        pandas = extra("pandas", "to_pandas")
        columns = self.columns()
        return pandas.DataFrame(columns).set_index("t")

    def to_parquet(self, path) -> None:
        """Write `columns` to a .parquet file, time first (needs the extra ``vmri_jax[parquet]``).

        Args:
            path: of the file; an existing file is replaced.

        Raises:
            ValueError: this is a batch.
            ImportError: pyarrow is not installed.
            OSError: the file cannot be written.
        """
        pyarrow, parquet = (extra(name, "to_parquet", "parquet") for name in ("pyarrow", "pyarrow.parquet"))
        with replaced(Path(path)) as file:
            parquet.write_table(pyarrow.table(self.columns()), file)

    def to_xarray(self):
        """The run as an `xarray.Dataset` over time (needs the extra ``vmri_jax[xarray]``), with a dimension of lanes in a batch.

        Row k of "method", "iterations", "residual" and of the micro nodes belongs to the steps from node k - 1 to node k, so that row 0 is
        empty (-1 or NaN). The store of `vmri_jax.stream` has the same dimensions.

        Raises:
            ImportError: xarray is not installed.
        """
        xarray = extra("xarray", "to_xarray")
        run = self.whole()
        names, rows = run.names, rows_of(run)
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
        return xarray.Dataset(data, coords=coordinates, attrs=attributes(run))


def attributes(run: SavedRun) -> dict:
    """The status of a run, and the names of bodies and constraints as JSON."""
    if np.ndim(run.t) > 1:
        status = {"result": np.asarray(run.result), "failed_at": np.asarray(run.failed_at)}
    else:
        status = {"result": Result(int(run.result)).name, "failed_at": int(run.failed_at)}
    names = run.origin.names
    return status | ({} if names is None else {"names": json.dumps(names.to_dict())})


def extra(package: str, caller: str, name: str = "xarray"):
    """An optional package.

    Args:
        package: to import.
        caller: the function that needs it, for the message.
        name: the extra of vmri_jax that installs it.

    Raises:
        ImportError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise NotInstalled(f"{caller} needs {package}; install it with pip install 'vmri_jax[{name}]'.") from error
