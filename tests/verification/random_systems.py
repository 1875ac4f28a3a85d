"""Random systems, starts, schemes and steps: tame ones that every method must solve, or any, most of them hard and some
hopeless.

A `Structure` decides what is compiled, a `Draw` all numbers: many draws of a structure share its compiled programs.
Both are drawn from a `random.Random`, so that a seed names them; Hypothesis has one that it can shrink.
"""

import dataclasses
from collections.abc import Callable
from functools import cache
from random import Random

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax import quadrature


def _distance(x):
    return jnp.linalg.norm(x, axis=-1)  # its derivative at zero is NaN, as in a user's code


# Of the next tables the first entries are harmless: two kinetic energies and slow constraints, three of the others.

# Energies of difference vectors x (pairs, dimension), of strength k and length a.
ENERGIES: dict[str, Callable] = {
    "harmonic": lambda x, k, a: k / 2 * jnp.sum(x**2),
    "spring": lambda x, k, a: k / 2 * jnp.sum((_distance(x) - a) ** 2),
    "double well": lambda x, k, a: k / 4 * jnp.sum((x**2 - a**2) ** 2),
    "periodic": lambda x, k, a: k * jnp.sum(1 - jnp.cos(x / a)),
    "contact": lambda x, k, a: k * jnp.sum(jnp.maximum(a - x[:, 0], 0.0) ** 1.5),
    "kink": lambda x, k, a: k * jnp.sum(jnp.abs(x)),
    "exponential": lambda x, k, a: k * jnp.sum(jnp.exp(-x / a)),
    "pole": lambda x, k, a: -k * jnp.sum(1 / _distance(x)),
    "pair": lambda x, k, a: k * jnp.sum((a / _distance(x)) ** 12 - 2 * (a / _distance(x)) ** 6),
    "logarithm": lambda x, k, a: -k * jnp.sum(jnp.log(x[:, 0] / a)),
    "finitely extensible": lambda x, k, a: -k * a**2 * jnp.sum(jnp.log1p(-jnp.sum(x**2, axis=1) / (2 * a) ** 2)),
    "root": lambda x, k, a: k * jnp.sum(jnp.sqrt(a**2 - jnp.sum(x**2, axis=1))),
    "falling": lambda x, k, a: -k * jnp.sum(x**4),
    "nothing": lambda x, k, a: k * a,
    "nan": lambda x, k, a: k * jnp.nan * jnp.sum(x**2),
}

# Values of constraints at slow and fast points; what is subtracted from them makes the start satisfy them, or not.
CONSTRAINTS: dict[str, Callable] = {
    "rod": lambda s, f, eps: jnp.sum((f[:1] - s[0]) ** 2, axis=1) / 2,
    "chain": lambda s, f, eps: jnp.sum(jnp.diff(f, axis=0, prepend=s[:1]) ** 2, axis=1) / 2,
    "anchored": lambda s, f, eps: _distance(f[:1]),
    "norm": lambda s, f, eps: _distance(f[:1] - s[0]),
    "same twice": lambda s, f, eps: jnp.stack([1.0, 3.0]) * jnp.sum((f[0] - s[0]) ** 2) / 2,
    "nearly same": lambda s, f, eps: jnp.sum((f[0] - s[0]) ** 2) / 2 + jnp.stack([0.0, 1.0]) * eps * f[0, 0],
    "loops": lambda s, f, eps: jnp.sum(jnp.stack([f - s[0], f - jnp.roll(f, 1, axis=0)]) ** 2, axis=2).reshape(-1) / 2,
    "slow only": lambda s, f, eps: jnp.sum(s[:1] ** 2, axis=1) / 2,
    "hardly fast": lambda s, f, eps: jnp.sum(s[:1] ** 2, axis=1) / 2 + eps * f[0, :1],
    "product": lambda s, f, eps: f[:1, 0] * (f[:1, -1] - s[0, 0]),
    "rows of other size": lambda s, f, eps: jnp.sum((f - s[0]) ** 2, axis=1) * 10.0 ** jnp.arange(0, 6 * len(f), 6),
    "tied": lambda s, f, eps: f[0] - s[0],
    "nothing": lambda s, f, eps: jnp.ones(1),
    "nan": lambda s, f, eps: jnp.nan * f[0, :1],
}
SLOW_CONSTRAINTS: dict[str, Callable] = {
    "sphere": lambda s: jnp.sum(s[:1] ** 2, axis=1) / 2,
    "norm": lambda s: _distance(s[:1]),
    "same twice": lambda s: jnp.stack([1.0, 2.0]) * jnp.sum(s[0] ** 2) / 2,
    "fixed": lambda s: s.reshape(-1),
}

