"""Rows that are left out as redundant follow from the others along the motion, or are refused."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.scene import Body, Cylinder, Gravity, JointSpring, MovingPivot, Revolute, RigidBody, RigidLink, Scene

Y = [0.0, 1.0, 0.0]
CARBON_DIOXIDE = {"O1": [-0.116, 0, 0], "C": [0, 0, 0], "O2": [0.116, 0, 0]}
FORMATE = {"C": [0, 0, 0], "H": [-0.11, 0, 0], "O1": [0.0625, 0.1083, 0], "O2": [0.0625, -0.1083, 0]}
SQUARE = {"a": [0, 0], "b": [1, 0], "c": [1, 1], "d": [0, 1]}


def molecule(places, mass=16.0):
    """Atoms with all distances between them."""
    return [Body(name, mass, place) for name, place in places.items()], [RigidLink(list(combinations(places, 2)))]


def four_bar(crank, rocker, foot):
    """Three bars between hinges about y that start at the origin, where crank and rocker end, and at the foot of the
    rocker."""

    def bar(name, start, end):
        start, end = np.asarray(start, float), np.asarray(end, float)
        along = end - start
        turned = [0.0, np.arctan2(along[0], along[2]), 0.0]
        return RigidBody(name, 1.0, Cylinder(0.02, float(np.linalg.norm(along))), (start + end) / 2, turned)

    bars = [bar("crank", [0, 0, 0], crank), bar("rod", crank, rocker), bar("rocker", foot, rocker)]
    feet = Revolute([("ground", "crank"), ("ground", "rocker")], [[0, 0, 0], foot], Y, name="feet")
    pins = Revolute([("crank", "rod"), ("rod", "rocker")], [crank, rocker], Y, name="pins")
    return bars, [Gravity(), feet, pins]


def bennett(alpha=0.6, beta=1.1, turned=1.2):
    """Bennett's loop of four hinges in space, ``sin(alpha) / a = sin(beta) / b``: one freedom, where counting says
    minus two."""
    a, b = 1.0, np.sin(beta) / np.sin(alpha)
    second = 2 * np.arctan(np.sin((beta + alpha) / 2) / np.sin((beta - alpha) / 2) / np.tan(turned / 2))
    axes, points, frame, place = [], [], np.eye(3), np.zeros(3)
    for angle, length, twist in ((turned, a, alpha), (second, b, beta), (-turned, a, alpha), (-second, b, beta)):
        axes.append(frame[:, 2])
        points.append(place)
        c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
        place = place + length * frame @ [c, s, 0]
        frame = frame @ [[c, -s * ct, s * st], [s, c * ct, -c * st], [0, st, ct]]
    np.testing.assert_allclose(place, 0.0, atol=1e-14)  # measured 4e-16: the loop is closed
    links = [RigidBody(f"link {i}", 1.0, [0.1, 0.1, 0.1], (points[i] + points[(i + 1) % 4]) / 2) for i in (1, 2, 3)]
    pairs = [("link 3", "ground"), ("ground", "link 1"), ("link 1", "link 2"), ("link 2", "link 3")]
    return links, [Revolute(pairs, points, axes, name="hinges")]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (molecule(CARBON_DIOXIDE), r"links \S+ depends on .*: links \S+ by \d.\de-0[23]"),  # measured 4e-03 to 1.3e-02
        (molecule(FORMATE), r"links \S+ depends on .*: links \S+ by \d.\de-0[23]"),  # measured 1.2e-03 to 6e-03
        (four_bar([0, 0, 1], [0, 0, 3], [0, 0, 2]), r"\S+ \S+ \[\d\] depends on .* by \d.\de-0[345]"),  # measured 2e-4
    ],
    ids=["carbon dioxide", "formate", "flat parallelogram"],
)
def test_rows_that_depend_on_others_at_the_start_alone_are_not_dropped(parts, message):
    with pytest.raises(
        ValueError, match=f'redundant="drop" would change the motion: {message}.*Bend bodies that lie in line'
    ):
        Scene(*parts, redundant="drop")
    with pytest.raises(
        ValueError, match=f"over-constrained at the start: .*; leaving one out would change the motion: {message}"
    ) as refused:
        Scene(*parts)
    assert "drop" not in str(refused.value)


def in_a_box(places, size=100.0):
    """A small molecule among free atoms that are far apart."""
    far = np.random.default_rng(0).uniform(0.0, size, (30, 2))
    small = {name: 0.1 * np.array(place) + 0.7 * size for name, place in places.items()}
    bodies, links = molecule(small)
    return [*bodies, *(Body(f"far {i}", 1.0, place) for i, place in enumerate(far))], links


@pytest.mark.parametrize(
    ("parts", "dropped"),
    [
        (molecule(SQUARE), 1),
        (in_a_box(SQUARE), 1),
        (molecule({f"p{i}": place for i, place in enumerate(np.random.default_rng(0).normal(size=(6, 3)))}), 3),
        (four_bar([1, 0, 1], [2, 0, 1], [2, 0, 0]), 3),
        (
            four_bar([0.01, 0, 1], [0.02, 0, 3], [0.01, 0, 2]),
            3,
        ),  # 0.01 rad from flat, where another row depends on others
        (bennett(), 3),
    ],
    ids=["square", "square in a box", "six atoms", "parallelogram", "nearly flat", "Bennett"],
)
def test_rows_that_follow_along_the_motion_are_dropped(parts, dropped):
    assert len(Scene(*parts, redundant="drop").dropped) == dropped
    with pytest.raises(ValueError, match=r"over-constrained at the start: .* or let the scene choose"):
        Scene(*parts)


def swing(t, params):
    """A point that moves along x."""
    return jnp.stack([jnp.sin(params["rate"] * t), 0.0 * t])


def test_rows_in_time_follow_in_time():
    def held(other):
        pivots = [MovingPivot("a", swing, params={"rate": rate}, name=f"at {rate}") for rate in (1.0, other)]
        return Scene([Body("a", 1.0, [0.0, -1.0])], pivots, redundant="drop")

    with pytest.raises(ValueError, match=r"at \d.0 a depends on the other constraints at the start alone"):
        held(2.0)  # both points start at the origin


def test_rows_that_contradict_others_are_not_dropped():
    bodies, _ = molecule(SQUARE)
    again = RigidLink(("a", "b"), length=1.01, name="again")
    with pytest.raises(ValueError, match=r"(\S+ a-b) contradicts the other constraints.* \1 by .*e-0[23]"):
        Scene(bodies, [RigidLink(("a", "b")), again], redundant="drop", project=True)


def test_a_run_watches_what_was_dropped():
    """The second link follows from the first for one length alone: the other lane of a batch fails, and says why."""
    bodies = [Body("a", 1.0, [0.0, 0.0], [0.0, -1.0]), Body("b", 1.0, [2.0, 0.0], [0.0, 1.0])]
    scene = Scene(bodies, [RigidLink(("a", "b")), RigidLink(("a", "b"), name="again")], redundant="drop")
    effect, pair = scene.dropped[0].split()
    assert (len(scene.dropped), pair) == (1, "a-b")
    system, state = scene.system(), scene.state()
    assert system.num_constraints(*scene.start[:2]) == (0, 1)
    longer = system.params | {effect: {"length": np.array(2.0 + 1e-5)}}
    params, states = jax.tree.map(lambda *lanes: jnp.stack(lanes), (system.params, state), (longer, state))
    with pytest.warns(vm.FailedLanesWarning, match=r"1 of 2 lanes failed.*lane 1, at macro step 0 \(NOT_IMPLIED\)"):
        run = vm.simulate_batch(system, vm.fully_explicit(1), states, macro_dt=0.01, num_steps=4, params=params)
    assert run.result.tolist() == [vm.Result.CONVERGED, vm.Result.NOT_IMPLIED]
    assert run.constraint_residual[0].max() < 1e-13  # measured 1e-15


def test_a_door_on_two_hinges_turns_as_on_one():
    """In joint coordinates all rows of the second hinge follow from the first one, so that no row is solved for."""
    door, turn = RigidBody("door", 3.0, [0.3, 0.5, 0.4], [0.5, 0.0, 0.0]), JointSpring("upper", 5.0, neutral=1.0)
    upper, lower = (Revolute(("ground", "door"), [0, y, 0], Y, name=name) for name, y in (("upper", 1), ("lower", -1)))

    def angle(*hinges):
        scene = Scene([door], [*hinges, turn], redundant="drop", coordinates="joint")
        return vm.simulate(scene, vm.fully_implicit(1), macro_dt=0.02, num_steps=5).q_s

    np.testing.assert_allclose(angle(upper, lower), angle(upper), rtol=1e-12)


def test_a_scene_that_drops_nothing_has_the_same_program():
    bodies, links = [Body(name, 1.0, place) for name, place in SQUARE.items()], [RigidLink([("a", "b"), ("b", "c")])]
    dropping, plain = Scene(bodies, links, redundant="drop").system(), Scene(bodies, links).system()
    assert dropping.implied is None
    assert jax.tree.structure(dropping) == jax.tree.structure(plain)


def test_a_hinge_far_from_the_origin_starts_closed():
    """As far as the moon positions in metres are rounded to 6e-8, more than a billionth of the bodies."""
    place = [3.84e8, -1.1e8, 7.3e7]
    heights, shape = {"a": 0.1, "b": 1.3}, Cylinder(0.1, 1.0)
    bodies = [RigidBody(name, 1.0, shape, np.add(place, [0, 0, z]), [0.3, z, 0.1]) for name, z in heights.items()]
    hinge = Revolute(("a", "b"), np.add(place, [0.1, 0.2, 0.7]), Y)
    assert Scene(bodies, [hinge], coordinates="directors").names.rows.keys() >= {"revolute"}
