"""What a run is of: its system and the names of its parts, and functions of a state at all of its nodes."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from vmri_jax.mechanics.checks import check_system
from vmri_jax.mechanics.names import Names
from vmri_jax.mechanics.state import HasProblem, Problem, opened
from vmri_jax.mechanics.system import System
from vmri_jax.running.settings import Settings


class Origin(NamedTuple):
    """What a run is of, as far as it is known.

    names: of bodies and constraints, None if nothing has one.
    system: what moved; None of a run that was read from a file.
    params: parameters of the run, as of its system.
    lanes: whether these have a batch axis.
    settings: scheme and steps, where they were chosen for an accuracy.
    """

    names: Names | None = None
    system: System | None = None
    params: Any = None
    lanes: bool = False
    settings: Settings | None = None

    @classmethod
    def of(cls, what: System | Problem | HasProblem) -> "Origin":
        """That of a system, a problem or a scene."""
        names = names_of(what)
        system = opened(what)
        system = system.system if isinstance(system, Problem) else system
        if not isinstance(system, System):
            raise TypeError(f"of: got {type(what).__name__}; give the vmri_jax.System, Problem or Scene of the run.")
        return cls(names, system, system.params)

    @classmethod
    def from_file(cls, names: dict | None, settings: dict | None = None) -> "Origin":
        """That of a run of which names and settings are known at most, from plain data."""
        known_names = None if names is None else Names.from_dict(names)
        return cls(known_names, settings=None if settings is None else Settings.from_dict(settings))

    def without_system(self) -> "Origin":
        """Names and settings alone: functions of a system may not be pickled."""
        return Origin(self.names, settings=self.settings)

    @property
    def known_system(self) -> System:
        """The system.

        Raises:
            ValueError: it is not known.
        """
        if self.system is None:
            raise ValueError(
                "this run does not know its system, since it was read from a file or went through a transformation of JAX. "
                "Give it: run.of(problem), with the Problem, Scene or System that was simulated."
            )
        return self.system

    def check(self, n_s: int, n_f: int) -> None:
        """Refuse a system of other coordinates than the run.

        Raises:
            ValueError: with what does not fit.
        """
        try:
            check_system(self.known_system, np.zeros(n_s), np.zeros(n_f))
        except ValueError as error:
            raise ValueError(f"of: the run has {n_s} slow and {n_f} fast coordinates. {error}") from None

    def lane(self, i: int) -> "Origin":
        """That of one run of a batch."""
        if not self.lanes:
            return self
        return self._replace(params=jax.tree.map(lambda a: a[i], self.params), lanes=False)


def names_of(what: Any) -> Names | None:
    """The names that a problem or a scene has."""
    return getattr(what, "names", None)


def at_nodes(function, origin: Origin, nodes, *static):
    """``function(system, node, *static)`` at every node.

    Args:
        function: of a module: it is compiled once for each system structure.
        origin: its system and parameters.
        nodes: a `State` or tuple whose first array is the times (k,), of a batch (lanes, k).
        static: further arguments, the same at all nodes.

    Raises:
        ValueError: the system is not known.
    """
    axes = jax.tree.leaves(nodes)[0].ndim
    return _mapped(function, axes, origin.lanes, static, origin.known_system, origin.params, nodes)


@eqx.filter_jit
def _mapped(function, axes: int, lanes: bool, static: tuple, system: System, params, nodes):
    def at(params, node):
        return function(system.replace(params=params), node, *static)

    for axis in range(axes):
        at = jax.vmap(at, (0 if axis == 1 and lanes else None, 0))
    return at(params, nodes)
