"""Andrews' squeezer ends where it is published to end."""

import numpy as np
import pytest

from benchmarks import squeezer


def test_scipy_in_seven_angles():
    assert np.abs(squeezer.by_scipy(1e-8) - squeezer.PUBLISHED).max() < 1e-7  # 1.3e-8


@pytest.mark.full
def test_ours_in_seven_angles():
    assert np.abs(squeezer.by_angles(2, 300) - squeezer.PUBLISHED).max() < 3e-6  # 1.0e-6


@pytest.mark.full
def test_ours_as_rigid_bodies():
    assert np.abs(squeezer.of_bodies(squeezer.by_bodies(2, 300)) - squeezer.PUBLISHED).max() < 1e-5  # 3.3e-6


def test_a_figure_has_a_curve_for_each():
    rows = [{"who": who, "error": 1e-3, "ms": 2.0} for who in ("a", "b", "a")]
    assert len(squeezer.draw(rows).axes[0].lines) == 2
