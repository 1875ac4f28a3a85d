"""Loops of steps: the plain loop of JAX, and loops whose derivatives in reverse mode need little memory."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import ceil, log, prod

import jax
import jax.numpy as jnp

from vmri_jax.steppers.solved import ROOT

MOST_STORED_STEPS = 1000
"""Most macro steps for which "checkpoint" keeps every state. A larger value takes more memory and saves the second computation of states
in runs up to that length."""
PARTS_PER_LEVEL = 100
"""Most parts into which the recursive adjoint divides a run or a part. A larger value takes more memory, and fewer levels compute states again."""


def plain(count, step: Callable, carry):
    """``carry = step(i, carry)`` for i from 0 to count - 1; `count` may be traced, and reverse mode has no derivative of it."""
    return jax.lax.fori_loop(0, count, step, carry)


@dataclass(frozen=True)
class Adjoint:
    """Loops whose derivatives in reverse mode keep the solutions of equations, and compute everything else again.

    `Solved` gives the solution of a step and its status the name `ROOT`; the steps of any other stepper are computed again.

    *Stored*: reverse mode keeps the start of every step. *Recursive*: it keeps the starts of the parts of a run, and runs each part again, itself
    divided into parts, to step back through it. With w = `PARTS_PER_LEVEL` and k levels, ``k = ceil(log n / log w)``, a run of n steps then takes
    memory for ``k w`` states and computes every step k times.

    Source: A. Griewank, A. Walther, Evaluating Derivatives, 2nd ed., SIAM (2008), chapter 12.

    Attributes:
        every: macro steps from one saved node to the next.
        is_recursive: else it is stored.
    """

    every: int
    is_recursive: bool

    def repeat(self, count: int, step: Callable, carry):
        """As `plain`."""
        body = _keeps_root(lambda carry, i: (step(i, carry), None))
        return (_levels if self.is_recursive else _scan)(body, carry, count)[0]

    def scan(self, body: Callable, carry, count: int):
        """``carry, y = body(carry, i)``, `count` times; returns the last carry and the stacked y."""
        if not self.is_recursive:
            return _scan(body, carry, count)
        # With every == 1 the body is a single step, whose root is kept; else `repeat` keeps the roots inside of the body.
        return _levels((_keeps_root if self.every == 1 else _keeps_start)(body), carry, count)


def _scan(body: Callable, carry, count: int):
    return jax.lax.scan(body, carry, jnp.arange(count))


def _levels(body: Callable, carry, count: int):
    """``jax.lax.scan`` over the numbers below `count` as nested loops; reverse mode keeps the start of each loop."""
    outermost, *sizes = _sizes(count)
    if not sizes:
        return _scan(body, carry, count)
    # The product of the sizes may exceed `count`: the last turns do nothing, and their outputs are cut off.
    part = _up_to(count, body)
    for size in reversed(sizes):
        part = _keeps_start(_part_of(part, size))
    carry, ys = _scan(part, carry, outermost)
    # the length as a number: parts without variables have outputs of size 0, from which it cannot be inferred
    turns = outermost * prod(sizes)
    return carry, jax.tree.map(lambda y: y.reshape(turns, *y.shape[1 + len(sizes) :])[:count], ys)


def _part_of(step: Callable, size: int) -> Callable:
    """`size` steps as one part: part k has the steps ``k size`` to ``(k + 1) size - 1``."""
    return lambda carry, number: jax.lax.scan(lambda carry, i: step(carry, number * size + i), carry, jnp.arange(size))


def _keeps_root(body: Callable) -> Callable:
    """The body, for which reverse mode keeps the carry at its start and the roots of its equations."""
    return jax.checkpoint(body, policy=jax.checkpoint_policies.save_only_these_names(ROOT), prevent_cse=False)


_keeps_start = partial(jax.checkpoint, prevent_cse=False)
"""The body of a loop, for which reverse mode keeps the carry at its start alone."""


def _sizes(count: int) -> list[int]:
    """Turns of each of the nested loops, the outermost first: at most `PARTS_PER_LEVEL`, nearly equal, with a product of at least `count`."""
    levels = max(ceil(log(count) / log(PARTS_PER_LEVEL) - 1e-9), 1)  # 1e-9: round-off of the logarithms adds no level
    width = ceil(count ** (1 / levels) - 1e-9)
    inner = [width] * (levels - 1)
    return [ceil(count / prod(inner)), *inner]


def _up_to(count: int, body: Callable) -> Callable:
    """The body for numbers below `count`; for larger numbers the carry stays and the outputs are zeros."""

    def step(carry, number):
        nothing = jax.tree.map(lambda y: jnp.zeros(y.shape, y.dtype), jax.eval_shape(body, carry, number)[1])
        return jax.lax.cond(number < count, body, lambda carry, _: (carry, nothing), carry, number)

    return step
