"""The nested march and the other methods: same solution, few passes, honest about what they did."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from vmri_jax.steppers.newton.extrapolation import Differences, Line
from vmri_jax.steppers.newton.secant import Pairs
from vmri_jax.steppers.newton.slow import ENOUGH, minimal_residuals
from vmri_jax.steppers.step import Memory, advance, start_memory

from tests.support import compiled_step, largest_difference
from tests.user_systems import bent_system, double_pendulum, two_oscillators
from vmri_jax import (
    ConstantMass,
    Method,
    Newton,
    Result,
    Scheme,
    System,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    galerkin,
    initial_state,
    macro,
    micro,
    quadrature,
    simulate,
    systems,
)
from vmri_jax.steppers.newton import interval

METHODS = ["nested", pytest.param("auto", marks=pytest.mark.full)]


def ends_differ(a, b) -> float:
    """Largest relative difference of two final states."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(largest_difference(x, y) / (1e-300 + float(np.abs(y).max(initial=0))) for x, y in pairs if x.size)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt"),
    [
        ("fpu", galerkin(4, 2), 0.04),
        ("fpu", explicit_slow(4), 0.04),
        ("tsp", galerkin(3, 2, "lobatto"), 0.006),
        ("tsp", galerkin(2, 3), 0.006),
        ("sam", fully_explicit(5), 0.002),
        pytest.param("sam", galerkin(2, 2), 0.002, marks=pytest.mark.full),
    ],
)
def test_methods_agree_with_the_exact_one(name, scheme, macro_dt, method, request):
    problem = request.getfixturevalue(name)

    def end(method):
        newton = Newton(method)
        return simulate(
            problem.system, scheme, problem.state(), macro_dt=macro_dt, num_steps=20, save_every=20, newton=newton
        )

    assert ends_differ(end(method).final_state, end("arrowhead").final_state) < 1e-11  # measured 1e-12


@pytest.mark.parametrize("tolerance", [1e-3, 1e-9])
@pytest.mark.parametrize(
    ("name", "scheme", "macro_dt"),
    [("fpu", galerkin(4, 2), 0.1), ("tsp", fully_explicit(5), 0.02), ("sam", explicit_slow(5), 0.01)],
)
def test_what_is_accepted_is_within_the_tolerance(name, scheme, macro_dt, tolerance, request):
    problem = request.getfixturevalue(name)

    def positions(newton):
        run = simulate(problem.system, scheme, problem.state(), macro_dt=macro_dt, num_steps=20, newton=newton)
        return np.concatenate([run.q_s, run.q_f], axis=1)

    exact = positions(Newton("arrowhead"))
    motion = np.abs(np.diff(exact, axis=0)).max()
    error = np.abs(positions(Newton("nested", tolerance)) - exact).max()
    assert error < tolerance * motion  # measured at most 0.14 of it


def test_two_passes_where_the_slow_motion_is_smooth(tsp):
    run = simulate(tsp.system, fully_explicit(10), tsp.state(), macro_dt=0.002, num_steps=500)
    assert np.asarray(run.info.iterations).mean() < 2.3  # measured 2.1


def test_light_slow_bodies_that_constraints_tie_to_fast_ones():
    """Were the slow equations solved with the slow masses alone, it would be 5.8."""
    problem = systems.triple_spherical_pendulum(masses=(1.0, 1.0, 1.0))
    run = simulate(problem.system, fully_explicit(10), problem.state(), macro_dt=0.01, num_steps=300)
    assert run.info.iterations.mean() < 5.5  # measured 4.6


def test_extrapolation_takes_the_order_that_was_best():
    n = np.arange(12.0)
    smooth, rough = 2 - n + 0.5 * n**3, np.random.default_rng(0).normal(size=12)
    for values, error in ((smooth, 1e-10), (rough, 5.0)):
        past = Differences.constant(jnp.asarray(values[:1]))
        for x in values[1:-1]:
            past = past.add(jnp.asarray([x]), 1)
        assert abs(past.next(1)[0] - values[-1]) < error
    rough, past, missed = np.random.default_rng(0).normal(size=200), Differences.constant(jnp.zeros(1)), []
    next_value, add = jax.jit(lambda past: past.next(1)), jax.jit(lambda past, x: past.add(x, 1))
    for x in rough:
        missed.append(abs(float(next_value(past)[0]) - x))
        past = add(past, jnp.asarray([x]))
    assert np.mean(missed) < 1.5  # measured 1.2; 2.3 if the last step alone decided on the order
    gap = past.add(jnp.asarray([jnp.nan]), 1).add(jnp.asarray([7.0]), 1)
    assert gap.next(1)[0] == 7.0  # a step that failed leaves no trace in the ones after


