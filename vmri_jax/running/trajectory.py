"""What a run returns: saved nodes, what the solver did, conserved quantities, and where it stopped."""

import dataclasses
import json
from pathlib import Path as FilePath
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from vmri_jax.mechanics.arrays import Numbers, require_x64
from vmri_jax.mechanics.state import State
from vmri_jax.running.files import replaced
from vmri_jax.steppers.results import Result

FORMAT = "vmri_jax trajectory 2"
NODES = ("t", "q_s", "q_f", "p_s", "p_f", "energy", "constraint_residual")
"""Fields with one entry per saved node; all others but `STATUS` have one per saved interval."""
STATUS = ("result", "failed_at")
MICRO = ("t_micro", "q_f_micro")
"""Fields that may be None."""


class RunInfo(NamedTuple):
    """What the solver did from one saved node to the next.

    Attributes:
        method: code of the most expensive method that a step took, see `Method`.
        iterations: most Newton iterations of a step, 0 for explicit ones.
        residual: largest residual that a step left, relative to the momentum, and of the constraints.
    """

    method: Int[Numbers, "k-1"]
    iterations: Int[Numbers, "k-1"]
    residual: Float[Numbers, "k-1"]


class Trajectory(eqx.Module):
    """Trajectory at the k saved macro nodes, the first one the start; in a batch every array has an axis of lanes before.

    Attributes:
        q_s, q_f, p_s, p_f: positions and momenta; NaN after a failure.
        energy: Hamiltonian.
        constraint_residual: largest |g| and largest |G v|.
        info: what the solver did since the node before.
        t_micro, q_f_micro: the micro nodes of the macro step that ends at each saved node (its start excluded); None unless
            asked for.
        result: status of the run, a `Result`; the first that was no success.
        failed_at: index of the macro step that failed, -1 if none did.
    """

    t: Float[Numbers, "k"]
    q_s: Float[Numbers, "k n_s"]
    q_f: Float[Numbers, "k n_f"]
    p_s: Float[Numbers, "k n_s"]
    p_f: Float[Numbers, "k n_f"]
    energy: Float[Numbers, "k"]
    constraint_residual: Float[Numbers, "k 2"]
    info: RunInfo
    result: Int[Numbers, ""]
    failed_at: Int[Numbers, ""]
    t_micro: Float[Numbers, "k-1 num_micro"] = None
    q_f_micro: Float[Numbers, "k-1 num_micro n_f"] = None

    @property
    def success(self):
        """Whether no step failed (of every run, in a batch)."""
        return self.result <= Result.CONVERGED_AT_ROUNDOFF

    @property
    def final_state(self):
        """`State` at the last saved node (of every run, in a batch)."""
        return State(self.t[..., -1], *(x[..., -1, :] for x in (self.q_s, self.q_f, self.p_s, self.p_f)))

    def plot(self, title: str = ""):
        """Positions, energy error and constraints against time, a matplotlib `Figure`; more in `vmri_jax.plots`.

        Args:
            title: over the figure.
        """
        from vmri_jax.plots import plot_trajectory  # matplotlib takes half a second

        return plot_trajectory(self, title)

    def save(self, path, drawing: dict | None = None) -> None:
        """Write all arrays to a .npz file (no pickled objects); a file that is there is replaced when all is on disk.

        Args:
            path: of the file.
            drawing: plain data of a `vmri_jax.animation.Drawing`, kept next to the arrays.
        """
        arrays = {name: np.asarray(value) for name, value in named_arrays(self).items() if value is not None}
        if drawing is not None:
            arrays["drawing"] = np.array(json.dumps(drawing))
        with replaced(path) as file:
            np.savez_compressed(file, **arrays, format=np.array(FORMAT))  # pyright: ignore[reportArgumentType]

    @classmethod
    def load(cls, path) -> "Trajectory":
        """Read a trajectory written by `save`.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a file that is damaged or not a trajectory.
        """
        require_x64()
        path = FilePath(path)
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; give the .npz file of a saved trajectory.")
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                arrays = dict(data)
        except Exception as error:
            raise ValueError(
                f"{path} cannot be read as a .npz file ({error}); it is damaged or something else."
            ) from error
        if str(arrays.pop("format", "")) != FORMAT:
            raise ValueError(f"{path} is a .npz file but not a trajectory saved by Trajectory.save.")
        arrays.pop("drawing", None)
        missing = _FIELDS - set(arrays) - set(MICRO)
        if missing or set(arrays) - _FIELDS:
            raise ValueError(
                f"{path} is a damaged trajectory: it lacks {sorted(missing)}, or has arrays of another kind."
            )
        return from_named_arrays({name: jnp.asarray(value) for name, value in arrays.items()})

    def to_xarray(self):
        """The trajectory as an `xarray.Dataset` over time (needs the extra ``vmri_jax[xarray]``)."""
        try:
            import xarray
        except ImportError as error:
            raise ImportError("to_xarray needs xarray; install it with pip install 'vmri_jax[xarray]'.") from error
        t = np.asarray(self.t)
        data = {
            "q_s": (("t", "slow"), self.q_s),
            "q_f": (("t", "fast"), self.q_f),
            "p_s": (("t", "slow"), self.p_s),
            "p_f": (("t", "fast"), self.p_f),
            "energy": ("t", self.energy),
            "constraint_residual": (("t", "level"), self.constraint_residual),
            "method": ("t_end", self.info.method),
            "iterations": ("t_end", self.info.iterations),
            "residual": ("t_end", self.info.residual),
        }
        if self.q_f_micro is not None:
            data["t_micro"] = (("t_end", "micro"), self.t_micro)
            data["q_f_micro"] = (("t_end", "micro", "fast"), self.q_f_micro)
        data = {k: (dims, np.asarray(v)) for k, (dims, v) in data.items()}
        coords = {"t": t, "t_end": t[1:], "level": ["position", "velocity"]}
        attributes = {"result": Result(int(self.result)).name, "failed_at": int(self.failed_at)}
        return xarray.Dataset(data, coords=coords, attrs=attributes)


