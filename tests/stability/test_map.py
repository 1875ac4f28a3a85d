"""Stability maps against measured windows, and against runs."""

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.stability import linear_model, plot_stability, stability_map
from vmri_jax.stability.map import find_windows

GRID = np.linspace(0.05, 4 * np.pi, 126)


@pytest.mark.full
def test_first_impulse_resonances():
    """omega 50, kappa 25: first unstable omega H / pi as measured with an independent code, within 0.005.

    `tests/steppers/test_mollified.py` has the first resonance of ten micro steps, by the derivative of the step itself.
    """
    expected = {2: 1.248, 3: 1.089, 5: 1.025, 10: 0.999, 20: 0.993}
    found = stability_map(linear_model(), {n: vm.explicit_slow(n) for n in expected}, GRID)
    first = {n: found.first_unstable(n) / np.pi for n in expected}
    assert first == pytest.approx(expected, abs=0.005)  # 1.2476, 1.0878, 1.0227, 0.9978, 0.9918


def triple_jump_radius(x):
    """Spectral radius of Yoshida's triple jump of Verlet steps for one oscillator."""
    outer, product = 1 / (2 - 2 ** (1 / 3)), np.eye(2)
    for h in x * np.array([outer, 1 - 2 * outer, outer]):
        kick = np.array([[1.0, 0.0], [-h / 2, 1.0]])
        product = kick @ np.array([[1.0, h], [0.0, 1.0]]) @ kick @ product
    return np.abs(np.linalg.eigvals(product)).max()


def test_rows_over_systems_compositions_and_the_explicit_limit(tmp_path):
    limit = 3 * 2.0  # omega h = 2 at 3 micro steps; kappa adds its part
    models = {kappa: linear_model(kappa=kappa) for kappa in (0.0, 25.0)}
    over_kappa = stability_map(models, vm.fully_explicit(3), np.linspace(0.95, 1.05, 11) * limit)
    assert over_kappa.rows == (0.0, 25.0)
    assert over_kappa.axis == "system"
    assert over_kappa.omega == 50.0
    assert over_kappa.macro_dt[-1] == pytest.approx(1.05 * limit / 50)
    assert over_kappa.first_unstable(0.0) == pytest.approx(limit, abs=1e-5)
    assert over_kappa.first_unstable(25.0) < limit
    triple = stability_map(linear_model(kappa=0.0), vm.compose(vm.fully_explicit(1), "yoshida4"), [1.5, 1.6])
    assert triple.first_unstable() == pytest.approx(1.573, abs=1e-3)  # its longest stage is beyond 2 from 1.175 on
    assert triple.radius[0] == pytest.approx([triple_jump_radius(1.5), triple_jump_radius(1.6)], rel=1e-12)

    over_kappa.to_csv(tmp_path / "map.csv")
    lines = (tmp_path / "map.csv").read_text().splitlines()
    assert lines[0] == "system,omega_H,macro_dt,radius"
    assert len(lines) == 1 + 2 * 11
    figure = plot_stability({"kappa": over_kappa, "composition": triple}, "two maps")
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_a_step_that_fails_is_unstable():
    """A step so large that its numbers overflow."""
    found = stability_map(linear_model(), vm.fully_explicit(3), [1.0, 1e200])
    assert found.radius[0, 0] == pytest.approx(1.0, abs=1e-9)
    assert found.radius[0, 1] == np.inf


def test_bad_input():
    model, scheme = linear_model(), vm.fully_explicit(3)
    with pytest.raises(TypeError, match="stability_map: a System has no start; give a State"):
        stability_map(model.system, scheme, GRID)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="give a Scheme"):
        stability_map(model, {"a": 3}, GRID)  # pyright: ignore[reportArgumentType]
    for grid in ([1.0], [0.0, 1.0], [2.0, 1.0], [1.0, np.nan]):
        with pytest.raises(ValueError, match=r"omega_H has shape .* give two or more positive values"):
            stability_map(model, scheme, grid)
    for systems in ({}, {1: model, 2: model, 3: model}):
        with pytest.raises(ValueError, match=f"{len(systems)} systems and 2 schemes; give one of either"):
            stability_map(systems, {1: scheme, 2: scheme}, GRID)
    free = vm.System(vm.ConstantMass([1.0], [1.0]))
    zero = np.zeros(1)
    with pytest.raises(ValueError, match="nothing vibrates"):
        stability_map(free, scheme, GRID, state=vm.State(0.0, zero, zero, zero, zero))
    found = stability_map(model, {"verlet": scheme}, [1.0, 2.0])
    with pytest.raises(ValueError, match="no row 'other'; there are 'verlet'"):
        found.windows("other")


# --- the search for windows, on a label that is known
# ---------------------------------------------------------------------
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
