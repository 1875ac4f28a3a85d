"""Reading an ensemble: its results as an `xarray.Dataset`, with the design as coordinates, loaded when they are asked for."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vmri_jax.ensembles import store
from vmri_jax.ensembles.design import Draw, Draws
from vmri_jax.ensembles.quantities import LEVELS
from vmri_jax.ensembles.store import LANE
from vmri_jax.running.export import FILL, extra

if TYPE_CHECKING:
    import xarray

LEVEL_NAMES = ["position", "velocity"]


def open_ensemble(path: str | os.PathLike) -> "xarray.Dataset":
    """The results of `ensemble`, as an `xarray.Dataset` whose arrays are loaded by Dask when they are needed.

        data = vm.open_ensemble("runs.zarr")
        data.energy_error.sel(num_micro=5, omega=50, method="nearest")

    A product of axes has a dimension for each of them. Other designs have the dimension "lane", with the columns of the design
    as coordinates. Runs that are not in the store yet are NaN, their result is -1. Runs that failed are NaN from there on, with
    their status in "result", an integer with the meanings in its attributes.

    Args:
        path: folder of the store.

    Raises:
        FileNotFoundError, ValueError: there is nothing, or something else.
        ImportError: xarray or Dask are not installed.
    """
    xarray = extra("xarray", "open_ensemble", "ensemble")
    extra("dask.array", "open_ensemble", "ensemble")
    path = Path(path)
    attributes = store.read_attributes(path)
    data = xarray.open_zarr(path, chunks={}, consolidated=True, mask_and_scale=False)
    data = _without_missing(data, path, attributes, xarray)
    about = attributes["design"]["columns"]
    if attributes["design"]["kind"] == "Product":
        data = _on_axes(data, about, xarray)
    else:
        columns = _drawn(attributes) if attributes["design"]["kind"] == "Draws" else _table(path, xarray)
        data = data.assign_coords(
            {name: ((LANE, *(f"{name}_{i}" for i in range(array.ndim - 1))), array) for name, array in columns.items()}
        )
    for name, one in about.items():
        data[name].attrs |= {key: one[key] for key in ("units", "description") if key in one}
    labels = {"slow": attributes["slow"], "fast": attributes["fast"], "level": LEVEL_NAMES, "quantile": list(LEVELS)}
    data = data.assign_coords({name: values for name, values in labels.items() if name in data.dims})
    kept = ("system", "lanes", "made_with")
    data.attrs = {"title": f"ensemble of {attributes['lanes']} runs"} | {name: attributes[name] for name in kept}
    return data


def _without_missing(data, path: Path, attributes: dict[str, Any], xarray):
    """Rows of chunks that do not count are taken out: perhaps only some of their arrays have been written."""
    lanes, chunk = attributes["lanes"], attributes["chunk"]
    there = np.zeros(-(-lanes // chunk), dtype=bool)
    there[list(store.committed(path))] = True
    if there.all():
        return data
    counts = xarray.DataArray(np.repeat(there, chunk)[:lanes], dims=LANE)
    return xarray.Dataset(
        {name: array.where(counts, FILL.get(array.dtype.kind, 0)) for name, array in data.items()}, attrs=data.attrs
    )


def _on_axes(data, about: dict[str, dict], xarray):
    """A dimension for each axis in place of the lanes."""
    axes = {name: one["values"] for name, one in about.items()}
    shape = tuple(map(len, axes.values()))
    arrays = {}
    for name, array in data.items():
        values = array.data.reshape((*shape, *array.shape[1:]))
        arrays[name] = xarray.DataArray(values, dims=(*axes, *array.dims[1:]), attrs=array.attrs)
    return xarray.Dataset(arrays, coords=axes)


def _drawn(attributes: dict[str, Any]):
    """Columns of random rows, each made when it is needed."""
    import dask.array

    design = _design_of(attributes)
    chunk, lanes = attributes["chunk"], attributes["lanes"]
    sizes = (*[chunk] * (lanes // chunk), *([lanes % chunk] if lanes % chunk else []))

    def of(name: str):
        def block(block_info: Any = None):
            ((first, last),) = block_info[None]["array-location"]
            return design.rows(first, last)[name]

        return dask.array.map_blocks(block, dtype=float, chunks=(sizes,), meta=np.zeros(0))

    return {name: of(name) for name in design.columns}


def _design_of(attributes: dict[str, Any]) -> Draws:
    """The random design of a store."""
    about = attributes["design"]
    columns = {}
    for name, one in about["columns"].items():
        kind, *arguments = one["distribution"]
        columns[name] = Draw(kind, tuple(arguments))
    return Draws(attributes["lanes"], columns, about["method"], about["seed"])


def _table(path: Path, xarray) -> dict[str, Any]:
    """Columns of a design that is a table."""
    found = xarray.open_zarr(path, group=store.DESIGN, chunks={}, consolidated=False, mask_and_scale=False)
    return {
        name: store.labelled(array.values, array.attrs) if store.LABELS in array.attrs else array.data
        for name, array in found.items()
    }
