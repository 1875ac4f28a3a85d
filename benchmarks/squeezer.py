"""Andrews' squeezer to t = 0.03 s: error against time, ours as rigid bodies and in seven angles, scipy, and Exudyn if it is there.

Data and angles at the end: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, VII.7.
"""

import runpy
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import vmri_jax as vm
from benchmarks.measure import Tell, silent
from benchmarks.report import Report
from vmri_jax import plots

COLUMNS = ("who", "setting", "error", "ms", "first call, s")
FILE = "notebooks/scenes/squeezer.py"
T_END = 0.03
ANGLES = ("beta", "theta", "gamma", "phi", "delta", "omega", "epsilon")
PUBLISHED = np.array(
    [
        *(15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948),
        *(0.5244099658805304, 0.5347301163226948, 1.048080741042263),
    ]
)
"""The angles at the end, rad."""
NODES = 30
"""Saved of the bodies, so that whole turns are seen."""


@dataclass(frozen=True)
class Size:
    """Steps by degree for both forms of ours, tolerances of scipy, steps of Exudyn, samples of a time."""

    steps: dict[int, tuple[int, ...]]
    tolerances: tuple[float, ...]
    exudyn: tuple[int, ...]
    repeats: int


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size({2: (300,)}, (1e-5, 1e-8), (300,), 3)
    steps = {1: (600, 2400), 2: (150, 300, 600, 1200), 3: (150, 300)}
    return Size(steps, (1e-4, 1e-6, 1e-8, 1e-10), (300, 3000, 30000), 5)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each integrator."""
    ours = [(f"degree {degree}, {n} steps", degree, n) for degree, many in size.steps.items() for n in many]
    runs: dict[str, dict[str, Callable]] = {
        "rigid bodies": {setting: partial(by_bodies, degree, n) for setting, degree, n in ours},
        "seven angles": {setting: partial(by_angles, degree, n) for setting, degree, n in ours},
        "scipy DOP853": {f"rtol {tolerance:g}": partial(by_scipy, tolerance) for tolerance in size.tolerances},
    }
    notes = []
    try:
        from benchmarks.peers import exudyn_squeezer
    except ImportError:
        notes = ["Exudyn is not installed: left out."]
    else:
        for solver in exudyn_squeezer.SOLVERS:
            runs[f"Exudyn {solver}"] = {
                f"{n} steps": partial(exudyn_squeezer.angles, data(), T_END, n, solver) for n in size.exudyn
            }
    rows: list[dict] = []
    for who, settings in runs.items():
        for setting, compute in settings.items():
            tell(f"{who}, {setting}")
            first, _ = timed(compute)
            samples, found = zip(*(timed(compute) for _ in range(size.repeats)), strict=True)
            angles = of_bodies(found[0]) if who == "rigid bodies" else found[0]
            row = {"who": who, "setting": setting, "error": float(np.abs(angles - PUBLISHED).max())}
            rows.append(row | {"ms": 1e3 * min(samples), "first call, s": first})
        yield Report("squeezer", name, list(rows), [], notes, {"squeezer": partial(draw, list(rows))})


def timed(compute: Callable) -> tuple[float, Any]:
    """Seconds, and what came of it."""
    begin = time.perf_counter()
    found = compute()
    return time.perf_counter() - begin, found


@cache
def data() -> dict:
    """All that is in the file of the scene."""
    return runpy.run_path(FILE)


def start() -> np.ndarray:
    """The angles at the start."""
    return np.array([data()["START"][name] for name in ANGLES])


@cache
def prepared(degree: int, steps: int, angles: bool) -> vm.Simulation:
    """Our run, compiled."""
    what = seven_angles() if angles else data()["scene"]
    scheme, every = vm.galerkin(1, degree), steps if angles else steps // NODES
    return vm.prepare(what, scheme, macro_dt=T_END / steps, num_steps=steps, save_every=every)


def by_bodies(degree: int, steps: int) -> vm.Trajectory:
    """The run of the scene of rigid bodies."""
    return prepared(degree, steps, False)()


def of_bodies(run: vm.Trajectory) -> np.ndarray:
    """The angles at its end."""
    turned = partial(data()["scene"].joint_motion, run)
    angles = [turned("motor shaft"), *(turned("hinges", pair=pair) for pair in (0, 1, 4, 2, 5, 3))]
    return np.array([angle[-1] for angle in angles]) + start()


def by_angles(degree: int, steps: int) -> np.ndarray:
    """The angles at the end, of the system in these angles."""
    return np.asarray(prepared(degree, steps, True)().q_s[-1])


# --- in seven angles with six constraints, as the source states it ----------------------------------------------------
def bars(q):
    """(7, 3) centres and angles of the bars."""
    c = data()
    beta, theta, gamma, phi, delta, omega, epsilon = q
    a, b = jnp.asarray(c["A"]), jnp.asarray(c["B"])
    centres = [
        turn(beta, c["RA"], 0.0),
        turn(beta, c["RR"], 0.0) - turn(beta + theta, c["DA"], 0.0),
        b + turn(gamma, c["SB"], -c["SA"]),
        a + turn(delta, c["ZT"], 0.0) + turn(phi + delta, 0.0, c["EA"] - c["E"]),
        a + turn(delta, c["TA"], c["TB"]),
        a + turn(epsilon, 0.0, -c["U"]) + turn(omega + epsilon, c["ZF"] - c["FA"], 0.0),
        a + turn(epsilon, -c["UB"], -c["UA"]),
    ]
    angles = jnp.stack([beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon])
    return jnp.concatenate([jnp.stack(centres), angles[:, None]], axis=1)


def turn(angle, x, y):
    """A vector of a bar at this angle."""
    return jnp.stack([x * jnp.cos(angle) - y * jnp.sin(angle), x * jnp.sin(angle) + y * jnp.cos(angle)])


def kinetic(q_s, q_f, v_s, v_f, params):
    """Of the bars."""
    _, rates = jax.jvp(bars, (q_s,), (v_s,))
    masses, moments = jnp.asarray(data()["MASSES"]), jnp.asarray(data()["MOMENTS"])
    return jnp.sum(masses[:, None] * rates[:, :2] ** 2) / 2 + jnp.sum(moments * rates[:, 2] ** 2) / 2


def spring(q_s, q_f, params):
    """Between the third bar and the ground."""
    c = data()
    end = jnp.asarray(c["B"]) + turn(q_s[2], c["SD"], -c["SC"])
    return c["STIFFNESS"] / 2 * (jnp.linalg.norm(end - jnp.asarray(c["C"])) - c["LENGTH"]) ** 2


def loops(q, params):
    """(6,) three bars meet the second one at its tip."""
    c = data()
    beta, theta, gamma, phi, delta, omega, epsilon = q
    a, b = jnp.asarray(c["A"]), jnp.asarray(c["B"])
    tip = turn(beta, c["RR"], 0.0) - turn(beta + theta, c["D"], 0.0)
    third = b + turn(gamma, 0.0, -c["SS"])
    fourth = a + turn(delta, c["ZT"], 0.0) + turn(phi + delta, 0.0, -c["E"])
    sixth = a + turn(epsilon, 0.0, -c["U"]) + turn(omega + epsilon, c["ZF"], 0.0)
    return jnp.concatenate([tip - third, tip - fourth, tip - sixth])


def motor(t, q_s, q_f, v_s, v_f, params):
    """A constant torque on the first bar."""
    return jnp.zeros(7).at[0].set(data()["TORQUE"]), jnp.zeros(0)


def seven_angles() -> vm.Problem:
    """The mechanism in its angles, all of them slow."""
    system = vm.System(kinetic, slow_potential=spring, slow_constraint=loops, force=motor)
    return vm.Problem(system, start(), np.zeros(0), project=True)


@jax.jit
def rates(z):
    """Of angles and their velocities, the constraints differentiated twice: what integrators without constraints are given."""
    q, v = z[:7], z[7:]
    none = jnp.zeros(0)

    def momentum(q, v):
        return jax.grad(kinetic, argnums=2)(q, none, v, none, None)

    mass = jax.jacfwd(momentum, argnums=1)(q, v)
    along_v, jacobian = jax.jvp(momentum, (q, v), (v, 0 * v))[1], jax.jacfwd(loops)(q, None)
    bent = jax.jvp(lambda q: jax.jvp(lambda q: loops(q, None), (q,), (v,))[1], (q,), (v,))[1]
    inertia = jax.grad(kinetic, argnums=0)(q, none, v, none, None) - along_v
    force = motor(0.0, q, none, v, none, None)[0] - jax.grad(spring)(q, none, None) + inertia
    matrix = jnp.block([[mass, jacobian.T], [jacobian, jnp.zeros((6, 6))]])
    return jnp.concatenate([v, jnp.linalg.solve(matrix, jnp.concatenate([force, -bent]))[:7]])


def by_scipy(tolerance: float) -> np.ndarray:
    """The angles at the end by DOP853."""
    z = np.concatenate([np.asarray(seven_angles().state().q_s), np.zeros(7)])
    found = solve_ivp(lambda t, z: np.asarray(rates(z)), (0.0, T_END), z, "DOP853", rtol=tolerance, atol=tolerance)
    return found.y[:7, -1]


def draw(rows: list[dict]):
    """Error against time."""
    with plots.new_figure(5.6, 3.4, "Andrews' squeezer", plots.LIGHT) as figure:
        axes = figure.subplots()
        for marker, who in zip(plots.MARKERS, dict.fromkeys(row["who"] for row in rows), strict=False):
            own = [row for row in rows if row["who"] == who]
            axes.loglog([r["ms"] for r in own], [r["error"] for r in own], marker, linestyle="", label=who)
        axes.set(xlabel="ms", ylabel="largest error of an angle, rad")
        axes.legend()
    return figure
