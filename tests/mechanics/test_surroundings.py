"""Functions of users that change, and functions that are not pure: a run uses what its functions say when it is
made."""

import dataclasses
import itertools
import random
import sys
import time
from enum import Enum, IntEnum
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from jax.extend.core import jaxpr_as_fun

import vmri_jax as vm
from vmri_jax.control.transcription import Transcription
from vmri_jax.ensembles.quantities import of_lanes, quantity
from vmri_jax.mechanics.functions import TracedOnce, traced_once

STRENGTH = 1.0
NUMBERS = np.ones(2)
TABLE = {"k": [1.0, 2.0]}
FILLED: dict[str, float] = {}
module = ModuleType("a_module_of_the_user")
sys.modules[module.__name__] = module
module.K = 1.0  # pyright: ignore[reportAttributeAccessIssue]
settings = SimpleNamespace(k=1.0)
here: Any = sys.modules[__name__]


def strength():
    return STRENGTH


def inner():
    return 1.0


def outer():
    return inner()


class Spring:
    of_all = 1.0

    def __init__(self, k=1.0):
        self.k, self.calls = k, 0

    def energy(self, q_s, q_f, params):
        return self.stiffness() * q_s[0] ** 2 / 2

    def stiffness(self):
        return self.k * self.of_all * self.doubled / 2

    @property
    def doubled(self):
        return 2.0

    def __call__(self, q_s, q_f, params):
        self.calls += 1
        return self.energy(q_s, q_f, params)


@dataclasses.dataclass
class Law:
    k: float = 1.0

    def __mul__(self, x):
        return self.k * x


def by_import(q_s, q_f, params):
    from a_module_of_the_user import K  # pyright: ignore[reportMissingImports]

    return K * q_s[0] ** 2 / 2


law = Law()


def by_global(q_s, q_f, params):
    return STRENGTH * q_s[0] ** 2 / 2


def by_default(q_s, q_f, params, k=1.0):
    return k * q_s[0] ** 2 / 2


def by_own_attribute(q_s, q_f, params):
    return by_own_attribute.k * q_s[0] ** 2 / 2


by_own_attribute.k = 1.0


def keyword(q_s, q_f, params, k):
    return k * q_s[0] ** 2 / 2


def closure():
    k = 1.0

    def energy(q_s, q_f, params):
        def twice():
            return 2 * k

        return twice() * q_s[0] ** 2 / 4

    def change(new):
        nonlocal k
        k = new

    return energy, change


def setting(owner, name):
    return lambda value: setattr(owner, name, value)


def entry(container, key):
    return lambda value: container.__setitem__(key, value)


def changes():
    """For each kind of surroundings a function of stiffness 1, and a change to another stiffness."""
    spring, again = Spring(), Spring()
    energy, change = closure()
    table, series = np.ones(()), pd.Series({"k": 1.0})
    return {
        "global": (by_global, setting(here, "STRENGTH")),
        "helper": (lambda q, *_: strength() * q[0] ** 2 / 2, lambda k: setattr(here, "strength", lambda: k)),
        "helper of a helper": (lambda q, *_: outer() * q[0] ** 2 / 2, lambda k: setattr(here, "inner", lambda: k)),
        "array written in place": (lambda q, *_: NUMBERS[0] * q[0] ** 2 / 2, entry(NUMBERS, 0)),
        "attribute of a module": (lambda q, *_: module.K * q[0] ** 2 / 2, setting(module, "K")),
        "import inside of the function": (by_import, setting(module, "K")),
        "entry of a list in a dictionary": (lambda q, *_: TABLE["k"][0] * q[0] ** 2 / 2, entry(TABLE["k"], 0)),
        "attribute by a text": (
            lambda q, *_: getattr(settings, "k") * q[0] ** 2 / 2,  # noqa: B009
            setting(settings, "k"),
        ),
        "default": (by_default, lambda k: setattr(by_default, "__defaults__", (k,))),
        "operator of a dataclass": (lambda q, *_: law * q[0] ** 2 / 2, setting(law, "k")),
        "attribute of the function": (by_own_attribute, setting(by_own_attribute, "k")),
        "table of pandas": (lambda q, *_: series["k"] * q[0] ** 2 / 2, entry(series, "k")),
        "partial": (partial(keyword, k=table), table.fill),
        "closure": (energy, change),
        "attribute of self": (spring.energy, setting(spring, "k")),
        "object that is called": (again, setting(again, "k")),
        "attribute of a class": (Spring().energy, setting(Spring, "of_all")),
        "property": (Spring().energy, lambda k: setattr(Spring, "doubled", property(lambda self: 2.0 * k))),
        "method": (Spring().energy, lambda k: setattr(Spring, "stiffness", lambda self: k)),
    }


