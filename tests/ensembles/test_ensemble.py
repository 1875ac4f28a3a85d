"""Ensembles in this process: results, resuming, reading, refusals."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.ensembles import own
from vmri_jax.ensembles import QUANTITIES, Axis, Draws, EnsembleError, Product, Table
from vmri_jax.ensembles.run import Ensemble
from vmri_jax.running import files
from vmri_jax.running.store import layout
from vmri_jax.steppers.results import Result

OWN = f"{Path(own.__file__)}"
STEPS = {"t_end": 0.2, "macro_dt": 0.02}


def few(out, **changes) -> Ensemble:
    arguments = {"system": "fpu", "scheme": "fully-explicit", "design": {"omega": [20.0, 50.0]}, "vary": own.put}
    return vm.ensemble(**arguments | {"num_micro": 3, **STEPS} | changes, out=out)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A store that no test changes."""
    out = tmp_path_factory.mktemp("stored") / "runs.zarr"
    few(out)
    return out


def chain(omega: float, num_springs: int = 3) -> vm.Problem:
    """The chain that starts as the one of omega = 50 does."""
    problem = vm.systems.fermi_pasta_ulam(num_springs)
    return replace(problem, system=problem.system.replace(params={"omega": np.asarray(omega)}))


def more_params(problem, row):
    return replace(problem, system=problem.system.replace(params=problem.system.params | {"more": 1.0}))


def heavier(problem, row):
    masses = vm.ConstantMass(np.full(3, 2.0), np.full(3, 2.0))
    return replace(problem, system=problem.system.replace(kinetic=masses))


def whole(problem, row):
    return replace(problem, q_s=problem.q_s * int(row["omega"]))


def test_runs_are_those_of_simulate(tmp_path):
    schemes = {"explicit": vm.fully_explicit, "implicit": vm.fully_implicit}
    axes = {"num_micro": [4], "num_steps": [8, 16], "omega": [20.0, 50.0], "v_s[0]": [0.1, 0.3]}
    save = ("end", "nodes", *(name for name in QUANTITIES if name not in ("end", "nodes")))
    how = {"vary": own.put, "t_end": 0.2, "save": save, "num_saves": 4}
    runs = vm.ensemble(chain(50.0, 1), schemes, axes, **how, out=tmp_path / "runs.zarr")
    assert runs.complete
    assert len(runs) == 16
    assert runs.failed_runs == 0
    assert "runs, 0 of them failed" in repr(runs)
    data = runs.open()
    assert dict(data.sizes) | {"scheme": 2, "num_micro": 1, "num_steps": 2, "omega": 2, "v_s[0]": 2} == dict(data.sizes)
    for scheme, make in schemes.items():
        at = {"scheme": scheme, "num_micro": 4, "num_steps": 16, "omega": 50.0, "v_s[0]": 0.3}
        one = data.sel(at).load()
        problem = replace(chain(50.0, 1), v_s=np.array([0.3]))
        run = vm.simulate(problem, make(4), macro_dt=0.2 / 16, num_steps=16, save=4)
        for name in ("q_s", "q_f", "p_s", "p_f"):
            assert np.allclose(one[name], getattr(run, name)[-1], rtol=0, atol=1e-13)  # 2e-15
            assert np.allclose(one[f"node_{name}"], getattr(run, name), rtol=0, atol=1e-13)
        assert one.energy_error == pytest.approx(float(np.abs(run.energy - run.energy[0]).max()), abs=1e-13)
        line = np.polynomial.Polynomial.fit(run.t, run.energy, 1)
        assert one.energy_drift == pytest.approx(line(run.t[-1]) - line(run.t[0]), abs=1e-12)
        assert np.allclose(one.max_q_f, run.q_f.max(axis=0), rtol=0, atol=1e-13)
        assert np.allclose(one.quantiles_q_s.sel(quantile=0.5), np.median(run.q_s, axis=0), rtol=0, atol=1e-13)
        assert one.result == int(run.result)
        assert one.iterations == int(run.info.iterations.max())


