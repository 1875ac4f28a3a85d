"""Checks and conversions of the numbers of users: real, and float64."""

from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from itertools import pairwise
from typing import Any, TypeAlias, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.refusals import Refused

Numbers: TypeAlias = Any
"""Arrays in annotations: ``Float[Numbers, "n_s"]`` is an array of n_s floats, of JAX or of NumPy."""
Number: TypeAlias = Float[Numbers, ""] | float
"""A number in annotations, of Python or as an array."""

ADVICE = "give float64: lists of numbers, NumPy arrays by .astype(float), JAX arrays made after vm.configure()"
"""Advice in messages about floats of less than 64 bits."""

QUICK = {"xla_backend_optimization_level": 0}
"""Compiler options for programs that run for milliseconds: with `OLDER_EMITTERS` they compile in a third of the time,
and run as fast on small matrices."""
OLDER_EMITTERS = {"xla_cpu_use_fusion_emitters": False}
"""Compiler options for programs of runs: XLA writes kernels in LLVM's language at once, not by dozens of MLIR passes.
First results take 8 to 33 % less time; steps take as long, but for one of eight programs (1.14 times as long)."""


def is_concrete(tree) -> bool:
    """Whether a pytree holds values, rather than tracers of jit, vmap or grad."""
    if isinstance(tree, np.ndarray):  # asked several times by each call of a prepared run
        return True
    return not any(map(_is_traced, jax.tree.leaves(tree)))


def is_known(tree) -> bool:
    """Whether a pytree holds values, outside of a program: while JAX stages a program, all new arrays are tracers."""
    return is_concrete((tree, _zero()))


@jax.jit
def _zero():
    """A new array in 4 us; ``jnp.asarray(np.zeros(()))`` takes 27 us."""
    return 0


def _is_traced(leaf) -> bool:
    return isinstance(leaf, jax.core.Tracer)  # pyright: ignore[reportAttributeAccessIssue]


def numbers_of(tree):
    """The arrays of a pytree by NumPy; tracers unchanged."""
    return jax.device_get(tree) if is_concrete(tree) else tree


class Known:
    """A pytree of concrete numbers as an argument of cached functions: equal to every other one of the same structure
    and numbers."""

    def __init__(self, tree):
        self.tree = tree
        leaves, structure = jax.tree.flatten(tree)
        self._key = structure, tuple((a.shape, a.tobytes()) for a in map(np.asarray, leaves))

    def __eq__(self, other) -> bool:
        return isinstance(other, Known) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def library(*values):
    """NumPy, or `jax.numpy` if a value is traced.

    NumPy is faster outside of programs: the first call of a JAX function takes some 20 ms.
    """
    return np if is_concrete(values) else jnp


@overload
def split_at(vector, end: int, /) -> tuple[Any, Any]:
    """The two parts before and from an index."""


@overload
def split_at(vector, *ends: int) -> tuple[Any, ...]:
    """The parts between several indices."""


def split_at(vector, *ends):
    """The parts of a joined vector, between the indices `ends` along its last axis: ``q_s, q_f = split_at(q, n_s)``.

    Empty parts are constants: XLA compiles wrong programs, or ends the process, where a program takes an empty slice of
    a concatenation (JAX 0.10.0 to 0.12.0, above all on a single core).
    """
    bounds = [0, *ends, vector.shape[-1]]
    empty = np.zeros((*vector.shape[:-1], 0), vector.dtype)
    return tuple(vector[..., a:b] if a < b else empty for a, b in pairwise(bounds))


@lru_cache
def options_of_runs() -> dict:
    """`OLDER_EMITTERS` if XLA has this option.

    XLA refuses programs with unknown options, and versions without this one have to run.
    """
    try:
        jax.jit(_zero, compiler_options=OLDER_EMITTERS).lower().compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return OLDER_EMITTERS


