"""Random systems, starts, schemes and steps, most of them hard and some hopeless, and what their runs must not do.

A `Structure` decides what is compiled, a `Draw` all numbers: many draws of a structure share its compiled programs. Both are
drawn from a `random.Random`, so that a seed names them; Hypothesis has one that it can shrink.
"""

import dataclasses
import linecache
from collections.abc import Callable
from functools import cache
from random import Random

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax.mechanics.checks import CONSTRAINT_TOLERANCE


def _distance(x):
    return jnp.linalg.norm(x, axis=-1)  # its derivative at zero is NaN, as in a user's code


# Of the next tables the first two or three entries are harmless.

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
    "norm": lambda s, f, eps: _distance(f[:1] - s[0]),
    "chain": lambda s, f, eps: jnp.sum(jnp.diff(f, axis=0, prepend=s[:1]) ** 2, axis=1) / 2,
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
}


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
    fixed_iterations: int | None = None
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


def structure(random: Random) -> Structure:
    """A random structure; about half of them have nothing hopeless in them."""

    def perhaps(table, share, harmless=3):
        names = list(table)[: harmless if random.random() < 0.6 else None]
        return random.choice(names) if random.random() < share else None

    scheme = random.choice(list(SCHEMES))
    method = random.choice(["auto"] * 4 + ["march", "frozen", "decoupled", "arrowhead", "dense"])
    return Structure(
        dimension=random.choice([1, 2, 2, 3]),
        slow=random.choice([1, 1, 2, 2, 3]),
        fast=random.choice([1, 1, 2, 2, 3]),
        kinetic=random.choice(["diagonal"] * 12 + ["matrix"] * 3 + list(KINETIC)),
        slow_potential=perhaps(ENERGIES, 0.8),
        fast_potential=perhaps(ENERGIES, 0.8),
        constraint=perhaps(CONSTRAINTS, 0.7),
        slow_constraint=perhaps(SLOW_CONSTRAINTS, 0.2, 2),
        moving=random.random() < 0.15,
        force=perhaps(FORCES, 0.2),
        scheme=scheme,
        num_micro=random.choice([1, 2, 3, 5, 10, 20]),
        degree=random.choice([1, 2, 3]) if scheme in ("gauss", "lobatto") else 1,
        composition=random.choice(["yoshida4", "suzuki4"]) if random.random() < 0.1 else None,
        method=method,
        fixed_iterations=random.choice([1, 3, 6]) if random.random() < 0.1 else None,
        num_saves=random.choice([1, 3]),
        save_micro=random.random() < 0.3,
        lanes=4 if random.random() < 0.1 else None,
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

    made = [slow_potential, fast_potential, constraint, slow_constraint, force]
    return {f.__name__: f for f in made if names[f.__name__]} | {"kinetic": kinetic}


@cache
def moving(of: Structure) -> dict:
    """The constraints of `functions` with values that move with time, as fast as the force is strong."""

    def moved(values):
        def at(t, *arguments):
            params = arguments[-1]
            return values(*arguments) - params["force"] * jnp.sin(t - params["time"])

        return vm.Rheonomic(at)

    return {name: moved(f) for name, f in functions(of).items() if name.endswith("constraint")}


def problem(of: Structure, at: Draw) -> vm.Problem:
    """System and start. The constraints hold at the start up to ``off``."""
    n_s = of.dimension * of.slow
    q, v, masses = (np.array(x) for x in (at.positions, at.velocities, at.masses))
    params = {
        name: jnp.asarray(getattr(at, name), dtype=float)
        for name in ("stiffness", "length", "small", "force", "masses", "time")
    }
    parts = functions(of)
    if of.constraint:
        rows = np.asarray(parts["constraint"](jnp.asarray(q[:n_s]), jnp.asarray(q[n_s:]), params))
        params["g"] = jnp.asarray(rows + at.off[0] * np.arange(1, len(rows) + 1))
    if of.slow_constraint:
        rows = np.asarray(parts["slow_constraint"](jnp.asarray(q[:n_s]), params))
        params["g_slow"] = jnp.asarray(rows + at.off[1] * np.arange(1, len(rows) + 1))
    if of.kinetic in KINETIC:
        kinetic = parts["kinetic"]
    elif of.kinetic == "matrix":
        kinetic = vm.ConstantMass(*(np.diag(m) + 0.3 * np.min(m) for m in (masses[:n_s], masses[n_s:])))
    else:
        kinetic = vm.ConstantMass(masses[:n_s], masses[n_s:])
    held = moving(of) if of.moving else {}
    system = vm.System(**parts | held | {"kinetic": kinetic}, params=params)
    return vm.Problem(system, q[:n_s], q[n_s:], v[:n_s], v[n_s:], at.time)


def scheme(of: Structure, at: Draw) -> vm.Scheme | vm.Composition:
    """The scheme, with the weights that alpha gives."""
    made = SCHEMES[of.scheme](of.num_micro, of.degree, at.alpha)
    return vm.compose(made, of.composition) if of.composition else made


def run(of: Structure, draws: list[Draw]) -> list[str]:
    """What becomes of each draw: the name of its `Result`, "REFUSED" with an error of ours, or what is wrong.

    A structure with lanes takes so many draws at once, with the masses and the scheme of the first.
    """
    try:
        first, problems = draws[0], [problem(of, at) for at in draws]
        how = {
            "num_steps": of.num_saves * first.save_every,
            "save_every": first.save_every,
            "save_micro": of.save_micro,
            "newton": vm.Newton(of.method, first.tolerance, first.max_iterations, of.fixed_iterations),  # pyright: ignore
        }
        made = scheme(of, first)
        if of.lanes is None:
            start = problems[0].state(project=first.project)
            found = [vm.simulate(problems[0].system, made, start, macro_dt=first.macro_dt, throw=False, **how)]
        else:
            found = _batch(problems, made, draws, how)
    except Exception as error:
        return [refusal(error)] * len(draws)
    return [judge(run, first.tolerance, how["num_steps"]) for run in found]


def _batch(problems, made, draws, how) -> list[vm.Trajectory]:
    """Lanes that `initial_state` refuses start from the state it would have projected, unprojected."""
    starts = []
    for at in problems:
        try:
            starts.append(at.state())
        except ValueError:
            v = jnp.zeros_like(at.q_s), jnp.zeros_like(at.q_f)
            starts.append(vm.State(at.t, at.q_s, at.q_f, *v))
    stacked = [
        {name: np.stack([np.asarray(x[name]) for x in lanes]) for name in lanes[0]}
        for lanes in ([vars(s) for s in starts], [p.system.params for p in problems])
    ]
    dt = np.array([at.macro_dt for at in draws])
    runs = vm.simulate_batch(problems[0].system, made, vm.State(**stacked[0]), params=stacked[1], macro_dt=dt, **how)
    fields = {f.name: getattr(runs, f.name) for f in dataclasses.fields(runs) if getattr(runs, f.name) is not None}
    info = fields.pop("info")
    return [
        vm.Trajectory(**{k: a[i] for k, a in fields.items()}, info=type(info)(*(a[i] for a in info)))
        for i in range(len(draws))
    ]


HONEST = "REFUSED", *vm.Result.__members__
"""Outcomes of a run that are as they should be; all others say what is wrong."""


def refusal(error: Exception) -> str:
    """ "REFUSED" for a ValueError or TypeError that this package raised itself, else what it was and where."""
    at = error.__traceback__
    while at is not None and at.tb_next is not None:
        at = at.tb_next
    where = at.tb_frame.f_globals.get("__name__", "?") if at is not None else "?"
    raised = at is not None and "raise" in linecache.getline(at.tb_frame.f_code.co_filename, at.tb_lineno)
    if isinstance(error, ValueError | TypeError) and where.split(".")[0] == "vmri_jax" and raised:
        return "REFUSED"
    return f"foreign error: {type(error).__name__} in {where}: {str(error)[:200]}"


def judge(run: vm.Trajectory, tolerance: float, num_steps: int) -> str:
    """The name of the `Result` of an honest run, else what is wrong with it."""
    code, failed_at, saves = int(run.result), int(run.failed_at), len(run.t) - 1
    if code not in set(vm.Result):
        return f"unknown status: {code}"
    status = vm.Result(code)
    if status.success != (failed_at < 0) or failed_at >= num_steps:
        return f"status at odds: {status.name} with failed_at {failed_at}"
    nodes = {name: np.asarray(getattr(run, name)) for name in ("q_s", "q_f", "p_s", "p_f", "energy")}
    kept = 1 + (saves if status.success else failed_at * saves // num_steps)
    if not status.success and not np.isfinite(nodes["energy"][0]):
        kept = 0  # the start itself is outside the domain of a function
    for name, a in nodes.items():
        finite = np.isfinite(a).reshape(len(a), -1)
        if not finite[:kept].all():
            return f"not finite: {name} at a node with success (status {status.name})"
        if finite[kept:].any() and finite.size:
            return f"stale numbers: {name} after a failure (status {status.name})"
    if run.q_f_micro is not None and not np.isfinite(np.asarray(run.q_f_micro)[: max(0, kept - 1)]).all():
        return "not finite: q_f_micro at a node with success"
    g = np.asarray(run.constraint_residual)[:kept, 0].max(initial=0.0)
    if not g <= max(CONSTRAINT_TOLERANCE, 100 * tolerance):
        return f"constraint violated: by {g:.1e} at a node with success (status {status.name})"
    if not np.isfinite(np.asarray(run.info.residual)[: max(0, kept - 1)]).all():
        return "not finite: residual of a step with success"
    return status.name
