"""What acts in a hinge, on bars whose equation of motion is known: springs, dampers, drives, limits, given motions."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.body_motions import accelerations, state_of
from vmri_jax import scene as sc
from vmri_jax.scene.rows import ConstraintRows

Y = np.array([0.0, 1.0, 0.0])
MASS, LENGTH, TILT, WEIGHT = 2.0, 0.7, 0.5, 2.0 * 9.81
INERTIA = MASS * (3 * 0.1**2 + 1.0) / 12 + MASS * LENGTH**2
"""Of a bar about its hinge."""
TIME, ANGLE, RATE = 1.0, 0.4, 0.8


def torque(t, params):
    return params["size"] * t


def swing(t, params):
    return params["far"] * t**2


EFFECTS = {  # the effect in the hinge of this name, and the torque about the hinge at TIME, ANGLE and RATE
    "spring": (sc.JointSpring("spring", 30.0, 0.1), -30.0 * (ANGLE - 0.1)),
    "drive": (sc.JointDrive("drive", torque, {"size": 3.0}), 3.0 * TIME),
    "damper": (sc.JointDamper("damper", 2.0), -2.0 * RATE),
    "limit": (sc.JointLimit("limit", -0.2, 0.3, stiffness=2000.0, smoothing=0.002), -2000.0 * (ANGLE - 0.3)),
}


def bars(turned=0.0, spin=0.0):
    """Bars that hang on hinges about the y axis, turned from where their angles are zero: one for each effect, a free
    and a moved one."""
    names, tilt = (*EFFECTS, "free", "motion"), TILT + turned
    out = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    bodies = [
        sc.RigidBody(
            f"bar {name}",
            MASS,
            sc.Cylinder(0.1, 1.0),
            LENGTH * out + 3.0 * i * Y,
            [0.0, -tilt, 0.0],
            spin=-spin * Y,
            velocity=spin * LENGTH * np.array([np.cos(tilt), 0.0, np.sin(tilt)]),
            pace=("slow", "fast")[i % 2],
        )
        for i, name in enumerate(names)
    ]
    hinges = [sc.Revolute(("ground", f"bar {name}"), 3.0 * i * Y, -Y, name=name) for i, name in enumerate(names)]
    return bodies, [*hinges, sc.Gravity(), *(effect for effect, _ in EFFECTS.values())]


def test_hinged_bars_obey_the_equation_of_the_compound_pendulum():
    """``I x'' = -m g l sin(tilt + x) + torque`` for slow and fast bars; the bar whose motion is given has the
    acceleration of this motion."""
    bodies, effects = bars()
    moved, same = bars(ANGLE, RATE)
    given = sc.JointMotion("motion", swing, {"far": 0.4})  # 0.4 t^2: at TIME the angle and rate of all bars
    scene = sc.Scene(bodies, [*effects, given], coordinates="directors")
    state = state_of(sc.Scene(moved, same, coordinates="directors"))
    seen = accelerations(scene, replace(state, t=np.asarray(TIME)))
    acceleration = {}
    for body, (q, _, a) in seen.items():  # sum d_i x d_i'' / 2, about -y
        acceleration[body.removeprefix("bar ")] = -np.cross(q[3:].reshape(3, 3), a[3:].reshape(3, 3)).sum(axis=0)[1] / 2
    fall = -WEIGHT * LENGTH * np.sin(TILT + ANGLE)
    expected = {name: (fall + torque) / INERTIA for name, (_, torque) in EFFECTS.items()}
    expected |= {"free": fall / INERTIA, "motion": 0.8}
    assert acceleration == pytest.approx(expected, abs=1e-9)


def test_a_given_motion_starts_where_the_joint_does():
    bodies, effects = bars()
    with pytest.raises(ValueError, match=r"joint_motion: path\(0\)"):
        sc.Scene(bodies, [*effects, sc.JointMotion("motion", lambda t, params: 1.0 + t)])
    with pytest.raises(ValueError, match=r"joint_motion: path returns shape \(2,\); it must return a number"):
        sc.Scene(bodies, [*effects, sc.JointMotion("motion", lambda t, params: t * jnp.ones(2))])
    with pytest.raises(ValueError, match=r"pulse: history returns \(shape \(\)\); it must return"):
        sc.Scene(bodies, [*effects, sc.JointDrive("motion", lambda t, params: (t,), name="pulse")])


def test_a_list_of_joints_is_refused():
    bodies, effects = bars()
    with pytest.raises(TypeError, match=r"joint_springs: joint is \['spring', 'free'\]"):
        sc.Scene(bodies, [*effects[:-4], sc.JointSpring(["spring", "free"], 1.0)]).system()


def test_rayleigh_damping_of_a_spring_in_a_joint():
    bar, hinge = (
        sc.RigidBody("bar", 2.0, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]),
        sc.Revolute(("ground", "bar"), at=[0, 0, 0]),
    )
    effects = [hinge, sc.JointSpring(hinge.name, 3.0), sc.RayleighDamping(stiffness=0.02)]
    system, none = sc.Scene([bar], effects, coordinates="joint").system(), np.zeros(0)
    assert float(system.forces(0.0, np.array([0.4]), none, np.array([2.0]), none)[0][0]) == pytest.approx(-0.12)


def test_rayleigh_damping_of_a_stretched_spring_leaves_a_common_rotation():
    """The bodies of the spring turn together, about another axis. By the directors the energy of the spring has a
    curvature along this rotation."""
    bodies = [sc.RigidBody(name, 1.0, [0.2, 0.25, 0.3], [x, 0.0, 0.0]) for name, x in (("a", 0.5), ("b", 1.5))]
    effects = [
        sc.Revolute(("ground", "a"), at=[0, 0, 0], name="bearing"),
        sc.Revolute(("a", "b"), at=[1, 0, 0], axis=[0.0, 0.6, 0.8], name="hinge"),
        sc.JointSpring("hinge", 8.0, neutral=0.3),
        sc.RayleighDamping(stiffness=0.02),
    ]
    scene = sc.Scene(bodies, effects, coordinates="directors").with_rates({"bearing": 1.0, "hinge": 0.0})
    force = np.concatenate(scene.system().forces(0.0, *scene.start))
    assert np.abs(force).max() < 1e-15  # 0.03 by the directors


def test_motions_of_pairs_with_and_without_coordinates_have_the_names_of_their_pairs():
    """The pair of b closes a loop, and its angle comes from directors: its row is a term of its own, after those of the
    other pairs."""
    bodies = [
        sc.RigidBody(name, 1.0, [1.0, 1.0, 1.0], [x, 1.0, 0.0]) for name, x in (("a", 0.0), ("b", 1.0), ("e", 5.0))
    ]
    hinges = sc.Revolute([("ground", name) for name in "abe"], [[0, 0, 0], [1, 0, 0], [5, 0, 0]], name="hinges")
    pin = sc.Revolute(("a", "b"), [0.5, 2.0, 0.0], name="pin")
    effects = [hinges, pin, sc.JointSpring("pin", 1.0), sc.JointMotion("hinges", lambda t, params: 0.0 * t)]
    sorting = sc.Scene(bodies, effects, coordinates="joint", redundant="drop").sorting
    rows, numbers = ConstraintRows(sorting), sorting.layout.numbers
    touched = {
        row.name: [name for name in ("hinges ground-a", "hinges ground-e", "pin") if np.any(gradient[numbers[name]])]
        for row, gradient in zip(rows.rows, rows.jacobian, strict=True)
    }
    assert touched["joint_motion ground-a"] == ["hinges ground-a"]
    assert touched["joint_motion ground-b"] == ["hinges ground-a", "pin"]
    assert touched["joint_motion ground-e"] == ["hinges ground-e"]
