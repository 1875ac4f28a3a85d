"""Bad input is refused at the door: the message names the argument, says what came and what to do."""

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vmri_jax import (
    ConstantMass,
    Rheonomic,
    Save,
    Scheme,
    SimulationError,
    State,
    System,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    galerkin,
    initial_state,
    macro,
    micro,
    mollified_impulse,
    quadrature,
    simulate,
    simulate_batch,
    systems,
)


def start(problem, **changes):
    vectors = {"q_s": problem.q_s, "q_f": problem.q_f, "v_s": problem.v_s, "v_f": problem.v_f} | changes
    return initial_state(problem.system, **vectors)


def test_float32_data(fpu):
    with pytest.raises(ValueError, match=r"q_s has dtype float32; give float64"):
        start(fpu, q_s=jnp.asarray(fpu.q_s, dtype=jnp.float32))
    state = fpu.state()
    with pytest.raises(ValueError, match=r"p_f has dtype float32; give float64"):
        simulate(
            fpu.system,
            fully_implicit(2),
            State(0.0, state.q_s, state.q_f, state.p_s, state.p_f.astype(jnp.float32)),
            macro_dt=0.1,
            num_steps=1,
        )


def test_64_bit_mode_off():
    calls = [
        "vmri_jax.systems.fermi_pasta_ulam()",
        "vmri_jax.initial_state(None, [1.0], [1.0], [0.0], [0.0])",
        "vmri_jax.simulate(None, vmri_jax.fully_implicit(2), None, macro_dt=0.1, num_steps=1)",
    ]
    program = f"""
import vmri_jax
for call in {calls}:
    try:
        eval(call)
    except ValueError as error:
        print(str(error).replace(chr(10), " "))
"""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True)
    messages = done.stdout.splitlines()
    assert len(messages) == len(calls)
    for message in messages:
        assert "needs 64-bit floats" in message
        assert 'jax.config.update("jax_enable_x64", True)' in message


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q_s": jnp.zeros((3, 1))}, r"q_s has shape \(3, 1\); it must be a vector"),
        ({"v_s": jnp.zeros(2)}, r"v_s has shape \(2,\), q_s has \(3,\); they must be equal"),
        ({"v_f": jnp.zeros(4)}, r"v_f has shape \(4,\), q_f has \(3,\)"),
        ({"q_f": jnp.zeros(4), "v_f": jnp.zeros(4)}, r"ConstantMass: fast is for 3 coordinates, the state has 4"),
        ({"q_f": jnp.array([0.0, jnp.nan, 0.0])}, r"q_f has entries that are not finite at \[1\]"),
        ({"v_s": jnp.array([jnp.inf, 0.0, 0.0])}, r"v_s has entries that are not finite at \[0\]"),
    ],
)
def test_bad_vectors(fpu, changes, message):
    with pytest.raises(ValueError, match=message):
        start(fpu, **changes)
    with pytest.raises(ValueError, match=message):
        replace(fpu, **changes).state()


@pytest.mark.parametrize("junk", ["one", [1.0, "a"], [[1.0], [2.0, 3.0]], {"a": 1}, object(), 1j, 10**400])
def test_what_is_no_number(fpu, junk: Any):
    for name in ("q_s", "v_f", "t", "tolerance"):
        with pytest.raises(TypeError, match=rf"{name} is .*; give (a )?real number"):
            start(fpu, **{name: junk})
    masses: Any = {"a": "heavy"} if junk == {"a": 1} else junk  # masses may be given by name
    with pytest.raises(TypeError, match=r"ConstantMass: fast(\['a'\])? is .*; give real numbers"):
        ConstantMass([1.0], masses)
    with pytest.raises(TypeError, match=r"affine: alpha is .*; give a real number"):
        explicit_slow(2, junk)
    with pytest.raises(TypeError, match=r"Rule: weights is .*; give real numbers"):
        quadrature.Rule((0.5,), junk)
    if junk is not None:
        with pytest.raises(TypeError, match=r"simulate: macro_dt is .*; give a real number"):
            simulate(fpu.system, fully_implicit(2), fpu.state(), macro_dt=junk, num_steps=1)


@pytest.mark.parametrize(
    ("changes", "message"), [({"t": np.nan}, "t is nan; it must be finite"), ({"t": [0.0]}, "t has shape")]
)
def test_bad_start_times(fpu, changes, message):
    with pytest.raises(ValueError, match=message):
        start(fpu, **changes)


def test_flags_are_true_or_false(fpu):
    with pytest.raises(TypeError, match="project is 'no'; it must be True or False"):
        start(fpu, project="no")
    for name in ("micro", "progress"):
        flag: Any = {name: 1}
        with pytest.raises(TypeError, match=f"{name} is 1; "):
            Save(**flag)


