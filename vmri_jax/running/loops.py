"""Loops of steps whose derivatives in reverse mode need little memory."""

from collections.abc import Callable
from functools import partial
from math import isqrt

import jax
import jax.numpy as jnp

from vmri_jax.steppers.solved import ROOT

MOST_STORED_NUMBERS = 2**21
"""Most numbers, 16 MB, of the states and solutions of all steps that an adjoint keeps. A larger value takes more
memory, which the lanes of a batch multiply; with a smaller one shorter runs compute their steps twice."""
MOST_UNDIVIDED = 100
"""Most turns of a loop that the adjoint in parts does not divide.

A larger value takes more memory, and fewer loops compute states again.
"""


def differentiable(count: int, step: Callable, carry, in_parts: bool):
    """``carry = step(i, carry)`` for i from 0 to count - 1, whose derivatives in reverse mode keep the solutions of
    equations, and compute everything else again.

    `Solved` gives the solution of a step and its status the name `ROOT`; the steps of any other stepper are computed
    again.

    *Stored*: reverse mode keeps the start of every step. *In parts*: it keeps the starts of the parts of a run, and
    runs each part again, to step back through it. A run of n steps in sqrt(n) parts then takes memory for 2 sqrt(n)
    states, and computes every step twice.

    Source: A. Griewank, A. Walther, Evaluating Derivatives, 2nd ed., SIAM (2008), chapter 12.
    """
    body = _keeps_root(lambda carry, i: (step(i, carry), None))
    return (_in_parts if in_parts else _scan)(body, carry, count)[0]


def scan(body: Callable, carry, count: int, in_parts: bool, every: int):
    """``carry, y = body(carry, i)``, `count` times, each with `every` steps of `differentiable`; returns the last carry
    and the stacked y."""
    if not in_parts:
        return _scan(body, carry, count)
    # With every == 1 the body is a single step, whose root is kept; else `differentiable` keeps the roots inside of the
    # body.
    return _in_parts((_keeps_root if every == 1 else _keeps_start)(body), carry, count)


def _scan(body: Callable, carry, count: int):
    return jax.lax.scan(body, carry, jnp.arange(count))


def _in_parts(body: Callable, carry, count: int):
    """`_scan` as a loop over parts of the loop, of whose starts reverse mode keeps one at a time beside the starts of
    all parts."""
    if count <= MOST_UNDIVIDED:
        return _scan(body, carry, count)
    size = isqrt(count - 1) + 1
    parts = -(-count // size)

    def turn(carry, number):  # the last part may have turns beyond `count`, which do nothing; their outputs are cut off
        nothing = jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(body, carry, number)[1])
        return jax.lax.cond(number < count, body, lambda carry, _: (carry, nothing), carry, number)

    def part(carry, number):
        return jax.lax.scan(turn, carry, number * size + jnp.arange(size))

    carry, ys = _scan(_keeps_start(part), carry, parts)
    # the length as a number: parts without variables have outputs of size 0, from which it cannot be inferred
    return carry, jax.tree.map(lambda y: y.reshape(parts * size, *y.shape[2:])[:count], ys)


def _keeps_root(body: Callable) -> Callable:
    """The body, for which reverse mode keeps the carry at its start and the roots of its equations."""
    return jax.checkpoint(body, policy=jax.checkpoint_policies.save_only_these_names(ROOT), prevent_cse=False)


_keeps_start = partial(jax.checkpoint, prevent_cse=False)
"""The body of a loop, for which reverse mode keeps the carry at its start alone."""
