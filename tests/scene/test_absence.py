"""What a scene does not call for costs nothing: every effect in turn put into a scene and taken out again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import ConstantMass, System, fully_explicit, initial_state
from vmri_jax import scene as sc
from vmri_jax.scene.ledger import compile_run, operations, temporary_bytes

POINTS = {"a": [0.0, 0.0, 9.0], "b": [2.0, 0.0, 8.0], "c": [3.0, 1.0, 8.0], "d": [3.0, 2.0, 9.5]}
MASSES = {"a": 50.0, "b": 1.0, "c": 2.0, "d": 1.5}
BASE = sc.Scene(
    [sc.Body(name, MASSES[name], q, pace="slow" if name == "a" else "fast") for name, q in POINTS.items()],
    [sc.Gravity(9.81), sc.Spring(("c", "d"), 1e4, 1.7)],
)


def along(q, params):
    return q[0][0] * params["f"]


def history(t, params):
    return params["f"] * jnp.sin(t) * jnp.ones(3)


def rotor(q, v, params):
    return params["f"] * v[0][0] * q[0][1]


def wind(t, q, v, params):
    return (params["f"] * jnp.ones(3),)


def sphere(q, params):
    return jnp.sum((q[0] - params["point"]) ** 2) / 2 - params["half"]


EFFECTS = [
    sc.NBodyGravity(1.0),
    sc.Spring(("a", "b"), 3.0, name="other spring"),
    sc.NonlinearSpring(("b", "c"), (1.0, 0.0, 2.0)),
    sc.RigidLink(("b", "c")),
    sc.Anchor("a", [0.0, 0.0, 0.0]),
    sc.SpringAnchor(["a", "b"], [0.0, 0.0, 0.0], 2.0),
    sc.MovingAnchor("b", history, 2.0, {"f": 1.0}),
    sc.Angle(("a", "b", "c"), 2.0),
    sc.Bending(("a", "b", "c"), 2.0),
    sc.Torsion(("a", "b", "c", "d"), 2.0),
    sc.Coulomb({"a": 1.0, "b": -1.0, "c": 2.0}, 1.0),
    sc.LennardJones(0.1, 1.0),
    sc.LinearDamping(0.1),
    sc.RayleighDamping(0.1, 0.001),
    sc.Dashpot(("b", "c"), 0.1),
    sc.QuadraticDrag(0.1),
    sc.HarmonicDrive("b", [1.0, 0.0, 0.0], 3.0),
    sc.Drive("b", history, {"f": 1.0}),
    sc.ConstantForce(["b", "c"], [1.0, 0.0, 0.0]),
    sc.FollowerForce(("b", "c"), 1.0),
    sc.PlaneContact(point=[0, 0, 0], normal=[0, 0, 1], stiffness=1e3, smoothing=0.01),
    sc.SphereContact(center=[0, 0, 0], sphere_radius=1.0, stiffness=1e3, smoothing=0.01),
    sc.MagneticField([0.0, 0.0, 1.0], 1.0, "b"),
    sc.Potential(along, "b", {"f": 1.0}),
    sc.Constraint(sphere, "b", {"point": jnp.zeros(3), "half": 34.0}),
    sc.Kinetic(rotor, "b", {"f": 1.0}),
    sc.Force(wind, "b", {"f": 1.0}),
]


def test_every_effect_is_in_the_list():
    listed = {type(effect) for effect in (*EFFECTS, *BASE.effects)}
    offered = {value for value in vars(sc).values() if isinstance(value, type) and issubclass(value, sc.Effect)}
    assert offered - listed == {sc.Effect}


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_what_is_taken_out_was_never_there(effect):
    """Equal static structure and equal shapes: the compiled program is the same one, by the rule that `jax.jit` follows."""
    scene = sc.Scene(BASE.bodies, (BASE.effects[0], effect, BASE.effects[1]))
    with_it, without, never = scene.system(), scene.without(effect.name).system(), BASE.system()
    assert jax.tree.structure(without) == jax.tree.structure(never)
    assert jax.tree.all(jax.tree.map(np.array_equal, without, never))
    assert jax.tree.structure(with_it) != jax.tree.structure(never)
    rows = {row.name: row for row in scene.explain(fully_explicit(5), measure=False).rows}
    values = scene.system().num_constraints(jnp.zeros(3), jnp.zeros(9))
    assert rows[effect.name].multipliers == 5 * values[0] + values[1]
    q_s, q_f, v_s, v_f = (getattr(scene.problem(), name) for name in ("q_s", "q_f", "v_s", "v_f"))
    state = initial_state(with_it, q_s, q_f, v_s, v_f)  # every function can be evaluated there
    forces = jax.eval_shape(with_it.forces, state.t, q_s, q_f, v_s, v_f)
    assert [f.shape for f in forces] == [(3,), (9,)]


def weight(q_s, q_f, params):
    heights = jnp.concatenate([q_s, q_f])[2::3]
    return params["g"] * jnp.sum(params["m"] * heights)


def spring(q_f, params):
    return params["k"] / 2 * (jnp.linalg.norm(q_f[6:] - q_f[3:6]) - params["l"]) ** 2


def test_program_is_that_of_the_system_written_by_hand():
    m = jnp.array(list(MASSES.values()))
    hand = System(
        ConstantMass(jnp.repeat(m[:1], 3), jnp.repeat(m[1:], 3)),
        weight,
        spring,
        params={"g": jnp.asarray(9.81), "m": m, "k": jnp.asarray(1e4), "l": jnp.asarray(1.7)},
    )
    scheme, state = fully_explicit(5), BASE.state()
    ours, theirs = (compile_run(system, scheme, state, 0.01) for system in (BASE.system(), hand))
    assert operations(ours) == operations(theirs)
    assert temporary_bytes(ours) == temporary_bytes(theirs)
