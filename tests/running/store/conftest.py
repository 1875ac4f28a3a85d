"""A short run in three chunks, and one that nobody interrupted."""

import numpy as np
import pytest

from vmri_jax import Save, StoredTrajectory, Trajectory, fully_implicit, stream
from vmri_jax.running.export import named_arrays

H, CHUNK, EVERY, STEPS = 0.02, 4, 2, 24


class Runs:
    """Streams the same run to any place, with changes."""

    def __init__(self, problem):
        self.problem, self.scheme = problem, fully_implicit(3)

    def __call__(self, out, **changes) -> StoredTrajectory:
        arguments = {
            "system": self.problem.system,
            "scheme": self.scheme,
            "state": self.problem.state(),
            "macro_dt": H,
            "num_steps": STEPS,
            "save": Save(EVERY, micro=True),
            "chunk": CHUNK,
        }
        return stream(out=out, **(arguments | changes))


@pytest.fixture(scope="module")
def run(fpu) -> Runs:
    return Runs(fpu)


@pytest.fixture(scope="module")
def uninterrupted(run, tmp_path_factory) -> StoredTrajectory:
    return run(tmp_path_factory.mktemp("store") / "uninterrupted.zarr")


def assert_identical(a: Trajectory, b: Trajectory) -> None:
    """Bit by bit, NaN included, and of the same types."""
    ours, theirs = named_arrays(a), named_arrays(b)
    for name, value in ours.items():
        x, y = np.asarray(value), np.asarray(theirs[name])
        assert x.dtype == y.dtype, name
        assert x.shape == y.shape, name
        assert x.tobytes() == y.tobytes(), name