# Kinetic energies and forces; m are masses, c a small or large number.
KINETIC: dict[str, Callable] = {
    "bent": lambda q, v, m, c: jnp.sum(m * (1 + jnp.sin(q) ** 2) * v**2) / 2,
    "coupled": lambda q, v, m, c: jnp.sum(m * v**2) / 2 + jnp.min(m) / 3 * v[0] * v[-1] * jnp.cos(q[0] - q[-1]),
    "massless": lambda q, v, m, c: jnp.sum((m * v**2)[1:]) / 2,
    "quartic": lambda q, v, m, c: jnp.sum(m * v**4) / 4,
    "relativistic": lambda q, v, m, c: -jnp.sum(m * jnp.sqrt(1 - v**2)),
    "nan": lambda q, v, m, c: jnp.sum(m * v**2) * jnp.sqrt(q[0]),
}
FORCES: dict[str, Callable] = {
    "damping": lambda t, q, v, c: -c * v,
    "drag": lambda t, q, v, c: -c * jnp.abs(v) * v,
    "drive": lambda t, q, v, c: c * jnp.sin(10 * t) * jnp.ones_like(v),
    "gain": lambda t, q, v, c: c * v + c * q,
    "root": lambda t, q, v, c: -c * jnp.sqrt(v),
    "nan": lambda t, q, v, c: jnp.nan * v,
}

SCHEMES: dict[str, Callable] = {
    "fully implicit": lambda n, degree, alpha: vm.fully_implicit(n),
    "explicit slow": lambda n, degree, alpha: vm.explicit_slow(n, alpha),
    "mollified impulse": lambda n, degree, alpha: vm.mollified_impulse(n, alpha),
    "fully explicit": lambda n, degree, alpha: vm.fully_explicit(n, alpha),
    "takahashi imada": lambda n, degree, alpha: vm.takahashi_imada(n),
    "gauss": lambda n, degree, alpha: vm.galerkin(n, degree, "gauss"),
    "lobatto": lambda n, degree, alpha: vm.galerkin(n, degree, "lobatto"),
    "mixed": lambda n, degree, alpha: vm.Scheme(
        n,
        degree,
        kinetic=vm.micro(quadrature.gauss(degree)),
        slow=vm.macro(quadrature.simpson),
        fast=vm.micro(quadrature.lobatto(degree + 1)),
        force=vm.micro(quadrature.radau(degree)),
    ),
}
HIGH_DEGREE = "gauss", "lobatto", "mixed"
"""Schemes of any degree; those before have degree 1."""


@dataclasses.dataclass(frozen=True)
class Structure:
    """What is compiled: a name of the tables above for every part, None where there is none.

    slow, fast: numbers of points, of so many coordinates each.
    moving: whether what the constraints keep moves with time.
    lanes: None for `simulate`, else the number of lanes of `simulate_batch`.
    """

    dimension: int = 1
    slow: int = 1
    fast: int = 1
    kinetic: str = "diagonal"
    slow_potential: str | None = None
    fast_potential: str | None = None
    constraint: str | None = None
    slow_constraint: str | None = None
    moving: bool = False
    force: str | None = None
    scheme: str = "fully implicit"
    num_micro: int = 1
    degree: int = 1
    composition: str | None = None
    method: str = "auto"
    num_saves: int = 3
    save_micro: bool = False
    lanes: int | None = None


@dataclasses.dataclass(frozen=True)
class Draw:
    """All numbers of a run; points as tuples of coordinates, slow before fast. Defaults are what is harmless."""

    positions: tuple[float, ...]
    velocities: tuple[float, ...]
    masses: tuple[float, ...]
    stiffness: tuple[float, float] = (1.0, 1.0)
    length: float = 1.0
    off: tuple[float, float] = (0.0, 0.0)
    small: float = 1e-3
    force: float = 0.1
    alpha: float = 0.5
    macro_dt: float = 0.01
    save_every: int = 1
    tolerance: float = 1e-12
    max_iterations: int = 100
    project: bool = False
    time: float = 0.0


