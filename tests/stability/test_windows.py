"""Search for windows, on a label that is known."""

import numpy as np
import pytest

from vmri_jax.stability.map import find_windows

WINDOWS = [(0.1, 0.35), (0.5, 0.50004), (0.8, 0.80002), (0.95, 1.0)]


def label(x):
    """None in a window, else the number of windows before."""
    inside = [any(a < y < b for a, b in WINDOWS) for y in x]
    return [None if i else sum(b <= y for _, b in WINDOWS) for y, i in zip(x, inside, strict=True)]


def test_windows_wider_and_narrower_than_the_grid():
    x = np.linspace(0.0, 1.0, 22)
    found = find_windows(label, x, label(x), 1e-9)
    assert found == [pytest.approx(window, abs=2e-9) for window in WINDOWS]


def test_windows_below_the_resolution_are_left_out():
    x = np.linspace(0.0, 1.0, 22)
    assert len(find_windows(label, x, label(x), 1e-3)) == 2
    assert find_windows(label, x[-1:], [None], 1e-3) == [(1.0, 1.0)]
    assert find_windows(label, x[:2], [0, 0], 1e-3) == []
