"""The user's functions: Python code that runs once for all programs that they are part of."""

import dataclasses
import inspect
import warnings
from collections import Counter
from collections.abc import Callable
from functools import lru_cache

import jax

COPIES_UNTIL_WARNING = 5
"""Functions made of one piece of code, each compiled anew, until the user is warned; a larger value lets more time go by, a smaller one warns about
a few cases that are meant."""


NO_TIME = (
    "Energies and masses that depend on time are out of scope. Take instead a force that depends on time, {force}, or a constraint that "
    "moves with time, {moving}."
)
"""What a function of energy that takes the time is told; {force} and {moving} say how these are given."""
NO_VELOCITY = (
    "Constraints hold positions; one that moves with time is {moving}. Constraints on velocities (rolling without slip, skates) are out "
    "of scope. Take instead the positions that they hold, where there are such (x - radius * angle of a wheel that rolls along a line), or a "
    "strong damper on the velocity that is forbidden, {force}."
)
"""What a constraint that takes the time or velocities is told."""
NOT_FOR_ALL = ("t", "v_s", "v_f")
"""Names of arguments that only some functions get."""


@dataclasses.dataclass(frozen=True)
class TracedOnce:
    """A function of arrays whose Python code runs once per process and shapes of its arguments.

    Programs take over what was traced, operation by operation, as if the function had been called in them. Two of these
    are equal if their functions are.
    """

    function: Callable

    def __call__(self, *arguments):
        return _traced(self.function)(*arguments)

    def __repr__(self) -> str:
        return repr(self.function)


class CompiledAgainWarning(UserWarning):
    """The same function is made anew again and again, and everything that contains it is compiled each time."""


@lru_cache(maxsize=1024)
def _traced(function: Callable) -> Callable:
    _count(function)
    return jax.jit(function, inline=True)


def _count(function: Callable) -> None:
    """Warn, once for each piece of code, that functions are made of it again and again."""
    function = getattr(function, "function", function)  # of `vmri_jax.mechanics.by_name.ByName`
    code = getattr(function, "__code__", None)
    if code is None:
        return
    _made[code] += 1
    if _made[code] == COPIES_UNTIL_WARNING:
        warnings.warn(
            f"the function {function.__name__} (line {code.co_firstlineno} of {code.co_filename}) has been made {COPIES_UNTIL_WARNING} times, and "
            "everything that contains it was compiled as often, since functions are compared by identity. Define it once, outside of "
            "the loop, and hand over what varies as params.",
            CompiledAgainWarning,
            stacklevel=2,
        )


_made: Counter = Counter()


def traced_once(function: Callable) -> TracedOnce:
    """`function` as `TracedOnce`, if it is not one already."""
    return function if isinstance(function, TracedOnce) else TracedOnce(function)


def check_arguments(what: str, function: Callable, arguments: str, instead: str = "") -> None:
    """Refuse a function of the user that takes other arguments than it is called with, or the same in another order.

    Args:
        what: the function's place, for messages: "System: constraint".
        function: of the user; where Python knows no signature of it, nothing is checked.
        arguments: names of the arguments that it is called with, in order: "q_s, q_f, params".
        instead: what to do where it takes the time, velocities, or more arguments.

    Raises:
        TypeError: with both lists of arguments.
    """
    try:
        signature = inspect.signature(function)
    except (ValueError, TypeError):
        return
    expected = arguments.split(", ")
    places = [p for p in signature.parameters.values() if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    required = [p.name for p in places if p.default is p.empty]
    not_there = [name for name in required if name in NOT_FOR_ALL and name not in expected]
    moved = [p.name for p, name in zip(places, expected, strict=False) if p.name != name and p.name in expected]
    try:
        signature.bind(*expected)
        if not not_there and not moved:
            return
    except TypeError:
        pass
    if not_there or len(required) > len(expected):
        advice = instead or "What varies besides them belongs into the params."
    else:
        advice = "Give it all of these arguments in this order, whether it uses them or not."
    name = getattr(function, "__name__", type(function).__name__)
    raise TypeError(f"{what} is {name}{signature}; it is called with ({arguments}). {advice}")


@dataclasses.dataclass(frozen=True)
class Rheonomic:
    """A holonomic constraint that depends on time: a function with the time as its first argument.

        System(..., constraint=Rheonomic(guided))  # guided(t, q_s, q_f, params) -> (n_g,)

    Its hidden constraint is ``G v + dg/dt = 0``. It does work: energy is not kept.

    Raises:
        TypeError: function is no function.
    """

    function: Callable

    def __post_init__(self):
        if not callable(self.function):
            raise TypeError(f"Rheonomic: function is {self.function!r}; give a function of (t, q_s, q_f, params).")


def with_time(function, t, *arguments):
    """A constraint as a plain function and its arguments, the time the first of them if it is `Rheonomic`."""
    return (function.function, (t, *arguments)) if isinstance(function, Rheonomic) else (function, arguments)