def structure(random: Random, tame: bool = False) -> Structure:
    """A random structure; about half of them have nothing hopeless in them, and no tame one has."""

    def perhaps(table, share, harmless=3):
        names = list(table)[: harmless if tame or random.random() < 0.6 else None]
        return random.choice(names) if random.random() < share else None

    scheme = random.choice([name for name in SCHEMES if not (tame and name == "mollified impulse")])
    degree = random.choice([1, 2, 3, 4] if tame else [1, 2, 3]) if scheme in HIGH_DEGREE else 1
    functions = list(KINETIC)[: (0 if scheme == "takahashi imada" else 2) if tame else None]
    methods = (
        ["auto", "exact", "null_space", "dense"] if tame else ["auto"] * 4 + ["masses", "exact", "null_space", "dense"]
    )
    composable = not tame or (degree == 1 and scheme != "mixed")
    return Structure(
        dimension=random.choice([1, 2, 2, 3]),
        slow=random.choice([1, 1, 2, 2, 3]),
        fast=random.choice([1, 1, 2, 2, 3]),
        kinetic=random.choice((["diagonal"] * 4 + ["matrix"]) * (1 if tame else 3) + functions),
        slow_potential=perhaps(ENERGIES, 0.8),
        fast_potential=perhaps(ENERGIES, 0.8),
        constraint=perhaps(CONSTRAINTS, 0.7),
        slow_constraint=perhaps(SLOW_CONSTRAINTS, 0.2, 2),
        moving=random.random() < 0.15,
        force=perhaps(FORCES, 0.2),
        scheme=scheme,
        num_micro=random.choice([1, 1, 2, 3, 4, 5] if tame else [1, 2, 3, 5, 10, 20]),
        degree=degree,
        composition=random.choice(["yoshida4", "suzuki4"]) if composable and random.random() < 0.1 else None,
        method=random.choice(methods),
        num_saves=random.choice([1, 3]),
        save_micro=random.random() < 0.3,
        lanes=4 if not tame and random.random() < 0.1 else None,
    )


def tame_draw(random: Random, of: Structure) -> Draw:
    """Random numbers for a tame structure: points apart, numbers of order one, steps that resolve what moves."""
    n, n_s = of.dimension * (of.slow + of.fast), of.dimension * of.slow
    positions = [random.uniform(-0.3, 0.3) for _ in range(n)]
    for i in range(of.slow + of.fast):  # fast points at 1, 2, ... of the first axis, slow ones at -1, -2, ...
        positions[i * of.dimension] += i + 1 - of.slow if i >= of.slow else -i - 1
    asymmetric = of.composition is None and random.random() < 0.4
    return Draw(
        positions=tuple(positions),
        velocities=tuple(random.uniform(-1, 1) for _ in range(n)),
        masses=tuple(random.uniform(2, 5) if i < n_s else random.uniform(0.3, 2) for i in range(n)),
        stiffness=(random.uniform(0.1, 5), random.uniform(1, 30)),
        alpha=random.uniform(0, 1) if asymmetric else 0.5,
        macro_dt=random.uniform(0.005, 0.05),
        force=random.uniform(0.1, 1),
        time=random.uniform(0, 1),
    )


def draw(random: Random, of: Structure) -> Draw:
    """Random numbers for a structure, spread over many orders of magnitude."""
    n = of.dimension * (of.slow + of.fast)

    def spread(low, high):
        return 10 ** random.uniform(low, high)

    def vector(scale):
        return tuple(scale * random.uniform(-1, 1) for _ in range(n))

    place = random.choice(["generic"] * 6 + ["coincident", "in line", "far away", "tiny", "ordered"])
    positions = vector({"coincident": 0.0, "far away": spread(3, 9), "tiny": spread(-12, -3)}.get(place, 1.0))
    if place == "in line":
        positions = tuple(x if i % of.dimension == 0 else 0.0 for i, x in enumerate(positions))
    if place == "ordered":  # slow points right of the fast ones
        positions = tuple(x + (1.5 if i < of.dimension * of.slow else 0.0) for i, x in enumerate(positions))
    speed = random.choice(["some"] * 5 + ["rest", "huge"])
    mild = random.random() < 0.5
    return Draw(
        positions=positions,
        velocities=vector({"rest": 0.0, "huge": spread(3, 12)}.get(speed, 1.0)),
        masses=tuple(spread(-1, 1) if mild else spread(-6, 6) for _ in range(n)),
        stiffness=(spread(-3, 1), spread(0, 3)) if mild else (spread(-3, 8), spread(-3, 8)),
        length=1.0 if mild else spread(-3, 1),
        off=tuple(0.0 if random.random() < 0.9 else spread(-12, 0) for _ in range(2)),  # pyright: ignore
        small=random.choice([0.0, spread(-12, -1)]),
        force=spread(-3, 0) if mild else spread(-3, 4),
        alpha=random.choice([0.5, 0.5, 0.0, 1.0, random.uniform(-1, 2)]),
        macro_dt=spread(-3, -1) if mild else spread(-9, 3),
        save_every=random.choice([1, 1, 2, 7]),
        tolerance=random.choice([1e-12, 1e-12, spread(-16, -1)]),
        max_iterations=random.choice([100, 100, 100, 1, 2, random.randint(3, 300)]),
        project=random.random() < 0.2,
        time=random.choice([0.0, 0.0, 1e6]),
    )


