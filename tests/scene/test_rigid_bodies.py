"""Rigid bodies by directors, against what is known in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj

import vmri_jax as vm
from tests.scene.mechanics import mechanics
from tests.support import set_up
from vmri_jax import scene as sc
from vmri_jax.accuracy.companions import resting
from vmri_jax.scene.rigid import angular_momentum, angular_velocity, matrix_of, quaternion, rotation

MOMENTS = np.array([1.0, 2.0, 2.5])
SPIN = np.array([0.8, 0.0, 1.0])
ONE = vm.fully_implicit(num_micro=1)


def spins(run, name="hub"):
    """Angular velocity in the axes of the body."""
    q = run.position(name)
    return np.einsum("kji,kj->ki", rotation(q), angular_velocity(q, run.velocity(name)))


def free_motion(t):
    """Of a free body that starts with the spin (w_1, 0, w_3), by Jacobi's functions (Landau, Lifshitz, Mechanics,
    37)."""
    (a, b, c), energy, momentum = MOMENTS, MOMENTS @ SPIN**2, MOMENTS**2 @ SPIN**2
    high, low = energy * c - momentum, momentum - energy * a
    rate = np.sqrt((c - b) * low / (a * b * c))
    sn, cn, dn, _ = ellipj(rate * t, (b - a) * high / ((c - b) * low))
    sizes = np.sqrt([high / (a * (c - a)), high / (b * (c - b)), low / (c * (c - a))])
    return sizes * np.stack([cn, sn, dn], axis=-1)


@pytest.mark.parametrize("degree", [*(pytest.param(degree, marks=pytest.mark.full) for degree in (1, 2)), 3])
def test_a_free_body_turns_as_jacobi_says_with_order_2_degree(degree):
    scene = sc.Scene([sc.RigidBody("hub", 1.0, MOMENTS, np.zeros(3), spin=SPIN)])
    errors = []
    for steps in (20, 40):
        scheme = vm.galerkin(num_micro=1, degree=degree)
        run = vm.simulate(scene, scheme, macro_dt=4.0 / steps, num_steps=steps, save=steps // 20)
        errors.append(np.abs(spins(run) - free_motion(np.asarray(run.t))).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * degree, abs=0.1)
    assert errors[1] < (6e-3, 2e-6, 3e-10)[degree - 1]


def test_a_free_body_keeps_energy_and_angular_momentum():
    body = sc.RigidBody("hub", 2.0, MOMENTS, [1.0, 0.0, 0.5], [0.1, 0.2, 0.3], [0.1, 0.4, 0.0], SPIN, pace="fast")
    run = vm.simulate(sc.Scene([body]), ONE, macro_dt=0.05, num_steps=1000)
    momenta = angular_momentum(run.position("hub"), run.momentum("hub"))
    inertia = body.rotation @ np.diag(MOMENTS) @ body.rotation.T
    np.testing.assert_allclose(momenta[0], inertia @ SPIN + 2.0 * np.cross(body.position, body.velocity), atol=1e-14)
    assert np.abs(momenta - momenta[0]).max() < 1e-12
    assert np.ptp(run.energy) < 1e-11
    assert np.abs(run.constraint_residual).max() < 1e-13
    turned = rotation(run.position("hub"))
    np.testing.assert_allclose(np.swapaxes(turned, 1, 2) @ turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-12)
    quaternions = quaternion(run.position("hub"))  # of ten turns
    assert np.abs(np.diff(quaternions, axis=0)).max() < 0.1


def test_a_steady_top_precesses_without_nutation_to_second_order():
    mass, length, across, along, tilt, precession = 1.0, 0.5, 0.1, 0.15, 0.4, 1.0
    about = across + mass * length**2
    spin = mass * 9.81 * length / (along * precession) + (about - along) / along * precession * np.cos(tilt)
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    omega = spin * axis + np.array([0.0, 0.0, precession])
    top = sc.RigidBody(
        "top", mass, [across, across, along], length * axis, [0.0, tilt, 0.0], np.cross(omega, length * axis), omega
    )
    scene = sc.Scene([top], [sc.Gravity(), sc.Spherical(("ground", "top"), [0.0, 0.0, 0.0])])
    nutation, late = [], []
    for steps in (100, 200):
        run = vm.simulate(scene, ONE, macro_dt=2.0 / steps, num_steps=steps, save=steps // 100)
        axes = rotation(run.position("top"))[..., 2]
        nutation.append(np.ptp(axes[:, 2]))
        late.append(abs(np.arctan2(axes[-1, 1], axes[-1, 0]) - 2.0 * precession))
    assert nutation[1] < 4e-4
    assert nutation[0] / nutation[1] == pytest.approx(4, rel=0.15)
    assert late[1] < 1e-3


@pytest.mark.parametrize(
    ("shape", "seen"),
    [
        (sc.Box((1.0, 2.0, 3.0)), [1.0, 1.0, 1.0]),
        (sc.Box((1.0, 2.0, 0.0)), [1.0, 1.0, 1.0]),
        (sc.Rod(2.0), [1.0, 1.0, 0.0]),  # along z
    ],
)
def test_angular_velocity_of_three_two_and_one_directors(shape, seen):
    """A rod has no spin about itself."""
    spin = np.array([0.3, -0.5, 0.7])
    body = sc.RigidBody("body", 3.0, shape, np.ones(3), spin=spin)
    problem = sc.Scene([body]).problem()
    q, v = (np.concatenate([problem.q_s, problem.q_f]), np.concatenate([problem.v_s, problem.v_f]))
    np.testing.assert_allclose(angular_velocity(q, v), spin * seen, atol=1e-14)


@pytest.mark.parametrize(
    ("shape", "moments"),
    [
        (sc.Box((1.0, 2.0, 3.0)), [13 / 6, 10 / 6, 5 / 6]),
        (sc.Cylinder(0.5, 2.0), [0.79166667, 0.79166667, 0.25]),
        (sc.Ball(0.5), [0.2, 0.2, 0.2]),
        (sc.Rod(2.0), [2 / 3, 2 / 3, 0.0]),
    ],
)
def test_moments_of_shapes(shape, moments):
    body = sc.RigidBody("hub", 2.0, shape, np.zeros(3))
    np.testing.assert_allclose(body.moments, moments, rtol=1e-7)
    assert body.shape is shape


def test_bodies_without_width_have_fewer_axes():
    rod = sc.RigidBody("rod", 3.0, sc.Rod(2.0), np.zeros(3), [0.0, np.pi / 2, 0.0], spin=[0.0, 0.7, 0.0])
    plate = sc.RigidBody("plate", 3.0, sc.Box((1.0, 2.0, 0.0)), np.zeros(3))
    assert (rod.size, plate.size, sc.RigidBody("box", 3.0, sc.Box((1.0, 2.0, 0.5)), np.zeros(3)).size) == (6, 9, 12)
    np.testing.assert_allclose(rod.masses, [3, 3, 3, 1, 1, 1])
    np.testing.assert_allclose(rod.coordinates[3:], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(rod.rates[3:], [0, 0, -0.7], atol=1e-15)
    scene = sc.Scene([rod, plate])
    assert scene.names.slow_constraint == {"rigid rod": 1, "rigid plate": 3}
    assert mechanics(scene).kinetic == pytest.approx(3.0 * 2.0**2 / 12 * 0.7**2 / 2)


def test_a_matrix_of_inertia_is_turned_into_principal_axes():
    turned = matrix_of(np.array([0.3, -0.2, 0.5]))
    at = [0.2, 0.3, -0.4]
    given = sc.RigidBody("hub", 2.0, turned @ np.diag(MOMENTS) @ turned.T, np.zeros(3), spin=SPIN)
    principal = sc.RigidBody("hub", 2.0, MOMENTS, np.zeros(3), turned, spin=SPIN)
    np.testing.assert_allclose(given.moments, MOMENTS)
    weight = sc.Body("weight", 1.0, [2.0, 2.0, 2.0])
    energies = []
    for body, point in ((given, at), (principal, np.asarray(turned).T @ at)):
        spring = sc.Spring((("hub", point), "weight"), 3.0, length=1.0)
        np.testing.assert_allclose(body.point(np.asarray(point)).position, at, atol=1e-15)
        energies.append(mechanics(sc.Scene([body, weight], [spring]))[1:3])
    assert np.all(np.asarray(energies) > 1.0)
    np.testing.assert_allclose(energies[0], energies[1], rtol=1e-12)


def test_rotations_are_given_as_people_have_them():
    vector = np.array([0.3, -0.2, 0.5])
    angle = np.linalg.norm(vector)
    w_xyz = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * vector / angle])
    matrix = matrix_of(vector)
    for given in (vector, w_xyz, matrix):
        body = sc.RigidBody("hub", 1.0, MOMENTS, np.zeros(3), given)
        np.testing.assert_allclose(body.rotation, matrix, atol=1e-14)
        np.testing.assert_allclose(quaternion(body.coordinates), w_xyz, atol=1e-14)
    np.testing.assert_allclose(matrix_of(jnp.asarray(vector)), matrix, atol=1e-14)


def slow_energy(scene):
    slow = scene.system().all_potentials(*scene.start[:2])["slow"]
    return float(slow)


def pinned(q, params):
    hub, weight = q
    return (jnp.sum((hub[:3] + 0.5 * hub[3:6] - weight) ** 2) - 1.25) / 2


def test_an_effect_on_a_point_of_a_body_is_that_on_its_coordinates():
    """The point is linear in the coordinates, so both are the same to round-off; forces are its transpose."""
    hub = sc.RigidBody("hub", 2.0, MOMENTS, np.zeros(3), spin=SPIN)
    weight = sc.Body("weight", 1.0, [1.0, 1.0, 0.0], pace="fast")
    by_point = sc.Scene(
        [hub, weight], [sc.RigidLink((("hub", [0.5, 0.0, 0.0]), "weight")), sc.Gravity(1.0)], project=True
    )
    by_hand = sc.Scene([hub, weight], [sc.Constraint(pinned, ("hub", "weight")), sc.Gravity(1.0)], project=True)
    random = np.random.default_rng(0)
    start = [random.normal(size=x.shape) for x in by_point.start]
    ours, theirs = (mechanics(scene, start) for scene in (by_point, by_hand))
    np.testing.assert_allclose(np.sort(ours.rows), np.sort(theirs.rows), atol=1e-14)
    assert ours.potential == pytest.approx(theirs.potential, rel=1e-14)

    pushed = sc.Scene([hub], [sc.ConstantForce(("hub", [0.5, 0.0, 0.0]), [0.0, 3.0, 0.0])])
    system, (q_s, q_f, v_s, v_f) = pushed.system(), pushed.start
    force, _ = system.forces(0.0, q_s, q_f, v_s, v_f)
    np.testing.assert_allclose(force, [0, 3, 0, 0, 1.5, 0, 0, 0, 0, 0, 0, 0])


def test_points_of_the_ground_stay_where_they_are():
    hub = sc.RigidBody("hub", 2.0, MOMENTS, np.zeros(3))
    scene = sc.Scene(
        [hub],
        [sc.Spring((("hub", [0.5, 0, 0]), ("ground", [2.0, 0, 0])), 7.0, 1.0), sc.Gravity(), sc.LinearDamping(0.1)],
    )
    assert slow_energy(scene) == pytest.approx(7.0 * 0.5**2 / 2)
    plane = sc.Scene([sc.Body("bob", 1.0, [1.0, 0.0])], [sc.Spring(("bob", ("ground", [0.0, 0.0])), 2.0)])
    assert plane.drawing()["anchors"] == [{"body": "bob", "point": [0.0, 0.0], "kind": "spring"}]


def test_many_bodies_are_taken_by_slices():
    """Centres of bodies that follow one another, also between other bodies, are where they should be."""
    bodies: list = [sc.RigidBody(f"b{i}", 1.0 + i, MOMENTS, [i, 2.0 * i, -i]) for i in range(4)]
    bodies.insert(2, sc.Body("point", 5.0, [7.0, 0.0, 1.0]))
    scene = sc.Scene(bodies, [sc.Gravity(2.0)])
    heights = [body.point().position[2] * body.mass for body in bodies]
    assert slow_energy(scene) == pytest.approx(2.0 * sum(heights))


BAD = [
    ({"mass": -1.0}, "mass is -1.0; it must be one positive number"),
    ({"inertia": [1.0, 1.0, 2.5]}, r"which no body has: the largest, 2.5, must not be larger than the sum of the"),
    ({"inertia": [0.0, 0.0, 0.0]}, "they must not be negative, nor all be zero"),
    ({"inertia": [[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, "it must be a symmetric matrix"),
    ({"inertia": [1.0, 2.0]}, r"inertia has shape \(2,\); give \(3,\) principal moments, a matrix, or a shape"),
    ({"rotation": np.diag([1.0, 1.0, -1.0])}, "which is no rotation: .* the determinant is -1"),
    ({"rotation": 2 * np.eye(3)}, "which is no rotation: R.T R differs from 1 by 3"),
    ({"rotation": [1.0, 1.0, 0.0, 0.0]}, "of length 1.4142135.*; divide it by its length"),
    ({"rotation": [1.0, 0.0]}, r"rotation has shape \(2,\); give a matrix \(3, 3\)"),
    ({"spin": [1.0]}, r"spin has shape \(1,\); give \(3,\)"),
    ({"position": [np.nan, 0, 0]}, "position is .* not finite"),
    ({"name": "ground"}, "'ground', which effects call the body that does not move"),
    ({"pace": "quick"}, "pace is 'quick'"),
]


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_bodies_that_cannot_be(changes, message):
    arguments = {"name": "hub", "mass": 1.0, "inertia": MOMENTS, "position": np.zeros(3)} | changes
    with pytest.raises(ValueError, match=message):
        sc.RigidBody(**arguments)


def test_points_that_cannot_be():
    hub, rod, ball = (
        sc.RigidBody("hub", 1.0, MOMENTS, np.zeros(3)),
        sc.RigidBody("rod", 1.0, sc.Rod(1.0), np.ones(3)),
        sc.Body("ball", 1.0, [2, 2, 2]),
    )
    for between, message in [
        ((("ball", [1.0, 0, 0]), "hub"), "springs: ball is no rigid body, so that no point is fixed in it"),
        ((("hub", [1.0, 0]), "ball"), r"springs: the point in hub has shape \(2,\); give \(3,\)"),
        ((("rod", [1.0, 0, 0]), "ball"), "springs: .* sticks out of rod: .* a plate or a rod"),
        (("ground", "ball"), "springs: the ground has no centre; give a point of it"),
        ((("ground", [0, 0, 0]), ("ground", [1, 0, 0])), "about the ground alone"),
        ((("hubb", [0, 0, 0]), "ball"), "no body 'hubb'.*hub"),
    ]:
        with pytest.raises(ValueError, match=message):
            sc.Scene([hub, rod, ball], [sc.Spring(between, 1.0)])
    with pytest.raises(ValueError, match=r"hub \(1, 0, 0\) has no mass; this effect needs the mass of a whole body"):
        sc.Scene([hub, ball], [sc.NBodyGravity(1.0, (("hub", [1.0, 0, 0]), "ball"))])


def test_coordinates_are_called_by_centre_and_directors():
    hub = sc.RigidBody("hub", 2.0, MOMENTS, [0.0, 0.0, 1.0], pace="slow")
    scene = sc.Scene([hub, sc.RigidBody("bar", 1.0, sc.Rod(1.0), [1.0, 0.0, 0.0], pace="fast")])
    names = scene.names
    directors = [f"hub d{i} {axis}" for i in (1, 2, 3) for axis in "xyz"]
    assert names.slow_coordinates == ["hub x", "hub y", "hub z", *directors]
    assert names.fast_coordinates == ["bar x", "bar y", "bar z", "bar d1 x", "bar d1 y", "bar d1 z"]
    assert [names.positions(part) for part in ("s", "f")] == [[0, 1, 2], [0, 1, 2]]
    run = resting(set_up(scene, vm.fully_explicit(1), 0.1, 2))
    panel = run.plot().axes[0]
    np.testing.assert_array_equal(panel.lines[2].get_ydata(), run.position("hub")[:, 2])
    assert len(panel.lines) == 3
