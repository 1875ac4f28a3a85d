"""More slow bodies in joint coordinates: micro intervals do not see them, and do not cost more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.mechanics.state import State
from vmri_jax.scene import Box, JointSpring, Revolute, RigidBody, Scene
from vmri_jax.schemes.equations import StepEquations
from vmri_jax.steppers.march import MarchEquations

SPIN = np.array([0.05, 0.02, 0.2])


def satellite(wheels: int, carried_by: str = "hub") -> Scene:
    """A hub with slow wheels on bearings, and a fast panel hinged to one of them or to the hub."""
    bodies, effects = [RigidBody("hub", 50.0, Box((1, 1, 1)), [0, 0, 0], spin=SPIN, pace="slow")], []

    def hang(name, on, place, hinge, axis, pace):
        shape = Box((0.4, 0.8, 0.03))
        bodies.append(RigidBody(name, 1.0, shape, place, spin=SPIN, velocity=np.cross(SPIN, place), pace=pace))
        effects.append(Revolute((on, name), at=hinge, axis=axis, name=f"joint of {name}"))

    for i in range(wheels):
        place = np.array([0.3, 0.0, 0.1 * i])
        hang(f"wheel {i}", "hub", place, place, [1, 0, 0], "slow")
    hang("panel", carried_by, np.array([0.0, 0.9, 0.0]), np.array([0.0, 0.5, 0.0]), [1, 0, 0], "fast")
    effects.append(JointSpring("joint of panel", 20.0, 0.3, rate="fast"))
    return Scene(bodies, effects, coordinates="joint")


def march_of(scene: Scene) -> tuple[MarchEquations, State]:
    """The equations of a macro step."""
    problem = scene.problem()
    state = problem.state()
    return MarchEquations(StepEquations.of(problem.system, vm.fully_implicit(5), state, 0.05)), state


def operations_of_an_interval(march: MarchEquations) -> float:
    """Floating-point operations of the residual of a micro interval and of all its columns."""

    def interval(x, arriving, slow):
        residual, push = jax.linearize(lambda *at: march.interval(1, *at), x, arriving, slow)
        return residual, jax.vmap(push)(*jax.tree.map(lambda a: jnp.ones((7, *a.shape)), (x, arriving, slow)))

    given = jnp.ones(march.num_fast), march.start(), jnp.ones(march.num_seen)
    analysis = jax.jit(interval).lower(*given).compile().cost_analysis()
    assert analysis is not None
    return analysis["flops"]


def test_a_micro_interval_does_not_cost_more_with_more_slow_bodies():
    costs = {}
    for wheels in (0, 6):
        march, state = march_of(satellite(wheels))
        assert (state.q_s.size, march.n_v) == (12 + wheels, 12)
        costs[wheels] = operations_of_an_interval(march)
    assert costs[0] > 500
    assert costs[6] < 1.05 * costs[0]  # what is seen is taken from more: measured 1.00


def test_what_carries_a_fast_body_is_seen():
    march, _ = march_of(satellite(3, "wheel 1"))
    assert march.intervals.seen.ends == [0, 12, 13, 14]


@pytest.mark.parametrize("carried_by", ["hub", "wheel 1"])
def test_kinetic_energy_and_bodies_are_those_of_all(carried_by):
    """The energy in parts, on both grids, is half the sum of masses times squared velocities of all bodies."""
    scene = satellite(3, carried_by)
    system, (q_s, q_f, v_s, v_f) = scene.system(), scene.start
    v_s = v_s + np.linspace(0.1, 0.3, v_s.size)
    kinematics, masses = scene.sorting.layout.kinematics, system.params["mass"]
    assert kinematics is not None
    rates = jax.jit(kinematics.velocities)(q_s, q_f, v_s, v_f, scene.sorting.joints)
    expected = sum(
        np.sum(masses[part] * np.square(rate)) / 2 for part, rate in zip(("slow", "fast"), rates, strict=True)
    )
    kinetic = jax.jit(type(system).kinetic_energy)(system, q_s, q_f, v_s, v_f)
    assert float(kinetic) == pytest.approx(expected, rel=1e-14)
    assert scene.places["wheel 0"].part == "s"