@pytest.mark.parametrize(
    ("system", "function"), [(own.hung, own.lengths), (f"{OWN}:hung", f"{OWN}:lengths")], ids=["problem", "file"]
)
def test_positions_as_dictionaries(tmp_path, system, function):
    """The store has vectors; functions of the user get a run with its dictionaries and names."""
    save = ("end", "nodes", "extremes", "quantiles", function)
    design = {"k": [30.0, 50.0]}
    runs = few(tmp_path / "runs.zarr", system=system, design=design, save=save, num_saves=5)
    one = runs.open().sel(k=50.0).load()
    stiff = replace(own.hung, system=own.hung.system.replace(params={"k": np.asarray(50.0)}))
    run = vm.simulate(stiff, vm.fully_explicit(3), macro_dt=0.02, num_steps=10, save=2)
    assert np.allclose(one.q_f, run.states.q_f[-1], rtol=0, atol=1e-13)
    assert np.allclose(one.max_q_f, run.states.q_f.max(axis=0), rtol=0, atol=1e-13)
    assert np.allclose(one["load"], run.q_f["load"][-1], rtol=0, atol=1e-13)
    assert np.allclose(one.distance, np.linalg.norm(run.q_f["load"] - run.q_f["hook"], axis=-1), rtol=0, atol=1e-13)


@pytest.mark.parametrize("steps", ["num_steps", "macro_dt"])
def test_steps_of_their_own_in_a_table_in_any_order(tmp_path, steps):
    numbers = np.array([20, 10, 20, 40, 10])
    columns = {"omega": [10.0, 20.0, 30.0, 40.0, 50.0], "v_f": 0.01 * np.arange(15.0).reshape(5, 3)}
    columns[steps] = numbers if steps == "num_steps" else 0.2 / numbers
    data = few(tmp_path / "table.zarr", design=Table(columns), macro_dt=None, t_end=0.2).open()
    assert data.omega.values.tolist() == columns["omega"]
    for i, n in enumerate(numbers):
        problem = replace(chain(columns["omega"][i]), v_f=columns["v_f"][i])
        run = vm.simulate(problem, vm.fully_explicit(3), macro_dt=0.2 / n, num_steps=n, save=n)
        assert np.allclose(data.q_f[i], run.q_f[-1], rtol=0, atol=1e-13)
        assert np.allclose(data.p_s[i], run.p_s[-1], rtol=0, atol=1e-13)


def test_a_column_that_changes_nothing_is_told(tmp_path):
    def frequency_alone(problem, row):
        return replace(problem, system=problem.system.with_params({"omega": row["omega"]}))

    with pytest.warns(UserWarning, match="ensemble: no run depends on mass: vary does not use"):
        few(tmp_path / "runs.zarr", design={"omega": [20.0], "mass": [1.0, 2.0]}, vary=frequency_alone)


def test_draws_can_be_read_and_repeated(tmp_path):
    design = Draws(300, {"omega": ("uniform", 20, 60), "v_f[0]": ("normal", 0, 0.1)}, seed=5)
    data = few(tmp_path / "draws.zarr", design=design, chunk=100).open()
    rows = design.rows(0, 300)
    assert np.array_equal(data.omega, rows["omega"])
    assert np.array_equal(data["v_f[0]"], rows["v_f[0]"])
    fast = data.where((data.omega > 40).compute(), drop=True)
    assert 0 < fast.sizes["lane"] < 300
    assert float(fast.omega.min()) > 40


