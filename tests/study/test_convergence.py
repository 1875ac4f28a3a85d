"""Convergence studies: orders, rows, failures, executors, Ctrl-C, and what is refused."""

import csv
import dataclasses
import pickle
from concurrent.futures import Executor, Future

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.executors.executor import in_worker
from vmri_jax.stability import stability_map
from vmri_jax.study import ConvergenceStudy, ReferenceSolution, convergence_study, reference_solution

OMEGA = 20.0


def stiff_spring(q_f, params):
    return params**2 / 2 * jnp.sum(q_f**2)


def soft_spring(q_s, q_f, params):
    return jnp.sum((q_s - q_f) ** 4) / 4


ONE = np.ones(1)
PROBLEM = vm.Problem(
    vm.System(vm.ConstantMass(ONE, ONE), soft_spring, stiff_spring, params=np.asarray(OMEGA)),
    q_s=ONE,
    q_f=ONE / OMEGA,
    v_s=ONE,
    v_f=ONE,
)
STEPS = (0.02, 0.01, 0.005)


@pytest.fixture(scope="module")
def reference():
    return reference_solution(PROBLEM, 1.0, num_saves=5, num_steps=200, degree=3)


@pytest.fixture(scope="module")
def study(reference):
    schemes = {"first order": vm.fully_explicit(4, alpha=0.0), "second order": vm.fully_explicit(4)}
    return convergence_study(PROBLEM, schemes, STEPS, 1.0, num_saves=5, reference=reference)


def test_the_reference_knows_its_own_error(reference):
    assert reference.q.shape == reference.p.shape == (6, 2)
    assert 0 < reference.error_q < 8e-11  # measured 8e-12
    assert 0 < reference.error_p < 2.5e-9  # measured 2.5e-10


@pytest.mark.parametrize(("scheme", "order"), [("first order", 1), ("second order", 2)])
def test_orders(study, scheme, order):
    for quantity in ("q", "p"):
        assert study.order(scheme, quantity) == pytest.approx(order, abs=0.1)
    fit = study.fit(scheme)
    assert fit.points == 3
    assert abs(fit.order - order) <= fit.half_width + 0.05
    energy = [row.energy_error for row in study.rows if row.scheme == scheme]
    assert energy[0] / energy[2] == pytest.approx(4**order, rel=0.3)


def test_errors_are_the_largest_over_nodes_and_coordinates(study, reference):
    trajectory = vm.simulate(
        PROBLEM.system, vm.fully_explicit(4), PROBLEM.state(), macro_dt=0.01, num_steps=100, save=20
    )
    q = np.concatenate([trajectory.q_s, trajectory.q_f], axis=1)
    (row,) = [row for row in study.rows if row.scheme == "second order" and row.macro_dt == 0.01]
    assert row.error_q == np.abs(q - reference.q).max()
    assert row.num_micro == 4
    assert row.result == "CONVERGED"
    assert row.energy_error == pytest.approx(float(jnp.abs(trajectory.energy - trajectory.energy[0]).max()), rel=1e-12)


def test_csv_has_a_line_for_every_run(study, tmp_path):
    study.to_csv(tmp_path / "study.csv")
    with open(tmp_path / "study.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [(line["scheme"], float(line["macro_dt"])) for line in lines] == [
        (scheme, dt) for scheme in ("first order", "second order") for dt in STEPS
    ]
    assert float(lines[0]["error_q"]) == study.rows[0].error_q


def test_a_run_that_fails_is_a_row_of_nan(reference):
    stiff = dataclasses.replace(PROBLEM, system=PROBLEM.system.replace(params=np.asarray(1e9)))
    study = convergence_study(stiff, {"unstable": vm.fully_explicit(4)}, STEPS, 1.0, num_saves=5, reference=reference)
    assert {row.result for row in study.rows} == {"NON_FINITE"}
    assert all(np.isnan(row.error_q) and np.isnan(row.error_p) for row in study.rows)
    assert np.isnan(study.order("unstable"))


