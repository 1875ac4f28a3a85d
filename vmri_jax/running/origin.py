"""The origin of a run, its system and names; and the evaluation of functions of system and state at all nodes of a run."""

import math
import pickle
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import is_concrete, library, of_one_type, options_of_runs
from vmri_jax.mechanics.checks import check_system
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.rows import Part
from vmri_jax.mechanics.state import HasProblem, Problem, opened
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused
from vmri_jax.running.progress import Working
from vmri_jax.running.settings import Settings

SavedRun: TypeAlias = Any
"""A `vmri_jax.Trajectory` in annotations of modules that its own module imports."""

NODES_AT_ONCE = 16
"""Nodes of a block, evaluated side by side. With fewer nodes XLA uses no vector instructions; with 64 the matrices of scenes no longer fit into the
first-level cache, and a run of a few nodes takes longer."""
NUMBERS_PER_CALL = 4096
"""Numbers in the nodes of a call, 32 kB. A larger value makes calls for short runs slower, which copy all of them; a smaller value divides long runs
into more calls of some 20 microseconds each."""


@partial(jax.tree_util.register_dataclass, data_fields=["simulated"], meta_fields=["names", "settings"])
@dataclass(frozen=True, eq=False)
class Origin:
    """The origin of a run, as far as it is known; a pytree, whose arrays have the lanes of a batch of runs as their first axes.

    Attributes:
        names: names of bodies and constraints; None if there are none.
        simulated: the system with the parameters of the run; None for a run that was read from a file.
        settings: scheme and steps of a run with an accuracy, for which they were chosen; else None.
    """

    names: Names | None = None
    simulated: System | None = None
    settings: Settings | None = None

    @classmethod
    def of(cls, moving: System | Problem | HasProblem) -> "Origin":
        """The origin of runs of a system, a problem or a scene."""
        names = names_of(moving)
        system = opened(moving)
        system = system.system if isinstance(system, Problem) else system
        if not isinstance(system, System):
            raise Refused(f"of: got {type(moving).__name__}; give the vmri_jax.System, Problem or Scene of the run.")
        return cls(names, system)

    @classmethod
    def from_file(cls, names: dict | None, settings: dict | None = None) -> "Origin":
        """The origin of a run that was read from a file: names and settings from plain data, without a system."""
        known_names = None if names is None else Names.from_dict(names)
        return cls(known_names, settings=None if settings is None else Settings.from_dict(settings))

    def with_params(self, params) -> "Origin":
        """The origin of a run with other parameters."""
        return self if self.simulated is None else replace(self, simulated=self.simulated.with_params(params))

    def repeated(self, lanes: tuple[int, ...]) -> "Origin":
        """The origin of a batch of runs: a view of every array with the axes of lanes, without copies."""
        return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (*lanes, *np.shape(leaf))), self) if lanes else self

    @property
    def knows_system(self) -> bool:
        """Whether the system is known."""
        return self.simulated is not None

    def system(self, axes: int = 0) -> System:
        """The system with the parameters of the run; of a batch with the parameters of its first lane.

        Args:
            axes: number of axes of lanes.

        Raises:
            ValueError: the run does not know its system.
        """
        if self.simulated is None:
            raise Refused(
                "this run does not know its system, since it was read from a file, or pickled with functions that Python cannot "
                "pickle. Give it: run.of(problem), with the Problem, Scene or System that was simulated."
            )
        return jax.tree.map(lambda leaf: leaf[(0,) * axes], self.simulated) if axes else self.simulated

    def shaped(self, part: Part, vectors) -> Any:
        """Vectors (..., n) in the form in which the user gave the start: vectors, or a dictionary of arrays by name."""
        return vectors if self.names is None else self.names.shaped(part, vectors)

    def check(self, n_s: int, n_f: int) -> None:
        """Refuse a system whose numbers of coordinates differ from the run.

        Raises:
            ValueError: with the numbers of the run.
        """
        try:
            check_system(self.system(), np.zeros(n_s), np.zeros(n_f))
        except ValueError as error:
            raise Refused(f"of: the run has {n_s} slow and {n_f} fast coordinates. {error}") from None

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


def names_of(moving: Any) -> Names | None:
    """The names of a problem or a scene; None for a system."""
    return getattr(moving, "names", None)


def at_nodes(function, origin: Origin, nodes, *static):
    """``function(system, node, *static)`` at every node; of concrete numbers by one program for runs of all lengths.

    Args:
        function: a function at module level, so that it is compiled once for each system structure.
        origin: the origin of the run.
        nodes: a `State` or tuple whose first array is the times, (k,) or in a batch (lanes, k).
        static: further arguments, the same at all nodes.

    Raises:
        ValueError: the system is not known.
    """
    arrays, structure = jax.tree.flatten(origin.system())  # raises if the system is not known
    with Working("quantities of the run"):
        return evaluated(function, structure, of_one_type(arrays), nodes, *static)


