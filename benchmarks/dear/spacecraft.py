"""A spacecraft in a gravity field of high degree: a hub with masses on stiff booms, which vibrate.

The potential of a mass at ``x = (x, y, z)`` with ``r = |x|`` and ``(s, t, u) = x / r`` is

    U = -mu / r (1 + sum_n (R / r)^n sum_m (C_nm Re (s + i t)^m + S_nm Im (s + i t)^m) A_nm(u)),        2 <= n <= degree

with fully normalised coefficients and the functions ``A_nm(u) = P_nm(u) / (1 - u^2)^(m / 2)`` of Pines, which have no
singularity at the poles. Their recursion by growing n,

    A_nn = sqrt((2 n + 1) / (2 n)) A_n-1,n-1,        A_nm = a_nm u A_n-1,m - b_nm A_n-2,m,

is stable. S. Pines, Uniform representation of the gravitational potential and its derivatives, AIAA J. 11 (1973); J. B.
Lundberg, B. E. Schutz, Recursion formulas of Legendre functions for use with nonsingular geopotential models, J.
Guidance 11 (1988).

Coefficients are random, of the size that Kaula's rule gives to those of the Earth: standard deviation ``1e-5 / n^2`` at
degree n; only that of the flattening is set.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from benchmarks.dear.systems import MIDDLE

MU, RADIUS = 3.986004418e14, 6.3781363e6
"""Of the Earth, m^3/s^2 and m."""
FLATTENING = -4.84165e-4
"""C_20 of the Earth, fully normalised."""
KAULA = 1e-5
"""Standard deviation of coefficients of degree n, times n^2."""
DEGREE = 50
LOW_DEGREE = 8
"""Degree up to which the field is the middle potential of three rates, with the central force."""
ALTITUDE, INCLINATION = 4e5, 0.9
"""Of a circular orbit: m, and radians."""
HUB, TIP = 500.0, 2.0
"""Masses, kg."""
LENGTH, FREQUENCY = 5.0, 3.0
"""Of a boom, m, and of its vibration along itself, Hz."""
SWING = 0.02
"""Velocity of the tips, m/s."""
TIPS = LENGTH * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
"""Places of the tips about the hub: along the orbit and across it."""


@cache
def coefficients(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """C and S, (degree + 1, degree + 1) by degree and order, those of a lower degree the same."""
    c, s = np.zeros((2, degree + 1, degree + 1))
    random = np.random.default_rng(50)
    for n in range(2, degree + 1):
        c[n, : n + 1], s[n, : n + 1] = KAULA / n**2 * random.normal(size=(2, n + 1))
    if degree >= 2:
        c[2, 0] = FLATTENING
    s[:, 0] = 0.0
    return c, s


@cache
def recursion(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``a_nm``, ``b_nm`` and the values ``A_nn`` on the diagonal, each (degree + 1, degree + 1)."""
    a, b, diagonal = np.zeros((3, degree + 1, degree + 1))
    value = 1.0
    for n in range(1, degree + 1):
        value *= np.sqrt((2 * n + 1) / (2 * n) * (2 if n == 1 else 1))
        diagonal[n, n] = value
        for m in range(n):
            a[n, m] = np.sqrt((2 * n - 1) * (2 * n + 1) / ((n - m) * (n + m)))
            if n >= 2:
                b[n, m] = np.sqrt((2 * n + 1) * (n - m - 1) * (n + m - 1) / ((2 * n - 3) * (n + m) * (n - m)))
    diagonal[0, 0] = 1.0
    return a, b, diagonal


