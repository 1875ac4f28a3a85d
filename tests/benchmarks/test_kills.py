"""kill -9 at random moments of a streaming run; `python -m benchmarks kills` does it a hundred times."""

from benchmarks import kills


def test_killed_runs_resume_to_the_last_bit(tmp_path):
    rows, runs = kills.kill_often(kills.Size(count=3), tmp_path)
    assert [row["identical"] for row in rows] == ["yes"] * 3
    assert max(row["chunks"] for row in rows) > 0
    assert runs
    assert all(runs)
