"""Orders and errors of the discrete flow of the chain and of the pendulum, and what it keeps.

Most runs have the schemes of `SCHEMES` and `NUM_SAVES` saved intervals, so that tests share compiled programs.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.support import (
    NAMES,
    NUM_SAVES,
    PROBLEMS,
    area_change,
    convergence,
    ground_truth,
    joined,
    largest_difference,
    node,
    states_near,
)
from vmri_jax.diagnostics import fit_order

SCHEMES = {
    f"{kind} alpha {alpha}": make(5, alpha)
    for kind, make in (("explicit slow", vm.explicit_slow), ("fully explicit", vm.fully_explicit))
    for alpha in (0.0, 1.0, 0.5)
}
SCHEMES["fully implicit"] = vm.fully_implicit(5)
GALERKIN = {"gauss 2": ("gauss", 2), "gauss 3": ("gauss", 3), "lobatto 3": ("lobatto", 3)}
SCHEMES |= {name: vm.galerkin(2, degree, rule) for name, (rule, degree) in GALERKIN.items()}
"""The schemes whose flow is verified; of degree 1 the rules are the midpoint and the trapezoidal one, see
`test_reductions`."""


# --- orders and errors -----------------------------------------------------------------------------------------------
TRUTH = {"fpu": "fpu3_t1", "tsp": "tsp_t1"}
TRUTH_ACCURACY = 1e-14

# Macro steps on [0, 1] inside the asymptotic range: omega H below about 1, and smaller where a first-order error of the
# momenta is at first hidden by a larger second-order one.
STEPS = {1: (3200, 6400, 12800), 2: (200, 400, 800), 4: (100, 200, 400), 6: (50, 100, 150)}
ORDERS = {name: 1 if name.endswith(("0.0", "1.0")) else 2 for name in SCHEMES}
ORDERS |= {name: 2 * degree for name, (_, degree) in GALERKIN.items()}


PENDULUM = [*(name for name in SCHEMES if "alpha" in name), "fully implicit", "gauss 2"]
"""What the pendulum is run with: all paths that constraints take; orders of other degrees are the chain's."""


@pytest.mark.parametrize(
    ("scheme", "name"),
    [(scheme, "fpu") for scheme in SCHEMES]
    + [(s, "tsp") if s in PENDULUM else pytest.param(s, "tsp", marks=pytest.mark.full) for s in SCHEMES],
)
def test_observed_order(scheme, name):
    """Least-squares slopes with the round-off plateau masked."""
    order = ORDERS[scheme]
    macro_dt, *errors = convergence(PROBLEMS[name](), SCHEMES[scheme], ground_truth(TRUTH[name]), STEPS[order])
    observed = [fit_order(macro_dt, e, floor=TRUTH_ACCURACY).order for e in errors]
    assert observed == pytest.approx([order, order], abs=0.1)  # measured 0.041, 0.2 wanted
    assert SCHEMES[scheme].order == order


RULE = vm.micro(vm.quadrature.gauss(2))
SEVERAL = {
    name: vm.Scheme(num_micro, 2, kinetic=RULE, slow=slow, fast=RULE)
    for name, slow, num_micro in (
        ("simpson", vm.macro(vm.quadrature.simpson), 2),
        ("simpson between the grids", vm.micro(vm.quadrature.simpson, every=2), 4),
        ("gauss 2, one interval", vm.macro(vm.quadrature.gauss(2)), 1),
    )
}


@pytest.mark.parametrize("name", SEVERAL)
def test_observed_order_of_rules_over_several_micro_intervals(name):
    scheme, order = SEVERAL[name], 4 if name.endswith("one interval") else 2
    macro_dt, *errors = convergence(PROBLEMS["fpu"](), scheme, ground_truth(TRUTH["fpu"]), STEPS[order])
    observed = [fit_order(macro_dt, e, floor=TRUTH_ACCURACY).order for e in errors]
    assert min(observed) == pytest.approx(order, abs=0.1)  # momenta show order 4 down to far smaller steps
    assert scheme.order == order


# An independent re-run of the reference study: FPU chain, t = 1, largest errors over all components at the end, not a
# sup over the nodes on the way, which is up to 9 times larger for the momenta (the fast momenta are worst in between).
# Scheme, order of q and p between H = 0.01 and 0.0005, errors of q at H = 0.01 and 0.001, errors of p.
TABLE = {
    "fully explicit, 0, 5": (vm.fully_explicit(5, 0.0), (0.98, 0.91), (1.0e-3, 1.1e-4), (8.5e-3, 1.0e-3)),
    "fully explicit, 1/2, 5": (vm.fully_explicit(5, 0.5), (2.00, 2.01), (4.8e-4, 4.9e-6), (1.7e-2, 1.6e-4)),
    "explicit slow, 0, 5": (vm.explicit_slow(5, 0.0), (0.99, 1.46), (1.1e-3, 1.1e-4), (3.4e-2, 8.5e-4)),
    "explicit slow, 1/2, 5": (vm.explicit_slow(5, 0.5), (2.00, 1.99), (1.0e-3, 9.9e-6), (3.1e-2, 3.2e-4)),
    "fully implicit, 5": (vm.fully_implicit(5), (2.00, 1.99), (1.0e-3, 9.9e-6), (3.1e-2, 3.2e-4)),
    "fully implicit, 10": (vm.fully_implicit(10), (2.00, 2.00), (2.5e-4, 2.5e-6), (8.0e-3, 8.1e-5)),
}