def evaluated(function, structure, arrays: list, nodes, *static):
    """`at_nodes` of the system with this structure and these leaves, which have the axes of lanes in a batch; concrete values as arrays of NumPy.

    A call of the program gets a room of nodes, of which it evaluates the first blocks; long runs take several calls.
    """
    shape = np.shape(jax.tree.leaves(nodes)[0])
    axes, count = len(shape), math.prod(shape)
    # Arrays that all lanes share go in once: for each node they would be copied.
    is_shared = [axes == 1 or is_repeated(array, axes - 1) for array in arrays]
    shared = [array[(0,) * (axes - 1)] if once else None for array, once in zip(arrays, is_shared, strict=True)]
    of_lanes = _in_a_row([None if once else array for array, once in zip(arrays, is_shared, strict=True)], axes - 1)
    of_nodes = _in_a_row(nodes, axes)
    if not is_concrete((arrays, nodes)):
        of_nodes_lanes = _rows(of_lanes, np.arange(count) // shape[-1])
        values = _at_all(function, structure, static, True)(shared, of_nodes_lanes, of_nodes)
        return jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), values)
    numbers = sum(math.prod(leaf.shape[1:]) for leaf in jax.tree.leaves((of_lanes, of_nodes)))
    room = max(NUMBERS_PER_CALL // numbers // NODES_AT_ONCE, 1) * NODES_AT_ONCE
    program, pieces = _at_all(function, structure, static, False), []
    for first in range(0, count, room):
        node, size = np.minimum(np.arange(first, first + room), count - 1), min(room, count - first)
        parts = _rows(of_lanes, node // shape[-1]), _rows(of_nodes, node)  # the last node fills up the room
        values = program(shared, *parts, -(-size // NODES_AT_ONCE))
        as_array = (
            np.asarray if is_concrete(values) else jnp.asarray
        )  # tracers, where JAX is tracing a function around this one
        pieces.append(jax.tree.map(lambda a, size=size, as_array=as_array: as_array(a)[:size], values))

    def joined(*parts):
        return library(parts).concatenate(parts).reshape(*shape, *parts[0].shape[1:])

    return jax.tree.map(joined, *pieces)


def is_repeated(array, axes: int = 1) -> bool:
    """Whether an array of NumPy is a view with zero strides along the lanes, as `Origin.repeated` makes it."""
    return isinstance(array, np.ndarray) and axes > 0 and not any(array.strides[:axes])


def _in_a_row(tree, axes: int):
    """The arrays with their first axes joined to one."""
    as_array = np.asarray if is_concrete(tree) else jnp.asarray
    return jax.tree.map(lambda a: as_array(a).reshape(int(np.prod(a.shape[:axes])), *a.shape[axes:]), tree)


def _rows(tree, rows: np.ndarray):
    return jax.tree.map(lambda a: a[rows], tree)


@lru_cache(maxsize=64)
def _at_all(function, structure, static: tuple, traced: bool):
    """``program(shared, of_lanes, of_nodes, blocks)``: values at the nodes of the first blocks, zeros for all others; traced at all nodes."""

    def at_node(shared, of_lane, node):
        arrays = [lane if array is None else array for array, lane in zip(shared, of_lane, strict=True)]
        return function(jax.tree.unflatten(structure, arrays), node, *static)

    at_block = jax.vmap(jax.jit(at_node), (None, 0, 0))  # jitted, so that shapes and values take one trace

    def program(shared, of_lanes, of_nodes, blocks):
        def block(i, values):
            part = jax.tree.map(lambda a: slice_in_dim(a, i * NODES_AT_ONCE, NODES_AT_ONCE), (of_lanes, of_nodes))
            new = at_block(shared, *part)
            return jax.tree.map(lambda a, b: update_in_dim(a, b, i * NODES_AT_ONCE, 0), values, new)

        slice_in_dim, update_in_dim = jax.lax.dynamic_slice_in_dim, jax.lax.dynamic_update_slice_in_dim
        shapes = jax.eval_shape(at_block, shared, of_lanes, of_nodes)
        return jax.lax.fori_loop(0, blocks, block, jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shapes))

    return (
        jax.jit(lambda *arrays: at_block(*arrays[:3]))
        if traced
        else jax.jit(program, compiler_options=options_of_runs())
    )
