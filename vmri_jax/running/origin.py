"""The origin of a run: its system and names, and the settings that were chosen for an accuracy; and the evaluation of
functions of system and state at all nodes of a run."""

import math
import pickle
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, of_one_type
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.rows import Part
from vmri_jax.mechanics.state import Movable, Problem, opened
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.progress import Working
from vmri_jax.schemes.composition import SchemeLike, stage_scheme
from vmri_jax.schemes.plain_data import from_plain, to_plain

SavedRun: TypeAlias = Any
"""A `vmri_jax.Trajectory` in annotations of modules that its own module imports."""

NODES_PER_CALL = 64
"""Nodes of a call, evaluated side by side. With a larger value runs of a few nodes take longer; with a smaller one long
runs take more calls of some 20 microseconds each."""


@dataclass(frozen=True)
class Settings:
    """The arguments of `vmri_jax.simulate` that repeat a run from the same start:
    ``vm.simulate(problem, **run.settings.arguments)``.

    Attributes:
        scheme: the scheme or composition.
        python: the Python expression of the scheme.
        options: the options of the scheme on the command line; empty for a scheme of the user.
        macro_dt: macro step H.
        num_steps: macro steps of the run.
        save_every: macro steps from one saved node to the next.
        gain: computing time with one micro step per macro step, divided by the time with the chosen number, for the
            same error; computed from the prices and error shares of the trial runs.
    """

    scheme: SchemeLike = field(compare=False)  # `python` and the numbers identify it
    python: str
    options: str
    macro_dt: float
    num_steps: int
    save_every: int
    gain: float = 1.0

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `vmri_jax.simulate` by name."""
        steps = {"macro_dt": self.macro_dt, "num_steps": self.num_steps, "save": self.save_every}
        return {"scheme": self.scheme, **steps}

    def command(self, system: str) -> str:
        """The command line that repeats the run of a system; without the scheme's options if the scheme is the
        user's."""
        steps = f"--macro-dt {self.macro_dt!r} --steps {self.num_steps} --save-every {self.save_every}"
        num_micro = stage_scheme(self.scheme).num_micro
        return f"vmri simulate {shlex.quote(system)} {self.options} --num-micro {num_micro} {steps}"

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**vars(self), "scheme": to_plain(self.scheme)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Settings":
        """The inverse of `to_dict`, also after a round trip through JSON."""
        return cls(**{**data, "scheme": from_plain(data["scheme"])})

    def __str__(self) -> str:
        return f"{self.python}, macro_dt={self.macro_dt!r}, num_steps={self.num_steps}, save={self.save_every}"


@partial(jax.tree_util.register_dataclass, data_fields=["simulated"], meta_fields=["names", "settings"])
@dataclass(frozen=True, eq=False)
class Origin:
    """The origin of a run, as far as it is known; a pytree, whose arrays have the lanes of a batch of runs as their
    first axes.

    Attributes:
        names: names of bodies and constraints; None if there are none.
        simulated: the system with the parameters of the run; None for a run that was read from a file.
        settings: scheme and steps of a run with an accuracy, for which they were chosen; else None.
    """

    names: Names | None = None
    simulated: System | None = None
    settings: Settings | None = None

    @classmethod
    def of(cls, moving: Movable) -> "Origin":
        """The origin of runs of a system, a problem or a scene."""
        system = opened(moving)
        system = system.system if isinstance(system, Problem) else system
        if not isinstance(system, System):
            raise Refused(f"of: got {type(moving).__name__}; give the vmri_jax.System, Problem or Scene of the run.")
        return cls(getattr(moving, "names", None), system)

    @classmethod
    def from_file(cls, names: dict | None, settings: dict | None = None) -> "Origin":
        """The origin of a run that was read from a file: names and settings from plain data, without a system."""
        known_names = None if names is None else Names.from_dict(names)
        return cls(known_names, settings=None if settings is None else Settings.from_dict(settings))

    def repeated(self, lanes: tuple[int, ...]) -> "Origin":
        """The origin of a batch of runs: a view of every array with the axes of lanes, without copies."""
        return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (*lanes, *np.shape(leaf))), self) if lanes else self

    def system(self, axes: int = 0) -> System:
        """The system with the parameters of the run, which has a number of axes of lanes: of its first lane."""
        if self.simulated is None:
            lost = "it was read from a file, or pickled with functions that Python cannot pickle"
            raise Refused(f"this run does not know its system: {lost}. Give what was simulated: run.of(problem).")
        return jax.tree.map(lambda leaf: leaf[(0,) * axes], self.simulated) if axes else self.simulated

    def shaped(self, part: Part, vectors) -> Any:
        """Vectors (..., n) in the form in which the user gave the start: vectors, or a dictionary of arrays by name."""
        return vectors if self.names is None else self.names.shaped(part, vectors)

    def __getstate__(self) -> dict:
        """All fields for pickle; without the system if Python cannot pickle one of its functions, such as a lambda."""
        state = dict(vars(self))
        try:
            pickle.dumps(self.simulated)
        except (pickle.PicklingError, AttributeError, TypeError):
            state["simulated"] = None
        return state