@pytest.fixture(autouse=True)
def restored():
    """All globals as they were."""
    attributes = dict(vars(Spring))
    before = {name: getattr(here, name) for name in ("STRENGTH", "strength", "inner", "law")}
    yield
    for name, value in before.items():
        setattr(here, name, value)
    for name in ("of_all", "doubled", "stiffness"):
        setattr(Spring, name, attributes[name])
    NUMBERS[0] = TABLE["k"][0] = module.K = settings.k = law.k = 1.0  # pyright: ignore
    by_default.__defaults__ = (1.0,)  # pyright: ignore[reportFunctionMemberAccess]
    FILLED.clear()


def slope(function):
    """The stiffness of an energy: its second derivative, by a program that JAX keeps for equal systems.

    The program is traced, which asks for one that is kept as a call does, and not compiled.
    """
    system = vm.System(vm.ConstantMass([1.0], []), function)
    (stiffness,) = jaxpr_as_fun(second_derivative.trace(system).jaxpr)(*jax.tree.leaves(system))
    return float(stiffness)


@jax.jit
def second_derivative(system):
    programs.append(system)
    return jax.hessian(lambda q: system.slow_potential(q, jnp.zeros(0), None))(jnp.ones(1))[0, 0]


programs = []


@pytest.mark.parametrize("kind", changes())
def test_a_program_is_made_anew_where_surroundings_change_and_only_there(kind):
    function, change = changes()[kind]
    assert slope(function) == 1.0
    programs.clear()
    assert slope(function) == 1.0
    assert not programs
    change(4.0)
    assert slope(function) == 4.0
    assert slope(function) == 4.0
    assert len(programs) == 1
    change(1.0)
    assert slope(function) == 1.0


def test_functions_of_one_code_with_equal_surroundings_share_their_programs():
    def made(k):
        return lambda q_s, q_f, params: k * q_s[0] ** 2 / 2

    assert TracedOnce(made(2.0)) == TracedOnce(made(2.0)) != TracedOnce(made(2))
    assert TracedOnce(made(0.0)) != TracedOnce(made(-0.0))
    assert TracedOnce(made(np.arange(3.0))) == TracedOnce(made(np.arange(3.0))) != TracedOnce(made(np.arange(3)))
    assert TracedOnce(made(jnp.arange(999.0))) == TracedOnce(made(jnp.arange(999.0)))
    assert TracedOnce(Spring(2.0).energy) == TracedOnce(Spring(2.0).energy) != TracedOnce(Spring(3.0).energy)


def test_circles_end():
    a, b = SimpleNamespace(k=1.0), [1.0]
    a.itself, b[0:] = a, [b, a]
    reads = TracedOnce(lambda: (a, b))
    before = reads._key
    assert reads._key == before
    a.k = 2.0
    assert reads._key != before


def filled(q_s, q_f, params):
    """An energy with a table that it fills on demand."""
    if "k" not in FILLED:
        FILLED["k"] = 2.0
    return FILLED["k"] * q_s[0] ** 2 / 2


def test_what_a_function_writes_itself_is_no_change():
    log, spring = [], Spring()
    for function in (filled, lambda *q: (log.append(len(log)), spring(*q))[1]):
        assert slope(function) == slope(function)
        programs.clear()
        slope(function)
        assert not programs
    assert spring.calls == 1
    FILLED["k"] = 3.0
    assert slope(filled) == 3.0


class Order(IntEnum):
    SOFT = 1
    HARD = 3


class Material(Enum):
    SOFT = 1.0
    HARD = 3.0


class Stiffness(float):
    """A number of a class of the user."""


class Bound(partial):
    """A function of a class of the user with an argument that it knows."""


class Sum:
    def __init__(self, k):
        self.k = k

    def add(self, q_s):
        return self.k * q_s[0] ** 2 / 2