def quickly_compiled(function: Callable, static_argnames: str | Sequence[str] = ()) -> Callable:
    """A function that runs a few times, compiled with the options `QUICK` and those of runs; inside a traced function
    it is a part of that program.

    Args:
        function: of arrays, and of the arguments that `static_argnames` names.
        static_argnames: as of `jax.jit`.
    """

    @lru_cache
    def quick() -> Callable:  # JAX starts with the first call, not with the import
        return jax.jit(function, static_argnames=static_argnames, compiler_options=QUICK | options_of_runs())

    part = jax.jit(function, static_argnames=static_argnames)  # JAX accepts compiler options for whole programs only

    @wraps(function)
    def call(*arguments):
        return (quick() if is_known(arguments) else part)(*arguments)

    return call


def own_array(value, dtype=None) -> np.ndarray:
    """Numbers as an array of NumPy that nobody else writes to."""
    is_shared = isinstance(value, np.ndarray) and value.flags.writeable
    return np.array(value, dtype) if is_shared else np.asarray(value, dtype)


def of_one_type(tree):
    """A pytree for a run: numbers as NumPy arrays of its own, tracers unchanged, since JAX would trace functions anew
    for each type of number; and functions with what they read from around them now."""

    def settled(leaf):
        if isinstance(leaf, TracedOnce):
            return leaf.now()
        return leaf if _is_traced(leaf) else own_array(leaf)

    return jax.tree.map(settled, tree, is_leaf=lambda leaf: isinstance(leaf, TracedOnce))


def require_x64() -> None:
    """Raise unless JAX's 64-bit mode is on."""
    if jnp.result_type(float) != np.float64:
        raise Refused(
            "vmri_jax needs 64-bit floats: Newton and the constraints are solved to round-off. Switch them on at the "
            "start of the program with vm.configure() (vm is vmri_jax), which also makes runs fast, or with"
            ' jax.config.update("jax_enable_x64", True).'
        )


def check_precision(name: str, value) -> None:
    """Refuse floats of less than 64 bits, also in lists: conversion to float64 does not restore their lost digits.

    Raises:
        ValueError: 64-bit mode is off, so that all JAX arrays are short; or this array is short.
    """
    for leaf in jax.tree.leaves(value):
        dtype = getattr(leaf, "dtype", None)
        if dtype is not None and jnp.issubdtype(dtype, jnp.inexact) and jnp.finfo(dtype).bits < 64:
            if isinstance(leaf, jax.Array):
                require_x64()
            raise Refused(f"{name} has dtype {dtype}; {ADVICE}.")


def real_array(name: str, value, ndim: int | None = None):
    """Numbers of the user as an array of float64: a JAX array if the value is one, else a NumPy array.

    Args:
        name: name of the value in messages.
        value: numbers, lists or arrays.
        ndim: required number of dimensions, None for any.

    Raises:
        TypeError: values that are no real numbers.
        ValueError: floats of less than 64 bits, or another number of dimensions.
    """
    advice = "give a real number" if ndim == 0 else "give real numbers, an array of float64"
    if isinstance(value, np.ndarray | jax.Array) and value.dtype == np.float64:
        array = value  # no conversion by JAX, which takes some ten microseconds
    elif isinstance(value, float):
        array = np.asarray(value)
    else:
        check_precision(name, value)
        if is_concrete(value) and not _is_real(value):
            raise Refused(f"{name} is {value!r}; {advice}.")
        is_jax = isinstance(value, jax.Array) or not is_concrete(value)
        array = (jnp if is_jax else np).asarray(value, dtype=float)
    if ndim is not None and array.ndim != ndim:
        raise Refused(f"{name} has shape {array.shape}; {advice}.")
    return array


def _is_real(value) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except Exception:  # ragged lists, and errors of the user's own classes
        return False


def whole_number(name: str, value, least: int = 1, otherwise: str = "") -> int:
    """An integer of at least `least`.

    Args:
        least: smallest allowed integer.
        otherwise: text in the message on other allowed values, e.g. ", or None".

    Raises:
        ValueError: another value.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise Refused(f"{name} is {value!r}; it must be an integer of at least {least}{otherwise}.")
    return int(value)
