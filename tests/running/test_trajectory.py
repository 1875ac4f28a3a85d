"""Trajectories on disk and as xarray datasets."""

import errno
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import vmri_jax as vm

SCHEME = vm.fully_explicit(3)
FIELDS = ("t", "q_s", "q_f", "p_s", "p_f", "energy", "constraint_residual")


@pytest.fixture(scope="module")
def trajectory(tsp):
    return vm.simulate(tsp.system, SCHEME, tsp.state(), macro_dt=0.02, num_steps=12, save=vm.Save(3, micro=True))


def test_save_and_load_keep_everything(tsp, trajectory, tmp_path):
    trajectory.save(tmp_path / "run.npz")
    loaded = vm.Trajectory.load(tmp_path / "run.npz")
    pairs = [(getattr(trajectory, name), getattr(loaded, name)) for name in (*FIELDS, "t_micro", "q_f_micro", "result")]
    for a, b in [*pairs, *zip(trajectory.info, loaded.info, strict=True)]:
        assert np.asarray(a).dtype == np.asarray(b).dtype
        assert np.array_equal(a, b)
    assert loaded.success
    assert isinstance(loaded.final_state, vm.State)
    with np.load(tmp_path / "run.npz", allow_pickle=False) as data:
        assert set(data.files) >= {*FIELDS, "iterations", "residual"}
        assert all(data[name].dtype != object for name in data.files)
    again = vm.simulate(tsp.system, SCHEME, loaded.final_state, macro_dt=0.02, num_steps=12, save=3)
    assert float(again.t[0]) == pytest.approx(0.24)
    assert np.array_equal(again.q_f[0], trajectory.q_f[-1])
    assert float(again.constraint_residual.max()) < 1e-12
    again.save(tmp_path / "again.npz")
    assert vm.Trajectory.load(tmp_path / "again.npz").q_f_micro is None


def test_a_file_is_not_lost_to_a_full_disk(trajectory, tmp_path, monkeypatch):
    def full(file, **_):
        file.write(b"a part")
        raise OSError(errno.ENOSPC, "No space left on device")

    trajectory.save(tmp_path / "run.npz")
    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space left"):
        trajectory.save(tmp_path / "run.npz")
    assert vm.Trajectory.load(tmp_path / "run.npz").t.shape == (5,)
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]


def test_files_that_are_no_trajectories(trajectory, tmp_path):
    path = tmp_path / "run.npz"

    def refused(message, error: type[Exception] = ValueError):
        with pytest.raises(error, match=message):
            vm.Trajectory.load(path)

    refused(r"run.npz does not exist; give the .npz file of a saved", FileNotFoundError)
    np.savez(path, t=np.arange(3.0))
    refused(r"run.npz is a .npz file but no trajectory of Trajectory.save of this version")
    path.write_text("t q_s q_f")
    refused(r"run.npz cannot be read as a .npz file")
    trajectory.save(path)
    whole = path.read_bytes()
    with np.load(path) as data:
        arrays: dict[str, Any] = {name: data[name] for name in data.files}
    for part in (0.3, 0.9):
        path.write_bytes(whole[: int(part * len(whole))])
        refused(r"run.npz cannot be read as a .npz file .*damaged")
    settings: Any = np.array("{}")
    np.savez(path, **arrays | {"settings": settings})
    refused(r"run.npz is a damaged trajectory: no names or settings")
    np.savez(path, **{name: array for name, array in arrays.items() if name != "p_f"})
    refused(r"run.npz")


def test_xarray_dataset(trajectory):
    data = trajectory.to_xarray()
    assert dict(data.sizes) == {"t": 5, "slow": 3, "fast": 6, "level": 2, "micro": 3}
    for name in ("q_s", "q_f", "p_s", "p_f", "energy", "constraint_residual"):
        assert np.array_equal(data[name], getattr(trajectory, name))
    assert np.array_equal(data["q_f_micro"][1:], trajectory.q_f_micro)
    assert np.isnan(data["q_f_micro"][0]).all()
    assert data["iterations"].values.tolist() == [-1, *trajectory.info.iterations.tolist()]
    assert float(data["q_s"].sel(t=0.12, method="nearest")[1]) == float(trajectory.q_s[2, 1])
    assert data.attrs == {"result": "CONVERGED", "failed_at": -1}


def test_a_run_refuses_a_system_with_other_parameters(tmp_path):
    """At the start the spring is relaxed: the energy at the end alone tells."""
    problem = vm.systems.fermi_pasta_ulam(1, omega=20.0)
    relaxed = replace(problem, q_s=np.ones(1), q_f=np.zeros(1))
    run = vm.simulate(relaxed, vm.fully_explicit(1), macro_dt=0.01, num_steps=5)
    run.save(tmp_path / "run.npz")
    loaded = vm.Trajectory.load(tmp_path / "run.npz")
    assert loaded.of(relaxed).work().balance == pytest.approx(run.work().balance)
    stiffer = replace(relaxed, system=relaxed.system.with_params({"omega": 20.001}))
    for made in (run, loaded):
        with pytest.raises(ValueError, match=r"of: the energy of the system is .*; give the system that was simulated"):
            made.of(stiffer)
