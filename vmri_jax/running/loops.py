"""Loops of steps: as fast as they go, or with derivatives in reverse mode that need little memory."""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, log, prod

import jax
import jax.numpy as jnp

from vmri_jax.steppers.solved import ROOT

WHOLE = 1000
"""Most macro steps whose states are all kept for a derivative: a longer run would take more memory than computing states again takes time."""
WIDTH = 100
"""Parts that are kept at a time, at every level of `Recursive`."""


class Loops:
    """JAX's own loops."""

    def repeat(self, count, step: Callable, carry):
        """``carry = step(i, carry)`` for i from 0 to count - 1; here `count` may be traced."""
        return jax.lax.fori_loop(0, count, step, carry)

    def scan(self, body: Callable, carry, count: int):
        """``carry, y = body(carry, None)``, `length` times, and the stacked y."""
        return jax.lax.scan(body, carry, length=count)


PLAIN = Loops()


class Stored(Loops):
    """Derivatives keep of every step where it starts and the solution of its equations, and compute the rest again."""

    def repeat(self, count: int, step: Callable, carry):
        return jax.lax.scan(_kept(_as_body(step)), carry, jnp.arange(count))[0]


@dataclass(frozen=True)
class Recursive(Loops):
    """Derivatives keep the starts of parts of a run, and run a part again, which has parts itself, to step through it.

    With k levels of at most `WIDTH` parts, n steps need memory for ``k WIDTH`` of them and are computed k times; k is
    ``log n / log WIDTH``, rounded up.

    Source: A. Griewank, A. Walther, Evaluating Derivatives, 2nd ed., SIAM (2008), chapter 12.

    every: steps from one saved node to the next.
    """

    every: int

    def repeat(self, count: int, step: Callable, carry):
        return _levels(_kept(_as_body(step)), carry, count)[0]

    def scan(self, body: Callable, carry, count: int):
        keep = _kept if self.every == 1 else _started
        return _levels(keep(lambda carry, _: body(carry, None)), carry, count)


def _levels(body: Callable, carry, count: int):
    """``jax.lax.scan`` over the numbers below `count` as loops within loops, of which the starts are kept."""
    outermost, *sizes = _sizes(count)
    if not sizes:
        return jax.lax.scan(body, carry, jnp.arange(count))
    part = _where_alive(body, count)
    for size in reversed(sizes):
        part = _started(_part_of(part, size))
    carry, ys = jax.lax.scan(part, carry, jnp.arange(outermost))
    return carry, jax.tree.map(lambda y: y.reshape(-1, *y.shape[1 + len(sizes) :])[:count], ys)


def _part_of(step: Callable, size: int) -> Callable:
    """So many steps as one; its number tells theirs."""
    return lambda carry, number: jax.lax.scan(lambda carry, i: step(carry, number * size + i), carry, jnp.arange(size))


def _kept(body: Callable) -> Callable:
    """Its derivative keeps where a step starts and the solution of its equations."""
    return jax.checkpoint(body, policy=jax.checkpoint_policies.save_only_these_names(ROOT), prevent_cse=False)


def _started(body: Callable) -> Callable:
    """Its derivative keeps where a part starts."""
    return jax.checkpoint(body, prevent_cse=False)


def _as_body(step: Callable) -> Callable:
    return lambda carry, i: (step(i, carry), None)


def _sizes(count: int) -> list[int]:
    """Parts of a loop, parts of a part, and so on; at most WIDTH each, about alike, their product at least `count`."""
    levels = max(ceil(log(count) / log(WIDTH) - 1e-9), 1)
    width = ceil(count ** (1 / levels) - 1e-9)
    inner = [width] * (levels - 1)
    return [ceil(count / prod(inner)), *inner]


def _where_alive(body: Callable, count: int) -> Callable:
    """The body for numbers below `count`; others change nothing."""

    def step(carry, number):
        nothing = jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(body, carry, number)[1])
        return jax.lax.cond(number < count, body, lambda carry, _: (carry, nothing), carry, number)

    return step
