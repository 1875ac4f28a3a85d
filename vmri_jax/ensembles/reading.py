"""Reading an ensemble: its results as an `xarray.Dataset` with the design as coordinates, loaded when they are used."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vmri_jax.ensembles.design import Draw, Draws
from vmri_jax.ensembles.quantities import LEVELS
from vmri_jax.running.export import FILL, extra
from vmri_jax.running.store import layout

if TYPE_CHECKING:
    import xarray

LANE = "lane"


def open_ensemble(path: str | os.PathLike) -> "xarray.Dataset":
    """The results of `ensemble`, as an `xarray.Dataset` whose arrays Dask loads when they are used.

        data = vm.open_ensemble("runs.zarr")
        data.energy_error.sel(num_micro=5, omega=50, method="nearest")

    A product of axes has a dimension for each of them. Other designs have the dimension "lane", with the columns of the
    design as coordinates. Runs that are not in the store yet are NaN, with the result -1. A failed run is NaN from its
    failure on. "result" has the status of each run, an integer whose meanings are in the attributes of the array.

    Args:
        path: folder of the store.

    Raises:
        FileNotFoundError, ValueError: the folder does not exist, or is not the store of an ensemble.
        ImportError: xarray or Dask are not installed.
    """
    xarray = extra("xarray", "open_ensemble", "ensemble")
    extra("dask.array", "open_ensemble", "ensemble")
    path = Path(path)
    attributes = layout.read_attributes(path, "ensemble")
    data = xarray.open_zarr(path, chunks={}, consolidated=True, mask_and_scale=False)
    data = _without_missing(data, path, attributes, xarray)
    columns_record = attributes["design"]["columns"]
    if attributes["design"]["kind"] == "Product":
        data = _on_axes(data, columns_record, xarray)
    else:
        is_drawn = attributes["design"]["kind"] == "Draws"
        columns = _drawn(attributes) if is_drawn else dict(np.load(path / layout.TABLE, allow_pickle=False))
        axes = {name: (LANE, *(f"{name}_{i}" for i in range(array.ndim - 1))) for name, array in columns.items()}
        data = data.assign_coords({name: (axes[name], array) for name, array in columns.items()})
    for name, column in columns_record.items():
        data[name].attrs |= {key: column[key] for key in ("units", "description") if key in column}
    labels = {"slow": attributes["slow"], "fast": attributes["fast"], "quantile": list(LEVELS)}
    labels["level"] = ["position", "velocity"]
    data = data.assign_coords({name: values for name, values in labels.items() if name in data.dims})
    data.attrs = {"title": f"ensemble of {attributes['rows']} runs"}
    data.attrs |= {name: attributes[name] for name in ("system", "made_with")}
    return data


def _without_missing(data, path: Path, attributes: dict[str, Any], xarray):
    """The data with rows of uncommitted chunks set to missing: a killed worker may have written some of their
    arrays."""
    lanes, chunk = attributes["rows"], attributes["chunk"]
    is_committed = np.zeros(-(-lanes // chunk), dtype=bool)
    is_committed[layout.committed(path)] = True
    if is_committed.all():
        return data
    in_store = xarray.DataArray(np.repeat(is_committed, chunk)[:lanes], dims=LANE)
    arrays = {name: array.where(in_store, FILL.get(array.dtype.kind, 0)) for name, array in data.items()}
    return xarray.Dataset(arrays, attrs=data.attrs)


def _on_axes(data, columns_record: dict[str, dict], xarray):
    """The data with a dimension for each axis of the product in place of the lanes."""
    axes = {name: axis["values"] for name, axis in columns_record.items()}
    shape = tuple(map(len, axes.values()))
    values = {name: array.data.reshape((*shape, *array.shape[1:])) for name, array in data.items()}
    arrays = {name: ((*axes, *array.dims[1:]), values[name], array.attrs) for name, array in data.items()}
    return xarray.Dataset(arrays, coords=axes)


def _drawn(attributes: dict[str, Any]):
    """Columns of random rows, as arrays of Dask whose values are drawn when they are used."""
    import dask.array

    record, chunk, lanes = attributes["design"], attributes["chunk"], attributes["rows"]
    distributions = {name: column["distribution"] for name, column in record["columns"].items()}
    draws = {name: Draw(kind, tuple(arguments)) for name, (kind, *arguments) in distributions.items()}
    design = Draws(lanes, draws, record["method"], record["seed"])
    sizes = (*[chunk] * (lanes // chunk), *([lanes % chunk] if lanes % chunk else []))

    def column(name: str):
        def block(block_info: Any = None):
            ((first, last),) = block_info[None]["array-location"]
            return design.rows(first, last)[name]

        return dask.array.map_blocks(block, dtype=float, chunks=(sizes,), meta=np.zeros(0))

    return {name: column(name) for name in design.columns}
