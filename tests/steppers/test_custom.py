"""A stepper of one's own as an argument: runs, batches and gradients by the exact rotation of stiff springs between
kicks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.user_systems import cart
from vmri_jax.schemes.discrete_lagrangian import lagrangian
from vmri_jax.steppers.kicked import Kicked
from vmri_jax.steppers.marched import Marched
from vmri_jax.steppers.stepper import StepInfo, Stepper, StepStatus

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
        info = StepInfo(*StepStatus.direct(vm.Method.EXPLICIT), q_f_micro=q_f[None], **nothing)
        return vm.State(state.t + macro_dt, state.q_s + macro_dt * state.p_s, q_f, state.p_s, p_f), info, memory

    def describe(self):
        return ["slow free, fast by rotation"]


def rotation(system, scheme):
    return Kicked(lagrangian(system.replace(fast_potential=None), scheme).kicks, Rotation(system))


EXACT = vm.Solver(stepper=rotation)


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
    states = jax.tree.map(lambda a: np.stack([a, a]), fpu.state())
    lanes = vm.simulate_batch(fpu, vm.fully_explicit(1), states, solver=EXACT, **STEPS)
    one = vm.simulate(fpu, vm.fully_explicit(1), solver=EXACT, **STEPS)
    np.testing.assert_allclose(lanes.states.q_f[1], one.states.q_f, rtol=1e-13)

    def end(omega):
        system = fpu.system.replace(params={**fpu.system.params, "omega": omega})
        moved = dataclasses.replace(fpu, system=system)
        return vm.simulate(moved, vm.fully_explicit(1), solver=EXACT, **STEPS)[-1].q_f[0]

    omega = float(fpu.system.params["omega"])
    program = jax.jit(jax.value_and_grad(end))
    difference = (float(program(omega + 1e-5)[0]) - float(program(omega - 1e-5)[0])) / 2e-5
    np.testing.assert_allclose(program(omega)[1], difference, rtol=1e-5)


def by_march(system, scheme):
    return Marched(vm.Solver("exact"))


def without_projection(system, scheme):
    """A whole step that ends with the momenta of the discrete Legendre transform."""
    whole = vm.plan(system, scheme, cart().state(), vm.Solver("masses")).stepper
    return WithoutProjection(whole.inner)  # pyright: ignore[reportAttributeAccessIssue]


@dataclasses.dataclass(frozen=True)
class WithoutProjection(Stepper):
    inner: Stepper

    def init(self, state, macro_dt):
        return self.inner.init(state, macro_dt)

    def advance(self, state, memory, macro_dt):
        return self.inner.advance(state, memory, macro_dt)

    def describe(self):
        return self.inner.describe()


def test_a_solver_gets_the_kicks_and_the_projection():
    """A user's solver solves the equations between the kicks; momenta end on the hidden constraints."""
    pendulum, scheme = cart(), vm.explicit_slow(2)
    ours = vm.simulate(pendulum, scheme, solver=vm.Solver(stepper=by_march), **STEPS)
    theirs = vm.simulate(pendulum, scheme, solver=vm.Solver("exact"), **STEPS)
    np.testing.assert_allclose(ours.states.p_f, theirs.states.p_f, rtol=1e-13)
    assert ours.constraint_residual.max() < 1e-12


def nothing(system, scheme):
    return None


def test_bad_input(fpu):
    with pytest.raises(TypeError, match=r"Solver: stepper is 3; give a function"):
        vm.Solver(stepper=3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"the value of Solver.stepper is NoneType"):
        vm.simulate(fpu, vm.fully_explicit(1), solver=vm.Solver(stepper=nothing), **STEPS)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"advance of .* returns StepInfo.q_f_micro of shape \(1, 3\)"):
        vm.simulate(fpu, vm.fully_explicit(2), solver=EXACT, **STEPS)


def test_momenta_of_a_whole_step_are_projected():
    """Where they are saved; of a subclass of `Kicked`, too, whose `advance` is called."""
    pendulum, scheme, calls = cart(), vm.fully_implicit(2), []

    class Counted(Kicked):
        def advance(self, state, memory, macro_dt):
            calls.append("advance")
            return super().advance(state, memory, macro_dt)

    def counted(system, scheme):
        return Counted((), without_projection(system, scheme))

    theirs = vm.simulate(pendulum, scheme, solver=vm.Solver("masses"), **STEPS)
    for make in (without_projection, counted):
        ours = vm.simulate(pendulum, scheme, solver=vm.Solver(stepper=make), **STEPS)
        assert ours.constraint_residual.max() < 1e-12
        np.testing.assert_allclose(ours.states.p_f, theirs.states.p_f, atol=1e-12)
    assert calls


@dataclasses.dataclass(frozen=True)
class Verlet(Stepper):
    """Velocity Verlet of the FPU chain, which carries its forces from step to step, and says a wrong time."""

    system: vm.System

    def _forces(self, state):
        def energy(q_s, q_f):
            params = self.system.params
            assert self.system.slow_potential
            assert self.system.fast_potential
            return self.system.slow_potential(q_s, q_f, params) + self.system.fast_potential(q_f, params)

        return jax.grad(energy, (0, 1))(state.q_s, state.q_f)

    def init(self, state, macro_dt):
        return self._forces(state)

    def advance(self, state, memory, macro_dt):
        p_s, p_f = state.p_s - macro_dt / 2 * memory[0], state.p_f - macro_dt / 2 * memory[1]
        end = vm.State(jnp.zeros(()), state.q_s + macro_dt * p_s, state.q_f + macro_dt * p_f, p_s, p_f)
        forces = self._forces(end)
        end = dataclasses.replace(end, p_s=p_s - macro_dt / 2 * forces[0], p_f=p_f - macro_dt / 2 * forces[1])
        nothing = {"multiplier": jnp.zeros((1, 1, 0)), "slow_multiplier": jnp.zeros((1, 0))}
        return end, StepInfo(*StepStatus.direct(vm.Method.EXPLICIT), q_f_micro=end.q_f[None], **nothing), forces

    def describe(self):
        return ["velocity Verlet"]


def test_stages_of_a_composition_start_with_their_own_memory(fpu):
    """Memory that depends on the state, and a wrong time: compositions of the stepper equal compositions of the
    library's scheme."""
    for scheme in (vm.fully_explicit(1), vm.compose(vm.fully_explicit(1), "suzuki4")):
        ours = vm.simulate(fpu, scheme, solver=vm.Solver(stepper=lambda system, scheme: Verlet(system)), **STEPS)
        theirs = vm.simulate(fpu, scheme, **STEPS)
        np.testing.assert_allclose(ours.states.q_f, theirs.states.q_f, atol=1e-14)
        np.testing.assert_allclose(ours.states.t, theirs.states.t, atol=1e-15)
