"""Scenes of traced numbers: made inside of jit, vmap and grad."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.scene.effect_scenes import BASE, EFFECTS
from vmri_jax import scene as sc
from vmri_jax.mechanics.invariants import potential_energy


def bouncing(x) -> sc.Scene:
    """A number in masses, places, radii and stiffnesses."""
    ball = sc.Body("ball", 2.0 * x, [1.0, x], [x, 0.0], pace="fast", radius=x)
    ground = sc.PlaneContact(point=[0.0, x - 3], normal=[0.0, 1.0], stiffness=x, smoothing=0.1, radius=x, rate="fast")
    return sc.Scene(
        [ball], [sc.Gravity([0.0, -x], rate="slow"), sc.SpringAnchor("ball", [x, 3.0], x, rate="fast"), ground]
    )


@pytest.mark.parametrize("transform", [jax.jit, jax.grad, lambda f: lambda x: jax.vmap(f)(x[None])[0]])
def test_traced_scenes_have_a_start(transform):
    """There is a state whatever is traced, and no drawing of numbers that are not known."""
    drawings = []

    def momentum(x):
        drawings.append(bouncing(x).problem().drawing)
        return bouncing(x).state().p_f[0]

    x = jnp.asarray(0.7)
    assert jax.jit(transform(momentum))(x) == pytest.approx(4 * 0.7 if transform is jax.grad else 2 * 0.7**2)
    assert drawings == [None]
    assert bouncing(x).problem().drawing == bouncing(x).drawing()
    assert bouncing(x).drawing()["bodies"][0]["radius"] == pytest.approx(0.7)


def swinging(x) -> sc.Scene:
    """A number in mass, inertia, place, rotation, spin, joint and spring of a rigid body."""
    moments, up = np.array([1.0, 2.0, 2.5]), np.array([0.0, 0.0, 1.0])
    bar = sc.RigidBody("bar", 2.0 * x, x * moments, x * up, x * np.array([0.1, 0.3, 0.2]), spin=x * up, pace="slow")
    hinge = sc.Revolute(("ground", ("bar", x * -up)), axis=x * np.array([0.1, 1.0, 0.2]), name="hinge")
    return sc.Scene(
        [bar], [hinge, sc.JointSpring("hinge", x, 0.1 * x, rate="slow")], project=True, coordinates="directors"
    )


def test_scenes_of_rigid_bodies_may_be_traced():
    def start(x):
        state, system = swinging(x).state(), swinging(x).system()
        return jnp.sum(state.p_s * jnp.arange(12.0)) + potential_energy(system, state.q_s, state.q_f)

    program, x, step = jax.jit(lambda x: jax.jvp(start, (x,), (1.0,))), 0.7, 1e-5
    difference = (program(x + step)[0] - program(x - step)[0]) / (2 * step)
    assert program(x)[1] == pytest.approx(float(difference), rel=1e-6)


def scaled(item, x, **changes):
    """A body or effect with all its numbers multiplied."""
    given = {field.name: getattr(item, field.name) for field in dataclasses.fields(item)} | changes
    return dataclasses.replace(
        item, **jax.tree.map(lambda leaf: x * leaf if isinstance(leaf, float | jax.Array | np.ndarray) else leaf, given)
    )


@pytest.mark.filterwarnings("ignore:initial_state. all velocities are zero")  # effects that move bodies at rest
@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_every_effect_may_be_traced(effect):
    gravity, spring = BASE.effects

    def scene(x):
        effects = [(gravity, "slow"), (effect, "slow"), (spring, "fast")]
        return sc.Scene([scaled(b, x) for b in BASE.bodies], [scaled(e, x, rate=rate) for e, rate in effects])

    def state(x):
        problem = scene(x).problem()
        assert problem.drawing is None
        return problem.state()

    traced = jax.eval_shape(state, 1.0)
    assert [x.shape for x in (traced.q_s, traced.q_f, traced.p_s, traced.p_f)] == [x.shape for x in scene(1.0).start]


@pytest.mark.parametrize("what", ["mass", "position", "velocity", "field"])
def test_traced_numbers_decide_nothing(what):
    def momentum(x):
        one, ones = (
            dict.fromkeys(["mass", "position", "velocity", "field"], n) | {what: x * n} for n in (1.0, np.ones(3))
        )
        light = sc.Body("light", one["mass"], ones["position"], ones["velocity"])
        return sc.Scene([light], [sc.MagneticField(ones["field"], 1.0)]).state().p_s.sum()

    with pytest.raises(ValueError, match=r"whether light is slow or fast depends on numbers that jax\.jit"):
        jax.grad(momentum)(1.0)


def test_names_hold_in_a_trace():
    """A scene made of traced numbers is simulated, and its run asked by name and differentiated; what needs numbers
    says so.

    `test_joint_motions` has derivatives of starts, forces and energies by lengths, masses and stiffnesses.
    """
    refused = []

    def end(stiffness):
        pulled = sc.Body("pulled", 2.0, [1.0, 0.0], pace="slow")
        scene = sc.Scene([pulled], [sc.SpringAnchor("pulled", [0.0, 0.0], stiffness, length=0.5)])
        run = vm.simulate(scene, vm.fully_explicit(1), macro_dt=0.1, num_steps=3)
        if isinstance(stiffness, jax.core.Tracer):  # pyright: ignore[reportAttributeAccessIssue]
            with pytest.raises(ValueError, match=r"work: the run is traced by JAX.*run.of\(problem\).work"):
                run.work()
            refused.append(True)
        return run.position("pulled")[-1, 0] + run.velocity("pulled")[-1, 0]

    slope = (end(3.01) - end(2.99)) / 0.02
    assert jax.grad(end)(3.0) == pytest.approx(float(slope), rel=1e-8)  # measured 2e-9
    lanes = jax.jit(jax.vmap(end))(np.array([2.99, 3.01]))
    assert np.allclose(lanes, [end(2.99), end(3.01)], rtol=1e-14, atol=0)
    assert refused
