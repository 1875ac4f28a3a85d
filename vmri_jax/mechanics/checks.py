"""Checks of user input before any computation; messages name the value, the expected value and a remedy."""

import hashlib
import re
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from types import UnionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.arrays import check_precision, is_concrete, real_array
from vmri_jax.mechanics.functions import TracedOnce, order_of, traced_once
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.surroundings import name_of
from vmri_jax.mechanics.system import System
from vmri_jax.refusals import Refused


def check_arrays(**arrays):
    """Arrays as float64 vectors, of JAX if they are, else of NumPy; velocities shaped like their positions; finite
    where concrete."""
    out = {}
    for name, value in arrays.items():
        array = real_array(name, value)
        if array.ndim != 1:
            raise Refused(f"{name} has shape {array.shape}; it must be a vector of coordinates, shape (n,).")
        if is_concrete(array) and not np.isfinite(array).all():
            raise Refused(f"{name} has entries that are not finite at {np.flatnonzero(~np.isfinite(array)).tolist()}.")
        out[name] = array
    for a, b in (("q_s", "v_s"), ("q_f", "v_f"), ("q_s", "p_s"), ("q_f", "p_f")):
        if a in out and b in out and out[a].shape != out[b].shape:
            raise Refused(f"{b} has shape {out[b].shape}, {a} has {out[a].shape}; they must be equal.")
    return tuple(out.values())


def check_number(name: str, value):
    """A finite real number, as an array of shape ()."""
    array = real_array(name, value, 0)
    if is_concrete(array) and not np.isfinite(array):
        raise Refused(f"{name} is {value}; it must be finite.")
    return array


def check_flags(**flags) -> None:
    """Refuse values that are neither True nor False: Python would read an array or a text as one of them."""
    for name, value in flags.items():
        if not isinstance(value, bool | np.bool_):
            raise Refused(f"{name} is {value!r}; it must be True or False.")


def check_type(name: str, value, kind: type | UnionType, example: str) -> Any:
    """The value; objects of another class are refused, and `example` in the message names a right object."""
    if not isinstance(value, kind):
        raise Refused(f"{name} is {type(value).__name__}; give {example}.")
    return value


def check_params(params) -> None:
    """Refuse parameters that are no numbers, or floats of less than 64 bits; the message gives their place in the
    pytree."""
    leaves = jax.tree.leaves(params)
    are_doubles = all(type(leaf) is float or getattr(leaf, "dtype", None) == np.float64 for leaf in leaves)
    if are_doubles and is_concrete(leaves) and all(np.isfinite(leaf).all() for leaf in leaves):
        return  # the usual case, within microseconds
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        name = f"System: params{jax.tree_util.keystr(path)}"
        check_precision(name, leaf)
        if getattr((leaf if hasattr(leaf, "dtype") else np.asarray(leaf)).dtype, "kind", "a key") not in "biufc":
            raise Refused(
                f"{name} is {leaf!r}; give arrays of numbers, which are handed to every function. Keep all other "
                "objects inside the functions. A class of your own becomes a pytree by "
                "jax.tree_util.register_dataclass or as an equinox.Module."
            )
        if is_concrete(leaf) and not np.isfinite(leaf).all():
            raise Refused(f"{name} is {leaf}, which is not finite; every function would be handed it.")


def check_system(system: System, q_s, q_f) -> None:
    """Check the shapes of masses, and of the values of every user function at these positions, by tracing alone."""
    check_params(system.params)
    n_s, n_f = q_s.shape[0], q_f.shape[0]
    if system.has_constant_mass:
        for name, mass, n in (("slow", system.kinetic.slow_mass, n_s), ("fast", system.kinetic.fast_mass, n_f)):
            if mass.size != n:
                raise Refused(f"ConstantMass: {name} is for {mass.size} coordinates, the state has {n} {name} ones.")
    values = {"t": np.zeros(()), "q_s": q_s, "q_f": q_f, "v_s": q_s, "v_f": q_f}
    for term in system.terms:
        name = f"System: {term.place}"
        shape = shape_of(name, term.function, *term.of_arguments(values), system.params)
        if term.kind in ("kinetic", "potential") and getattr(shape, "shape", None) != ():
            raise Refused(f"{name} returns {describe(shape)}; it must return a scalar, shape ().")
        if term.kind in ("constraint", "implied") and len(getattr(shape, "shape", ())) != 1:
            raise Refused(f"{name} returns {describe(shape)}; it must return a vector, shape (n_g,), or rows by name.")
        is_pair = isinstance(shape, tuple) and [getattr(s, "shape", None) for s in shape] == [(n_s,), (n_f,)]
        if term.kind == "force" and not is_pair:
            raise Refused(
                f"{name} returns {describe(shape)}; it must return (F_s, F_f) of shapes ({n_s},) and ({n_f},)."
            )
        for part in shape if isinstance(shape, tuple) else (shape,):
            if part.dtype != np.float64:
                raise Refused(
                    f"{name} returns {part.dtype}; it must return float64. Whole numbers become floats as 0.0 instead "
                    "of 0, arrays by .astype(float)."
                )
    if system.implied is not None and not system.is_constrained:
        raise Refused(
            "System: implied is given, but neither constraint nor slow_constraint: its rows are watched, not solved "
            "for, and must follow from rows that are. Give it as constraint."
        )


