"""What molecules need: torsion of any sign, pairs that are left out, rates that are declared, lengths that are
given."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import scene as sc
from vmri_jax.mechanics.invariants import potential_energy

CHAIN = ["a", "b", "c", "d"]
PLACES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.6, 0.8]])
BODIES = [sc.Body(name, 1.0, place, pace="slow") for name, place in zip(CHAIN, PLACES, strict=True)]
BONDS = list(itertools.pairwise(CHAIN))


def energy(*effects) -> float:
    scene = sc.Scene(BODIES, effects)
    q_s, q_f, *_ = scene.start
    return float(potential_energy(scene.system(), q_s, q_f))


def test_a_negative_torsion_has_its_maximum_where_others_have_their_minimum():
    plus, minus = (energy(sc.Torsion(tuple(CHAIN), sign * 2.0, angle=0.3, multiplicity=2)) for sign in (1, -1))
    assert minus == pytest.approx(-plus, rel=1e-14)
    moved = energy(sc.Torsion(tuple(CHAIN), 2.0, angle=0.3 + np.pi / 2, multiplicity=2))
    assert minus == pytest.approx(moved - 4.0, rel=1e-12)


def test_pairs_within_so_many_bonds():
    assert sc.within_bonds(BONDS, 1) == BONDS
    assert sc.within_bonds(BONDS, 2) == [("a", "b"), ("a", "c"), ("b", "c"), ("b", "d"), ("c", "d")]
    assert sc.within_bonds(BONDS) == list(itertools.combinations(CHAIN, 2))
    assert sc.within_bonds([*BONDS, ("d", "a")], 2) == list(itertools.combinations(CHAIN, 2))  # a ring


@pytest.mark.parametrize(
    "make", [lambda **k: sc.LennardJones(0.3, 0.8, **k), lambda **k: sc.Coulomb(dict.fromkeys(CHAIN, 0.5), 1.0, **k)]
)
def test_pairs_that_are_left_out(make):
    left = make(between=[("a", "d"), ("a", "c")])
    assert energy(make(exclude=[*BONDS, ("d", "b")])) == pytest.approx(energy(left), rel=1e-14)
    for exclude, message in (
        (["ab"], "'ab' is in exclude; give pairs of names"),
        ([("a", "e")], "exclude: there is no body 'e'"),
        (sc.within_bonds(BONDS), "exclude leaves no pair"),
    ):
        with pytest.raises(ValueError, match=message):
            sc.Scene(BODIES, [make(exclude=exclude)])


def molecule(**torsion) -> sc.Scene:
    """Bonds of 45, angles of 18 and torsion of 10 rad/s: no gap of a factor 3."""
    bodies = [sc.Body(name, 1.0, place) for name, place in zip(CHAIN, PLACES, strict=True)]
    angles = sc.Angle(list(zip(CHAIN, CHAIN[1:], CHAIN[2:], strict=False)), 80.0)
    return sc.Scene(bodies, [sc.Spring(BONDS, 1000.0), angles, sc.Torsion(tuple(CHAIN), 30.0, **torsion)])


def test_what_is_declared_slow_is_a_side_of_the_border():
    assert {pace.value for pace in molecule().sorting.paces.values()} == {"slow"}
    sorting = molecule(rate="slow").sorting
    assert {pace.value for pace in sorting.paces.values()} == {"fast"}
    assert {part.effect.name: part.home for part in sorting.placed} == {
        "springs": "fast_potential",
        "angles": "slow_potential",  # below the widest gap above the torsion
        "torsion": "slow_potential",
    }


def test_terms_between_the_same_bodies_stay_together():
    bodies = [sc.Body(name, 1.0, place, pace="fast") for name, place in zip(CHAIN, PLACES, strict=True)]
    torsion = sc.Torsion([tuple(CHAIN)] * 2, [0.01, 30.0], multiplicity=[1, 3])
    scene = sc.Scene(bodies, [sc.Spring(BONDS, 3000.0), torsion, sc.Spring(("a", "d"), 1e-3, name="soft")])
    assert len([part for part in scene.sorting.placed if part.effect.name == "torsion"]) == 1


def test_places_are_moved_onto_lengths_that_are_given():
    bodies = [sc.Body(name, 1.0, place + 1e-4, pace="fast") for name, place in zip(CHAIN, PLACES, strict=True)]
    effects = [sc.RigidLink(BONDS, 1.001, name="bonds"), sc.Anchor("a", [0.0, 2.0, 0.0], 1.0, name="hook")]
    with pytest.raises(ValueError, match=r"length of a-b is 1.001; it starts as 1; .*project=True"):
        sc.Scene(bodies, effects)
    state = sc.Scene(bodies, effects, project=True).state()
    places = np.asarray(state.q_f).reshape(4, 3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 1.001, rtol=1e-12)
    assert np.linalg.norm(places[0] - [0.0, 2.0, 0.0]) == pytest.approx(1.0, rel=1e-12)


def path(t, params):
    return jnp.array([0.1 + t, 1.0, 0.0])


def test_a_guided_body_is_moved_onto_its_path():
    bodies = [sc.Body("a", 1.0, PLACES[0], pace="fast"), *BODIES[1:]]
    with pytest.raises(ValueError, match=r"positions at the start violate guides a \[0\] by 0.1"):
        sc.Scene(bodies, [sc.Guide("a", path)])
    state = sc.Scene(bodies, [sc.Guide("a", path)], project=True).state()
    np.testing.assert_allclose(state.q_f, [0.1, 1.0, 0.0], atol=1e-12)


def numpy_potential(q, params):
    return np.sin(q[0][0]) * params["k"]


def test_custom_functions_are_tried_when_the_scene_is_made():
    with pytest.raises(ValueError, match=r"numpy_potential: function cannot be traced, line \d+ of test_molecules.py"):
        sc.Scene(BODIES, [sc.Potential(numpy_potential, "a", {"k": 2.0})])
    with pytest.raises(ValueError, match=r"pull: bodies is .*for several tuples of bodies write"):
        sc.Scene(BODIES, [sc.Potential(numpy_potential, [("a", "b"), ("c", "d")], name="pull")])