def drag(t, q_s, q_f, v_s, v_f, params):
    return -0.1 * v_s, -0.2 * v_f * jnp.sum(v_f**2)


def strong_drag(t, q_s, q_f, v_s, v_f, params):
    return -5.0 * v_s, 0.0 * v_f


def skew(q_f, params):
    return jnp.sum(jnp.cosh(q_f)) + 10 * (q_f[0] - q_f[1]) ** 2


def link(q_s, q_f, params):
    return jnp.stack([jnp.sum((q_f[:2] - q_s) ** 2) - 2.0])


@pytest.mark.full
def test_full_masses_forces_and_coupled_fast_potential():
    mass = ConstantMass(jnp.array([[5.0, 1.0], [1.0, 4.0]]), jnp.array([[1.0, 0.2, 0], [0.2, 1.0, 0.1], [0, 0.1, 2.0]]))
    system = System(mass, fast_potential=skew, constraint=link, force=drag)
    state = initial_state(system, [0.0, 0.0], [1.0, 1.0, 0.3], [0.1, 0.2], [0.0, 0.3, -0.2])
    for scheme in (fully_implicit(4), galerkin(2, 2)):
        ends = [compiled_step(system, scheme, state, 0.1, Newton(method))[0] for method in ("nested", "arrowhead")]
        assert ends_differ(*ends) < 1e-12  # measured 1e-15


def test_macro_steps_in_which_slow_forces_turn_over():
    """At H = 1 what V answers is as large as the masses: by the masses alone the march does not converge."""
    problem = systems.fermi_pasta_ulam(10)
    run = simulate(
        problem.system, fully_implicit(100), problem.state(), macro_dt=1.0, num_steps=20, newton=Newton("nested")
    )
    assert run.info.iterations.max() < 16  # measured 10


@pytest.mark.parametrize("degree", [1, 2])
def test_forces_on_slow_variables_cost_few_passes(degree):
    """Potential and damping: by the masses alone it would be 77 and 31."""
    problem = two_oscillators()
    system = problem.system.replace(force=strong_drag)
    run = simulate(system, galerkin(20, degree), problem.state(), macro_dt=0.2, num_steps=20, newton=Newton("nested"))
    assert run.info.iterations.mean() < 7.5  # measured 6.3 and 6.4


def test_minimal_residuals_solve_a_linear_problem():
    """Not symmetric, and close to one."""
    matrix = jnp.eye(5) + 0.03 * jnp.asarray(np.random.default_rng(0).normal(size=(5, 5)))
    b = jnp.arange(1.0, 6.0)
    x = minimal_residuals(lambda x: matrix @ x, b)
    assert largest_difference(matrix @ x, b) < 5 * ENOUGH  # of the largest entry of b
    assert np.array_equal(minimal_residuals(lambda x: matrix @ x, 0 * b), 0 * b)


def test_a_line_expects_what_stands_out():
    """A line with a jump at the start of every macro step goes on exactly."""
    line, value = Line.zero((), stands_out=True), lambda k: 3.0 + 0.5 * k + 7.0 * (k % 4 == 0)
    missed = []
    for first in range(0, 20, 4):
        within = line
        for m in range(4):
            missed.append(abs(float(within.next(m)) - value(first + m)))
            within = within.add(m, value(first + m))
        line = line.after_step(jnp.stack([value(first + m) for m in range(4)]))
    assert max(missed[:8]) > 5.0
    assert max(missed[12:]) < 1e-12


def test_two_passes_where_slow_motion_is_smooth():
    """Were micro intervals to start straight, without the bends of those before, it would be 2.6."""
    problem = systems.triple_spherical_pendulum()
    for scheme in (fully_implicit(10), explicit_slow(10)):
        run = simulate(problem.system, scheme, problem.state(), micro_dt=2e-4, num_steps=1000)
        assert run.info.iterations.mean() < 2.1  # measured 2.04


def test_equal_masses_converge():
    """Fast and slow parts of one weight: nothing is weak about the coupling."""
    problem = systems.triple_spherical_pendulum(masses=(1.0, 1.0, 1.0), stiffness=50.0)
    run = simulate(problem.system, fully_implicit(10), problem.state(), macro_dt=0.1, num_steps=50)
    assert int(run.info.method.max()) == Method.MARCH
    passes = run.info.iterations
    assert passes.mean() < 11  # measured 9.3
    assert passes.max() < 15  # measured 13


