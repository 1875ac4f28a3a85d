"""Functions of users: their Python code runs once, systems are equal if their functions are."""

import pickle

import jax
import jax.numpy as jnp
import pytest

from vmri_jax import CompiledAgainWarning, ConstantMass, Rheonomic, System, explicit_slow, fully_explicit, simulate
from vmri_jax.mechanics.functions import TracedOnce, traced_once


def test_the_code_of_a_function_runs_three_times_in_the_check_and_once_for_all_programs(tsp):
    problem, calls = tsp, []

    def counted(name):
        function = getattr(problem.system, name)
        return function and (lambda *arguments: (calls.append(name), function.function(*arguments))[1])

    names = "slow_potential", "fast_potential", "constraint", "slow_constraint"
    system = problem.system.replace(**{name: counted(name) for name in names})
    state = type(problem)(system, problem.q_s, problem.q_f, problem.v_s, problem.v_f).state()
    for scheme in (fully_explicit(2), explicit_slow(2)):
        simulate(system, scheme, state, macro_dt=0.01, num_steps=2)
    assert sorted(calls) == sorted(4 * [name for name in names if getattr(system, name)])


def make_many():
    for stiffness in range(8):
        TracedOnce(lambda x, stiffness=stiffness: stiffness * x)(1.0)


def test_functions_made_in_a_loop_are_told_once():
    message = r"<lambda> \(line \d+ of .*test_functions.py\) has been traced 5 times"
    with pytest.warns(CompiledAgainWarning, match=message) as told:
        make_many()
    assert len(told) == 1


def soft(q_s, q_f, params):
    return jnp.sum(q_s**2)


def held(t, q_s, q_f, params):
    return q_f - t


def test_systems_compare_by_the_functions_of_users():
    def system():
        return System(ConstantMass([1.0], [1.0]), soft, constraint=Rheonomic(held))

    assert jax.tree.structure(system()) == jax.tree.structure(system())
    assert jax.tree.structure(system().replace(params=None)) == jax.tree.structure(system())
    assert system().slow_potential == TracedOnce(soft)
    assert traced_once(traced_once(soft)).function is soft
    assert pickle.loads(pickle.dumps(system())).slow_potential.function is soft


@pytest.mark.skipif(
    jax.__version_info__ >= (0, 12), reason="this JAX takes them over when it compiles, not when it traces"
)
def test_operations_are_taken_over_in_place():
    jaxpr = jax.make_jaxpr(jax.grad(traced_once(soft)))(jnp.ones(2), jnp.ones(1), None)
    assert not any(equation.params.get("name") == soft.__name__ for equation in jaxpr.eqns)
