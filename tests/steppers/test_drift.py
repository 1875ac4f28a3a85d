"""Drift along the constraints: the multipliers alone are solved for, errors are within the tolerance. Its steps are
held to the textbook in `tests/textbook`."""

import numpy as np
import pytest

import vmri_jax as vm
from tests.support import largest_difference, phase
from tests.user_systems import tied_system
from vmri_jax.steppers.solver import Solver

DT = 0.002


def phases(problem_or_system, solver, scheme=None, state=None, macro_dt=DT, num_steps=20):
    """(num_steps + 1, 2 n) positions and momenta of a run, and its info."""
    system = getattr(problem_or_system, "system", problem_or_system)
    start = problem_or_system.state() if state is None else state
    how = {"macro_dt": macro_dt, "num_steps": num_steps, "solver": solver}
    run = vm.simulate(system, scheme or vm.fully_explicit(1), start, **how)
    return phase(run), run.info


def started(name, request) -> tuple[vm.System, vm.State]:
    """A system and its start."""
    if name == "general":
        return tied_system()
    problem = request.getfixturevalue(name)
    return problem.system, problem.state()


SUZUKI = vm.compose(vm.fully_explicit(1), "suzuki4")


@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        ("tsp", vm.fully_explicit(1)),
        ("general", SUZUKI),
        *(pytest.param("sam", scheme, marks=pytest.mark.full) for scheme in (vm.fully_explicit(1), SUZUKI)),
    ],
)
def test_errors_are_within_the_tolerance(name, scheme, request):
    system, start = started(name, request)
    n = start.q_s.size + start.q_f.size
    expected, info = phases(system, Solver("masses"), scheme, start)
    assert int(info.method.max()) == vm.Method.MASSES
    motion = np.abs(np.diff(expected[:, :n], axis=0)).max()
    for tolerance in (1e-3, 1e-9):
        loose, _ = phases(system, Solver("masses", tolerance), scheme, start)
        assert largest_difference(loose[:, :n], expected[:, :n]) < tolerance * motion


def test_a_composition_solves_the_equations_of_its_stages():
    """What a solver without memory finds, although guesses are handed from stage to stage."""
    system, start = tied_system()
    (drift, _), (exact, _) = (phases(system, Solver(matrix), SUZUKI, start) for matrix in ("masses", "exact"))
    assert largest_difference(drift, exact) / np.abs(exact).max() < 1e-13  # measured 1.4e-14


@pytest.mark.parametrize(
    ("name", "scheme", "matrix"),
    [
        ("tsp", vm.compose(vm.fully_explicit(1), [1.0, -1.0, 1.0]), "masses"),
        pytest.param("tsp", vm.fully_implicit(2), "masses", marks=pytest.mark.full),  # `test_custom` has such a step
        ("tsp", vm.fully_implicit(2), "exact"),
    ],
)
def test_momenta_are_projected_where_they_are_saved(name, scheme, matrix, request):
    """Between saved nodes they are not, which changes multipliers alone, also where two stages undo each other."""
    system, start = started(name, request)

    def run(save_every):
        length = {"macro_dt": DT, "num_steps": 20 * save_every, "save": save_every}
        return vm.simulate(system, scheme, start, solver=Solver(matrix), **length)

    often, rarely = run(1), run(5)
    for field in ("q_s", "q_f", "p_s", "p_f"):
        a, b = np.asarray(getattr(often, field)), np.asarray(getattr(rarely, field))
        assert largest_difference(a[::5], b[:5]) / np.abs(a).max() < 1e-12
    assert np.all(rarely.constraint_residual < 1e-11)
    assert int(rarely.info.method.max()) == vm.Method[matrix.upper()]
    assert int(rarely.info.iterations[:4].max()) <= int(often.info.iterations.max()) + 1


def test_one_correction_where_the_motion_is_smooth(tsp):
    _, info = phases(tsp, Solver(), macro_dt=2.5e-4, num_steps=500)
    assert np.asarray(info.iterations).mean() < 1.1  # measured 1.0