def test_own_quantities_systems_and_units(tmp_path):
    axis = Axis([20.0, 30.0], "rad/s", "frequency of the stiff springs")
    save = ("end", f"{OWN}:reach")
    runs = few(tmp_path / "own.zarr", system=f"{OWN}:slow_chain", design={"omega": axis}, save=save, num_saves=5)
    data = runs.open()
    assert data.omega.attrs == {"units": "rad/s", "description": "frequency of the stiff springs"}
    assert data.reach.attrs["description"] == "Largest elongation of the first stiff spring."
    run = vm.simulate(chain(30.0, 2), vm.fully_explicit(3), macro_dt=0.02, num_steps=10, save=2)
    assert data.reach.sel(omega=30.0) == pytest.approx(float(np.abs(run.q_f[:, 0]).max()), abs=1e-14)
    module = "tests.ensembles.own:slow_chain"
    again = few(tmp_path / "module.zarr", system=module, design={"omega": axis}, save=save, num_saves=5)
    assert np.array_equal(again.open().q_f, data.q_f)


def test_failed_runs_have_a_status_and_others_do_not_notice(tmp_path):
    design, save = {"omega": [20.0, 1e9]}, ("end", "energy_error")
    runs = few(tmp_path / "failed.zarr", design=design, t_end=2.0, save=save, num_saves=10)
    assert runs.failed_runs == 1
    data = runs.open()
    good, bad = data.isel(omega=0), data.isel(omega=1)
    assert good.result <= Result.CONVERGED_AT_ROUNDOFF
    assert good.failed_at == -1
    assert np.isfinite(good.energy_error)
    assert bad.result == Result.NON_FINITE
    assert np.isnan(bad.q_f).all()
    flags = dict(zip(data.result.attrs["flag_values"], data.result.attrs["flag_meanings"].split(), strict=True))
    assert flags[int(bad.result)] == "non_finite"


def test_a_poisoned_chunk_is_named_and_the_rest_goes_on(tmp_path):
    out = tmp_path / "poison.zarr"
    design = {"q_s[0]": [1.0, 2.0, own.POISON, 4.0]}
    arguments = {"design": design, "save": f"{OWN}:raises", "chunk": 1}
    with pytest.raises(EnsembleError, match=r"1 of 4 chunks could not be computed: runs 2 to 2\. Chunk 2:") as caught:
        few(out, **arguments)
    assert sorted(caught.value.ensemble.done) == [0, 1, 3]
    assert "poison" in str(caught.value.__cause__)
    data = vm.open_ensemble(out)
    assert data.raises.isnull().values.tolist() == [False, False, True, False]
    assert data.result.values.tolist() == [0, 0, -1, 0]
    again = few(out, **arguments, resume=True, throw=False)
    assert list(again.failures) == [2]
    assert again.computed == 0


def test_others_are_not_tried_where_none_can_be_computed(tmp_path):
    design = Table({"q_s[0]": np.full(30, own.POISON)})
    message = r"10 of 30 chunks could not .* and 5 more\. .*poison\. 0 of 30 chunks are in"
    with pytest.raises(EnsembleError, match=message):
        few(tmp_path / "runs.zarr", design=design, save=f"{OWN}:raises", chunk=1)


def test_ctrl_c_keeps_the_chunk_at_work(tmp_path):
    design = {"q_s[0]": [1.0, own.POISON, 3.0]}
    arguments = {"design": design, "save": f"{OWN}:interrupts", "chunk": 1}
    with pytest.raises(vm.Interrupted, match=r"interrupted after 2 of 3 chunks; go on with resume=True") as caught:
        few(tmp_path / "runs.zarr", **arguments)
    assert sorted(caught.value.done.done) == [0, 1]
    assert few(tmp_path / "runs.zarr", **arguments, resume=True).complete