def test_parameters_that_are_no_numbers(fpu):
    system = fpu.system.replace(params={"springs": [1.0, "stiff"]})
    with pytest.raises(TypeError, match=r"params\['springs'\]\[1\] is 'stiff'; give arrays of numbers"):
        initial_state(system, fpu.q_s, fpu.q_f, fpu.v_s, fpu.v_f)
    with pytest.raises(TypeError, match=r"params\['springs'\]\[1\] is 'stiff'; give arrays of numbers"):
        simulate(system, fully_implicit(2), fpu.state(), macro_dt=0.1, num_steps=1)


def test_parameters_of_a_batch(fpu):
    states = jax.tree.map(lambda a: jnp.stack([a, a]), fpu.state())
    for params in ("stiff", {"other": jnp.ones(2)}, jax.tree.map(lambda a: jnp.stack([a] * 3), fpu.system.params)):
        with pytest.raises((ValueError, TypeError), match="params"):
            simulate_batch(fpu.system, fully_implicit(2), states, macro_dt=0.1, num_steps=1, params=params)


def vector_potential(q_s, q_f, params):
    return q_s**2


def vector_fast_potential(q_f, params):
    return q_f**2


def entry_that_is_not_there(q_f, params):
    """JAX takes the last entry instead, without a word."""
    return jnp.sin(q_f[3])


def scalar_constraint(q_s, q_f, params):
    return jnp.sum(q_f)


def one_force(t, q_s, q_f, v_s, v_f, params):
    return -v_s


def swapped_forces(t, q_s, q_f, v_s, v_f, params):
    return -v_f[:2], -v_s


def failing_potential(q_s, q_f, params):
    return params["no such entry"]


def whole_potential(q_s, q_f, params):
    return 0


def complex_potential(q_f, params):
    return jnp.sum(q_f) * 1j


def single_constraint(q_s, q_f, params):
    return q_f.astype(jnp.float32)


def branching_potential(q_f, params):
    return q_f[0] if q_f[0] > 0 else 0.0


def numpy_potential(q_f, params):
    return np.square(float(q_f[0]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slow_potential": whole_potential}, "slow_potential returns int64; it must return float64"),
        ({"fast_potential": complex_potential}, "fast_potential returns complex128; it must return float64"),
        ({"constraint": single_constraint}, "constraint returns float32; it must return float64"),
        ({"fast_potential": branching_potential}, "fast_potential cannot be traced, line .* of test_bad_input.py"),
        ({"fast_potential": numpy_potential}, "fast_potential cannot be traced, line .* of test_bad_input.py"),
        ({"slow_potential": lambda q_s, q_f, params: None}, "slow_potential returns NoneType; it must return a scalar"),
        ({"fast_potential": entry_that_is_not_there}, r"fast_potential takes an entry .* test_bad_input.py .*index 3"),
        ({"slow_potential": vector_potential}, r"slow_potential returns shape \(3,\); it must return a scalar"),
        ({"fast_potential": vector_fast_potential}, r"fast_potential returns shape \(3,\); it must return a scalar"),
        ({"constraint": scalar_constraint}, r"constraint returns shape \(\); it must return a vector"),
        ({"force": one_force}, r"force returns shape \(3,\); it must return \(F_s, F_f\)"),
        ({"force": swapped_forces}, r"force returns \(shape \(2,\), shape \(3,\)\); it must return \(F_s, F_f\)"),
        ({"slow_potential": failing_potential}, r"slow_potential could not be evaluated .*KeyError.*no such entry"),
    ],
)
def test_user_functions_of_the_wrong_shape(fpu, changes, message):
    system = fpu.system.replace(**changes)
    with pytest.raises(ValueError, match=message):
        initial_state(system, fpu.q_s, fpu.q_f, fpu.v_s, fpu.v_f)
    with pytest.raises(ValueError, match=message):
        simulate(system, fully_implicit(2), fpu.state(), macro_dt=0.1, num_steps=1)