@pytest.mark.parametrize("row", TABLE)
def test_errors_and_orders_of_the_table(row):
    scheme, orders, q_errors, p_errors = TABLE[row]
    steps = (100, 200, 500, 1000, 2000)
    macro_dt, e_q, e_p = convergence(PROBLEMS["fpu"](), scheme, ground_truth("fpu3_t1"), steps, only_end=True)
    assert np.allclose(macro_dt[[0, 3]], [0.01, 0.001])
    ratios = np.array([e_q[[0, 3]] / q_errors, e_p[[0, 3]] / p_errors])
    assert np.abs(np.log(ratios)).max() < np.log(1.1)  # measured 0.96 to 1.04
    fitted = [fit_order(macro_dt, e_q).order, fit_order(macro_dt, e_p).order]
    assert fitted == pytest.approx(orders, abs=0.03)  # measured 0.011


# --- what a step keeps -----------------------------------------------------------------------------------------------
MACRO_DT = {"fpu": 0.05, "tsp": 0.02, "sam": 0.02}


@cache
def generic_state(name):
    """A state with all momenta excited, on the constraints."""
    problem = PROBLEMS[name]()
    run = vm.simulate(
        problem.system, vm.fully_implicit(5), problem.state(), macro_dt=MACRO_DT[name], num_steps=NUM_SAVES
    )
    return node(run, 20)


def one_step(name, scheme, state):
    """The first step of a run that other tests share."""
    run = vm.simulate(PROBLEMS[name]().system, scheme, state, macro_dt=MACRO_DT[name], num_steps=NUM_SAVES)
    return node(run, 1)


def area_change_of(name, scheme) -> float:
    """Of one step from the generic state."""
    problem, state = PROBLEMS[name](), generic_state(name)
    dimension = 2 * {"fpu": 6, "tsp": 7}[name]
    v_s, v_f = problem.system.kinetic.velocity(state.p_s, state.p_f)
    near = states_near(vm.Problem(problem.system, state.q_s, state.q_f, v_s, v_f, project=True), dimension)

    def ends(x):
        start = near(x)
        return start, one_step(name, scheme, start)

    return area_change(ends, dimension)


@pytest.mark.parametrize(
    ("name", "scheme"),
    [("fpu", "fully implicit"), ("fpu", "lobatto 3"), ("tsp", "fully implicit"), ("tsp", "gauss 2"), ("fpu", "radau")]
    + [(name, scheme) for name in ("fpu", "tsp") for scheme in SCHEMES if "alpha" in scheme],
)
def test_step_is_symplectic(name, scheme):
    """Radau's rule is not symmetric."""
    rules = SCHEMES | {"radau": vm.galerkin(3, 1, vm.quadrature.radau(2))}
    assert area_change_of(name, rules[scheme]) < 1e-12  # measured 1e-13


def test_the_measure_of_symplecticity_sees_drag():
    """A step that shrinks all momenta by a thousandth shrinks areas as much."""
    rng = np.random.default_rng(1)
    middle = rng.normal(size=4)

    def ends(x):
        q, p = np.split(middle + x, 2)
        return vm.State(0.0, q[:1], q[1:], p[:1], p[1:]), vm.State(1.0, q[:1], q[1:], 0.999 * p[:1], 0.999 * p[1:])

    assert area_change(ends, 4) == pytest.approx(1e-3, rel=1e-6)


def there_and_back(name, scheme):
    """A step, momenta turned, a step, momenta turned: the state between and at the end."""

    def flip(s):
        return vm.State(s.t, s.q_s, s.q_f, -s.p_s, -s.p_f)

    there = one_step(name, scheme, generic_state(name))
    return there, flip(one_step(name, scheme, flip(there)))


@pytest.mark.parametrize(
    ("name", "scheme"),
    [("fpu", SCHEMES["explicit slow alpha 0.5"]), ("fpu", SEVERAL["simpson"]), ("fpu", SCHEMES["lobatto 3"])]
    + [
        ("tsp", SCHEMES[s])
        for s in ("fully implicit", "explicit slow alpha 0.5", "fully explicit alpha 0.5", "gauss 2")
    ],
)
def test_symmetric_schemes_are_reversible(name, scheme):
    state = generic_state(name)
    there, back = there_and_back(name, scheme)
    worst = max(largest_difference(getattr(back, k), getattr(state, k)) for k in NAMES)
    assert largest_difference(there.q_f, state.q_f) > 1e-3
    assert worst < 1e-11  # measured 4e-16 (FPU), 2e-13 (TSP)