@cache
def functions(of: Structure) -> dict:
    """The functions of a system of this structure, made once, so that its draws share their programs."""
    shape, names = (-1, of.dimension), dataclasses.asdict(of)

    def slow_potential(q_s, q_f, params):
        x = q_s.reshape(shape)[:, None] - q_f.reshape(shape)
        return ENERGIES[names["slow_potential"]](x.reshape(shape), params["stiffness"][0], params["length"])

    def fast_potential(q_f, params):
        x = jnp.diff(q_f.reshape(shape), axis=0, prepend=jnp.zeros((1, of.dimension)))
        return ENERGIES[names["fast_potential"]](x, params["stiffness"][1], params["length"])

    def constraint(q_s, q_f, params):
        values = CONSTRAINTS[names["constraint"]](q_s.reshape(shape), q_f.reshape(shape), params["small"])
        return values - params.get("g", 0.0)

    def slow_constraint(q_s, params):
        return SLOW_CONSTRAINTS[names["slow_constraint"]](q_s.reshape(shape)) - params.get("g_slow", 0.0)

    def force(t, q_s, q_f, v_s, v_f, params):
        f = FORCES[names["force"]]
        return f(t, q_s, v_s, params["force"]), f(t, q_f, v_f, params["force"])

    def kinetic(q_s, q_f, v_s, v_f, params):
        q, v = jnp.concatenate([q_s, q_f]), jnp.concatenate([v_s, v_f])
        return KINETIC[names["kinetic"]](q, v, params["masses"], params["small"])

    def moved(values):
        """With time, as fast as the force is strong."""
        return vm.Rheonomic(lambda t, *args: values(*args) - args[-1]["force"] * jnp.sin(t - args[-1]["time"]))

    made = {f.__name__: f for f in (slow_potential, fast_potential, constraint, slow_constraint, force)}
    made = {name: f for name, f in made.items() if names[name]} | {"kinetic": kinetic}
    return made | {name: moved(f) for name, f in made.items() if of.moving and name.endswith("constraint")}


def problem(of: Structure, at: Draw) -> vm.Problem:
    """System and start.

    The constraints hold at the start up to ``off``; where they hold, velocities are projected onto them.
    """
    n_s = of.dimension * of.slow
    q, v, masses = (np.array(x) for x in (at.positions, at.velocities, at.masses))
    params = {
        name: np.asarray(getattr(at, name), dtype=float)
        for name in ("stiffness", "length", "small", "force", "masses", "time")
    }
    parts = functions(of)
    points = np.asarray(q[:n_s]), np.asarray(q[n_s:])
    for name, value, off in zip(("constraint", "slow_constraint"), ("g", "g_slow"), at.off, strict=True):
        if name in parts:
            start = vm.System(vm.ConstantMass([], []), **{name: parts[name]}, params=params)
            rows = np.asarray(start.g(at.time, *points) if value == "g" else start.g_slow(at.time, points[0]))
            params[value] = np.asarray(rows + off * np.arange(1, len(rows) + 1))
    if of.kinetic in KINETIC:
        kinetic = parts["kinetic"]
    elif of.kinetic == "matrix":
        kinetic = vm.ConstantMass(*(np.diag(m) + 0.3 * np.min(m) for m in (masses[:n_s], masses[n_s:])))
    else:
        kinetic = vm.ConstantMass(masses[:n_s], masses[n_s:])
    system = vm.System(**parts | {"kinetic": kinetic}, params=params)
    return vm.Problem(system, q[:n_s], q[n_s:], v[:n_s], v[n_s:], at.time, project=not any(at.off))


def scheme(of: Structure, at: Draw) -> vm.Scheme | vm.Composition:
    """The scheme, with the weights that alpha gives."""
    made = SCHEMES[of.scheme](of.num_micro, of.degree, at.alpha)
    return vm.compose(made, of.composition) if of.composition else made
