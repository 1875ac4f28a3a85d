"""Functions of the user: checks of their arguments, the order of their params, and tracing once for all programs that
contain them.

JAX sorts the names of a dictionary whenever it takes a pytree apart: in jit, grad and vmap, and in ``jax.tree.map``.
Functions of the user may rely on the order of writing, ``zip(params["k"].values(), q_f.values())``. So the order is
kept with the functions, and every dictionary is put back into its order before a function is called, while JAX traces.
"""

import dataclasses
import inspect
from collections import Counter
from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from typing import Any, TypeAlias

import jax

from vmri_jax.mechanics.surroundings import Surroundings, innermost, name_of
from vmri_jax.refusals import Refused, warn_user

COPIES_UNTIL_WARNING = 5
"""Number of surroundings of one piece of code, each compiled anew, at which the user is warned. A larger number warns
late; a smaller one warns about programs that define a few variants on purpose."""
NO_TIME = (
    "Energies and masses that depend on time are out of scope. Take instead a force that depends on time, {force}, or "
    "a constraint that moves with time, {moving}."
)
"""Advice for an energy function that takes the time; {force} and {moving} are the signatures of forces and of
`Rheonomic` constraints."""
NO_VELOCITY = (
    "Constraints hold positions; one that moves with time is {moving}. Constraints on velocities (rolling without "
    "slip, skates) are out of scope. Take instead the positions that they hold, where there are such (x - radius * "
    "angle of a wheel that rolls along a line), or a strong damper on the velocity that is forbidden, {force}."
)
"""Advice for a constraint that takes the time or velocities."""
TIME_AND_VELOCITIES = ("t", "v_s", "v_f")
"""Names of arguments that only forces, kinetic energies and `Rheonomic` constraints get."""


Order: TypeAlias = tuple[tuple[Any, ...] | None, tuple[Any, ...]]
"""Names in a dictionary in the order of writing, None for a list, a tuple or another node of a pytree; and the order of
each entry, None for an entry without dictionaries."""


def order_of(tree: Any) -> Order | None:
    """The order of all dictionaries in a pytree; None if there is only one order."""
    if isinstance(tree, dict):
        parts = tuple(map(order_of, tree.values()))
        return (tuple(tree), parts) if len(tree) > 1 or any(parts) else None
    parts = tuple(None if child is tree else order_of(child) for child in _children(tree)[0])
    return (None, parts) if any(parts) else None


def in_order(tree: Any, order: Order | None) -> Any:
    """The pytree with its dictionaries in an order; names that the order does not know come last."""
    if order is None:
        return tree
    names, parts = order
    if names is not None and isinstance(tree, dict):
        of_names, ordered = dict(zip(names, parts, strict=True)), tree.copy()
        for name in [*(name for name in names if name in tree), *(name for name in tree if name not in of_names)]:
            ordered[name] = in_order(ordered.pop(name), of_names.get(name))  # moved to the end
        return ordered
    children, structure = _children(tree)
    if names is not None or len(children) != len(parts):
        return tree
    return jax.tree.unflatten(structure, map(in_order, children, parts))


def _children(tree: Any) -> tuple[list, Any]:
    """The entries of the outermost node of a pytree, and the structure of this node."""
    return jax.tree.flatten(tree, is_leaf=lambda node: node is not tree)


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True, eq=False)
class TracedOnce:
    """A function of arrays that JAX traces once per process, for given shapes of its arguments and for what it reads
    from around it.

    Later programs inline the traced operations, as if they had called the function. Two instances are equal if the
    codes of their functions, their surroundings and their orders are. A pytree node without arrays, whose structure is
    what the function reads.

    Args:
        function: of the user.
        seen: key of its `Surroundings` when a run was made; None for what the function reads now. With `seen` new
            traces after a change are refused: they would mix old and new numbers.
        order: in which the function gets the dictionaries in its last argument, the params; None for the order in which
            they come.
    """

    function: Callable
    seen: Hashable = None
    order: Order | None = None

    def __call__(self, *arguments):
        return _traced(self if self.seen is not None else self.now())(*arguments)

    def called(self, *arguments):
        """The value of the function, by its Python code."""
        around = Surroundings(self.function)
        if self.seen not in (None, around.key):
            raise Refused(
                f"{name_of(self)} reads something else from around it than when its run was made. Make the run again; "
                "what varies is better handed over in params."
            )
        if self.order is not None:
            *others, params = arguments
            arguments = *others, in_order(params, self.order)
        value = self.function(*arguments)
        around.before(Surroundings(self.function))
        return value

    def now(self) -> "TracedOnce":
        """The function with what it reads at present, for a run."""
        last = vars(self).get("last")
        if last is None or not last[0].hold():
            around = Surroundings(self.function)
            last = vars(self)["last"] = around, TracedOnce(self.function, around.key, self.order)
        return last[1]

    @property
    def is_of_user(self) -> bool:
        """Whether the function, or a function that it reads, has code of the user."""
        return Surroundings(self.function).have_code

    @property
    def _key(self) -> Hashable:
        return self.now().seen if self.seen is None else self.seen, self.order

    def __eq__(self, other) -> bool:
        return isinstance(other, TracedOnce) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return repr(self.function)

    def __reduce__(self):  # code cannot be pickled; another process reads what is there
        return TracedOnce, (self.function, None, self.order)

    def tree_flatten(self):
        """No arrays; the structure is what the function reads, and whether it keeps that."""
        return (), (self.seen is None, self.now() if self.seen is None else self)

    @classmethod
    def tree_unflatten(cls, structure, _):
        """The inverse of `tree_flatten`."""
        reads_now, function = structure
        return cls(function.function, order=function.order) if reads_now else function