def test_resume_computes_only_what_is_missing(tmp_path, monkeypatch):
    design = {"omega": np.linspace(20.0, 50.0, 40)}
    whole = few(tmp_path / "whole.zarr", design=design, chunk=8)
    part = few(tmp_path / "part.zarr", design=design, chunk=8)
    for number in (1, 3):  # as if it had been killed while these were written
        (part.path / layout.NOTES / str(number)).unlink()
    next(part.path.glob("q_f/c.3.0")).write_bytes(b"torn")
    (part.path / "q_f" / "c.1.0.1234.partial").write_bytes(b"torn")
    data = vm.open_ensemble(part.path)
    assert int((data.result == -1).sum()) == 16
    assert int(data.p_f.isnull().any("fast").sum()) == 16
    write = layout.Writer.write

    def torn(writer, *arguments):  # as by a worker that is killed meanwhile
        write(writer, *arguments)
        (part.path / "p_f" / "c.0.0.5678.partial").touch()

    monkeypatch.setattr(layout.Writer, "write", torn)
    resumed = few(part.path, design=design, chunk=8, resume=True)
    assert resumed.computed == 16
    assert _files(part.path) == _files(whole.path)


def test_a_store_that_takes_the_place_of_another(tmp_path):
    """The first one's arrays are shorter."""
    few(tmp_path / "runs.zarr", design={"omega": [20.0]}, chunk=1)
    design = {"omega": [20.0, 30.0, 40.0]}
    longer = few(tmp_path / "runs.zarr", design=design, chunk=1, overwrite=True)
    assert _files(longer.path) == _files(few(tmp_path / "other.zarr", design=design, chunk=1).path)
    assert np.isfinite(longer.open().q_f).all()


def test_resume_starts_what_is_not_there_and_no_columns_are_a_single_run(tmp_path):
    runs = few(tmp_path / "new.zarr", design=Product({}), resume=True)
    assert runs.complete
    assert len(runs) == 1
    assert runs.open().q_f.shape == (3,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"design": {"omega": [20.0, 51.0]}}, r"column omega: \[20\.0, 51\.0\] here, \[20\.0, 50\.0\] in the store"),
        ({"macro_dt": 0.01}, r"macro_dt: 0\.01 here, 0\.02 in the store"),
        ({"num_micro": 4}, r"num_micro: 4 here, 3 in the store"),
        ({"save": "energy_error", "num_saves": 5}, r"save: energy_error here, end in the store"),
        ({"scheme": "fully-implicit"}, r"scheme"),
        ({"system": f"{OWN}:slow_chain"}, r"state\.q_s"),
        ({"chunk": 1}, r"chunk: 1 here, 2 in the store"),
    ],
)
def test_another_ensemble_is_not_gone_on_with(stored, changes, message):
    with pytest.raises(ValueError, match=r"holds another ensemble .*" + message):
        few(stored, **changes, resume=True)


def test_what_is_in_the_way(tmp_path):
    out = tmp_path / "runs.zarr"
    few(out)
    with pytest.raises(FileExistsError, match=r"is a stored ensemble, 1 of 1 chunks done"):
        few(out)
    assert few(out, overwrite=True, design={"omega": [1.0]}).open().sizes["omega"] == 1
    (tmp_path / "other").mkdir()
    with pytest.raises(ValueError, match="is not a stored ensemble"):
        few(tmp_path / "other")
    with pytest.raises(FileNotFoundError, match="does not exist; make it first"):
        few(tmp_path / "no" / "runs.zarr")
    with pytest.raises(ValueError, match="both resume and overwrite"):
        few(out, resume=True, overwrite=True)
    with pytest.raises(FileNotFoundError, match="does not exist; give the folder of a stored ensemble"):
        vm.open_ensemble(tmp_path / "nothing.zarr")


def test_a_place_that_cannot_be_written():
    with pytest.raises(OSError, match=r"/proc/runs\.zarr cannot be written: .* Give another place"):
        few("/proc/runs.zarr")