@pytest.mark.parametrize(
    "made",
    [
        lambda hard: Bound(scaled, Order.HARD if hard else Order.SOFT),
        lambda hard: partial(scaled_by_value, Material.HARD if hard else Material.SOFT),
        lambda hard: partial(scaled, Stiffness(3.0 if hard else 1.0)),
        lambda hard: added(Sum(3.0 if hard else 1.0)),
    ],
    ids=["enumeration in a subclass of partial", "value of an enumeration", "subclass of float", "add"],
)
def test_values_of_derived_classes_and_methods_called_as_those_of_logs_count(made):
    assert (slope(made(False)), slope(made(True))) == (1.0, 3.0)


def scaled(k, q_s, q_f, params):
    return float(k) * q_s[0] ** 2 / 2


def scaled_by_value(material, q_s, q_f, params):
    return material.value * q_s[0] ** 2 / 2


def added(law):
    return lambda q_s, q_f, params: law.add(q_s)


def test_starts_keep_their_numbers_when_arrays_of_the_user_change():
    system = vm.System(vm.ConstantMass(np.ones(1000), []))
    for _ in range(5):  # JAX takes the memory of some arrays, as they lie
        q, state = np.full(1000, 0.5), None
        state = vm.initial_state(system, q, [])
        q[:] = 9.0
        assert np.array_equal(state.q_s, np.full(1000, 0.5))
        assert np.array_equal(vm.initial_state(system, np.full(1000, 0.5), []).q_s, np.full(1000, 0.5))


STEPS = {"macro_dt": 0.1, "num_steps": 3}
SCHEME = vm.fully_explicit(1)


def by_params(q_s, q_f, params):
    return params * q_s[0] ** 2 / 2


def by_both(q_s, q_f, params):
    return STRENGTH * params * q_s[0] ** 2 / 2


def problem(function=by_global, k=None):
    return vm.Problem(vm.System(vm.ConstantMass([1.0], []), function, params=k), [1.0], [])


def simulated(_):
    return vm.simulate(problem(), SCHEME, **STEPS).q_s[-1, 0]


def prepared(_):
    return vm.prepare(problem(), SCHEME, **STEPS)().q_s[-1, 0]


def streamed(folder):
    stored = vm.stream(problem(), SCHEME, out=folder / str(STRENGTH), **STEPS)
    return stored[:].q_s[-1, 0]


def in_a_batch(_):
    states = jax.tree.map(lambda a: np.asarray(a)[None], problem().state())
    return vm.simulate_batch(problem().system, SCHEME, states, **STEPS).q_s[0, -1, 0]


def differentiated(_):
    def end(q):
        state = dataclasses.replace(problem().state(), q_s=q)
        return vm.simulate(problem().system, SCHEME, state, **STEPS).q_s[-1, 0]

    return jax.grad(end)(jnp.ones(1))[0]  # the motion is linear in its start


def in_steps(_):
    state = problem().state()
    for _ in range(3):
        state, _ = vm.macro_step(problem().system, SCHEME, state, 0.1)
    return state.q_s[0]


def of_a_scene(_):
    ball = vm.scene.Body("ball", 1.0, [1.0])
    scene = vm.scene.Scene([ball], [vm.scene.Potential(of_a_ball, "ball")])
    return vm.simulate(scene, SCHEME, **STEPS).position("ball")[-1, 0]


def of_a_ball(q, params):
    return strength() * q[0][0] ** 2 / 2


@pytest.mark.parametrize("road", [simulated, prepared, streamed, in_a_batch, differentiated, in_steps, of_a_scene])
def test_every_road_uses_what_functions_say_now(road, tmp_path):
    for k in (1.0, 9.0):
        here.STRENGTH = k
        right = vm.simulate(problem(by_params, k), SCHEME, **STEPS).q_s[-1, 0]
        assert float(road(tmp_path)) == pytest.approx(float(right), rel=1e-14)


def by_mass(q_s, q_f, v_s, v_f, params):
    return STRENGTH * v_s[0] ** 2 / 2


def test_momenta_and_the_velocities_of_an_earlier_run():
    system = vm.System(by_mass, slow_potential=by_params, params=1.0)
    run = vm.simulate(system, SCHEME, vm.initial_state(system, [1.0], [], [2.0], []), **STEPS)
    here.STRENGTH = 4.0
    assert vm.initial_state(system, [1.0], [], [2.0], []).p_s == 8.0
    assert run.states.p_s[0] == 2.0
    assert run.v_s[0] == 2.0  # of the mass with which the run was made


