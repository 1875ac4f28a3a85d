"""A new effect is one short class: a formula and declarations, from which arrays, checks and messages follow."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import fully_implicit, simulate
from vmri_jax.scene import Body, Effect, Scene
from vmri_jax.scene.declare import array, common, names, number, positive, vector


def turned(q, params=None):
    """Angle of a pointer (x, y) from the first axis."""
    (q,) = q
    return jnp.arctan2(q[..., 1], q[..., 0])


class TorsionSpring(Effect):
    """A spring that turns pointers in the plane back to an angle, ``V = sum k/2 (phi - phi_0)^2``."""

    bodies: Any = names()
    stiffness: Any = positive()
    angle: Any = number(default=None, measured=True)

    kind = "potential"
    default_name = "torsion_springs"
    dimensions = (2,)
    rest = staticmethod(turned)

    @staticmethod
    def function(q, params):
        return jnp.sum(params["stiffness"] / 2 * (turned(q) - params["angle"]) ** 2)


POINTERS = [Body("a", 1.0, [1.0, 0.0], [0.0, 0.3], pace="slow"), Body("b", 1.0, [0.0, 2.0], pace="slow")]


@pytest.mark.compiles
def test_one_class_is_enough():
    scene = Scene(POINTERS, [TorsionSpring(["a", "b"], [1.0, 4.0])])
    assert np.allclose(scene.params["torsion_springs"]["angle"], [0.0, np.pi / 2])
    q = jnp.array([1.0, 1.0, 0.0, 2.0])
    potential = scene.system().slow_potential
    assert potential is not None
    energy = potential(q, jnp.zeros(0), scene.params)
    assert energy == pytest.approx((np.pi / 4) ** 2 / 2)
    run = simulate(scene.system(), fully_implicit(1), scene.state(), macro_dt=0.01, num_steps=50)
    assert np.ptp(np.asarray(run.energy)) < 1e-6


@pytest.mark.parametrize(
    ("bodies", "effect", "message"),
    [
        (POINTERS, TorsionSpring("a", -1.0), "torsion_springs: stiffness is -1.0; it must be positive"),
        (POINTERS, TorsionSpring("a", [1.0, 2.0]), r"stiffness has shape \(2,\); give one number"),
        (POINTERS, TorsionSpring("c", 1.0), "there is no body 'c'"),
        (POINTERS, TorsionSpring("a", 1.0, np.inf), "torsion_springs: angle is inf, which is not finite"),
        ([Body("a", 1.0, np.ones(3))], TorsionSpring("a", 1.0), "a has 3 coordinates; .* points of dimension 2"),
        (POINTERS, TorsionSpring([], 1.0), r"torsion_springs: bodies is \[\]; give the name of a body"),
    ],
)
def test_declarations_are_checked(bodies, effect, message):
    with pytest.raises(ValueError, match=message):
        Scene(bodies, [effect])


class Everything(Effect):
    """One field of each kind."""

    between: Any = names(2, pairs=True, default=None)
    free: Any = number(default=1.0)
    radius: Any = number(default=0.0, sign="at least zero")
    line: Any = vector(default=(1.0, 0.0))
    table: Any = array(default=((1.0, 2.0), (3.0, 4.0)))

    kind = "potential"
    default_name = "everything"
    masses = ("mass_a", "mass_b")

    @staticmethod
    def function(q, params):
        return jnp.zeros(())


class Wind(Effect):
    """A vector for all bodies."""

    bodies: Any = names(default=None)
    direction: Any = common(default=(1.0, 0.0))

    kind = "force"
    default_name = "wind"

    @staticmethod
    def function(t, q, v, params):
        return (jnp.broadcast_to(params["direction"], q[0].shape),)


def test_kinds_of_fields():
    bodies = [*POINTERS, Body("c", 3.0, [5.0, 5.0], pace="slow")]
    params = Scene(bodies, [Everything(), Wind()]).params
    shapes = {name: np.shape(value) for name, value in params["everything"].items()}
    assert shapes == {"free": (), "radius": (), "line": (3, 2), "table": (2, 2), "mass_a": (3,), "mass_b": (3,)}
    assert params["everything"]["mass_b"].tolist() == [1.0, 3.0, 3.0]
    assert params["wind"]["direction"].shape == (2,)
    with pytest.raises(ValueError, match=r"everything: radius is -1.0; it must be at least zero"):
        Scene(bodies, [Everything(radius=-1.0)])
    with pytest.raises(ValueError, match=r"everything: line has shape \(3,\); its bodies have dimension 2"):
        Scene(bodies, [Everything(line=np.ones(3))])
    with pytest.raises(ValueError, match=r"wind: direction has shape \(3,\), a has dimension 2; they must agree"):
        Scene(bodies, [Wind(direction=np.ones(3))])
    with pytest.raises(ValueError, match="everything: between is \\('a',\\); give at least two bodies"):
        Scene(bodies, [Everything(("a",))])


def test_incomplete_classes_of_effects_say_what_they_lack():
    def function(q, params):
        return jnp.sum((q[0] - q[1]) ** 2)

    body = {
        "kind": "potential",
        "function": staticmethod(function),
        "pairs": names(2),
        "__annotations__": {"pairs": Any},
    }
    classes = {
        "has no kind; write kind = one of 'kinetic'": type("Kindless", (Effect,), {**body, "kind": None}),
        "has no field with names of bodies": type(
            "Alone", (Effect,), {name: body[name] for name in ("kind", "function")}
        ),
        "function without @staticmethod": type("Bound", (Effect,), {**body, "function": function}),
    }
    for message, cls in classes.items():
        with pytest.raises(TypeError, match=f"the class of effects {cls.__name__} .*{message}"):
            cls(("a", "b"))
    magnets: Any = type("Magnets", (Effect,), dict(body))
    assert magnets(("a", "b")).name == "magnets"
