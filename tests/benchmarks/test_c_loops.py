"""The C loops of the benchmarks compute what `simulate` computes."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from benchmarks import c_loops
from tests.support import relative_difference

needs_compiler = pytest.mark.skipif(c_loops.compiler() is None, reason="no C compiler (cc, gcc or clang) on the PATH")


def difference(loop, problem, num_micro, micro_dt, num_steps):
    """Largest relative difference of (q_s, q_f, p_s, p_f) at the end from those of `simulate`."""
    scheme = vm.fully_explicit(num_micro)
    steps = {"macro_dt": num_micro * micro_dt, "num_steps": num_steps, "save": num_steps}
    run = vm.simulate(problem.system, scheme, problem.state(), **steps)
    ends = (run.q_s[-1], run.q_f[-1], run.p_s[-1], run.p_f[-1])
    return max(relative_difference(a, np.asarray(b)) for a, b in zip(loop(), ends, strict=True))


@needs_compiler
@pytest.mark.parametrize("num_micro", [1, 7])
@pytest.mark.parametrize("num_springs", [1, 3, 50, 65, 200])  # with and without vectors, and numbers left over
def test_chain(num_springs, num_micro):
    """From a start that leaves no spring at rest."""
    q_s, q_f, v_s, v_f = np.random.default_rng(0).normal(size=(4, num_springs))
    problem = dataclasses.replace(vm.systems.fermi_pasta_ulam(num_springs), q_s=q_s, q_f=q_f / 50, v_s=v_s, v_f=v_f)
    loop = c_loops.fpu(problem, num_micro, 1e-3, 100)
    assert difference(loop, problem, num_micro, 1e-3, 100) < 5e-14  # measured 6e-15
    assert loop.run()[1] == 0


@needs_compiler
@pytest.mark.parametrize(
    ("loop", "problem"),
    [
        (c_loops.tsp, vm.systems.triple_spherical_pendulum()),
        (c_loops.tsp, vm.systems.triple_spherical_pendulum((5.0, 2.0, 1.0), 300.0, (4.0, 1.0, 2.0), 1.0)),
        (c_loops.sam, vm.systems.simple_atomic_model()),
        (c_loops.sam, vm.systems.simple_atomic_model((10.0, 4.0, 3.0, 2.0, 1.0, 5.0), (7.0, 20.0, 300.0), 3.0, 1.0)),
    ],
)
def test_rattle(loop, problem):
    assert difference(loop(problem, 2e-4, 100), problem, 1, 2e-4, 100) < 4e-12  # measured 4e-13


@needs_compiler
@pytest.mark.parametrize("name", ["tsp", "sam"])
def test_constraints_hold(name, request):
    """Positions within the tolerance, velocities to round-off, about one Newton iteration per step."""
    problem = request.getfixturevalue(name)
    (q_s, q_f, p_s, p_f), iterations = getattr(c_loops, name)(problem, 2e-4, 5000, tolerance=1e-12).run()
    velocity = problem.system.kinetic.velocity(p_s, p_f)
    at = 0.0, jnp.asarray(q_s), jnp.asarray(q_f)
    assert float(jnp.abs(problem.system.constraints(*at)).max()) < 1.1e-12
    assert float(jnp.abs(problem.system.constraint_rates(*at, *velocity)).max()) < 1e-13  # measured 7e-15
    assert 4500 < iterations < 6000  # measured 4997 and 5000


@needs_compiler
def test_a_tolerance_below_round_off_is_an_error(tsp):
    with pytest.raises(RuntimeError, match="below the round-off"):
        c_loops.tsp(tsp, 2e-4, 100, tolerance=1e-18)()


def test_only_what_the_loops_know():
    with pytest.raises(ValueError, match="tsp: the C loop knows only the built-in system"):
        c_loops.tsp(vm.systems.triple_spherical_pendulum(quartic=True), 2e-4, 1)
    chain = vm.systems.fermi_pasta_ulam()
    heavy = chain.system.replace(kinetic=vm.ConstantMass(np.full(3, 2.0), np.ones(3)))
    with pytest.raises(ValueError, match="fpu: the C loop knows only the built-in system"):
        c_loops.fpu(dataclasses.replace(chain, system=heavy), 1, 1e-3, 1)
    with pytest.raises(ValueError, match="at least 1"):
        c_loops.fpu(chain, 1, 1e-3, 0)


def test_no_compiler(tsp, monkeypatch):
    monkeypatch.setenv("PATH", "")
    c_loops._library.cache_clear()
    assert c_loops.compiler() is None
    with pytest.raises(c_loops.NoCompiler, match="install one"):
        c_loops.tsp(tsp, 2e-4, 1)