@pytest.mark.parametrize(
    ("scheme", "method"),
    [
        (fully_explicit(4), Method.EXPLICIT),
        (explicit_slow(4), Method.LINEAR),
        (fully_implicit(4), Method.MARCH),
    ],
)
def test_info_says_how_a_step_was_solved(fpu, scheme, method):
    assert int(compiled_step(fpu.system, scheme, fpu.state(), 0.01, Newton())[1].method) == method


def test_terms_inside_the_macro_interval_take_the_arrowhead(fpu):
    rule = micro(quadrature.midpoint)
    scheme = Scheme(4, kinetic=rule, slow=macro(quadrature.gauss(2)), fast=rule)
    assert int(compiled_step(fpu.system, scheme, fpu.state(), 0.01, Newton())[1].method) == Method.ARROWHEAD
    with pytest.raises(ValueError, match="method 'nested' needs a ConstantMass, and potentials"):
        simulate(fpu.system, scheme, fpu.state(), macro_dt=0.01, num_steps=1, newton=Newton("nested"))


def test_kinetic_functions_take_the_arrowhead():
    problem = double_pendulum()
    info = compiled_step(problem.system, fully_implicit(3), problem.state(), 0.01, Newton())[1]
    assert int(info.method) == Method.ARROWHEAD


def test_auto_falls_back_where_the_march_does_not_converge(fpu):
    """At H = 2 the curvature of V outweighs the mass of the slow variables."""
    problem, newton = two_oscillators(kappa=25.0), Newton(max_iterations=6)
    scheme, state = fully_implicit(20), problem.state()
    march = compiled_step(problem.system, scheme, state, 40.0, Newton("nested", max_iterations=6))[1]
    assert int(march.result) == Result.STAGNATED
    end, info = compiled_step(problem.system, scheme, state, 40.0, newton)
    exact, _ = compiled_step(problem.system, scheme, state, 40.0, Newton("arrowhead"))
    assert int(info.method) == Method.ARROWHEAD
    assert ends_differ(end, exact) < 1e-12
    run = simulate(problem.system, scheme, state, macro_dt=40.0, num_steps=3, newton=newton)
    assert run.success
    assert int(run.info.method.max()) == Method.ARROWHEAD
    inside = jax.jit(lambda state: simulate(problem.system, scheme, state, macro_dt=40.0, num_steps=3, newton=newton))
    assert int(inside(state).info.method.max()) == Method.ARROWHEAD
    assert largest_difference(inside(state).q_f, run.q_f) < 1e-11


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
        return simulate(tsp.system, fully_explicit(5), state, macro_dt=0.001, num_steps=5).q_f

    found = list(loops_around(jax.make_jaxpr(run)(tsp.state()).jaxpr, "eigh"))
    assert found
    assert all(around[:1] == ("cond",) for around in found)


def test_a_fallback_keeps_what_was_computed(fpu):
    """The run goes on from the last saved node, with the same trajectory as the exact method."""
    scheme = fully_implicit(100)
    free = simulate(fpu.system, scheme, fpu.state(), macro_dt=1.0, num_steps=20)
    first = int(free.info.iterations[0])
    assert first < int(free.info.iterations.max())
    run = simulate(fpu.system, scheme, fpu.state(), macro_dt=1.0, num_steps=20, newton=Newton(max_iterations=first))
    exact = simulate(fpu.system, scheme, fpu.state(), macro_dt=1.0, num_steps=20, newton=Newton("arrowhead"))
    methods = np.asarray(run.info.method)
    assert methods[0] == Method.MARCH
    assert Method.ARROWHEAD in methods
    assert largest_difference(run.q_f[:10], exact.q_f[:10]) < 1e-8  # errors grow fast at this step; measured 1e-10


@pytest.mark.parametrize("method", ["nested", "arrowhead"])
def test_fixed_iterations(tsp, method):
    def run(count):
        newton = Newton(method, fixed_iterations=count)
        return simulate(
            tsp.system, fully_explicit(5), tsp.state(), macro_dt=0.002, num_steps=20, newton=newton, throw=False
        )

    free = simulate(tsp.system, fully_explicit(5), tsp.state(), macro_dt=0.002, num_steps=20)
    enough = run(6)
    assert enough.success
    assert np.all(np.asarray(enough.info.iterations) == 6)
    assert largest_difference(enough.q_f, free.q_f) < 1e-12  # measured 2e-15
    assert Result(int(run(1).result)) is Result.STAGNATED


