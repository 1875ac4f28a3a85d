"""A stepper of one's own as an argument: runs, batches and gradients by the exact rotation of stiff springs between kicks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.steppers.kicked import Kicked
from vmri_jax.steppers.stepper import Status, StepInfo, Stepper

STEPS = {"macro_dt": 0.01, "num_steps": 20}


@dataclasses.dataclass(frozen=True)
class Rotation(Stepper):
    """Slow unit masses fly freely, fast ones swing on springs."""

    system: vm.System

    def advance(self, state, memory, macro_dt):
        omega = self.system.params["omega"]
        c, s = jnp.cos(omega * macro_dt), jnp.sin(omega * macro_dt)
        q_f, p_f = c * state.q_f + s / omega * state.p_f, c * state.p_f - omega * s * state.q_f
        nothing = {"multiplier": jnp.zeros((1, 1, 0)), "slow_multiplier": jnp.zeros((1, 0))}
        info = StepInfo(*Status.direct(vm.Method.EXPLICIT), q_f_micro=q_f[None], **nothing)
        return vm.State(state.t + macro_dt, state.q_s + macro_dt * state.p_s, q_f, state.p_s, p_f), info, memory

    def describe(self):
        return ["slow free, fast by rotation"]


def rotation(system, scheme):
    return Kicked(lagrangian(system.replace(fast_potential=None), scheme).kicks, Rotation(system))


EXACT = vm.solvers.Custom(rotation)


def test_micro_steps_converge_to_it(fpu):
    exact = vm.simulate(fpu, vm.fully_explicit(1), solver=EXACT, **STEPS)
    errors = [
        np.abs(vm.simulate(fpu, vm.fully_explicit(n), **STEPS).states.q_f - exact.states.q_f).max() for n in (10, 40)
    ]
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.02)  # order 2 of micro steps; measured 16.01
    assert "slow free, fast by rotation" in str(vm.plan(fpu, vm.fully_explicit(1), solver=EXACT))


def test_compositions_batches_and_gradients(fpu):
    composed = vm.compose(vm.fully_explicit(1), "suzuki4")
    coarse, fine, finest = (
        vm.simulate(fpu, composed, solver=EXACT, macro_dt=0.08 / 2**k, num_steps=2 * 2**k)[-1].q_s for k in range(3)
    )
    assert np.log2(np.abs(coarse - fine).max() / np.abs(fine - finest).max()) > 3.5  # order 4
    states = jax.tree.map(lambda a: jnp.stack([a, a]), fpu.state())
    lanes = vm.simulate_batch(fpu, vm.fully_explicit(1), states, solver=EXACT, **STEPS)
    one = vm.simulate(fpu, vm.fully_explicit(1), solver=EXACT, **STEPS)
    np.testing.assert_allclose(lanes.states.q_f[1], one.states.q_f, rtol=1e-13)

    def end(omega):
        system = fpu.system.replace(params={**fpu.system.params, "omega": omega})
        moved = dataclasses.replace(fpu, system=system)
        return vm.simulate(moved, vm.fully_explicit(1), solver=EXACT, **STEPS)[-1].q_f[0]

    omega = jnp.asarray(fpu.system.params["omega"], dtype=float)
    difference = (end(omega + 1e-5) - end(omega - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(end)(omega), difference, rtol=1e-5)


def nothing(system, scheme):
    return None


def test_bad_input(fpu):
    with pytest.raises(TypeError, match=r"Custom: stepper is 3; give a function"):
        vm.solvers.Custom(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(
        TypeError, match=r"the stepper of solvers.Custom is NoneType; give a vmri_jax.steppers.stepper.Stepper"
    ):
        vm.simulate(fpu, vm.fully_explicit(1), solver=vm.solvers.Custom(nothing), **STEPS)  # pyright: ignore[reportArgumentType]