TIME = "Energies and masses that depend on time are out of scope. Take instead a force .* or a constraint that moves"
VELOCITY = (
    "Constraints on velocities .* are out of scope. Take instead the positions that they hold.* or a strong damper"
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fast_potential": lambda q_f: 0.0}, r"\(q_f\); it is called with \(q_f, params\)\. Give it all of these"),
        ({"slow_potential": lambda q_f, q_s, params: 0.0}, r"called with \(q_s, q_f, params\)\. Give it .* in this"),
        ({"force": lambda q_s, q_f, v_s, v_f, t, params: (v_s, v_f)}, "force is .* Give it .* in this order"),
        ({"slow_potential": lambda t, q_s, q_f, params: 0.0}, f"slow_potential is .* {TIME}"),
        ({"fast_potential": lambda t, params: 0.0}, f"fast_potential is .* {TIME}"),
        ({"kinetic": lambda t, q_s, q_f, v_s, v_f, params: 0.0}, f"kinetic is .* {TIME}"),
        ({"constraint": lambda q_s, q_f, v_s, v_f, params: q_f}, f"constraint is .* {VELOCITY}"),
        ({"slow_constraint": lambda t, q_s, params: q_s}, "slow_constraint is .* one that moves with time is"),
        ({"constraint": Rheonomic(lambda q_s, q_f, params: q_f)}, r"called with \(t, q_s, q_f, params\)\. Give it all"),
    ],
)
def test_user_functions_of_other_arguments(fpu, changes, message):
    with pytest.raises(TypeError, match=message):
        fpu.system.replace(**changes)


def test_functions_may_take_more_where_it_has_a_default(fpu):
    fpu.system.replace(fast_potential=lambda q_f, params, stiffness=2.0: stiffness * jnp.sum(q_f**2))
    fpu.system.replace(slow_potential=lambda *arguments: jnp.sum(arguments[0]))


def ring(q_s, q_f, params):
    return jnp.array([q_s @ q_s - 1.0])


@pytest.mark.parametrize("num_fast", [0, 1])
def test_constraints_of_slow_coordinates_alone(num_fast):
    system = System(ConstantMass([1.0, 1.0], [1.0] * num_fast), constraint=ring)
    with pytest.raises(ValueError, match=r"\[0\] of constraint do not depend on the fast .*System\(slow_constraint="):
        initial_state(system, [1.0, 0.0], [0.0] * num_fast, [0.0, 0.0], [0.0] * num_fast)


@pytest.mark.parametrize(
    ("slow", "message"),
    [
        ([1.0, 0.0], r"slow = \[1. 0.\]; every mass must be positive"),
        ([1.0, -2.0], "every mass must be positive"),
        ([1.0, np.nan], "every mass must be positive and finite"),
        (1.0, r"slow has shape \(\); give \(n,\) masses"),
        (np.diag([1.0, -1.0]), "slow must be a symmetric positive definite matrix"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "slow must be a symmetric positive definite matrix"),
    ],
)
def test_bad_masses(slow, message):
    with pytest.raises(ValueError, match=message):
        ConstantMass(slow, [1.0])


def test_system_fields_of_the_wrong_type():
    with pytest.raises(TypeError, match=r"kinetic is 3.0; give ConstantMass"):
        System(3.0)
    with pytest.raises(TypeError, match="slow_potential is a ConstantMass; masses come first"):
        System(vector_fast_potential, ConstantMass([1.0], [1.0]))
    with pytest.raises(TypeError, match="slow_potential is 2; it must be a function or None"):
        System(ConstantMass([1.0], [1.0]), slow_potential=2)
    with pytest.raises(TypeError, match=r"force is Unhashable.*, which has no hash"):
        System(ConstantMass([1.0], [1.0]), force=Unhashable())


@dataclass
class Unhashable:
    """A callable that programs cannot be kept for."""

    strength: float = 1.0

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        return v_s, v_f


@pytest.mark.parametrize("make", [fully_implicit, explicit_slow, lambda n: galerkin(n, 2)])
def test_bad_num_micro(make):
    for bad in (0, -3):
        with pytest.raises(ValueError, match=f"num_micro is {bad}; it must be at least 1"):
            make(bad)
    for bad in (2.0, "5", True, None):
        with pytest.raises(TypeError, match=f"num_micro is {bad!r}; it must be an integer"):
            make(bad)