def test_the_matrix_of_the_micro_intervals_is_the_derivative(tsp, fpu):
    """Of the rows by the increments, for all coordinates at once and for each alone."""
    from vmri_jax.schemes.equations import StepEquations
    from vmri_jax.steppers.newton.linearization import linearize

    for problem, scheme in ((tsp, galerkin(2, 2)), (fpu, fully_implicit(2)), (fpu, explicit_slow(2))):
        state = problem.state()
        equations = StepEquations(problem.system, scheme, 0.0, state.q_s, state.q_f, state.p_s, state.p_f, 0.01)
        matrix = interval.interval_matrix(equations)
        r, n_f = scheme.degree, state.q_f.size
        system, local = interval.interval_problem(problem.system, scheme)
        if problem is fpu:  # V is left out there
            system = system.replace(slow_potential=None)
        eqs = StepEquations(system, local, 0.0, state.q_s, state.q_f, state.p_s, state.p_f, 0.005)
        v_s, v_f = interval.constant_mass(system).velocity(state.p_s, state.p_f)
        x = eqs.guess(v_s, v_f, jnp.zeros(int(problem is tsp)), jnp.zeros(0))
        block = linearize(eqs, x).ff[0, :, :, 1:]
        rows = jnp.asarray(np.random.default_rng(0).normal(size=(r, n_f)))
        inc = matrix.solve(rows)
        assert largest_difference(jnp.einsum("iajb,jb->ia", block[:-1], inc), rows) < 1e-13
        assert largest_difference(jnp.einsum("ajb,jb->a", block[-1], inc), matrix.outgoing(inc)) < 1e-13


def test_constant_and_linear_parts_are_recognised(fpu, tsp):
    q_s, q_f, none = fpu.q_s, fpu.q_f, jnp.zeros(0)
    assert interval.is_constant(fpu.system, fully_implicit(3), q_s, q_f)
    assert not interval.is_linear(fpu.system, fully_implicit(3), q_s, q_f)
    fast = fpu.system.replace(slow_potential=None, kinetic=ConstantMass(none, jnp.ones(3)))
    assert interval.is_linear(fast, fully_implicit(1), none, q_f)
    assert interval.is_constant(tsp.system, fully_explicit(3), tsp.q_s, tsp.q_f)
    assert not interval.is_constant(tsp.system, fully_implicit(3), tsp.q_s, tsp.q_f)
    assert not interval.can_be_cut(bent_system(), fully_implicit(3))


def test_secant_pairs_solve_a_linear_problem():
    """After as many pairs as dimensions the update is exact."""
    matrix = jnp.array([[1.0, 0.4, 0.0], [0.1, 0.7, 0.2], [0.0, 0.3, 1.2]])
    target = jnp.array([1.0, -2.0, 0.5])
    x, pairs, last = jnp.zeros(3), Pairs.none(3), None
    for _ in range(5):
        d = target - matrix @ x
        if last is not None:
            pairs = pairs.add(x - last[0], d - last[1], 1e-14, 3)
        last = x, d
        x = x + pairs.corrected(d, 3)
    assert largest_difference(matrix @ x, target) < 1e-12  # measured 3e-16


def test_no_library_call_in_a_compiled_run(tsp):
    """The loop over macro steps of a small constrained system has no call out of it."""
    run = jax.jit(
        lambda state: simulate(
            tsp.system, fully_explicit(5), state, macro_dt=0.001, num_steps=5, newton=Newton("nested")
        )
    )
    text = str(run.lower(tsp.state()).compile().as_text())
    assert "custom-call" not in text
    assert " dot(" not in text


def test_a_large_matrix_is_renewed_when_it_costs_passes(tsp):
    """18 rows: kept from step to step, renewed after a step of too many passes; small ones are renewed by every step."""
    system, state, newton = tsp.system, tsp.state(), Newton("nested")

    def matrices(scheme):
        memory, now, found = start_memory(system, scheme, state, 0.02, newton), state, []
        for passes in (None, None, 50):  # the last step finds that the one before took many
            assert isinstance(memory, Memory)
            if passes is not None:
                memory = memory._replace(warm=memory.warm._replace(passes=memory.warm.passes.at[1].set(passes)))
            now, info, memory = jax.jit(advance)(system, scheme, now, 0.02, newton, memory)
            assert int(info.result) == Result.CONVERGED
            found.append(np.asarray(memory.matrix.inverse))
        return found

    first, second, third = matrices(galerkin(2, 3))
    assert first.shape == (18, 18)
    assert np.array_equal(first, second)
    assert not np.array_equal(second, third)
    first, second, _ = matrices(galerkin(2, 2))
    assert first.shape == (12, 12)
    assert not np.array_equal(first, second)
