"""Numbers as users give them: real, and float64 wherever they are not traced."""

import jax
import jax.numpy as jnp
import numpy as np


def is_concrete(tree) -> bool:
    """Whether a pytree holds values, rather than tracers of jit, vmap or grad."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))  # pyright: ignore


def real_array(name: str, value, ndim: int | None = None):
    """Numbers as users give them as an array of floats, of JAX if they are, else of NumPy; refused is what is not real."""
    advice = "give a real number" if ndim == 0 else "give real numbers, an array of float64"
    if is_concrete(value):
        try:
            kind = np.asarray(value).dtype.kind
        except Exception:  # ragged lists, and whatever an object of one's own raises
            kind = ""
        if kind not in tuple("biuf"):
            raise TypeError(f"{name} is {value!r}; {advice}.")
    given = isinstance(value, jax.Array) or not is_concrete(value)
    array = jnp.asarray(value, dtype=float) if given else np.asarray(value, dtype=float)
    if ndim is not None and array.ndim != ndim:
        raise ValueError(f"{name} has shape {array.shape}; {advice}.")
    return array


def double_array(name: str, value):
    """`real_array` of numbers in double precision: the digits that an array of float32 lacks cannot be had back.

    Raises:
        ValueError: an array of float32 or float16, as JAX makes them before its 64-bit mode is switched on.
    """
    for leaf in jax.tree.leaves(value):
        if getattr(leaf, "dtype", None) in (np.float32, np.float16):
            raise ValueError(
                f"{name} has dtype {leaf.dtype}; give float64. JAX makes arrays of float32 until 64-bit mode is switched on: "
                'call jax.config.update("jax_enable_x64", True) before any array is made.'
            )
    return real_array(name, value)