class CompiledAgainWarning(UserWarning):
    """A function reads other numbers from around it again and again, and JAX compiles every program that contains it
    again."""


@lru_cache(maxsize=1024)
def _traced(function: TracedOnce) -> Callable:
    _count(function.function)

    @wraps(function.function, updated=())
    def operations(*arguments):
        return function.called(*arguments)

    return jax.jit(operations, inline=True)


def _count(function: Callable) -> None:
    """Count the surroundings in which one piece of code is traced, and warn once about `COPIES_UNTIL_WARNING` of
    them."""
    function = innermost(function)
    code = getattr(function, "__code__", None)
    package = __name__.partition(".")[0]
    if code is None or str(function.__module__).startswith(f"{package}."):  # each scene has its own terms
        return
    _made[code] += 1
    if _made[code] == COPIES_UNTIL_WARNING:
        warn_user(
            f"the function {function.__name__} (line {code.co_firstlineno} of {code.co_filename}) has been traced "
            f"{COPIES_UNTIL_WARNING} times, and everything that contains it compiled as often, since it reads other "
            "values from around it each time. Hand over what varies as params.",
            CompiledAgainWarning,
        )


_made: Counter = Counter()


def traced_once(function: Callable, order: Order | None = None) -> TracedOnce:
    """`function` as `TracedOnce`, with an order of its params; one that has an order keeps it."""
    if not isinstance(function, TracedOnce):
        return TracedOnce(function, order=order)
    return function if order is None or function.order else TracedOnce(function.function, order=order)


def check_arguments(place: str, function: Callable, arguments: str, instead: str = "") -> None:
    """Refuse a function of the user whose arguments have other names than the arguments of the call, or another order.

    Args:
        place: of the function, for messages: "System: constraint".
        function: of the user; a function without a signature is not checked.
        arguments: names of the arguments of the call, in order: "q_s, q_f, params".
        instead: advice if the function takes the time, velocities, or more arguments.

    Raises:
        TypeError: with both lists of arguments.
    """
    try:
        signature = inspect.signature(function)
    except (ValueError, TypeError):
        return
    expected = arguments.split(", ")
    positional = [p for p in signature.parameters.values() if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    required = [p.name for p in positional if p.default is p.empty]
    not_there = [name for name in required if name in TIME_AND_VELOCITIES and name not in expected]
    moved = [p.name for p, name in zip(positional, expected, strict=False) if p.name != name and p.name in expected]
    try:
        signature.bind(*expected)
        if not not_there and not moved:
            return
    except TypeError:
        pass
    if not_there or len(required) > len(expected):
        advice = instead or "Pass all further data in the params."
    else:
        advice = "Give it all of these arguments in this order, whether it uses them or not."
    name = getattr(function, "__name__", type(function).__name__)
    raise Refused(f"{place} is {name}{signature}; it is called with ({arguments}). {advice}")


@dataclasses.dataclass(frozen=True)
class Rheonomic:
    """A holonomic constraint that depends on time: a function with the time as its first argument.

        System(..., constraint=Rheonomic(guided))  # guided(t, q_s, q_f, params) -> (n_g,)

    The hidden constraint is ``G v + dg/dt = 0``. Constraint forces do work, so that energy is not conserved.

    Raises:
        TypeError: `function` is not callable.
    """

    function: Callable

    def __post_init__(self):
        if not callable(self.function):
            raise Refused(f"Rheonomic: function is {self.function!r}; give a function of (t, q_s, q_f, params).")
