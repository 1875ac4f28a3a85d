"""Explicit time in a system: forces and moving constraints that drive it, and the events in them.

An *event* is a peak or a dip in time of an entry of the force F, of a moving constraint g, or of dg/dt. It lasts as
long as the entry keeps more than half of the smaller of its swings before and after the turning point: a rectangular
pulse its length, half a sine wave half a period. A jump or a ramp to another value is no event: no step passes over it,
since all later nodes see the new value.

The round-off of an entry may be all that it has, as of the generalised force on a joint about which two opposite forces
have no moment. It is neither an event nor a jump: an entry counts as constant within its round-off, which is measured.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.structure import depends_on
from vmri_jax.mechanics.system import System

SAMPLES = 2**20
"""Samples in time of an entry.

With fewer samples short pulses are overlooked, with more of them the search for events takes longer.
"""
MOST_NUMBERS = 2**23
"""Samples times varying entries, 64 MiB of memory: systems with more than 8 varying entries get fewer samples."""
CHUNK = 2**22
"""Most numbers that the compiled program returns in one call, 32 MiB; a larger value takes more memory."""
LEAST_HEIGHT = 1e-6
"""Least height of an event, as a part of the range of its entry; a smaller value reports ripples that no run feels."""
TINY = 2.0**-40
"""Steps in which round-off is measured, relative to the length of the time, to positions and to velocities. In smaller
steps terms keep their round-off, in larger ones the smooth change of an entry counts as round-off."""
SAFETY = 4.0
"""Round-off that counts over the round-off that was measured at fewer times; a smaller value reports round-off as
events, a larger one overlooks weak drives beside large forces that cancel."""
REFINEMENTS, PARTS = 3, 16
"""Rounds of refinement about events that last less than `COARSE` samples, and the parts of a refined interval: 16^3
times finer samples."""
LEAST_JUMP = 1e-3
"""Change of an entry in a part of 16^3 of a sample, relative to its range, that counts as a jump: smooth pulses change
by at most 1 / 16^3."""
COARSE = 8
"""Samples of an event below which its length is measured again. With fewer samples the length is known less well."""
GOLDEN = (np.sqrt(5) - 1) / 2


class Events(NamedTuple):
    """Events in the terms that drive a system, in the order of time.

    Attributes:
        names: of the terms that depend on time, see `driven`.
        times: (k,) times of the turning points.
        lengths: (k,) how long the events last, in the unit of time.
        jump: whether an entry jumps.
    """

    names: tuple[str, ...] = ()
    times: np.ndarray = np.zeros(0)
    lengths: np.ndarray = np.zeros(0)
    jump: bool = False

    @property
    def shortest(self) -> float:
        """Length of the shortest event; infinite without events."""
        return float(self.lengths.min(initial=np.inf))


def driven(system: System, state) -> tuple[str, ...]:
    """Names of the terms of a system that depend explicitly on time: "force", "constraint", "slow_constraint".

    The operations of the traced functions decide, whatever their values: ``jnp.where(t > 2, F, 0)`` depends on time,
    also before t = 2; a `Rheonomic` function that does not use t does not. Nothing is computed, so that state and
    params may be traced.

    Args:
        state: a `State`, or any object with arrays q_s (n_s,) and q_f (n_f,).
    """
    values = {"q_s": state.q_s, "q_f": state.q_f, "v_s": jnp.zeros_like(state.q_s), "v_f": jnp.zeros_like(state.q_f)}
    moving = [term for term in system.terms if "t" in term.arguments and term.kind != "implied"]

    def depends_on_time(term) -> bool:
        return depends_on(lambda t: term(system.params, t=t, **values), jnp.zeros(()))[0]

    return tuple(term.field for term in moving if depends_on_time(term))


def events(system: System, state, t_end: float) -> Events:
    """The events of a system from the time of a state to `t_end`; none if nothing in it depends on time.

    All terms of `driven` are sampled at 2^20 times (fewer if more than 8 entries vary), at one generic configuration
    near the state, since a parametric drive has no force at an equilibrium. Two neighbouring samples are at most twice
    the mean distance apart, and their times are no multiples of each other, so that no train of pulses falls between
    them. Short events are sampled again on finer grids. Overlooked are: pulses that last less than two samples and have
    no flanks (2e-5 in a run of length 10), events of a millionth of the range of their entry, and a drive that begins
    only in other configurations.

    Args:
        state: a `State`; its t is the start.
    """
    names, t_0 = driven(system, state), float(state.t)
    if not names or not t_end > t_0:
        return Events(names)
    configuration = generic(state, t_end - t_0)
    program = partial(_sampled, system, names)
    size = jax.eval_shape(program, configuration, jnp.zeros(1)).shape[1]
    chunk = 2 ** int(np.log2(np.clip(CHUNK // size, PARTS, SAMPLES // PARTS)))

    def chunks(t: np.ndarray):
        padded = np.append(t, np.full(-len(t) % chunk, t[-1])).reshape(-1, chunk)
        return (np.asarray(program(configuration, part)) for part in padded)

    def values(t: np.ndarray) -> np.ndarray:
        return np.concatenate([part[:, varying] for part in chunks(t)])[: len(t)]

    t = t_0 + (t_end - t_0) * _unit_times(chunk)
    coarse, noise = next(chunks(t)), round_off(program, configuration, t)
    num = int(np.clip(MOST_NUMBERS // max(1, np.count_nonzero(np.ptp(coarse, axis=0) > noise)), chunk, SAMPLES))
    t = t_0 + (t_end - t_0) * _unit_times(num)
    # Of the entries of many bodies, few vary: the others are not kept.
    parts = [
        (columns := np.flatnonzero((np.abs(part - coarse[0]) > noise).any(axis=0)), part[:, columns])
        for part in chunks(t)
    ]
    varying = np.unique(np.concatenate([columns for columns, _ in parts]))
    f = np.concatenate([np.broadcast_to(coarse[0, varying], (chunk, len(varying)))] * len(parts))
    for i, (columns, part) in enumerate(parts):
        f[i * chunk : (i + 1) * chunk, np.searchsorted(varying, columns)] = part
    f, distance = f[: len(t)], (t_end - t_0) / len(t)
    if not len(varying):
        return Events(names)
    least = noise[varying] / LEAST_HEIGHT
    jump = _jumps(values, t, f, _ranges(f, least))
    for _ in range(REFINEMENTS):
        drives = _events(names, t, f, jump, least)
        if drives.shortest > COARSE * distance:
            return drives
        # Insert times where neighbouring samples differ most.
        distance /= PARTS
        parted = _steepest(f, chunk // PARTS, _ranges(f, least))
        new = (t[parted, None] + np.diff(t)[parted, None] * np.arange(1, PARTS) / PARTS).reshape(-1)
        order = np.argsort(np.append(t, new), kind="stable")
        t, f = np.append(t, new)[order], np.concatenate([f, values(new)])[order]
    return _events(names, t, f, jump, least)


def _ranges(f: np.ndarray, least: np.ndarray) -> np.ndarray:
    """(m,) the range of each entry of f (k, m), at least `least`, of which round-off is the part `LEAST_HEIGHT`."""
    return np.maximum(np.ptp(f, axis=0), least)


def _steepest(f: np.ndarray, num: int, span: np.ndarray) -> np.ndarray:
    """(num,) the intervals in which an entry of f (k, m) changes most, relative to its range."""
    change = (np.abs(np.diff(f, axis=0)) / span).max(axis=1)
    return np.argpartition(change, -num)[-num:]


def _jumps(values, t: np.ndarray, f: np.ndarray, span: np.ndarray) -> bool:
    """Whether an entry changes by more than `LEAST_JUMP` of its range in the 16^3-th part of one of the steepest
    intervals."""
    steepest = _steepest(f, PARTS, span)
    begin, end, change = t[steepest], t[steepest + 1], np.abs(np.diff(f, axis=0)[steepest] / span).max(initial=0.0)
    for _ in range(REFINEMENTS):
        if change < LEAST_JUMP:
            return False
        times = np.linspace(begin, end, PARTS + 1)  # (PARTS + 1, intervals)
        changes = (np.abs(np.diff(values(times.reshape(-1)).reshape(*times.shape, -1), axis=0)) / span).max(axis=2)
        part, interval = changes.argmax(axis=0), np.arange(times.shape[1])
        begin, end, change = times[part, interval], times[part + 1, interval], changes.max()
    return bool(change >= LEAST_JUMP)


@partial(jax.jit, static_argnames="names")
def _sampled(system: System, names: tuple[str, ...], configuration, times):
    """(k, m) entries of the terms `names` at the times (k,): forces, and values and rates of moving constraints."""
    values = dict(zip(("q_s", "q_f", "v_s", "v_f"), configuration, strict=True))

    def entries(t):
        parts = []
        for term in system.terms:
            if term.field in names:
                value = partial(lambda term, t: term(system.params, t=t, **values), term)
                parts += value(t) if term.kind == "force" else jax.jvp(value, (t,), (jnp.ones_like(t),))
        return jnp.nan_to_num(jnp.concatenate(parts), posinf=0.0, neginf=0.0)

    return jax.vmap(entries)(times)


def round_off(entries: Callable, configuration: tuple, times: np.ndarray) -> np.ndarray:
    """(m,) the round-off of ``entries(configuration, times)``, (k, m), `SAFETY` times their largest second difference

        f(x) - 2 f(x + h) + f(x + 2 h),    x = (t, q_s, q_f, v_s, v_f)

    at the times (k,). Smooth changes add the square of h, `TINY`, only, and round-off up to four times itself: Moré and
    Wild, Estimating computational noise, SIAM J. Sci. Comput. 33 (2011). The first and the last time are left out, at
    which drives are switched on and off.
    """
    x, h = (times[1:-1], *configuration), (np.ptp(times), *configuration)
    lines = []
    for k in range(3):
        t, *moved = (a + k * TINY * step for a, step in zip(x, h, strict=True))
        lines.append(np.asarray(entries(tuple(moved), np.pad(t, 1, mode="edge"))))
    return SAFETY * np.abs(np.diff(lines, n=2, axis=0)[0]).max(axis=0)


@partial(jax.jit, static_argnames="names")
def sampled_with_rates(system: System, names: tuple[str, ...], configuration, times):
    """(k, m) entries of the terms `names` at the times (k,) in a configuration (q_s, q_f, v_s, v_f), and their rates of
    change."""
    return jax.jvp(partial(_sampled, system, names, configuration), (times,), (jnp.ones_like(times),))


def generic(state, length: float) -> tuple:
    """Positions and velocities (q_s, q_f, v_s, v_f) near a state, always the same: positions a hundredth away,
    velocities of ten sizes in a run."""
    random, q = np.random.default_rng(0), (np.asarray(state.q_s), np.asarray(state.q_f))
    size = max(float(np.abs(a).max(initial=0.0)) for a in q) or 1.0
    moved = [a + 1e-2 * size * random.normal(size=a.shape) for a in q]
    return *moved, *(10 * size / length * random.normal(size=a.shape) for a in q)


@lru_cache(maxsize=4)
def _unit_times(num: int) -> np.ndarray:
    """(num,) increasing times in [0, 1], one in each of num equal intervals, placed in it by multiples of the golden
    ratio."""
    i = np.arange(num)
    times = (i + i * GOLDEN % 1.0) / num
    times[-1] = 1.0
    return times


def _events(names: tuple[str, ...], t: np.ndarray, f: np.ndarray, jump: bool, least: np.ndarray) -> Events:
    """The events of all entries f (k, m) at times t (k,), with their least ranges."""
    heights = LEAST_HEIGHT * _ranges(f, least)
    pairs = [(np.zeros(0), np.zeros(0)), *map(partial(_events_of, t), f.T, heights)]
    times, lengths = map(np.concatenate, zip(*pairs, strict=True))
    order = np.argsort(times)
    return Events(names, times[order], lengths[order], jump)


def _events_of(t: np.ndarray, f: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and lengths of the events of an entry f (k,) whose heights are at least `height`."""
    steps = np.diff(f)
    moving = np.flatnonzero(steps)
    turns = moving[1:][np.diff(np.sign(steps[moving])) != 0]
    turns = _without_ripples(f, np.concatenate([[0], turns, [len(f) - 1]]), height)
    heights, inner = np.abs(np.diff(f[turns])), turns[1:-1]
    if not inner.size:
        return np.zeros(0), np.zeros(0)
    # The ends of the time cut the first and the last swing, which are taken as large as their neighbours.
    heights[[0, -1]] = np.maximum(heights[[0, -1]], heights[[1, -2]])
    half = np.minimum(heights[1:], heights[:-1]) / 2
    # The variation v(t) = sum |df| grows by half a height on either side of a turning point.
    variation = np.append(0.0, np.cumsum(np.abs(steps)))
    moves = slice(moving[0], moving[-1] + 2)  # without rest at both ends of the time
    begin, end = (np.interp(variation[inner] + side * half, variation[moves], t[moves]) for side in (-1, 1))
    before, after = t[inner] - begin, end - t[inner]
    is_cut, is_cut_after = variation[inner] < half, variation[inner] + half > variation[-1]
    # An event that an end cuts lasts until the end at least, or as long as on its other side.
    longer = np.maximum(before, after)
    return t[inner], np.where(is_cut, longer, before) + np.where(is_cut_after, longer, after)


def _without_ripples(f: np.ndarray, turns: np.ndarray, height: float) -> np.ndarray:
    """The turning points without pairs whose values differ by less than a height, the smallest first."""
    random = np.random.default_rng(0)
    while len(turns) > 2:
        # Equal heights, as of round-off, are told apart at random: else a pass would remove few of them.
        heights = np.abs(np.diff(f[turns])) * (1 + LEAST_HEIGHT * random.random(len(turns) - 1))
        sides = np.pad(heights, 1, constant_values=np.inf)
        ripples = np.flatnonzero((heights < height) & (heights <= sides[:-2]) & (heights < sides[2:]))
        removed = np.union1d(ripples, ripples + 1)
        removed = removed[(removed > 0) & (removed < len(turns) - 1)]
        if not removed.size:
            return turns
        turns = np.delete(turns, removed)
    return turns