UNKNOWN = Origin()
"""The origin of a run whose system and names are unknown."""


def at_nodes(function, origin: Origin, nodes, *static):
    """``function(system, node, *static)`` at every node; of concrete numbers by one program for runs of all lengths.

    The function is at module level, so that it is compiled once for each system structure; `nodes` are a `State` or a
    tuple whose first array is the times, (k,) or in a batch (lanes, k).
    """
    arrays, structure = jax.tree.flatten(origin.system())  # raises if the system is not known
    arrays, shape = of_one_type(arrays), np.shape(jax.tree.leaves(nodes)[0])
    axes, count = len(shape) - 1, math.prod(shape)
    # Arrays that all lanes share go in once: for each node they would be copied.
    is_shared = tuple(not axes or is_repeated(array, axes) for array in arrays)
    arrays = [a[(0,) * axes] if once else _in_a_row(a, axes) for a, once in zip(arrays, is_shared, strict=True)]
    of_nodes, program, pieces = _in_a_row(nodes, axes + 1), _at_all(function, structure, is_shared, static), []
    size = NODES_PER_CALL if is_concrete((arrays, nodes)) else count
    with Working("quantities of the run"):
        for first in range(0, count, size):
            node = np.minimum(np.arange(first, first + size), count - 1)  # the last node fills up the last call
            lanes = [a if once else a[node // shape[-1]] for a, once in zip(arrays, is_shared, strict=True)]
            pieces.append(program(lanes, jax.tree.map(lambda a, node=node: a[node], of_nodes)))

    def joined(*parts):
        return library(parts).concatenate(parts)[:count].reshape(*shape, *parts[0].shape[1:])

    return jax.tree.map(joined, *pieces)


def is_repeated(array, axes: int = 1) -> bool:
    """Whether an array of NumPy is a view with zero strides along the lanes, as `Origin.repeated` makes it, or is
    empty, with any strides."""
    return isinstance(array, np.ndarray) and axes > 0 and not (array.size and any(array.strides[:axes]))


def _in_a_row(tree, axes: int):
    """The arrays with their first axes joined to one."""
    as_array = np.asarray if is_concrete(tree) else jnp.asarray
    return jax.tree.map(lambda a: as_array(a).reshape(int(np.prod(a.shape[:axes])), *a.shape[axes:]), tree)


@lru_cache(maxsize=64)
def _at_all(function, structure, is_shared: tuple[bool, ...], static: tuple) -> Callable:
    """``program(arrays, nodes)``: values at all nodes; arrays of the system that are not shared have one for each
    node."""

    def at_node(arrays, node):
        return function(jax.tree.unflatten(structure, arrays), node, *static)

    return jax.jit(jax.vmap(at_node, ([None if once else 0 for once in is_shared], 0)))