def test_a_full_disk_keeps_the_chunks_before(tmp_path, monkeypatch):
    out, written = tmp_path / "runs.zarr", []
    design = {"omega": np.linspace(20.0, 50.0, 40)}

    def write(writer, first, values, note):
        if len(written) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(first)
        return whole(writer, first, values, note)

    whole = layout.Writer.write
    with monkeypatch.context() as patch:
        patch.setattr(layout.Writer, "write", write)
        with pytest.raises(OSError, match=r"No space left on device\. 2 of 5 chunks are kept") as caught:
            few(out, design=design, chunk=8)
    assert caught.value.errno == errno.ENOSPC
    assert few(out, design=design, chunk=8, resume=True).computed == 24
    assert not list(files.Path(out).rglob("*.partial"))


NO_STEP = {"macro_dt": None}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"design": {"num_mirco": [1]}, "vary": None}, r"the column 'num_mirco' is neither a step nor a"),
        ({"design": {"q_s": [1.0]}}, r"q_s has shape \(\); it must be a vector"),
        ({"design": {"omega": ["fast"]}}, r"'omega' has labels; give numbers"),
        ({"design": {"scheme": ["leapfrog"]}}, r"no scheme 'leapfrog'"),
        ({"design": {"num_micro": [2.5]}, "num_micro": None}, r"num_micro is 2\.5; it must be a whole"),
        ({"design": {"macro_dt": [0.03]}} | NO_STEP, r"no whole number"),
        ({"design": {"macro_dt": [0.01]}}, r"macro_dt is a column and an argument"),
        ({"design": {"num_micro": [1]}}, r"num_micro is a column and an argument"),
        ({"design": {"macro_dt": [-0.01]}} | NO_STEP, r"macro_dt is .*; it must be a positive number"),
        (
            {"design": {"macro_dt": [0.01, -0.01]}, "t_end": None, "num_steps": 4} | NO_STEP,
            r"macro_dt is .*; it must be a positive number",
        ),
        ({"design": Draws(4, {"num_steps": ("uniform", 1, 9)})} | NO_STEP, r"num_steps cannot be drawn"),
        ({"design": {"t": [0.0, 1.0]}}, r"vary changes t, so that t_end does not fix the number of steps"),
        ({"t_end": None}, r"got macro_dt; give two of"),
        ({"num_micro": None}, r"num_micro is missing for the scheme 'fully-explicit'"),
        ({"scheme": vm.fully_implicit(2)}, r"has its num_micro already"),
        ({"scheme": 3}, r"scheme is .*3.*; give a Scheme"),
        ({"scheme": {}}, r"give a Scheme"),
        ({"design": [1, 2]}, r"design is list; give a Product, Table or Draws"),
        ({"save": "enrgy_error"}, r"save has 'enrgy_error'\. Did you mean energy_error\?"),
        ({"save": "energy_error"}, r"looks at the saved nodes of a run, and only its end is saved"),
        ({"save": ("end", "end")}, r"two arrays called"),
        ({"save": f"{OWN}:rech"}, r"has no name 'rech'\. Did you mean reach\?"),
        ({"num_saves": 3}, r"num_steps = 10 is not a multiple of the 3 saved intervals"),
        ({"system": "fup"}, r"there is no system 'fup'"),
        ({"system": "no.such:thing"}, r"the module no\.such cannot be imported"),
        ({"executor": 3}, r"executor is int; give a dask\.distributed\.Client"),
        ({"chunk": 0}, r"chunk is 0"),
        ({"vary": lambda problem, row: row}, r"vary\(problem, row\) is dict; give dataclasses\.replace"),
        ({"vary": more_params}, "the structure or shape of one of them"),
        ({"vary": heavier}, "the system besides its params"),
        ({"vary": whole}, "vary cannot be traced, line .* of test_ensemble.py"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, changes, message):
    with pytest.raises(vm.Refused, match=message):
        few(tmp_path / "runs.zarr", **changes)
    assert not any(tmp_path.iterdir())