def shape_of(name: str, function: Callable, *args):
    """Shape and type of the value of a user function, by tracing; two derivatives in forward mode, by all arguments but
    params, must exist.

    Functions without code of the user are not differentiated: to trace their derivatives takes a tenth of the time to
    the first result of a scene.

    Args:
        name: name of the function in messages.
        function: of floats or pytrees of floats, and of params.
        args: of the function, params last.

    Raises:
        ValueError: the function cannot be traced, differentiated, or evaluated.
    """
    called: Any = function if isinstance(function, ConstantMass) else traced_once(function, order_of(args[-1]))

    def differentiated_twice(*args):
        *moving, params = args

        def tangent(*moving):
            return jax.jvp(lambda *moving: called(*moving, params), moving, moving)

        (value, _), _ = jax.jvp(tangent, moving, moving)
        return value

    is_of_package = isinstance(function, TracedOnce) and not function.is_of_user  # its tests differentiate it
    shapes = [getattr(a, "shape", type(a).__name__) for a in args[:-1]]
    with traced(name, f" on arguments of shapes {shapes} and {'params=None' if args[-1] is None else 'the params'}"):
        shape = jax.eval_shape(called if is_of_package else differentiated_twice, *args)
    if not isinstance(function, ConstantMass):
        leaves, structure = jax.tree.flatten(args)
        fault = _fault(called, structure, tuple((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves))
        if fault:
            raise Refused(f"{name} {fault}.")
    return shape


@contextmanager
def traced(name: str, on: str = "") -> Iterator[None]:
    """Refuse a function of the user that fails while JAX traces it; the message names the function, and with `on` its
    arguments."""
    try:
        yield
    except Refused:
        raise
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        raise Refused(
            f"{name} cannot be traced{_line_of(error)}: JAX knows shapes there, no numbers. Use jax.numpy (jnp.sin) "
            "instead of numpy and math, jnp.where(condition, a, b) instead of if, and no float(...) or int(...)."
        ) from None
    except Exception as error:
        if "custom_vjp" in str(error) or "custom_lin" in str(error):
            raise Refused(
                f"{name} has no derivative in forward mode{_line_of(error)}: implicit steps take second derivatives, "
                "which a jax.custom_vjp does not give. Use jax.custom_jvp, which gives both modes."
            ) from error
        raise Refused(f"{name} could not be evaluated{on}{_line_of(error)}: {type(error).__name__}: {error}") from error


@lru_cache(maxsize=1024)
def _fault(function: TracedOnce, structure, types: tuple[tuple[tuple[int, ...], np.dtype], ...]) -> str:
    """Faults of a function that none of its values shows, in words; empty for none. Cached, since tracing takes
    milliseconds.

    A function that takes ``q[3]`` of three entries: JAX returns the last entry instead, NumPy raises an IndexError; its
    other errors do not count, since NumPy arrays lack some operations of JAX arrays. And a function that is not pure:
    two traces of it differ.
    """
    arguments = jax.tree.unflatten(structure, [np.zeros(*of_leaf) for of_leaf in types])
    try:
        with np.errstate(all="ignore"):
            jax.eval_shape(lambda: function.called(*arguments))
    except IndexError as error:
        return f"takes an entry that is not there{_line_of(error)}: {error}"
    except Exception:
        pass
    if function.is_of_user and operations(function.called, *arguments) != operations(function.called, *arguments):
        return (
            f"is {name_of(function)}, which is not pure: two calls with the same arguments do not do the same. JAX "
            "calls it once for a whole run. A state belongs in coordinates; noise is drawn before the run, and "
            "handed over in params"
        )
    return ""


def operations(function: Callable, *arguments) -> str:
    """A digest of the operations that a function traces to, with their constants."""
    untraced = partial(function)  # JAX keeps the traces of a function
    closed = jax.make_jaxpr(untraced)(*arguments)
    text = re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr))  # addresses in memory
    return f"digest {digest(text.encode(), *(np.asarray(constant).tobytes() for constant in closed.consts))}"


def digest(*parts: bytes) -> str:
    """A short text that tells different bytes apart."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part)
    return total.hexdigest()[:16]


def _line_of(error: Exception) -> str:
    """The line in a file of the user from which an error comes, in words; empty if no file of the user is involved."""
    package = Path(__file__).parents[1]
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.exists() and "site-packages" not in path.parts and package not in path.parents:
            return f", line {frame.lineno} of {path.name} ({frame.line})"
    return ""


def describe(value) -> str:
    """The shapes of the value of a function, in words."""
    if isinstance(value, tuple):
        return "(" + ", ".join(describe(v) for v in value) + ")"
    return f"shape {value.shape}" if hasattr(value, "shape") else type(value).__name__
