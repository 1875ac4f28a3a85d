"""What moves most in a step: a failing run names it, with its amount."""

import pickle

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.running.failures import Move, largest_motion
from vmri_jax.scene import Cylinder, RigidBody, Rod, Scene

SPIN, H = 30.0, 0.04  # 1.2 rad a step: directors that multipliers hold reach no more than 1


def largest(problem: vm.Problem, state: vm.State, macro_dt: float, names: vm.Names | None) -> Move:
    """Of a step with ten micro steps."""
    motion = largest_motion(problem.system, state, names, macro_dt, 10)
    assert motion is not None
    return motion


@pytest.fixture(scope="module")
def wheel():
    """A wheel that spins freely, slow."""
    wheel = RigidBody("wheel", 2.0, Cylinder(0.2, 0.1), [2, 0, 0], spin=[0, 0, SPIN], pace="slow")
    return Scene([wheel], []).problem()


def test_a_body_that_turns_too_far_is_named(wheel):
    with pytest.raises(vm.SimulationError, match=r"wheel turns 1\.2 rad in a macro step") as caught:
        vm.simulate(wheel, vm.fully_explicit(1), macro_dt=H, num_steps=100, solver=vm.Solver("masses"))
    error = caught.value
    assert error.step == 0
    assert "turns 1.2 rad" in error.moved
    assert pickle.loads(pickle.dumps(error)).moved == error.moved
    run = vm.simulate(wheel, vm.fully_explicit(1), macro_dt=0.016, num_steps=100, solver=vm.Solver("masses"))
    assert run.success


def test_the_turn_is_the_angular_velocity_times_the_step(wheel):
    """Of bodies with three directors exactly; of a rod by its one director."""
    motion = largest(wheel, wheel.state(), H, wheel.names)
    assert (motion.name, motion.micro, motion.turns) == ("wheel", False, True)
    assert motion.amount == pytest.approx(SPIN * H, rel=1e-12)
    rod = Scene([RigidBody("rod", 1.0, Rod(1.0), [0, 0, 0], spin=[SPIN, 0, 0], pace="fast")], []).problem()
    motion = largest(rod, rod.state(), H, rod.names)
    assert (motion.name, motion.micro) == ("rod", True)
    assert motion.amount == pytest.approx(SPIN * H / 10, rel=1e-12)  # fast bodies make micro steps
    assert "rod turns 0.12 rad in a micro step, which is little" in motion.sentence(H)


def test_points_and_coordinates_count_by_the_extent_of_the_system(fpu):
    state = vm.initial_state(fpu.system, fpu.q_s, fpu.q_f, 0 * fpu.v_s, np.array([0.0, 40.0, 0.0]))
    extent = np.ptp(np.concatenate([fpu.q_s, fpu.q_f]))
    motion = largest(fpu, state, 0.1, fpu.names)
    assert motion.name == "elongations[1]"
    assert motion.amount == pytest.approx(0.4 / extent, rel=1e-12)
    assert "take macro_dt below" in motion.sentence(0.1)
    assert "elongations[1] ran away before the failure" in motion._replace(amount=1e9).sentence(0.1)
    assert largest(fpu, state, 0.1, None).name == "q_f[1]"