def test_several_schemes_need_a_column_in_a_table(tmp_path):
    schemes = {"a": vm.fully_explicit(2), "b": vm.fully_explicit(3)}
    with pytest.raises(ValueError, match="give a column 'scheme'"):
        few(tmp_path / "runs.zarr", scheme=schemes, num_micro=None, design=Table({"omega": [1.0]}))
    design = Table({"omega": [20.0, 20.0], "scheme": ["b", "a"]})
    data = few(tmp_path / "runs.zarr", scheme=schemes, num_micro=None, design=design).open()
    assert data.scheme.values.tolist() == ["b", "a"]
    assert not np.array_equal(data.q_f[0], data.q_f[1])


def test_constrained_systems(tmp_path, tsp):
    design, save = {"v_s[0]": [0.0, 0.1]}, ("end", "constraint_residual")
    how = {"macro_dt": 0.01, "num_steps": 10, "project": True, "num_saves": 5, "solver": vm.Solver("masses")}
    runs = vm.ensemble(tsp, vm.fully_explicit(1), design, vary=own.put, save=save, **how, out=tmp_path / "tsp.zarr")
    data = runs.open()
    assert runs.failed_runs == 0
    assert float(data.constraint_residual.max()) < 1e-11
    assert data.level.values.tolist() == ["position", "velocity"]


def _files(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_functions_of_runs_are_kept_by_their_names(tmp_path):
    def reach(run):  # pyright: ignore[reportRedeclaration]
        return jnp.max(run.q_f)

    design, out = {"omega": [20.0]}, tmp_path / "runs.zarr"
    few(out, design=design, save=reach)

    def reach(run):  # another function of the same name
        return jnp.min(run.q_f)

    with pytest.raises(ValueError, match=r"another ensemble.*operations of reach"):
        few(out, design=design, save=reach, resume=True)
    for save in (lambda run: 1.0, 3.0):
        with pytest.raises(ValueError, match=r"a function without a name|There are end, nodes"):
            few(out, design=design, save=save, overwrite=True)


def test_a_function_of_rows_makes_the_problems(tmp_path):
    design = Table({"speed": [0.5, 2.0, 1.0], "frequency": [20.0, 50.0, 30.0], "num_micro": [3, 3, 4]})
    runs = few(tmp_path / "runs.zarr", system=chain(50.0), design=design, num_micro=None, vary=own.faster)
    data = runs.open()
    assert data.speed.values.tolist() == [0.5, 2.0, 1.0]
    problem = chain(20.0)
    run = vm.simulate(replace(problem, v_s=0.5 * problem.v_s), vm.fully_explicit(3), macro_dt=0.02, num_steps=10)
    assert np.allclose(data.q_f[0], run.q_f[-1], rtol=0, atol=1e-14)
    slower = lambda problem, row: own.faster(problem, row | {"speed": row["speed"] / 2})  # noqa: E731
    with pytest.raises(ValueError, match="operations of vary"):
        few(runs.path, system=chain(50.0), design=design, num_micro=None, vary=slower, resume=True)


def test_a_function_of_rows_changes_params_in_place(tmp_path, stored):
    def in_place(problem, row):
        problem.system.params["omega"] = row["omega"]
        return problem

    system = chain(50.0)
    runs = few(tmp_path / "runs.zarr", system=system, vary=in_place)
    np.testing.assert_allclose(runs.open().q_f, vm.open_ensemble(stored).q_f, rtol=0, atol=1e-14)
    assert float(system.system.params["omega"]) == 50.0


def test_a_function_of_rows_with_dictionaries(tmp_path):
    vary = lambda problem, row: replace(problem, q_f={"hook": problem.q_f[:2], "load": jnp.stack([row["x"], -1.2])})  # noqa: E731
    runs = few(tmp_path / "runs.zarr", system=own.hung, design={"x": [0.7, 1.0]}, vary=vary)
    run = vm.simulate(own.hung, vm.fully_explicit(3), macro_dt=0.02, num_steps=10)
    assert np.allclose(runs.open().q_f.sel(x=1.0), run.states.q_f[-1], rtol=0, atol=1e-14)
