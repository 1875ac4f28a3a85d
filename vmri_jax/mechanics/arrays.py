"""Numbers as users give them: real, and float64."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

Numbers: TypeAlias = Any
"""Arrays in annotations: ``Float[Numbers, "n_s"]`` is an array of n_s floats, of JAX or of NumPy."""
Number: TypeAlias = Float[Numbers, ""] | float
"""A number in annotations, of Python or as an array."""

ADVICE = "give float64: lists of numbers, NumPy arrays by .astype(float), JAX arrays made after vm.configure()"
"""What to do about numbers of less than 64 bits."""

QUICK = {"xla_backend_optimization_level": 0}
"""Options of the compiler for programs that run for milliseconds: compiled in half the time, at the same speed on small matrices."""


def is_concrete(tree) -> bool:
    """Whether a pytree holds values, rather than tracers of jit, vmap or grad."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))  # pyright: ignore[reportAttributeAccessIssue]


def library(*values):
    """NumPy, or `jax.numpy` where a value is traced: single calls of JAX take some 20 ms each the first time."""
    return np if is_concrete(values) else jnp


def quickly_compiled(function: Callable, static_argnames: str | Sequence[str] = ()) -> Callable:
    """A function that runs a few times, compiled with the options `QUICK`; within a function that JAX stages it is a part of its program.

    Args:
        function: of arrays, and of the arguments that `static_argnames` names.
        static_argnames: as of `jax.jit`.
    """
    quick = jax.jit(function, static_argnames=static_argnames, compiler_options=QUICK)
    part = jax.jit(function, static_argnames=static_argnames)  # JAX takes options for whole programs alone

    @wraps(function)
    def call(*arguments):
        is_whole = is_concrete((arguments, jnp.zeros(())))  # while JAX stages a program, all new arrays are tracers
        return (quick if is_whole else part)(*arguments)

    return call


def of_one_type(tree):
    """A pytree with its numbers as arrays of NumPy, tracers as they are: what differs in kind would be traced anew."""
    return jax.tree.map(lambda leaf: np.asarray(leaf) if is_concrete(leaf) else leaf, tree)


def require_x64() -> None:
    """Raise unless JAX's 64-bit mode is on."""
    if jnp.result_type(float) != np.float64:
        raise ValueError(
            "vmri_jax needs 64-bit floats: Newton and the constraints are solved to round-off. Switch them on at the start "
            "of the program with vm.configure() (vm is vmri_jax), which also makes runs fast, or with "
            'jax.config.update("jax_enable_x64", True).'
        )


def is_short(value) -> bool:
    """Whether a value is an array of floats with less than 64 bits each."""
    dtype = getattr(value, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.inexact) and jnp.finfo(dtype).bits < 64


def check_precision(name: str, value) -> None:
    """Refuse floats of less than 64 bits, in lists too: the digits that they lack cannot come back.

    Raises:
        ValueError: the 64-bit mode is off, where all arrays of JAX are short; or this array is.
    """
    for leaf in jax.tree.leaves(value):
        if is_short(leaf):
            if isinstance(leaf, jax.Array):
                require_x64()
            raise ValueError(f"{name} has dtype {leaf.dtype}; {ADVICE}.")


def real_array(name: str, value, ndim: int | None = None):
    """Numbers as users give them as an array of float64, of JAX if they are, else of NumPy.

    Args:
        name: what they are called in messages.
        ndim: how many dimensions they must have, None for any.

    Raises:
        TypeError: what is not real.
        ValueError: floats of less than 64 bits, or another number of dimensions.
    """
    advice = "give a real number" if ndim == 0 else "give real numbers, an array of float64"
    if is_concrete(value):
        try:
            kind = "f" if is_short(value) else np.asarray(value).dtype.kind
        except Exception:  # ragged lists, and whatever an object of one's own raises
            kind = ""
        if kind not in tuple("biuf"):
            raise TypeError(f"{name} is {value!r}; {advice}.")
    check_precision(name, value)
    given = isinstance(value, jax.Array) or not is_concrete(value)
    array = jnp.asarray(value, dtype=float) if given else np.asarray(value, dtype=float)
    if ndim is not None and array.ndim != ndim:
        raise ValueError(f"{name} has shape {array.shape}; {advice}.")
    return array


def whole_number(what: str, value, least: int = 1, otherwise: str = "") -> int:
    """An integer of at least `least`; messages call it `what`, and say what else may be given."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{what} is {value!r}; it must be an integer of at least {least}{otherwise}.")
    return int(value)
