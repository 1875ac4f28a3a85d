"""Which solver takes a step: the words of a plan, the fallback of passes that do not converge, the programs that are
compiled."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import vmri_jax as vm
from tests.support import largest_difference, until_failure
from tests.user_systems import double_pendulum, two_oscillators
from vmri_jax.running import progress
from vmri_jax.steppers.solver import Solver


def drag(t, q_s, q_f, v_s, v_f, params):
    return -0.1 * v_s, -0.2 * v_f * jnp.sum(v_f**2)


def test_a_plan_says_how_a_step_is_solved(fpu, tsp):
    """Only kicks by V let slow and fast variables go their own ways, a force couples them; a term inside the macro
    interval needs the whole equations with exact matrices, a kinetic energy that is a function the matrices of its
    masses."""
    rule = vm.micro(vm.quadrature.midpoint)
    inside = vm.Scheme(4, kinetic=rule, slow=vm.macro(vm.quadrature.gauss(2)), fast=rule)
    forced, whole = fpu.system.replace(force=drag), "exact: micro intervals in order with exact matrices"
    assert str(vm.plan(fpu, vm.fully_implicit(4))).startswith("masses: passes")
    assert "masses:" not in str(vm.plan(fpu, vm.explicit_slow(4)))
    assert "masses:" in str(vm.plan(forced, vm.explicit_slow(4), fpu.state()))
    assert str(vm.plan(fpu, inside)).startswith(whole)
    assert str(vm.plan(double_pendulum(), vm.fully_implicit(3))).startswith(
        "masses: micro intervals in order with matrices of the masses"
    )
    assert str(vm.plan(double_pendulum(), vm.fully_implicit(3), solver=Solver("exact"))).startswith(whole)
    with pytest.raises(ValueError, match="the matrix 'masses' needs potentials and forces on the micro grid"):
        vm.plan(fpu, inside, solver=Solver("masses"))
    with pytest.raises(ValueError, match=r"the matrix 'modes' needs .* here num_micro = 4, degree = 1"):
        vm.plan(fpu, vm.fully_implicit(4), solver=Solver("modes"))
    assert vm.plan(fpu, vm.fully_implicit(4)).first.matrix == "masses"
    assert vm.plan(tsp, vm.galerkin(1, 3)).first.matrix == "modes"
    assert vm.plan(fpu, inside).first.matrix == "auto"


def test_auto_falls_back_where_the_march_does_not_converge():
    """At H = 2 the curvature of V outweighs the mass of the slow variables."""
    problem, solver, exactly = two_oscillators(kappa=25.0), *(Solver(m, max_iterations=6) for m in ("auto", "exact"))

    def go(state, solver):
        step = {"macro_dt": 40.0, "num_steps": 3, "solver": solver}
        return until_failure(problem.system, vm.fully_implicit(20), state, **step)

    state = problem.state()
    run, exact = go(state, solver), go(state, exactly)
    assert run.success
    assert np.all(run.info.method == vm.Method.EXACT)
    for name in ("q_s", "q_f", "p_s", "p_f"):
        found, expected = getattr(run, name)[1], getattr(exact, name)[1]
        assert largest_difference(found, expected) / np.abs(expected).max() < 1e-12
    inside = jax.jit(lambda state: go(state, solver))(state)
    assert int(inside.info.method.max()) == vm.Method.EXACT
    assert largest_difference(inside.q_f, run.q_f) < 1e-11


def test_the_fallback_stays_out_of_the_loop_in_a_compiled_function(tsp):
    """A library call in it would keep the loop over macro steps from being one kernel."""

    def loops_around(jaxpr, name, around: tuple[str, ...] = ()):
        """For every equation of this name the loops and conditions that it is in, the outermost first."""
        for eqn in jaxpr.eqns:
            kind = eqn.primitive.name
            if kind == name:
                yield around
            inside = (*around, kind) if kind in ("while", "scan", "cond") else around
            for part in jaxprs_in_params(eqn.params):
                yield from loops_around(part, name, inside)

    def run(state):
        return vm.simulate(tsp.system, vm.fully_explicit(5), state, macro_dt=0.001, num_steps=5).q_f

    found = list(loops_around(jax.make_jaxpr(run)(tsp.state()).jaxpr, "svd"))
    assert found
    assert all(around[:1] == ("cond",) for around in found)


def test_a_run_that_fails_late_is_made_again_with_exact_matrices(tsp, capsys, monkeypatch):
    """At this step passes with masses solve seven or eight steps, as round-off has it, and not the next one.

    A prepared run says so.
    """
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)
    step = {"macro_dt": 0.2, "num_steps": 20}
    march, exact = (
        until_failure(tsp, vm.fully_implicit(10), solver=Solver(matrix, max_iterations=40), **step)
        for matrix in ("masses", "exact")
    )
    assert 2 <= int(march.failed_at) < 20
    prepared = vm.prepare(tsp, vm.fully_implicit(10), solver=Solver(max_iterations=40), **step)
    run = prepared()
    line = "a step was not solved: computing its part of the run again with exact matrices"
    assert line in capsys.readouterr().err
    assert run.success
    assert np.all(run.info.method == vm.Method.EXACT)
    assert largest_difference(run.q_f, exact.q_f) == 0.0
    prepared.timed()()


@pytest.mark.skipif(os.environ.get("VMRI_KERNELS") == "plain", reason="the plain kernels are library calls")
def test_no_library_call_in_a_compiled_run(tsp):
    """The loop over macro steps of a small constrained system has no call out of it."""
    run = jax.jit(
        lambda state: vm.simulate(
            tsp.system, vm.fully_explicit(5), state, macro_dt=0.001, num_steps=5, solver=Solver("masses")
        )
    )
    text = str(run.lower(tsp.state()).compile().as_text())
    assert "custom-call" not in text
    assert " dot(" not in text


def rod_by_squares(q_s, params):
    distance = q_s - jnp.stack([0.0, 0.0, params["height"] + 5.0])
    return (distance @ distance / 10 - 2.5)[None]


def rod_by_norm(q_s, params):
    return (jnp.linalg.norm(q_s - jnp.stack([0.0, 0.0, params["height"] + 5.0])) - 5.0)[None]


@pytest.mark.parametrize("height", [0.0, 1.0])
@pytest.mark.parametrize(("rod", "matrix"), [(rod_by_squares, "auto"), (rod_by_norm, "exact")])
def test_round_off_of_a_constraint_counts_by_its_own_length(height, rod, matrix):
    """A slow bob near the origin on a rod of 5 m: the constraint has the round-off of 5 m, the positions have none."""
    masses = vm.ConstantMass(jnp.ones(3), jnp.zeros(0))
    system = vm.System(masses, slow_constraint=rod, params={"height": height})
    problem = vm.Problem(system, [0.0, 0.0, height], [], [0.01, 0.0, 0.0], [])
    run = vm.simulate(problem, vm.fully_implicit(1), macro_dt=0.0025, num_steps=100, solver=Solver(matrix))
    angle = 0.01 * 0.25 / 5  # of free motion along the circle
    assert run.q_s[-1] == pytest.approx([5 * np.sin(angle), 0.0, height + 5 * (1 - np.cos(angle))], abs=1e-13)
