"""Terms: a system is its coordinates and a list of terms, each a function with a kind.

| symbol | argument of `System` | kind | function |
|---|---|---|---|
| T | kinetic | kinetic | ``T(q_s, q_f, v_s, v_f, params) -> ()``, or a `ConstantMass` |
| T_s | slow_kinetic | kinetic | ``T_s(q_s, v_s, params) -> ()`` |
| V | slow_potential | potential | ``V(q_s, q_f, params) -> ()`` |
| W | fast_potential | potential | ``W(q_f, params) -> ()`` |
| a name, or k | potentials | potential | ``V_i(q_s, q_f, params) -> ()`` |
| g | constraint | constraint | ``g(q_s, q_f, params) -> (n_g,)`` |
| g_s | slow_constraint | constraint | ``g_s(q_s, params) -> (n_gs,)`` |
| F | force | force | ``F(t, q_s, q_f, v_s, v_f, params) -> (F_s, F_f)`` |
| g_i | implied | implied | ``g_i(q_s, q_f, params) -> (n_i,)`` |

A constraint or implied row that is `Rheonomic` gets t before the other arguments.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeVar

import jax

from vmri_jax.mechanics.functions import Order, traced_once
from vmri_jax.mechanics.masses import ConstantMass

POSITIONS, VELOCITIES = ("q_s", "q_f"), ("v_s", "v_f")
Value = TypeVar("Value")


class Named(dict[str | int, Value]):
    """Values of further potentials by name; as a pytree the names are structure: JAX cannot sort texts and numbers."""


jax.tree_util.register_pytree_node(
    Named,
    lambda named: (list(named.values()), tuple(named)),
    lambda names, values: Named(zip(names, values, strict=True)),
)


class Kind(NamedTuple):
    """The requirements of `System` on one of its functions.

    symbol: of the term; empty for further potentials, whose symbols are their names.
    kind: "kinetic", "potential", "constraint", "force" or "implied".
    arguments: names of the arguments, without params; rows may have t before them, see `Rheonomic`.
    in_words: for summaries, before the symbol or name.
    """

    symbol: str
    kind: str
    arguments: tuple[str, ...]
    in_words: str


KINDS: dict[str, Kind] = {
    "kinetic": Kind("T", "kinetic", (*POSITIONS, *VELOCITIES), "kinetic energy"),
    "slow_kinetic": Kind("T_s", "kinetic", ("q_s", "v_s"), "kinetic energy"),
    "slow_potential": Kind("V", "potential", POSITIONS, "slow potential"),
    "fast_potential": Kind("W", "potential", ("q_f",), "fast potential"),
    "constraint": Kind("g", "constraint", POSITIONS, "constraint"),
    "slow_constraint": Kind("g_s", "constraint", ("q_s",), "slow constraint"),
    "potentials": Kind("", "potential", POSITIONS, "potential"),
    "force": Kind("F", "force", ("t", *POSITIONS, *VELOCITIES), "force"),
    "implied": Kind("g_i", "implied", POSITIONS, "implied rows"),
}
"""The functions of a system, by the argument of `System`, in the order of summaries."""


@partial(jax.tree_util.register_dataclass, data_fields=["function"], meta_fields=["field", "name", "arguments"])
@dataclass(frozen=True)
class Term:
    """A function of a system.

    field: the argument of `System` that has it.
    name: its symbol, or the name of a further potential: a text, or a whole number k.
    arguments: names of its arguments, without params: some of t, q_s, q_f, v_s, v_f.
    function: `TracedOnce`, or a `ConstantMass`.
    """

    field: str
    name: str | int
    arguments: tuple[str, ...]
    function: Callable

    def __call__(self, params, **values):
        """The value of the function, with its arguments by name among `values`."""
        return self.function(*self.of_arguments(values), params)

    def at(self, positions, params):
        """Its value at the positions (q_s, q_f)."""
        return self(params, **dict(zip(POSITIONS, positions, strict=True)))

    def of_arguments(self, values) -> list:
        """Its arguments, in order, out of a mapping by name."""
        return [values[name] for name in self.arguments]

    def with_function(self, function: Callable, order: Order | None) -> "Term":
        """The term with another function of the same arguments; `order` is of the params."""
        is_mass = isinstance(function, ConstantMass)
        return replace(self, function=function if is_mass else traced_once(function, order))

    @property
    def kind(self) -> str:
        """Its kind, see `Kind`."""
        return KINDS[self.field].kind

    @property
    def label(self) -> str:
        """Its name in texts: V_k for the potential k."""
        return label(self.name)

    @property
    def place(self) -> str:
        """Its place in messages, ``slow_potential`` or ``potentials['bends']``."""
        return f"potentials[{self.name!r}]" if self.field == "potentials" else self.field

    @property
    def moves(self) -> bool:
        """Whether its rows depend on time: `System` takes and shows its function as `Rheonomic`."""
        return "t" in self.arguments and self.kind != "force"


def label(name: str | int) -> str:
    """The name of a potential in texts; V_k for the name k."""
    return f"V_{name}" if isinstance(name, int) else name
