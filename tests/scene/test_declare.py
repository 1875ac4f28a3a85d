"""A new effect is one short class: a formula and declarations, from which arrays, checks and messages follow."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import Refused, fully_implicit, initial_state, simulate_batch
from vmri_jax import scene as sc
from vmri_jax.mechanics.slots import free, leaves_by_name
from vmri_jax.scene.declare import array, common, names, number, positive, vector


def turned(q, params=None):
    """Angle of a pointer (x, y) from the first axis."""
    (q,) = q
    return jnp.arctan2(q[..., 1], q[..., 0])


class TorsionSpring(sc.Effect):
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


POINTERS = [sc.Body("a", 1.0, [1.0, 0.0], [0.0, 0.3], pace="slow"), sc.Body("b", 1.0, [0.0, 2.0], pace="slow")]


@pytest.mark.compiles
def test_one_class_is_enough():
    scene = sc.Scene(POINTERS, [TorsionSpring(["a", "b"], [1.0, 4.0])])
    assert np.allclose(scene.params["torsion_springs"]["angle"], [0.0, np.pi / 2])
    q = np.array([1.0, 1.0, 0.0, 2.0])
    potential = scene.system().slow_potential
    assert potential is not None
    energy = potential(q, np.zeros(0), scene.params)
    assert energy == pytest.approx((np.pi / 4) ** 2 / 2)


@pytest.mark.parametrize(
    ("bodies", "effect", "message"),
    [
        (POINTERS, TorsionSpring("a", -1.0), "torsion_springs: stiffness is -1.0; it must be positive"),
        (POINTERS, TorsionSpring("a", [1.0, 2.0]), r"stiffness has shape \(2,\); give one number"),
        (POINTERS, TorsionSpring("c", 1.0), "there is no body 'c'"),
        (POINTERS, TorsionSpring("a", 1.0, np.inf), "torsion_springs: angle is inf, which is not finite"),
        ([sc.Body("a", 1.0, np.ones(3))], TorsionSpring("a", 1.0), "a has 3 coordinates; .* points of dimension 2"),
        (POINTERS, TorsionSpring([], 1.0), r"torsion_springs: bodies is \[\]; give the name of a body"),
    ],
)
def test_declarations_are_checked(bodies, effect, message):
    with pytest.raises(ValueError, match=message):
        sc.Scene(bodies, [effect])


class Everything(sc.Effect):
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


class Wind(sc.Effect):
    """A vector for all bodies."""

    bodies: Any = names(default=None)
    direction: Any = common(default=(1.0, 0.0))

    kind = "force"
    default_name = "wind"

    @staticmethod
    def function(t, q, v, params):
        return (jnp.broadcast_to(params["direction"], q[0].shape),)


def test_kinds_of_fields():
    bodies = [*POINTERS, sc.Body("c", 3.0, [5.0, 5.0], pace="slow")]
    params = sc.Scene(bodies, [Everything(), Wind()]).params
    shapes = {name: np.shape(value) for name, value in params["everything"].items()}
    assert shapes == {"free": (), "radius": (), "line": (3, 2), "table": (2, 2), "mass_a": (3,), "mass_b": (3,)}
    assert params["everything"]["mass_b"].tolist() == [1.0, 3.0, 3.0]
    assert params["wind"]["direction"].shape == (2,)
    with pytest.raises(ValueError, match=r"everything: radius is -1.0; it must be at least zero"):
        sc.Scene(bodies, [Everything(radius=-1.0)])
    with pytest.raises(ValueError, match=r"everything: line has shape \(3,\); its bodies have dimension 2"):
        sc.Scene(bodies, [Everything(line=np.ones(3))])
    with pytest.raises(ValueError, match=r"wind: direction has shape \(3,\), a has dimension 2; they must agree"):
        sc.Scene(bodies, [Wind(direction=np.ones(3))])
    with pytest.raises(ValueError, match="everything: between is \\('a',\\); give at least two bodies"):
        sc.Scene(bodies, [Everything(("a",))])


def test_incomplete_classes_of_effects_say_what_they_lack():
    def function(q, params):
        return jnp.sum((q[0] - q[1]) ** 2)

    alone = {"kind": "potential", "function": staticmethod(function)}
    body = {**alone, "pairs": names(2), "__annotations__": {"pairs": Any}}
    classes = {
        "has no kind; write kind = one of 'kinetic'": type("Kindless", (sc.Effect,), {**body, "kind": None}),
        "has no field with names of bodies": type("Alone", (sc.Effect,), alone),
        "function without @staticmethod": type("Bound", (sc.Effect,), {**body, "function": function}),
    }
    for message, cls in classes.items():
        with pytest.raises(TypeError, match=f"the class of effects {cls.__name__} .*{message}"):
            cls(("a", "b"))
    magnets: Any = type("Magnets", (sc.Effect,), dict(body))
    assert magnets(("a", "b")).name == "magnets"


COPIES = {
    "gravity": {"mass"},
    "nbody_gravity": {"mass_a", "mass_b"},
    "coulomb": {"charge_a", "charge_b"},
    "rayleigh_damping": {"mass_of"},
    "joint_springs": {"factors", "offsets"},
}
"""Numbers of bodies, charges and joints that effects have in their params."""
HELD = {
    "directors": {"hinge": {"factors", "offsets"}},
    "joint": {"mass": {"slow", "fast"}, "kinematics": {"turn", "slide", "zero"}},
}


@pytest.mark.compiles
@pytest.mark.parametrize("coordinates", HELD)
def test_copies_of_the_numbers_of_bodies_are_not_changed_alone(coordinates):
    bodies = [
        sc.RigidBody("bar", 2.0, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]),
        *(sc.Body(name, 1.0, [x, 0.0, 0.0]) for name, x in (("a", 1.0), ("b", 2.0))),
    ]
    effects = [
        sc.Revolute(("ground", "bar"), at=[0, 0, 0], name="hinge"),
        sc.JointSpring("hinge", 3.0),
        sc.Gravity(),
        sc.NBodyGravity(1.0, ["a", "b"]),
        sc.Coulomb({"a": 1.0, "b": 2.0}),
        sc.RayleighDamping(mass=0.1),
    ]
    problem = sc.Scene(bodies, effects, coordinates=coordinates).problem()
    system, params = problem.system, problem.system.params
    names_of, _ = leaves_by_name(params)
    copies = {f"{name}.{key}" for name, keys in (COPIES | HELD[coordinates]).items() for key in keys}
    assert set(names_of) - set(free(names_of)) == copies
    for copy in copies - {"mass.fast"}:  # which is empty: all bodies are slow
        effect, key = copy.split(".")
        changed = params | {effect: params[effect] | {key: np.asarray(params[effect][key]) + 1.0}}
        with pytest.raises(Refused, match=f"params: {copy} is "):
            system.replace(params=changed)
        with pytest.raises(Refused, match=f"params: {copy} is "):
            system.with_params(changed)

    twice = jax.tree.map(lambda value: np.stack([value, value]), params)
    steps = {"macro_dt": 0.1, "num_steps": 1}
    for name in ("gravity.mass", "coulomb.charge_a"):
        effect, key = name.split(".")
        changed = {name: twice[effect][key] * [[1.0], [2.0]] if np.ndim(params[effect][key]) else np.array([1.0, 2.0])}
        with pytest.raises(Refused, match=f"params: {name} is "):
            simulate_batch(problem, fully_implicit(1), initial_state(problem), params=changed, **steps)

    def replaced(weight):
        return system.replace(params=params | {"gravity": weight}).params

    with pytest.raises(Refused, match=r"params: gravity.mass is .*Tracer"):
        jax.eval_shape(replaced, params["gravity"])
    assert jax.eval_shape(lambda all_params: system.replace(params=all_params).params, params) is not None


@pytest.mark.compiles
def test_the_length_of_a_normal_changes_nothing():
    contact: Any = sc.PlaneContact(point=[0.0, 0.0], normal=[0.0, 2.0], stiffness=1e3, smoothing=0.1)
    system: Any = sc.Scene([sc.Body("a", 1.0, [0.3, 0.05], pace="slow")], [contact]).system()
    q, none = np.array([0.3, 0.05]), np.zeros(0)
    depth = 0.1 * np.log1p(np.exp(-0.5))
    for normal in ([0.0, 2.0], [0.0, 6.0]):
        params = system.params | {contact.name: system.params[contact.name] | {"normal": np.array(normal)}}
        assert float(system.slow_potential(q, none, params)) == pytest.approx(1e3 / 2 * depth**2, rel=1e-12)