def test_schemes_with_one_sided_rules_are_not_reversible():
    _, back = there_and_back("fpu", vm.fully_explicit(5, 0.0))
    assert largest_difference(back.q_f, generic_state("fpu").q_f) > 1e-5


# --- what long runs keep ---------------------------------------------------------------------------------------------
LONG = {
    "fully implicit": vm.fully_implicit(5),
    "explicit slow": vm.explicit_slow(5),
    "fully explicit": vm.fully_explicit(5),
}


def long_run(system, scheme, state):
    """10 000 steps and 100 saved intervals, in two runs of `NUM_SAVES`."""
    pieces = []
    for _ in range(2):
        pieces.append(vm.simulate(system, scheme, state, macro_dt=0.01, num_steps=100 * NUM_SAVES, save=100))
        state = pieces[-1].final_state
    return joined(pieces)


def bodies(run):
    """Positions and momenta (nodes, 3) of each body of the pendulum; `tests/test_diagnostics.py` has `momentum_map`."""
    q, p = np.concatenate([run.q_s, run.q_f], axis=1), np.concatenate([run.p_s, run.p_f], axis=1)
    return [(q[:, i : i + 3], p[:, i : i + 3]) for i in (0, 3, 6)]


@cache
def run_of(name, scheme):
    problem = PROBLEMS[name]()
    return long_run(problem.system, LONG[scheme], problem.state())


@pytest.mark.parametrize("scheme", LONG)
def test_angular_momentum_and_constraints_of_the_pendulum_over_10000_steps(scheme):
    run = run_of("tsp", scheme)
    along_z = np.sum([np.cross(q, p)[:, 2] for q, p in bodies(run)], axis=0)
    assert np.abs(along_z / along_z[0] - 1).max() < 1e-12  # measured 2.4e-13
    position, velocity = np.asarray(run.constraint_residual).max(axis=0)
    assert position < 2e-13  # measured 2.2e-14, 1e-12 wanted
    assert velocity < 2e-13  # measured 2.3e-14, 1e-10 wanted


def only_differences(q_s, q_f, params):
    q = jnp.concatenate([q_s, q_f]).reshape(-1, 3)
    return jnp.sum(jnp.sum((q[1:] - q[:-1]) ** 2, axis=1) ** 2)


@pytest.mark.parametrize("scheme", [vm.explicit_slow(5), vm.galerkin(2, 2)], ids=["explicit slow", "gauss 2"])
def test_linear_momentum_of_free_bodies(scheme):
    """Of the pendulum without its pivot: slow and fast variables push each other on both grids."""
    system = PROBLEMS["tsp"]().system.replace(slow_potential=only_differences, slow_constraint=None)
    run = vm.simulate(system, scheme, generic_state("tsp"), macro_dt=0.005, num_steps=200)
    momenta = [p for _, p in bodies(run)]
    total = np.sum(momenta, axis=0)
    assert largest_difference(momenta[0][-1], momenta[0][0]) > 0.01
    assert largest_difference(total, total[0]) < 1e-12 * np.abs(total[0]).max()


def hanging_pendulum():
    """The triple pendulum swinging regularly, not far from hanging."""
    system = PROBLEMS["tsp"]().system
    q_s, q_f = np.array([3.0, 0.0, -9.5]), np.array([3.5, 0.5, -11.4, 3.6, 0.6, -14.4])
    v_s, v_f = np.array([0.0, 1.0, 0.0]), np.array([0.5, 1.0, 0.0, 0.0, 1.5, 0.1])
    return system, vm.initial_state(system, q_s, q_f, v_s, v_f, project=True)


@pytest.mark.parametrize("scheme", LONG)
def test_energy_of_the_pendulum_stays_in_a_band_without_drift(scheme):
    system, state = hanging_pendulum()
    check_band(long_run(system, LONG[scheme], state), ENERGY_BAND["tsp", scheme])


@pytest.mark.parametrize("scheme", LONG)
def test_energy_of_the_chain_stays_in_a_band_without_drift(scheme):
    check_band(run_of("fpu", scheme), ENERGY_BAND["fpu", scheme])


def check_band(run, largest):
    """The band of the energy, and the line fitted through it, relative to the energy at the start."""
    energy = np.asarray(run.energy) / abs(float(run.energy[0]))
    band = np.ptp(energy)
    drift = np.polyfit(np.asarray(run.t) / float(run.t[-1]), energy, 1)[0]
    assert band < largest
    assert abs(drift) < 0.2 * band  # measured 0.08


ENERGY_BAND = {  # measured: 1.1e-6, 1.6e-6, 1.6e-6; 2.9e-5, 7.7e-4, 1.5e-3
    ("tsp", "fully implicit"): 3e-6,
    ("tsp", "explicit slow"): 3e-6,
    ("tsp", "fully explicit"): 3e-6,
    ("fpu", "fully implicit"): 1e-4,
    ("fpu", "explicit slow"): 2e-3,
    ("fpu", "fully explicit"): 4e-3,
}