def test_errors_near_the_reference_are_not_fitted(study):
    macro_dt, errors = study.errors("second order")
    worse = dataclasses.replace(study.references[""], error_q=errors[-1] / 50)
    coarse = dataclasses.replace(study, references={"": worse})
    assert coarse.usable("second order")[0].tolist() == macro_dt[:2].tolist()


SCHEMES = {"explicit": vm.fully_explicit(4)}


def test_progress_hears_of_every_run(reference):
    heard = []
    how = {"num_saves": 5, "reference": reference}
    convergence_study(PROBLEM, SCHEMES, STEPS, 1.0, **how, progress=lambda *news: heard.append(news))
    assert heard[0] == ("explicit, H = 0.02", 0, 3)
    assert heard[-1] == ("done", 3, 3)


@pytest.mark.parametrize(("words", "rows"), [("H = 0.005", 2), ("measuring times", 3)])
def test_ctrl_c_keeps_the_rows(reference, words, rows):
    def progress(what, done, total):
        if words in what:
            raise KeyboardInterrupt

    how = {"num_saves": 5, "reference": reference, "repeats": 1, "progress": progress}
    with pytest.raises(vm.Interrupted, match=f"interrupted after {rows} runs") as caught:
        convergence_study(PROBLEM, SCHEMES, STEPS, 1.0, **how)
    study = caught.value.done
    assert isinstance(study, ConvergenceStudy)
    assert [row.macro_dt for row in study.rows] == list(STEPS[:rows])
    assert study.order("explicit") == pytest.approx(2.0, abs=0.1)


