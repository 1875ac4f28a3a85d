"""Whether derivatives are those of the functions: gradients against differences of values, second derivatives of gradients.

With s(z) a function of positions (and velocities), or the sum of its components with some weights, and d a direction,

    grad s(z) . d = (8 (s(z + h d) - s(z - h d)) - (s(z + 2 h d) - s(z - 2 h d))) / (12 h) + O(h^4)

for one h at least: too large an h meets the curvature, too small a one round-off. The second derivative of a potential is
compared with differences of the gradient in the same way, and must be symmetric.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.hard_cases.case import Outcome
from vmri_jax.hard_cases.measures import run
from vmri_jax.mechanics.invariants import velocity
from vmri_jax.mechanics.state import Problem
from vmri_jax.schemes.scheme import Scheme

DIRECTIONS = 6
STEPS = 10.0 ** -np.arange(2, 7)
"""h, in units of the largest position."""
OFF = 1e-4
"""Points are moved by so much of the largest position: a bend exactly there has no derivative."""
WRONG = 1e-4
"""Relative difference from which on a derivative is wrong; those that are right are at 1e-7 and below."""
ROUND_OFF = 1e-14


class Term(NamedTuple):
    """A function of the system as one of a vector: ``function(z) -> (m,)``, and the points z (k, n) to look at."""

    name: str
    function: Callable
    points: np.ndarray


def derivatives(problem: Problem, scheme: Scheme, macro_dt: float) -> Outcome:
    """The largest relative difference of derivatives, and which function is wrong."""
    worst = {}
    for name, function, points in _terms(problem, scheme, macro_dt):
        first, second, lopsided = _apart(function, points)
        worst[f"the gradient of {name} from differences of its values"] = first
        if "potential" in name:
            worst[f"the second derivative of {name} from differences of its gradient"] = second
            worst[f"the second derivative of {name} from its transpose"] = lopsided
    wrong = {what: apart for what, apart in worst.items() if not apart < WRONG}
    largest = max(worst.values(), default=0.0)
    if not wrong:
        return Outcome(f"at most {largest:.0e} from differences", True, {"apart": largest})
    words = "; ".join(f"{what} differs by {apart:.2g}" for what, apart in wrong.items())
    return Outcome(
        f"relative to its size, {words}. Likely cause: a derivative of one's own (jax.custom_jvp, custom_vjp) that is not that of the "
        "function, or jax.lax.stop_gradient, which hides a part from it. Forces that no potential has belong into force.",
        False,
        {"apart": largest},
    )


def _terms(problem: Problem, scheme: Scheme, macro_dt: float) -> Iterator[Term]:
    """What the system consists of, at the start and along a short run as far as it goes."""
    system, n_s = problem.system, problem.q_s.size
    along = run(problem, scheme, macro_dt, 20, save_every=5)
    speeds = jax.jit(jax.vmap(lambda *z: jnp.concatenate(velocity(system, *z))))
    velocities = np.asarray(speeds(along.q_s, along.q_f, along.p_s, along.p_f))
    found = np.concatenate([along.q_s, along.q_f, velocities], axis=1)
    found, t = found[np.isfinite(found).all(axis=1)], along.t[0]
    n = found.shape[1] // 2
    params = system.params
    if (slow := system.slow_potential) is not None:
        yield Term("slow_potential", lambda q: slow(q[:n_s], q[n_s:], params)[None], found[:, :n])
    if (fast := system.fast_potential) is not None:
        yield Term("fast_potential", lambda q: fast(q, params)[None], found[:, n_s:n])
    for name, potential in system.potentials:
        function = partial(_of_joined, potential, n_s, params)
        yield Term(f"potential {name!r}", function, found[:, :n])
    if not system.has_constant_mass:
        parts = (n_s, n, n + n_s)
        yield Term("kinetic", lambda z: system.kinetic(*jnp.split(z, parts), params)[None], found)
    if system.is_constrained:
        yield Term("the constraints", lambda q: system.constraints(t, q[:n_s], q[n_s:]), found[:, :n])


def _of_joined(potential: Callable, n_s: int, params, q):
    """(1,) value of a potential of all positions q."""
    return potential(q[:n_s], q[n_s:], params)[None]


def _apart(function: Callable, points: np.ndarray) -> tuple[float, float, float]:
    """Relative differences of the gradient, of the second derivative, and of that from its transpose; largest of all points."""
    random = np.random.default_rng(0)
    size = float(np.abs(points).max(initial=0.0)) or 1.0
    points = points + OFF * size * random.uniform(-1, 1, points.shape)
    directions = random.uniform(-1, 1, (DIRECTIONS, points.shape[1]))

    def value(z):
        values = function(z)
        return jnp.sum(values * jnp.linspace(1.0, 2.0, values.size))

    @jax.jit
    @jax.vmap
    def compared(z):
        d = jnp.asarray(directions)
        gradient = jax.grad(value)
        own, curved = jax.lax.map(lambda x: jax.jvp(gradient, (z,), (x,)), d)
        values, slopes = (_differences(f, z, d, size) for f in (value, gradient))
        bent = curved @ d.T
        first = _nearest(jnp.sum(own * d, axis=1), values, jnp.abs(value(z)) / size)
        second = _nearest(curved, slopes, jnp.abs(gradient(z)).max() / size)
        scale = jnp.abs(bent).max() + ROUND_OFF * jnp.abs(gradient(z)).max() / size
        return first, second, jnp.abs(bent - bent.T).max() / jnp.where(scale > 0, scale, 1.0)

    if not points.shape[1]:
        return 0.0, 0.0, 0.0
    first, second, lopsided = (float(np.max(np.asarray(x))) for x in compared(jnp.asarray(points)))
    return first, second, lopsided


def _differences(f: Callable, z, directions, size: float):
    """Differences of f along every direction for every h, (STEPS, DIRECTIONS, ...)."""

    def difference(h, d):
        one, two = (f(z + k * h * d) - f(z - k * h * d) for k in (1, 2))
        return (8 * one - two) / (12 * h)

    return jax.lax.map(lambda h: jax.lax.map(lambda d: difference(h, d), directions), jnp.asarray(STEPS * size))


def _nearest(own, differences, per_size):
    """The relative difference for the h where it is smallest, less round-off; `per_size`: value over the size of positions."""
    away = jnp.abs(differences - own).reshape(len(STEPS), -1).max(axis=1)
    away = jnp.where(jnp.isfinite(away), away, jnp.inf)
    away = jnp.maximum(away - ROUND_OFF * per_size / STEPS, 0.0)
    scale = jnp.maximum(jnp.abs(own).max(), jnp.abs(differences[2]).max())
    return jnp.min(away) / jnp.where(scale > 0, scale, 1.0)
