"""Bad input is refused at the door: the message names the argument, says what came and what to do."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm


def start(problem, system=None, **changes):
    vectors = {"q_s": problem.q_s, "q_f": problem.q_f, "v_s": problem.v_s, "v_f": problem.v_f} | changes
    return vm.initial_state(system or problem.system, **vectors)


def step(problem, system=None, state=None, **how):
    """One step of a run."""
    how = {"scheme": vm.fully_implicit(2), "macro_dt": 0.1, "num_steps": 1} | how
    return vm.simulate(system or problem.system, state=state or problem.state(), **how)


def test_bad_data(fpu):
    with pytest.raises(vm.Refused, match=r"q_s has dtype float32; give float64"):
        start(fpu, q_s=jnp.asarray(fpu.q_s, dtype=jnp.float32))
    state = fpu.state()
    with pytest.raises(vm.Refused, match=r"p_f has dtype float32; give float64"):
        step(fpu, state=replace(state, p_f=state.p_f.astype(jnp.float32)))
    with pytest.raises(vm.Refused, match=r"p_s has entries that are not finite at \[0, 1, 2\]"):
        step(fpu, state=replace(state, p_s=state.p_s * np.nan))
    for value, message in ((np.nan, "t is nan; it must be finite"), ([0.0], "t has shape")):
        with pytest.raises(vm.Refused, match=message):
            start(fpu, t=value)
    with pytest.raises(vm.Refused, match="project is 'no'; it must be True or False"):
        start(fpu, project="no")
    for name in ("micro", "progress"):
        flag: Any = {name: 1}
        with pytest.raises(vm.Refused, match=f"{name} is 1; "):
            vm.Save(**flag)
    with pytest.raises(vm.Refused, match="num_springs is 0; there must be at least 1"):
        vm.systems.fermi_pasta_ulam(num_springs=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q_s": jnp.zeros((3, 1))}, r"q_s has shape \(3, 1\); it must be a vector"),
        ({"v_s": np.zeros(2)}, r"v_s has shape \(2,\), q_s has \(3,\); they must be equal"),
        ({"v_f": np.zeros(4)}, r"v_f has shape \(4,\), q_f has \(3,\)"),
        ({"q_f": np.zeros(4), "v_f": np.zeros(4)}, r"ConstantMass: fast is for 3 coordinates, the state has 4"),
        ({"q_f": np.array([0.0, np.nan, 0.0])}, r"q_f has entries that are not finite at \[1\]"),
        ({"v_s": np.array([np.inf, 0.0, 0.0])}, r"v_s has entries that are not finite at \[0\]"),
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
        vm.ConstantMass([1.0], masses)
    with pytest.raises(TypeError, match=r"affine: alpha is .*; give a real number"):
        vm.explicit_slow(2, junk)
    with pytest.raises(TypeError, match=r"Rule: weights is .*; give real numbers"):
        vm.quadrature.Rule((0.5,), junk)
    with pytest.raises(TypeError, match=r"simulate: macro_dt is .*; give a real number"):
        step(fpu, macro_dt=junk)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"springs": [1.0, "stiff"]}, r"params\['springs'\]\[1\] is 'stiff'; give arrays of numbers"),
        ({"omega": np.nan}, r"System: params\['omega'\] is nan, which is not finite"),
        ({"noise": jax.random.key(0)}, r"(?s)System: params\['noise'\] is .*; give arrays of numbers"),
    ],
)
def test_bad_parameters(fpu, params, message):
    system = fpu.system.replace(params=params)
    with pytest.raises(vm.Refused, match=message):
        start(fpu, system)
    with pytest.raises(vm.Refused, match=message):
        step(fpu, system)
    with pytest.raises(vm.Refused, match=message):  # before any function gets them
        vm.Problem(vm.System(vm.ConstantMass({}, {"a": 1.0}), params=params), {}, {"a": 0.0})


def test_parameters_of_a_batch(fpu):
    states = jax.tree.map(lambda a: np.stack([a, a]), fpu.state())
    for params in ("stiff", {"other": np.ones(2)}, jax.tree.map(lambda a: np.stack([a] * 3), fpu.system.params)):
        with pytest.raises((ValueError, TypeError), match="params"):
            vm.simulate_batch(fpu.system, vm.fully_implicit(2), states, macro_dt=0.1, num_steps=1, params=params)


def vector_fast_potential(q_f, params):
    return q_f**2


def entry_that_is_not_there(q_f, params):
    """JAX takes the last entry instead, without a word."""
    return jnp.sin(q_f[3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slow_potential": lambda q_s, q_f, params: 0}, "slow_potential returns int64; it must return float64"),
        (
            {"fast_potential": lambda q_f, params: jnp.sum(q_f) * 1j},
            "fast_potential returns complex128; it must return float64",
        ),
        (
            {"constraint": lambda q_s, q_f, params: q_f.astype(jnp.float32)},
            "constraint returns float32; it must return float64",
        ),
        (
            {"fast_potential": lambda q_f, params: q_f[0] if q_f[0] > 0 else 0.0},
            "fast_potential cannot be traced, line .* of test_bad_input.py",
        ),
        (
            {"fast_potential": lambda q_f, params: np.square(float(q_f[0]))},
            "fast_potential cannot be traced, line .* of test_bad_input.py",
        ),
        ({"slow_potential": lambda q_s, q_f, params: None}, "slow_potential returns NoneType; it must return a scalar"),
        ({"fast_potential": entry_that_is_not_there}, r"fast_potential takes an entry .* test_bad_input.py .*index 3"),
        (
            {"slow_potential": lambda q_s, q_f, params: q_s**2},
            r"slow_potential returns shape \(3,\); it must return a scalar",
        ),
        ({"fast_potential": vector_fast_potential}, r"fast_potential returns shape \(3,\); it must return a scalar"),
        (
            {"constraint": lambda q_s, q_f, params: jnp.sum(q_f)},
            r"constraint returns shape \(\); it must return a vector",
        ),
        (
            {"force": lambda t, q_s, q_f, v_s, v_f, params: -v_s},
            r"force returns shape \(3,\); it must return \(F_s, F_f\)",
        ),
        (
            {"force": lambda t, q_s, q_f, v_s, v_f, params: (-v_f[:2], -v_s)},
            r"force returns \(shape \(2,\), shape \(3,\)\); it must return \(F_s, F_f\)",
        ),
        (
            {"slow_potential": lambda q_s, q_f, params: params["no such entry"]},
            r"slow_potential could not be evaluated .*KeyError.*no such entry",
        ),
    ],
)
def test_user_functions_of_the_wrong_shape(fpu, changes, message):
    system = fpu.system.replace(**changes)
    with pytest.raises(vm.Refused, match=message):
        start(fpu, system)
    with pytest.raises(vm.Refused, match=message):
        step(fpu, system)


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
        (
            {"constraint": vm.Rheonomic(lambda q_s, q_f, params: q_f)},
            r"called with \(t, q_s, q_f, params\)\. Give it all",
        ),
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
    system = vm.System(vm.ConstantMass([1.0, 1.0], [1.0] * num_fast), constraint=ring)
    with pytest.raises(ValueError, match=r"\[0\] of constraint do not depend on the fast .*System\(slow_constraint="):
        vm.initial_state(system, [1.0, 0.0], [0.0] * num_fast, [0.0, 0.0], [0.0] * num_fast)


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
        vm.ConstantMass(slow, [1.0])


def test_system_fields_of_the_wrong_type():
    with pytest.raises(TypeError, match=r"kinetic is 3.0; give ConstantMass"):
        vm.System(3.0)
    with pytest.raises(TypeError, match="slow_potential is a ConstantMass; masses come first"):
        vm.System(vector_fast_potential, vm.ConstantMass([1.0], [1.0]))
    with pytest.raises(TypeError, match="slow_potential is 2; it must be a function or None"):
        vm.System(vm.ConstantMass([1.0], [1.0]), slow_potential=2)
    with pytest.raises(TypeError, match=r"force is Unhashable.*, which has no hash"):
        vm.System(vm.ConstantMass([1.0], [1.0]), force=Unhashable())


@dataclass
class Unhashable:
    """A callable that programs cannot be kept for."""

    strength: float = 1.0

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        return v_s, v_f


@pytest.mark.parametrize("make", [vm.fully_implicit, vm.explicit_slow, lambda n: vm.galerkin(n, 2)])
def test_bad_num_micro(make):
    for bad in (0, -3):
        with pytest.raises(ValueError, match=f"num_micro is {bad}; it must be an integer of at least 1"):
            make(bad)
    for bad in (2.0, "5", True, None):
        with pytest.raises(TypeError, match=f"num_micro is {bad!r}; it must be an integer"):
            make(bad)


HALF = vm.micro(vm.quadrature.midpoint)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"degree": 0}, "degree is 0; it must be an integer of at least 1"),
        ({"degree": 1.5}, "degree is 1.5; it must be an integer"),
        ({"slow": vm.macro(2 * vm.quadrature.left)}, "weights of the slow rule sum to 2; they must sum to 1"),
        ({"fast": vm.quadrature.left}, r"fast is a bare rule; say on which grid .* macro\(rule\) or micro"),
        ({"fast": "midpoint"}, r"fast is 'midpoint'; give macro\(rule\) or micro\(rule\)"),
        ({"kinetic": vm.macro(vm.quadrature.midpoint)}, r"kinetic rule must be placed with micro"),
        ({"constraint": vm.micro(vm.quadrature.gauss(2))}, r"constraint must be held .* give"),
        ({"slow_constraint": vm.micro(vm.quadrature.trapezoidal)}, r"give macro\(lobatto\(2\)\), got micro"),
    ],
)
def test_bad_schemes(changes, message):
    fields = {"num_micro": 3, "kinetic": HALF, "slow": HALF, "fast": HALF} | changes
    with pytest.raises(vm.Refused, match=message):
        vm.Scheme(**fields)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "macro_dt is missing; give the macro step H"),
        ({"macro_dt": 0.0}, "macro_dt is 0.0; it must be a positive number"),
        ({"macro_dt": -0.1}, "macro_dt is -0.1; it must be a positive number"),
        ({"macro_dt": float("nan")}, "macro_dt is nan; it must be a positive number"),
        ({"macro_dt": 0.1, "num_steps": 0}, "num_steps is 0; it must be an integer of at least 1"),
        ({"macro_dt": 0.1, "num_steps": -4}, "num_steps is -4"),
        ({"macro_dt": 0.1, "num_steps": 10.0}, "num_steps is 10.0; it must be an integer"),
        ({"macro_dt": 0.1, "save": 0}, "save is 0; it must be an integer of at least 1, or a Save"),
        ({"macro_dt": 0.1, "save": 3}, "num_steps = 10 is not a multiple of save = 3"),
        ({"macro_dt": 0.1, "save": vm.Save(number=3)}, "not a multiple of the 3 saved intervals"),
        ({"macro_dt": 0.1, "scheme": "fully_implicit"}, "scheme is str; give a Scheme"),
        ({"macro_dt": 0.1, "state": None}, r"a System has no start; give a State, e.g. from initial_state"),
    ],
)
def test_bad_arguments_of_simulate(fpu, changes, message):
    arguments = {"scheme": vm.fully_implicit(2), "state": fpu.state(), "num_steps": 10} | changes
    with pytest.raises(vm.Refused, match=message):
        vm.simulate(fpu.system, **arguments)


@pytest.mark.compiles
def test_nan_from_a_user_function(fpu):
    system = fpu.system.replace(fast_potential=lambda q_f, params: jnp.sum(jnp.sqrt(-1.0 - q_f**2)))
    with pytest.raises(vm.SimulationError, match=r"a NaN or infinity appeared.*outside its domain") as caught:
        step(fpu, system)
    assert caught.value.step == 0


def test_bad_rules():
    for place in (vm.macro, vm.micro):
        with pytest.raises(vm.Refused, match="rule is 'midpoint'; give a Rule"):
            place("midpoint")  # pyright: ignore[reportArgumentType]
    with pytest.raises(vm.Refused, match="rule is 3; give a Rule"):
        vm.galerkin(2, 1, 3)  # pyright: ignore[reportArgumentType]
    for alpha in (2.0, -0.5, np.nan):
        for make in (vm.explicit_slow, vm.fully_explicit, vm.mollified_impulse):
            with pytest.raises(vm.Refused, match=f"alpha is {alpha}; it must be from 0 to 1: it is the part of a kick"):
                make(2, alpha)


def test_results_that_do_not_fit_into_memory(fpu):
    message = r"100000000001 saved nodes would take 1.92e\+04 GB, and .* GB of memory are free. Save fewer .*stream"
    with pytest.raises(ValueError, match=message):
        step(fpu, num_steps=10**11)
    states = jax.tree.map(lambda a: np.stack([a, a]), fpu.state())
    with pytest.raises(ValueError, match="simulate_batch: 100000000001 saved nodes of 2 runs would take 3"):
        vm.simulate_batch(fpu.system, vm.fully_implicit(2), states, macro_dt=0.1, num_steps=10**11)