def test_a_prepared_run_keeps_what_it_was_made_with():
    k = np.ones(())
    run = vm.prepare(problem(by_both, k), vm.fully_implicit(1), **STEPS)
    here.STRENGTH = k[...] = 9.0
    first = run().q_s
    exact = run.exact()  # the fallback, which is compiled only now
    np.testing.assert_allclose(exact.q_s, first, rtol=1e-14)
    here.STRENGTH = k[...] = 1.0
    np.testing.assert_array_equal(run().q_s, first)
    kept = TracedOnce(by_global).now()
    here.STRENGTH = 5.0
    with pytest.raises(ValueError, match="by_global reads something else from around it"):
        kept(jnp.ones(7), jnp.zeros(0), None)


rng, counter = np.random.default_rng(0), itertools.count()
IMPURE = {
    "a generator of random numbers": lambda q_s, q_f, params: rng.normal() * q_s[0],
    "the module of random numbers": lambda q_s, q_f, params: random.random() * q_s[0],
    "a clock": lambda q_s, q_f, params: time.perf_counter() * q_s[0],
    "a counter": lambda q_s, q_f, params: float(next(counter)) * q_s[0],
    "an array of random numbers": lambda q_s, q_f, params: jnp.sum(rng.normal(size=3) * q_s[0]),
}


@pytest.mark.parametrize("kind", IMPURE)
def test_functions_that_are_not_pure_are_refused(kind):
    with pytest.raises(ValueError, match="System: slow_potential is <lambda>, which is not pure"):
        problem(IMPURE[kind]).state()


class Controller:
    """A force that counts its calls."""

    calls = 0

    def __call__(self, t, q_s, q_f, v_s, v_f, params):
        self.calls += 1
        return self.calls * q_s, q_f


def test_controllers_with_a_state_and_functions_of_runs_that_are_not_pure_are_refused():
    system = vm.System(vm.ConstantMass([1.0], []), force=Controller())
    with pytest.raises(ValueError, match=r"System: force is Controller, which is not pure: .* belongs in coordinates"):
        vm.simulate(vm.Problem(system, [1.0], []), SCHEME, **STEPS)
    with pytest.raises(ValueError, match="error returns other numbers for the same run"):
        vm.simulate(problem(), SCHEME, **STEPS, error=lambda run: run.q_s[-1] + rng.normal())


TRANSFORMATIONS = {
    "grad": lambda f: jax.grad(f)(1.0),
    "jit": lambda f: jax.jit(f)(1.0),
    "grad in jit": lambda f: jax.jit(jax.grad(f))(1.0),
    "vmap": lambda f: jax.vmap(f)(jnp.ones(2)),
}


@pytest.mark.parametrize("kind", TRANSFORMATIONS)
@pytest.mark.parametrize("held", ["number", "list"])
def test_functions_that_close_over_traced_numbers_are_refused_everywhere(kind, held):
    state = problem().state()

    def end(k):
        stiffness = {"number": k, "list": [k]}[held]

        def energy(q_s, q_f, params):
            return jnp.sum(jnp.asarray(stiffness)) * q_s[0] ** 2 / 2

        system = vm.System(vm.ConstantMass([1.0], []), energy)
        return vm.simulate(system, SCHEME, state, **STEPS).q_s[-1, 0]

    with pytest.raises(ValueError, match=r"energy reads stiffness, which jax\.grad, jit, vmap or jvp traces"):
        TRANSFORMATIONS[kind](end)


def of_run(run):
    return STRENGTH * run.q_s[-1]


def test_quantities_that_ensembles_keep_say_what_their_functions_say_now():
    quantities = [quantity(f"{__name__}:of_run")]
    run = vm.simulate(problem(), SCHEME, **STEPS)
    lanes = jax.device_put(jax.tree.map(lambda a: np.asarray(a)[None], run))
    for here.STRENGTH in (1.0, 2.0):
        np.testing.assert_array_equal(of_lanes(quantities, lanes)["of_run"][0], here.STRENGTH * run.q_s[-1])


def test_the_functions_of_control_and_of_solvers_are_watched():
    custom = vm.Solver(stepper=by_global)
    f = traced_once(by_global)
    optimal = Transcription(
        problem().system, problem().state(), SCHEME, vm.Solver(), 0.1, f, f, f, f, (np.zeros(1), np.ones(1)), 1, f
    )
    for value in (custom, optimal):
        here.STRENGTH = 1.0
        before = jax.tree.structure(value)
        assert jax.tree.structure(value) == before
        here.STRENGTH = 2.0
        assert jax.tree.structure(value) != before