HALF = micro(quadrature.midpoint)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"degree": 0}, ValueError, "degree is 0; it must be at least 1"),
        ({"degree": 1.5}, TypeError, "degree is 1.5; it must be an integer"),
        ({"slow": macro(2 * quadrature.left)}, ValueError, "weights of the slow rule sum to 2; they must sum to 1"),
        ({"fast": quadrature.left}, TypeError, r"fast is a bare rule; say on which grid .* macro\(rule\) or micro"),
        ({"fast": "midpoint"}, TypeError, r"fast is 'midpoint'; give macro\(rule\) or micro\(rule\)"),
        ({"kinetic": macro(quadrature.midpoint)}, ValueError, r"kinetic rule must be placed with micro"),
        ({"constraint": micro(quadrature.gauss(2))}, ValueError, r"constraint must be held .* give"),
        ({"slow_constraint": micro(quadrature.trapezoidal)}, ValueError, r"give macro\(lobatto\(2\)\), got micro"),
    ],
)
def test_bad_schemes(changes, error, message):
    fields = {"num_micro": 3, "kinetic": HALF, "slow": HALF, "fast": HALF} | changes
    with pytest.raises(error, match=message):
        Scheme(**fields)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({}, ValueError, "macro_dt is missing; give the macro step H"),
        ({"macro_dt": 0.0}, ValueError, "macro_dt is 0.0; it must be a positive number"),
        ({"macro_dt": -0.1}, ValueError, "macro_dt is -0.1; it must be a positive number"),
        ({"macro_dt": float("nan")}, ValueError, "macro_dt is nan; it must be a positive number"),
        ({"macro_dt": 0.1, "num_steps": 0}, ValueError, "num_steps is 0; it must be an integer of at least 1"),
        ({"macro_dt": 0.1, "num_steps": -4}, ValueError, "num_steps is -4"),
        ({"macro_dt": 0.1, "num_steps": 10.0}, ValueError, "num_steps is 10.0; it must be an integer"),
        ({"macro_dt": 0.1, "save": 0}, ValueError, "save is 0; it must be an integer of at least 1, or a Save"),
        ({"macro_dt": 0.1, "save": 3}, ValueError, "num_steps = 10 is not a multiple of save = 3"),
        ({"macro_dt": 0.1, "save": Save(number=3)}, ValueError, "not a multiple of the 3 saved intervals"),
        ({"macro_dt": 0.1, "scheme": "fully_implicit"}, TypeError, "scheme is str; give a Scheme"),
        ({"macro_dt": 0.1, "state": None}, TypeError, r"a System has no start; give a State, e.g. from initial_state"),
    ],
)
def test_bad_arguments_of_simulate(fpu, changes, error, message):
    arguments = {"scheme": fully_implicit(2), "state": fpu.state(), "num_steps": 10} | changes
    with pytest.raises(error, match=message):
        simulate(fpu.system, **arguments)


def nan_potential(q_f, params):
    return jnp.sum(jnp.sqrt(-1.0 - q_f**2))


@pytest.mark.compiles
def test_nan_from_a_user_function(fpu):
    system = fpu.system.replace(fast_potential=nan_potential)
    with pytest.raises(SimulationError, match=r"a NaN or infinity appeared.*outside its domain") as caught:
        simulate(system, fully_implicit(2), fpu.state(), macro_dt=0.1, num_steps=3)
    assert caught.value.step == 0


def test_nan_in_a_state(fpu):
    state = fpu.state()
    bad = State(0.0, state.q_s, state.q_f, state.p_s * jnp.nan, state.p_f)
    with pytest.raises(ValueError, match=r"p_s has entries that are not finite at \[0, 1, 2\]"):
        simulate(fpu.system, fully_implicit(2), bad, macro_dt=0.1, num_steps=1)


def test_only_rules_are_placed():
    for place in (macro, micro):
        with pytest.raises(TypeError, match="rule is 'midpoint'; give a Rule"):
            place("midpoint")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="rule is 3; give a Rule"):
        galerkin(2, 1, 3)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("alpha", [2.0, -0.5, np.nan])
def test_parts_of_kicks_are_from_0_to_1(alpha):
    for make in (explicit_slow, fully_explicit, mollified_impulse):
        with pytest.raises(ValueError, match=f"alpha is {alpha}; it must be from 0 to 1: it is the part of a kick"):
            make(2, alpha)


def test_bad_number_of_springs():
    with pytest.raises(ValueError, match="num_springs is 0; there must be at least 1"):
        systems.fermi_pasta_ulam(num_springs=0)


def test_parameters_that_are_not_finite(fpu):
    system = fpu.system.replace(params={"omega": np.nan})
    with pytest.raises(ValueError, match=r"System: params\['omega'\] is nan, which is not finite"):
        initial_state(system, fpu.q_s, fpu.q_f, fpu.v_s, fpu.v_f)


def test_results_that_do_not_fit_into_memory(fpu):
    message = r"100000000001 saved nodes would take 1.92e\+04 GB, and .* GB of memory are free. Save fewer .*stream"
    with pytest.raises(ValueError, match=message):
        simulate(fpu.system, fully_implicit(2), fpu.state(), macro_dt=0.1, num_steps=10**11)
    states = jax.tree.map(lambda a: jnp.stack([a, a]), fpu.state())
    with pytest.raises(ValueError, match="simulate_batch: 100000000001 saved nodes of 2 runs would take 3"):
        simulate_batch(fpu.system, fully_implicit(2), states, macro_dt=0.1, num_steps=10**11)
