"""Scenes of traced numbers: made inside of jit, vmap and grad."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.scene.effect_scenes import BASE, EFFECTS
from vmri_jax.scene import Body, Gravity, MagneticField, PlaneContact, Scene, SpringAnchor


def bouncing(x) -> Scene:
    """A number in masses, places, radii and stiffnesses."""
    ball = Body("ball", 2.0 * x, [1.0, x], [x, 0.0], pace="fast", radius=x)
    ground = PlaneContact(point=[0.0, x - 3], normal=[0.0, 1.0], stiffness=x, smoothing=0.1, radius=x, rate="fast")
    return Scene([ball], [Gravity([0.0, -x], rate="slow"), SpringAnchor("ball", [x, 3.0], x, rate="fast"), ground])


@pytest.mark.parametrize("transform", [jax.jit, jax.grad, lambda f: lambda x: jax.vmap(f)(x[None])[0]])
def test_traced_scenes_have_a_start(transform):
    """There is a state whatever is traced, and no drawing of numbers that are not known."""
    drawings = []

    def momentum(x):
        drawings.append(bouncing(x).problem().drawing)
        return bouncing(x).state().p_f[0]

    x = jnp.asarray(0.7)
    assert transform(momentum)(x) == pytest.approx(4 * 0.7 if transform is jax.grad else 2 * 0.7**2)
    assert drawings == [None]
    assert bouncing(x).problem().drawing == bouncing(x).drawing()
    assert bouncing(x).drawing()["bodies"][0]["radius"] == pytest.approx(0.7)


def scaled(item, x, **changes):
    """A body or effect with all its numbers multiplied."""
    given = {field.name: getattr(item, field.name) for field in dataclasses.fields(item)} | changes
    return dataclasses.replace(
        item, **jax.tree.map(lambda leaf: x * leaf if isinstance(leaf, float | jax.Array | np.ndarray) else leaf, given)
    )


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_every_effect_may_be_traced(effect):
    gravity, spring = BASE.effects

    def scene(x):
        effects = [(gravity, "slow"), (effect, "slow"), (spring, "fast")]
        return Scene([scaled(b, x) for b in BASE.bodies], [scaled(e, x, rate=rate) for e, rate in effects])

    def state(x):
        problem = scene(x).problem()
        assert problem.drawing is None
        return problem.state()

    assert jax.tree.map(jnp.shape, jax.eval_shape(state, 1.0)) == jax.tree.map(jnp.shape, scene(1.0).state())


@pytest.mark.parametrize("what", ["mass", "position", "velocity", "field"])
def test_traced_numbers_decide_nothing(what):
    def momentum(x):
        one, ones = (
            dict.fromkeys(["mass", "position", "velocity", "field"], n) | {what: x * n} for n in (1.0, np.ones(3))
        )
        light = Body("light", one["mass"], ones["position"], ones["velocity"])
        return Scene([light], [MagneticField(ones["field"], 1.0)]).state().p_s.sum()

    with pytest.raises(ValueError, match="whether light is slow or fast depends on numbers that are traced"):
        jax.grad(momentum)(1.0)
