"""A system in other units is the same system: every number of a run comes out the same, scaled, and every check decides
the same.

Units are powers of two, so that scaling rounds nothing: runs are equal bit for bit, but for those of `ROUNDED`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vmri_jax as vm
from vmri_jax import kernels
from vmri_jax.scene import Anchor, Body, Gravity, Revolute, RigidBody, RigidLink, Scene, Spring
from vmri_jax.systems import fermi_pasta_ulam, simple_atomic_model, triple_spherical_pendulum

SCALES = [(60, 0, 0), (-60, 17, 23), (0, -60, 60), (23, 60, -60)]
"""Exponents of 2 of the units of length, time and mass."""
ROUNDED = dict.fromkeys(("sam", "polar", "on_a_spiral", "joints"), 1e-14)
"""Largest relative differences of runs that are not equal bit for bit: 1e-33 in the projected start of sam; 3e-16 in
energies, whose velocities come from mass matrices over square roots of odd powers of two."""


class Units:
    """Numbers in other units: ``u(1.0, 1, -1)`` is a velocity. The exponents of the dimensions may be arrays."""

    def __init__(self, length=0, time=0, mass=0):
        self.exponents = length, time, mass

    def __call__(self, number, x: Any = 0.0, t=0.0, m=0.0):
        length, time, mass = self.exponents
        return np.asarray(number, dtype=float) * 2.0 ** (length * np.asarray(x) + time * t + mass * m)

    def spring(self, number):
        return self(number, 0, -2, 1)

    def gravity(self, number):
        return self(number, 1, -2)


def in_units(problem, u, dimensions):
    """A problem whose coordinates are lengths, in other units; `dimensions` (l, t, m) of its params."""
    system = problem.system
    params = {name: u(value, *dimensions[name]) for name, value in system.params.items()}
    masses = vm.ConstantMass(u(system.kinetic.slow, m=1), u(system.kinetic.fast, m=1))
    q, v = ([u(getattr(problem, f"{kind}_{part}"), 1, t) for part in "sf"] for kind, t in (("q", 0), ("v", -1)))
    return vm.Problem(system.replace(kinetic=masses, params=params), *q, *v, project=problem.project)


def fpu(u):
    length, time, _ = (
        u.exponents
    )  # the stiffness of its soft springs is the number 1, of which the unit of mass follows
    u.exponents = length, time, 2 * (length + time)
    return in_units(fermi_pasta_ulam(), u, {"omega": (1, 0, 0)}), vm.fully_implicit(5), 0.02


ATOMS = {"masses": (0, 0, 1), "stiffness": (0, -2, 1), "gravity": (1, -2, 0), "length": (1, 0, 0), "lengths": (1, 0, 0)}


def tsp(u):
    return in_units(triple_spherical_pendulum(), u, ATOMS), vm.fully_explicit(2), 0.01


def sam(u):
    return in_units(simple_atomic_model(), u, ATOMS), vm.fully_implicit(5), 0.01


def polar_kinetic(q_s, q_f, v_s, v_f, params):
    return params["m"] * (v_s["r"] ** 2 + q_s["r"] ** 2 * v_s["phi"] ** 2) / 2


def attraction(q_s, q_f, params):
    return -params["m"] * params["GM"] / q_s["r"]


def spiral(q_s, params):
    return {"spiral": q_s["r"] - params["rise"] * q_s["phi"]}


def polar(u, **parts):
    """A satellite in polar coordinates, in metres."""
    params = {"m": u(1000.0, m=1), "GM": u(3.986e14, 3, -2), "rise": u(7.0e6, 1)}
    system = vm.System(polar_kinetic, attraction, params=params, **parts)
    velocities = {"r": u(7.0e3 if parts else 500.0, 1, -1), "phi": u(1e-3, t=-1)}
    return vm.Problem(system, {"r": u(7.0e6, 1), "phi": 1.0}, {}, velocities), vm.fully_implicit(1), 10.0


def on_a_spiral(u):
    """A constraint between a length and an angle."""
    return polar(u, slow_constraint=spiral)


def springs(q_s, q_f, params):
    d = jnp.concatenate([q_s, q_f]) - params["far"]
    return params["k"] / 2 * d @ d


def swinging(t, q_s, q_f, params):
    return q_f - q_s - params["swing"] * jnp.array([jnp.sin(params["omega"] * t), 0.0])


def rod(t, q_s, q_f, params):
    return jnp.array([jnp.linalg.norm(swinging(t, q_s, q_f, params)) - params["L"]])


def rod_squared(t, q_s, q_f, params):
    d = swinging(t, q_s, q_f, params)
    return jnp.array([d @ d - params["L"] ** 2])


def friction(t, q_s, q_f, v_s, v_f, params):
    return -params["c"] * v_s, -params["c"] * v_f


def moving(u):
    """A rod whose end swings, a thousand lengths from the origin, with damping and a redundant row."""
    params = {"far": u([1e3, 0, 1e3, 0], 1), "k": u.spring(4.0), "swing": u(0.1, 1), "omega": u(3.0, t=-1)}
    params |= {"L": u(1.0, 1), "c": u(0.1, 0, -1, 1)}
    masses = vm.ConstantMass(u([2.0, 2.0], m=1), u([1.0, 1.0], m=1))
    rows = {"constraint": vm.Rheonomic(rod), "implied": vm.Rheonomic(rod_squared)}
    system = vm.System(masses, springs, force=friction, params=params, **rows)
    starts = u([1e3, 0.0], 1), u([1e3 + 0.6, 0.8], 1), u([0.3, 0.0], 1, -1), u([0.6, 0.0], 1, -1)
    return vm.Problem(system, *starts), vm.fully_implicit(3), 0.02


def well(q_f, params):
    return params["k"] * (1 - jnp.cos(q_f[0] / params["L"])) * params["L"] ** 2


def one_coordinate(u):
    system = vm.System(vm.ConstantMass([], u([2.0], m=1)), None, well, params={"k": u.spring(3.0), "L": u(0.5, 1)})
    return vm.Problem(system, [], u([0.3], 1)), vm.fully_implicit(4), 0.05


def points(u):
    """A scene of points."""
    hook = Body("hook", u(5.0, m=1), u([0.0, -1.0], 1), pace="slow")
    load = Body("load", u(1.0, m=1), u([0.4, -1.3], 1), pace="fast")
    spring = Spring(("hook", "load"), u.spring(400.0), u(0.5, 1))
    scene = Scene([hook, load], [Gravity(u.gravity(9.81)), Anchor("hook", u([0.0, 0.0], 1)), spring])
    return scene.problem(), vm.fully_implicit(3), 0.02


def joints(u):
    """A scene in joint coordinates."""
    inertia = u([0.1, 0.2, 0.25], 2, 0, 1)
    bodies = [RigidBody(name, u(1.0, m=1), inertia, u([x, 0.0, 0.0], 1)) for name, x in (("a", 0.5), ("b", 1.5))]
    hinges = [
        Revolute(pair, u([x, 0.0, 0.0], 1), axis=[0, 1, 0], name=name)
        for name, pair, x in (("one", ("ground", "a"), 0.0), ("two", ("a", "b"), 1.0))
    ]
    scene = Scene(bodies, [*hinges, Gravity(u.gravity(9.81))], coordinates="joint")
    return scene.problem(), vm.fully_implicit(2), 0.01


SYSTEMS = (fpu, tsp, sam, polar, on_a_spiral, moving, one_coordinate, points, joints)
ANGLES = {"polar": [1, 0], "on_a_spiral": [1, 0], "joints": [0, 0]}
"""Exponents of length of slow coordinates where they are no lengths."""


def numbers_of(system, units):
    """All numbers of a short run, in the base units."""
    u = Units(*units)
    problem, scheme, macro_dt = system(u)
    run = vm.simulate(problem, scheme, macro_dt=float(u(macro_dt, t=1)), num_steps=8)
    back = Units(*(-np.array(u.exponents)))
    of_s = np.array(ANGLES.get(system.__name__, 1.0))
    s, info = run.states, run.info
    return {
        "t": back(run.t, t=1),
        "q_s": back(s.q_s, of_s) if s.q_s.size else s.q_s,
        "q_f": back(s.q_f, 1),
        "p_s": back(s.p_s, 2 - of_s, -1, 1) if s.q_s.size else s.q_s,
        "p_f": back(s.p_f, 1, -1, 1),
        "energy": back(run.energy, 2, -2, 1),
        **{name: getattr(info, name) for name in ("method", "iterations")},
        "result": run.result,
    }


LONG = (sam, on_a_spiral)
"""Runs for --full: terms of sam are in tsp and in fpu; a constraint between a length and an angle is refused in all
units below."""


@pytest.mark.parametrize(
    "system",
    [pytest.param(system, marks=pytest.mark.full if system in LONG else ()) for system in SYSTEMS],
    ids=lambda system: system.__name__,
)
def test_a_run_in_other_units(system):
    here = numbers_of(system, (0, 0, 0))
    for units in SCALES:
        there = numbers_of(system, units)
        for name, value in here.items():
            size = np.abs(value).max(initial=1.0 if name == "energy" else 0.0)  # of terms of about 1 J, which cancel
            np.testing.assert_allclose(
                there[name], value, rtol=0, atol=ROUNDED.get(system.__name__, 0) * size, err_msg=f"{name} {units}"
            )


@pytest.mark.parametrize(
    ("system", "part", "number"),
    [(tsp, "q_f", 1), (moving, "q_f", -1), (on_a_spiral, "q_s", -1)],
    ids=["tsp", "moving", "on_a_spiral"],
)
def test_a_start_off_its_constraints_is_refused_in_all_units(system, part, number):
    for units in [(0, 0, 0), *SCALES]:
        problem = system(Units(*units))[0]
        start = {name: np.array(getattr(problem, name)) for name in ("q_s", "q_f", "v_s", "v_f")}
        start[part][number] *= 1 + 1e-12
        vm.initial_state(problem.system, *start.values())
        start[part][number] *= 1 + 1e-3
        with pytest.raises(ValueError, match="violate"):
            vm.initial_state(problem.system, *start.values())


def flat(q_s, q_f, v_s, v_f, params):
    return params["m"] * (v_s[0] + params["L"] * v_s[1]) ** 2 / 2


def test_masses_in_other_units():
    for units in [(0, 0, 0), *SCALES]:
        u = Units(*units)
        root = np.array([u(1.0, 1), 1.0])
        vm.ConstantMass([], np.array([[2.0, 1.0], [1.0, 1.0]]) * u(1.0, m=1) * root[:, None] * root)
        with pytest.raises(ValueError, match="positive definite"):
            vm.ConstantMass([], np.array([[1.0, 2.0], [2.0, 1.0]]) * root[:, None] * root)
        singular = vm.System(flat, params={"m": u(1.0, m=1), "L": u(1.0, 1)})
        with pytest.raises(ValueError, match="not positive definite"):
            vm.Problem(singular, [u(1.0, 1), 0.5], []).state()


A = np.array([6.8e6, 0.0])
B = A + 2.0e4 * np.array([np.cos(0.5), np.sin(0.5)])


@pytest.mark.parametrize("project", [False, True])
def test_a_tether_on_an_orbit(project):
    """The round-off of positions 6800 km from the origin is 3e-8 in the distance, 7.6e-6 in its square over 2e4."""
    scene = Scene([Body("a", 1000.0, A), Body("b", 500.0, B)], [RigidLink(("a", "b"))], project=project)
    state = scene.state()
    np.testing.assert_allclose(np.append(state.q_s, state.q_f), [*A, *B], rtol=1e-15, atol=1e-8)


def distance(q_s, q_f, params):
    return jnp.array([jnp.linalg.norm(q_f[2:] - q_f[:2]) - params["L"]])


def distance_squared(q_s, q_f, params):
    d = q_f[2:] - q_f[:2]
    return jnp.array([d @ d - params["L"] ** 2])


@pytest.mark.parametrize("constraint", [distance, distance_squared])
def test_a_tether_by_functions(constraint):
    masses = vm.ConstantMass([], [1000.0, 1000.0, 500.0, 500.0])
    system = vm.System(masses, constraint=constraint, params={"L": 2e4})
    v = np.array([0.0, 7600.0, 0.0, 7600.0])
    for project, end in ((False, B), (True, B + np.array([30.0, 0.0]))):
        problem = vm.Problem(system, [], np.append(A, end), [], v, project=project)
        run = vm.simulate(problem, vm.fully_implicit(1), macro_dt=1.0, num_steps=20)
        lengths = np.linalg.norm(run.q_f[:, 2:] - run.q_f[:, :2], axis=1)
        np.testing.assert_allclose(lengths, 2e4, rtol=0, atol=3e-8)  # 1e-9
    with pytest.raises(ValueError, match="violate constraint"):
        vm.Problem(system, [], np.append(A, B + 1e-3), [], v).state()


def test_a_satellite_in_polar_coordinates():
    def rates(_, y):
        r, _, v, omega = y
        return [v, omega, r * omega**2 - 3.986e14 / r**2, -2 * v * omega / r]

    run = vm.simulate(*polar(Units())[:2], macro_dt=10.0, num_steps=580, save=580)
    end = solve_ivp(rates, (0, 5800), [7.0e6, 1.0, 500.0, 1e-3], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    assert abs(run.q_s["r"][-1] / end[0] - 1) < 1e-5
    assert abs(run.q_s["phi"][-1] - end[1]) < 1e-4


@pytest.mark.parametrize("n", [3, 8, 12])
def test_eliminations(n):
    a = np.random.default_rng(n).normal(size=(n, n))
    a, b = a @ a.T + np.eye(n), np.ones((n, 1))
    eliminated = jax.jit(lambda a: (kernels.inverse(a), kernels.solve(a, b)))
    for size in (2.0**-60, 2.0**60):
        for there, here in zip(eliminated(size * a), eliminated(a), strict=True):
            np.testing.assert_array_equal(size * np.asarray(there), here)
