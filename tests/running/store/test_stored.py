"""Reading a store: parts of it, how far it is, and damage."""

import itertools
import pickle
import shutil
import warnings

import jax
import numpy as np
import pytest
import xarray

from tests.running.store.conftest import CHUNK, STEPS, assert_identical
from tests.support import joined
from vmri_jax import State, StoredTrajectory
from vmri_jax.running.store import layout


@pytest.fixture
def copy(uninterrupted, tmp_path):
    """Path of a copy that may be damaged."""
    return shutil.copytree(uninterrupted.path, tmp_path / "copy.zarr")


def test_parts_are_those_of_the_whole(uninterrupted):
    whole = uninterrupted.load()
    part = uninterrupted[3:9]
    for name in ("t", "q_s", "q_f", "p_s", "p_f", "energy", "constraint_residual"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[3:9])
    for name in ("t_micro", "q_f_micro"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[3:8])
    assert np.array_equal(part.info.iterations, whole.info.iterations[3:8])
    assert_identical(joined(list(uninterrupted.chunks())), whole)
    assert_identical(uninterrupted[:], whole)
    assert uninterrupted[12:].q_f.shape[0] == 1
    assert isinstance(uninterrupted.final_state, State)
    assert np.array_equal(uninterrupted.final_state.q_f, whole.q_f[-1])
    for run in (uninterrupted, whole):
        assert isinstance(run[3], State)
        assert np.array_equal(run[3].q_f, whole.q_f[3])
        assert float(run[-1].t) == float(whole.t[-1])
        with pytest.raises(IndexError, match="there is no node 13; it has 13 nodes, counted from 0"):
            run[13]
    for index, message in (("q_s", "the index is 'q_s'; give the number"), (slice(None, None, -1), "taken forwards")):
        with pytest.raises((ValueError, TypeError), match=message):
            uninterrupted[index]
    with pytest.raises(ValueError, match=r"no nodes 13:13:1; it has 13"):
        uninterrupted[20:]
    assert not list(uninterrupted.path.parent.glob("**/*.partial"))


def test_a_store_has_what_its_trajectory_has(uninterrupted):
    whole = uninterrupted.load()
    for name in ("states", "energy", "t", "q_f", "micro", "v_f"):
        for ours, theirs in zip(*(jax.tree.leaves(getattr(run, name)) for run in (uninterrupted, whole)), strict=True):
            assert np.array_equal(ours, theirs), name
    assert set(dir(whole)) <= set(dir(uninterrupted))
    assert uninterrupted.names.slow_coordinates == whole.names.slow_coordinates
    assert pickle.loads(pickle.dumps(uninterrupted))[3].q_f.tolist() == whole[3].q_f.tolist()
    with pytest.raises(AttributeError, match="StoredTrajectory has no attribute 'q_x'"):
        uninterrupted.q_x  # noqa: B018 (the attribute is what is tested)


@pytest.mark.parametrize(("first", "stop", "stride"), [(0, 13, 3), (0, 13, 5), (2, 12, 4), (1, 2, 7)])
def test_every_nth_node(uninterrupted, first, stop, stride):
    whole, part = uninterrupted.load(), uninterrupted[first:stop:stride]
    nodes = list(range(first, stop, stride))
    assert np.array_equal(part.q_s, whole.q_s[np.array(nodes)])
    between = list(itertools.pairwise(nodes))
    residual, iterations = np.asarray(whole.info.residual), np.asarray(whole.info.iterations)
    assert np.asarray(part.info.residual).tolist() == [residual[a:b].max() for a, b in between]
    assert np.asarray(part.info.iterations).tolist() == [iterations[a:b].max() for a, b in between]
    ends = np.array(nodes[1:], dtype=int)
    assert np.array_equal(part.q_f_micro, whole.q_f_micro[ends - 1])
    assert np.array_equal(np.asarray(part.q_f_micro)[:, -1], whole.q_f[ends])


def test_a_store_that_has_just_begun(run, tmp_path, monkeypatch):
    def dies(*_):
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(layout.Writer, "write", dies)
        with pytest.raises(SystemExit):
            run(tmp_path / "run.zarr")
    begun = StoredTrajectory(tmp_path / "run.zarr")
    assert (len(begun), begun.step, begun.complete) == (0, 0, False)
    assert "0 of 24 macro steps, not complete" in repr(begun)
    with pytest.raises(ValueError, match=r"no nodes 0:0:1; it has 0"):
        begun.load()


def test_any_zarr_library_reads_it(uninterrupted):
    import zarr

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        group = zarr.open_group(uninterrupted.path, mode="r")
        members = dict(group.members(max_depth=None))
    assert {"t", "q_s", "q_f_micro", "resume/chunks"} <= set(members)
    assert np.array_equal(np.asarray(group["q_f"]), uninterrupted.load().q_f)
    assert group.attrs["num_steps"] == STEPS
    assert len(list((uninterrupted.path / "q_f").glob("c.*"))) == -(-(STEPS // 2 + 1) // CHUNK)


def test_xarray_opens_it(uninterrupted):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xarray.open_zarr(uninterrupted.path)
    assert dict(data.sizes) == {"t": 13, "slow": 3, "fast": 3, "level": 2, "micro": 3}
    expected = uninterrupted.to_xarray()
    assert set(expected.data_vars) == set(data.data_vars)
    for name in expected.variables:
        if name in data.variables:
            assert data[name].dims == expected[name].dims
            assert np.array_equal(data[name], expected[name], equal_nan=True)
    assert np.array_equal(data["t"], uninterrupted.load().t)


def test_places_without_a_stored_run(copy, tmp_path):
    def refused(path, message, error: type[Exception] = ValueError):
        with pytest.raises(error, match=message):
            StoredTrajectory(path)

    refused(tmp_path / "no.zarr", r"no.zarr does not exist; give the folder of a stored run", FileNotFoundError)
    refused(tmp_path, r"is not a stored run")
    layout.change_attributes(copy, kind="ensemble")
    refused(copy, r"is not a stored run but a stored ensemble")
    layout.change_attributes(copy, format="vmri_jax trajectory store 2", made_with={"vmri_jax": "0.1.0"})
    refused(copy, r"format 'vmri_jax trajectory store 2'.* read it with vmri_jax 0\.1\.0")
    (copy / "zarr.json").write_text((copy / "zarr.json").read_text()[:100])
    refused(copy, r"copy.zarr is not a stored run")


@pytest.mark.parametrize("part", [0.0, 0.5, 0.99])
def test_truncated_checkpoint(copy, part):
    file = copy / layout.NOTES / str(layout.committed(copy)[-1])
    whole = file.read_bytes()
    file.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ValueError, match=r"copy.zarr: the checkpoint is damaged"):
        StoredTrajectory(copy)


def test_damaged_and_missing_chunks(copy, uninterrupted):
    first, second = copy / "q_f" / "c.0.0", copy / "q_f" / "c.1.0"
    data = bytearray(first.read_bytes())
    data[5] ^= 1
    first.write_bytes(data)
    second.unlink()
    stored = StoredTrajectory(copy)
    with pytest.raises(ValueError, match=r"q_f cannot be read .*checksum"):
        stored[:3]
    with pytest.raises(ValueError, match=r"q_f cannot be read \(chunk 1 is missing\); the store is damaged"):
        stored[6:8]
    assert_identical(stored[9:], uninterrupted[9:])
