"""Random runs end on workers as they do in this process."""

import pytest

from benchmarks import fuzz

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("default")  # of Dask, about ports and slow loops


def test_fuzzing(tmp_path):
    here = fuzz.fuzz(1, 1, tmp_path / "here.jsonl", 300.0)
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0")
    with cluster, distributed.Client(cluster) as client:
        there = fuzz.fuzz(1, 1, tmp_path / "there.jsonl", 300.0, executor=client)
    assert here == there
    assert not fuzz.wrong(there)