def join(pieces: list[Trajectory]) -> Trajectory:
    """Consecutive trajectories, each starting where the one before ends, as one."""
    if len(pieces) == 1:
        return pieces[0]
    flat = [named_arrays(piece) for piece in pieces]
    failed = [f for f in flat if int(f["failed_at"]) >= 0]
    status = failed[0] if failed else max(flat, key=lambda f: int(f["result"]))

    def joined(name: str):
        first = flat[0][name]
        if first is None or name in STATUS:
            return status[name]
        skip = 1 if name in NODES else 0  # a piece starts with the last node of the one before
        return jnp.asarray(np.concatenate([first, *(f[name][skip:] for f in flat[1:])]))

    return from_named_arrays({name: joined(name) for name in flat[0]})


def named_arrays(trajectory: Trajectory) -> dict:
    """All arrays of a trajectory by name, those of `info` among them; None for what was not asked for."""
    fields = dict(vars(trajectory))
    return fields | fields.pop("info")._asdict()


def from_named_arrays(arrays: dict) -> Trajectory:
    """The inverse of `named_arrays`; those that may be None may be absent."""
    info = RunInfo(**{name: arrays.pop(name) for name in RunInfo._fields})
    return Trajectory(**arrays, info=info)


def from_arrays(arrays: list, saves: int | None = None) -> Trajectory:
    """The trajectory with these leaves, or the first `saves` saved intervals of it."""
    whole = jax.tree.unflatten(_STRUCTURES[len(arrays)], arrays)
    if saves is None or len(whole.t) == saves + 1:
        return whole

    def first(name: str, value):
        return value if value is None or name in STATUS else jnp.asarray(np.asarray(value)[: saves + (name in NODES)])

    return from_named_arrays({name: first(name, value) for name, value in named_arrays(whole).items()})


_FIELDS = {field.name for field in dataclasses.fields(Trajectory)} - {"info"} | set(RunInfo._fields)
_ONE = np.zeros(())
_STRUCTURES = {
    len(jax.tree.leaves(trajectory)): jax.tree.structure(trajectory)
    for micro in (None, _ONE)
    for trajectory in [from_named_arrays(dict.fromkeys(_FIELDS, _ONE) | dict.fromkeys(MICRO, micro))]
}
"""Of trajectories without and with micro nodes, by the number of their arrays."""
