"""The origin of a run, its system and names; and the evaluation of functions of system and state at all nodes of a run."""

import pickle
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np

from vmri_jax.mechanics.checks import check_system
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.rows import Part
from vmri_jax.mechanics.state import HasProblem, Problem, opened
from vmri_jax.mechanics.system import System
from vmri_jax.running.progress import Working
from vmri_jax.running.settings import Settings

SavedRun: TypeAlias = Any
"""A `vmri_jax.Trajectory` in annotations of modules that its own module imports."""


@partial(jax.tree_util.register_dataclass, data_fields=["bare", "params"], meta_fields=["names", "settings"])
@dataclass(frozen=True, eq=False)
class Origin:
    """The origin of a run, as far as it is known; a pytree, whose arrays have the lanes of a batch of runs as their first axes.

    Attributes:
        names: names of bodies and constraints; None if there are none.
        bare: the system without its parameters; None for a run that was read from a file.
        params: the parameters of the run, like ``system.params``.
        settings: scheme and steps of a run with an accuracy, for which they were chosen; else None.
    """

    names: Names | None = None
    bare: System | None = None
    params: Any = None
    settings: Settings | None = None

    @classmethod
    def of(cls, moving: System | Problem | HasProblem) -> "Origin":
        """The origin of runs of a system, a problem or a scene."""
        names = names_of(moving)
        system = opened(moving)
        system = system.system if isinstance(system, Problem) else system
        if not isinstance(system, System):
            raise TypeError(f"of: got {type(moving).__name__}; give the vmri_jax.System, Problem or Scene of the run.")
        return cls(names, system.with_params(None), system.params)

    @classmethod
    def from_file(cls, names: dict | None, settings: dict | None = None) -> "Origin":
        """The origin of a run that was read from a file: names and settings from plain data, without a system."""
        known_names = None if names is None else Names.from_dict(names)
        return cls(known_names, settings=None if settings is None else Settings.from_dict(settings))

    def repeated(self, lanes: tuple[int, ...], params: Any = None) -> "Origin":
        """The origin of a batch of runs: a view of every array with the axes of lanes, without copies.

        Args:
            lanes: shape of the batch.
            params: parameters with the axes of lanes, where lanes differ in them; None where all lanes share them.
        """
        if not lanes:
            return self

        def of_all(tree):
            return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (*lanes, *np.shape(leaf))), tree)

        return replace(self, bare=of_all(self.bare), params=of_all(self.params) if params is None else params)

    @property
    def knows_system(self) -> bool:
        """Whether the system is known."""
        return self.bare is not None

    def system(self, axes: int = 0) -> System:
        """The system with the parameters of the run; of a batch with the parameters of its first lane.

        Args:
            axes: number of axes of lanes.

        Raises:
            ValueError: the run does not know its system.
        """
        if self.bare is None:
            raise ValueError(
                "this run does not know its system, since it was read from a file, or pickled with functions that Python cannot "
                "pickle. Give it: run.of(problem), with the Problem, Scene or System that was simulated."
            )
        bare, params = (
            jax.tree.map(lambda leaf: leaf[(0,) * axes], (self.bare, self.params)) if axes else (self.bare, self.params)
        )
        return bare.with_params(params)

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
            raise ValueError(f"of: the run has {n_s} slow and {n_f} fast coordinates. {error}") from None

    def __getstate__(self) -> dict:
        """All fields for pickle; without the system if Python cannot pickle one of its functions, such as a lambda."""
        state = dict(vars(self))
        try:
            pickle.dumps(self.bare)
        except (pickle.PicklingError, AttributeError, TypeError):
            state |= {"bare": None, "params": None}
        return state


UNKNOWN = Origin()
"""The origin of a run whose system and names are unknown."""


def names_of(moving: Any) -> Names | None:
    """The names of a problem or a scene; None for a system."""
    return getattr(moving, "names", None)


def at_nodes(function, origin: Origin, nodes, *static):
    """``function(system, node, *static)`` at every node.

    Args:
        function: a function at module level, so that it is compiled once for each system structure.
        origin: the origin of the run.
        nodes: a `State` or tuple whose first array is the times, (k,) or in a batch (lanes, k).
        static: further arguments, the same at all nodes.

    Raises:
        ValueError: the system is not known.
    """
    axes = jax.tree.leaves(nodes)[0].ndim
    origin.system(axes - 1)  # raises if the system is not known
    arrays, structure = jax.tree.flatten((origin.bare, origin.params))
    # Arrays that all lanes share go in once: mapped over the lanes they would be copied for each.
    repeated = tuple(is_repeated(array, axes - 1) for array in arrays)
    arrays = [array[(0,) * (axes - 1)] if shared else array for array, shared in zip(arrays, repeated, strict=True)]
    with Working("quantities of the run"):
        return _mapped(function, repeated, structure, static, arrays, nodes)


def is_repeated(array, axes: int = 1) -> bool:
    """Whether an array of NumPy is a view with zero strides along the lanes, as `Origin.repeated` makes it."""
    return isinstance(array, np.ndarray) and axes > 0 and not any(array.strides[:axes])


@eqx.filter_jit
def _mapped(function, repeated: tuple[bool, ...], structure, static: tuple, arrays: list, nodes):
    def at_node(arrays, node):
        bare, params = jax.tree.unflatten(structure, arrays)
        return function(bare.with_params(params), node, *static)

    mapped = at_node
    for axis in range(jax.tree.leaves(nodes)[0].ndim):
        # axis 0, the innermost map, runs over the nodes
        lanes = [None if axis == 0 or shared else 0 for shared in repeated]
        mapped = jax.vmap(mapped, (lanes, 0))
    return mapped(arrays, nodes)