class Travelling(Executor):
    """Tasks and results travel as bytes, as to a worker and back, but the worker is this process: programs are compiled
    once."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        fn, args, kwargs = pickle.loads(pickle.dumps((fn, args, kwargs)))
        future: Future = Future()
        future.set_result(pickle.loads(pickle.dumps(fn(*args, **kwargs))))
        return future


def test_executors_have_the_results_of_this_process(reference, monkeypatch):
    """`tests/ensembles/test_workers.py` has a cluster."""
    monkeypatch.setattr(
        f"{in_worker.__module__}._prepare", lambda process: None
    )  # this process has its settings already
    how = {"num_saves": 5, "reference": reference}
    here, there = (convergence_study(PROBLEM, SCHEMES, STEPS, 1.0, **how, executor=e) for e in (None, Travelling()))
    assert here.to_pandas().equals(there.to_pandas())
    timed = convergence_study(PROBLEM, SCHEMES, STEPS, 1.0, **how, executor=Travelling(), repeats=1)
    assert all(row.seconds > 0 for row in timed.rows)
    schemes, grid = {n: vm.fully_explicit(n) for n in (2, 5)}, np.linspace(0.5, 2.0, 12) * np.pi
    here, there = (stability_map(vm.stability.linear_model(), schemes, grid, executor=e) for e in (None, Travelling()))
    assert np.allclose(here.radius, there.radius, rtol=0, atol=1e-12)
    assert here.rows == there.rows
    assert here.unstable == there.unstable
    assert here.unstable[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schemes": {}}, "schemes is empty"),
        ({"macro_dt": ()}, "macro_dt is empty"),
        ({"macro_dt": (0.03,)}, r"there are 33\.3333 macro steps of 0\.03"),
        ({"macro_dt": (-0.1,)}, "macro_dt is -0.1"),
        ({"macro_dt": (0.25,)}, "multiple of the 5 saved intervals"),
        ({"reference": ReferenceSolution(np.zeros((3, 2)), np.zeros((3, 2)))}, r"both must be \(6, 2\)"),
    ],
)
def test_bad_input(reference, changes, message):
    arguments = {"schemes": SCHEMES, "macro_dt": STEPS, "reference": reference} | changes
    with pytest.raises(ValueError, match=message):
        convergence_study(PROBLEM, t_end=1.0, num_saves=5, **arguments)


def test_asking_for_a_scheme_that_was_not_run(study):
    with pytest.raises(ValueError, match=r"no scheme 'third order'.*first order, second order"):
        study.order("third order")


def test_cases_side_by_side():
    params = {"soft": np.asarray(10.0), "stiff": np.asarray(40.0)}
    schemes = {"impulse": vm.fully_explicit(4), "composed": vm.compose(vm.fully_explicit(4), "suzuki4")}
    study = convergence_study(PROBLEM, schemes, STEPS, 1.0, num_saves=5, params=params)
    assert study.cases == ["soft", "stiff"]
    for case in params:
        assert study.order("impulse", case=case) == pytest.approx(2, abs=0.1)
        alone = dataclasses.replace(PROBLEM, system=PROBLEM.system.replace(params=params[case]))
        single = convergence_study(alone, schemes, STEPS, 1.0, num_saves=5, reference=study.references[case])
        np.testing.assert_allclose(study.errors("composed", "p", case)[1], single.errors("composed", "p")[1], rtol=1e-3)
    data = study.to_xarray()
    assert len(study.to_pandas()) == 12
    assert data.error_q.dims == ("scheme", "case", "macro_dt")
    assert data.macro_dt.values.tolist() == sorted(STEPS, reverse=True)
    assert (
        float(data.error_q.sel(scheme="impulse", case="stiff", macro_dt=0.01))
        == study.errors("impulse", case="stiff")[1][1]
    )
    assert study.table().row_count == 4
    with pytest.raises(ValueError, match="reference must be a mapping"):
        convergence_study(PROBLEM, schemes, STEPS, 1.0, num_saves=5, params=params, reference=study.references["soft"])
    with pytest.raises(ValueError, match="params is empty"):
        convergence_study(PROBLEM, schemes, STEPS, 1.0, num_saves=5, params={})


def driven(t, q_s, q_f, v_s, v_f, params):
    """Work that is much larger than the error of any step here."""
    return 5.0 + jnp.sin(4.0 * t) - 0.5 * v_s, 0.0 * v_f


def test_the_energy_of_a_driven_system_has_an_error_too():
    """It is not its change, which is the work that is done."""
    problem = dataclasses.replace(PROBLEM, system=PROBLEM.system.replace(force=driven))
    reference = reference_solution(problem, 1.0, num_saves=5, num_steps=100, degree=2)
    study = convergence_study(
        problem, {"implicit": vm.fully_implicit(2)}, (0.02, 0.01), 1.0, num_saves=5, reference=reference
    )
    coarse, fine = (row.energy_error for row in study.rows)
    run = vm.simulate(problem, vm.fully_implicit(2), macro_dt=0.01, num_steps=100, save=20)
    assert abs(run.energy - run.energy[0]).max() > 3.0  # measured 6.3
    assert coarse / fine == pytest.approx(4, rel=0.05)  # measured 4.04
    assert fine < 2e-3  # measured 3.8e-4


def test_a_reference_refines_itself_until_it_agrees():
    reference = reference_solution(PROBLEM, 1.0, num_saves=1)
    assert 0 < reference.error_q < 1e-12
    assert reference.num_saves == 1


def test_work_is_counted_and_timed(reference):
    schemes = {"impulse": vm.fully_explicit(4), "midpoint": vm.fully_implicit(4)}
    study = convergence_study(PROBLEM, schemes, (0.02, 0.01), 1.0, num_saves=5, reference=reference, repeats=2)
    work = study.work()
    impulse, midpoint = work.curve("impulse"), work.curve("midpoint")
    assert (impulse[0].slow_evaluations, impulse[0].fast_evaluations, impulse[0].solves) == (50, 200, 0)
    assert midpoint[1].solves == 100
    assert midpoint[1].fast_evaluations >= 400
    assert all(row.seconds > 0 for row in study.rows)
    assert {row.scheme for row in work.pareto()} <= set(schemes)
    labels = {kind: work.plot(work=kind).axes[0].get_xlabel() for kind in ("seconds", "solves")}
    assert labels == {"seconds": "computing time of the run", "solves": "systems of equations solved"}