def disturbance(x, degree: int, lowest: int = 2):
    """The sum over degrees from `lowest` to `degree` of a field, times ``-mu / r``, at places x (k, 3)."""
    r = jnp.linalg.norm(x, axis=1)
    s, t, u = (x / r[:, None]).T
    c_nm, s_nm = coefficients(degree)
    a, b, diagonal = recursion(degree)

    def power(z, _):
        return z * (s + 1j * t), z

    _, powers = jax.lax.scan(power, jnp.ones_like(s) + 0j, None, length=degree + 1)  # (degree + 1, k)

    def row(carry, of_degree):
        last, before, scale = carry  # A_n-1,m, A_n-2,m and (R / r)^n
        a_n, b_n, diagonal_n, c_n, s_n = of_degree
        values = a_n[:, None] * u * last - b_n[:, None] * before + diagonal_n[:, None]
        terms = (c_n[:, None] * powers.real + s_n[:, None] * powers.imag) * values
        return (values, last, scale * (RADIUS / r)), scale * jnp.sum(terms, axis=0)

    none = jnp.zeros((degree + 1, len(x)))
    rows = tuple(jnp.asarray(table) for table in (a, b, diagonal, c_nm, s_nm))
    _, sums = jax.lax.scan(row, (none, none, jnp.ones_like(r)), rows)
    return -MU / r * jnp.sum(sums[lowest:], axis=0)


def masses() -> np.ndarray:
    """(5,) of the hub and the tips."""
    return np.array([HUB, *[TIP] * len(TIPS)])


def places(q_f):
    """(5, 3) hub and tips, from the centre of the Earth: coordinates are differences from the place of the hub at the
    start, to lose no digits."""
    return q_f.reshape(-1, 3) + jnp.array([RADIUS + ALTITUDE, 0.0, 0.0])


def field(degree: int, lowest: int, q_s, q_f, params):
    """Gravity on all masses: the terms of degrees from `lowest` on, with the central one if that is 0."""
    x, m = places(q_f), masses()
    central = -jnp.sum(m * MU / jnp.linalg.norm(x, axis=1)) if lowest == 0 else 0.0
    return central + jnp.sum(m * disturbance(x, degree, max(lowest, 2)))


def booms(q_f, params):
    """``k / 2 sum (|d| - l)^2`` of the hub and each tip, and of neighbouring tips, which hold the cross together."""
    q = q_f.reshape(-1, 3)
    along = jnp.linalg.norm(q[1:] - q[0], axis=1) - LENGTH
    ring = jnp.array([1, 3, 2, 4])
    stays = jnp.linalg.norm(q[ring] - q[jnp.roll(ring, -1)], axis=1) - np.sqrt(2) * LENGTH
    stiffness = TIP * (2 * np.pi * FREQUENCY) ** 2
    return stiffness / 2 * (jnp.sum(along**2) + jnp.sum(stays**2))


def spacecraft(three_rates: bool = False, degree: int = DEGREE) -> vm.Problem:
    """Hub and tips on an orbit, the tips swinging.

    Args:
        three_rates: whether the degrees up to `LOW_DEGREE` are a potential of their own, `MIDDLE`.
        degree: of the field.
    """
    random = np.random.default_rng(3)
    speed = np.sqrt(MU / (RADIUS + ALTITUDE))
    orbit = speed * np.array([0.0, np.cos(INCLINATION), np.sin(INCLINATION)])
    along = orbit / speed
    across = np.cross([1.0, 0, 0], along)
    turn = np.stack([along, across, [1.0, 0, 0]])  # rows: axes of the cross
    q = np.concatenate([np.zeros((1, 3)), TIPS @ turn])
    v = orbit + np.concatenate([np.zeros((1, 3)), SWING * random.normal(size=TIPS.shape)])
    inertia = vm.ConstantMass([], np.repeat(masses(), 3))
    if three_rates:
        potentials = {MIDDLE: partial(field, LOW_DEGREE, 0)}
        system = vm.System(inertia, partial(field, degree, LOW_DEGREE + 1), booms, potentials=potentials)
    else:
        system = vm.System(inertia, partial(field, degree, 0), booms)
    return vm.Problem(system, [], q.reshape(-1), [], v.reshape(-1))
