"""Designs: rows, and what is refused."""

import numpy as np
import pytest
from scipy import stats

from vmri_jax.ensembles import Axis, Draw, Draws, Product, Table
from vmri_jax.ensembles.design import unique_rows


def test_product_varies_the_last_axis_first():
    design = Product({"a": [1.0, 2.0], "b": [10, 20, 30]})
    rows = design.rows(0, len(design))
    assert rows["a"].tolist() == [1, 1, 1, 2, 2, 2]
    assert rows["b"].tolist() == [10, 20, 30, 10, 20, 30]
    part = design.rows(2, 5)
    assert {name: values.tolist() for name, values in part.items()} == {"a": [1, 2, 2], "b": [30, 10, 20]}


def test_large_designs_take_no_memory():
    design = Product({"a": np.arange(10**5), "b": np.arange(10**5) + 0.5})
    assert len(design) == 10**10
    assert design.rows(10**10 - 1, 10**10)["b"].tolist() == [10**5 - 0.5]
    assert Draws(10**12, {"a": ("normal", 0, 1)}, method="random").rows(10**12 - 2, 10**12)["a"].shape == (2,)


@pytest.mark.parametrize("method", ["sobol", "latin-hypercube", "random"])
def test_rows_do_not_depend_on_the_part(method):
    design = Draws(1000, {f"x{i}": ("uniform", i, i + 1) for i in range(5)}, method=method, seed=3)
    whole, part = design.rows(0, 1000), design.rows(123, 457)
    assert all(np.array_equal(part[name], whole[name][123:457]) for name in whole)
    assert not np.array_equal(whole["x0"], Draws(1000, design.columns, method=method, seed=4).rows(0, 1000)["x0"])


@pytest.mark.parametrize(
    ("method", "first", "last"),
    [
        ("sobol", 0.286169162020087, 0.773987294174731),
        ("latin-hypercube", 0.912620681570396, 0.22209836940681),
        ("random", 0.303568034306759, 0.337422794010803),
    ],
)
def test_the_random_streams_stay(method, first, last):
    """docs/what_stays.md promises these rows for every 1.x."""
    rows = Draws(8, {"a": ("uniform", 0, 1), "b": ("uniform", 0, 1)}, method=method, seed=1).rows(0, 8)
    assert [rows["a"][0], rows["b"][7]] == pytest.approx([first, last], abs=1e-12)


@pytest.mark.parametrize(
    ("draw", "mean", "deviation"),
    [
        (("uniform", 2, 6), 4.0, 4 / 12**0.5),
        (("normal", 3, 0.5), 3.0, 0.5),
        (("loguniform", 1, 10), 9 / np.log(10), None),
        (("triang", 0.5, 0, 2), 1.0, 2 * 24**-0.5),
    ],
)
def test_distributions(draw, mean, deviation):
    x = Draws(4096, {"x": draw}, seed=1).rows(0, 4096)["x"]
    assert x.mean() == pytest.approx(mean, rel=1e-3)  # 2e-5 to 2e-4
    if deviation is not None:
        assert x.std() == pytest.approx(deviation, rel=5e-3)


def test_sobol_averages_better_than_random():
    def error(method):
        columns = {"x": ("uniform", 0, 1), "y": ("uniform", 0, 1)}
        rows = Draws(4096, columns, method=method, seed=2).rows(0, 4096)
        return abs(np.mean(np.exp(rows["x"] * rows["y"])) - 1.3179021514544)

    assert error("sobol") < error("random") / 10
    assert error("latin-hypercube") < error("random")


def test_all_distributions_are_those_of_scipy():
    at = np.array([0.1, 0.9])
    assert np.array_equal(Draw("gumbel_r", (1.0, 2.0)).quantiles(at), stats.gumbel_r.ppf(at, 1.0, 2.0))


def test_unique_rows():
    rows = {"a": np.array([2.0, 1.0, 2.0, 2.0]), "b": np.array(["x", "x", "y", "x"])}
    different, number = unique_rows(rows)
    assert len(different["a"]) == 3
    assert all(np.array_equal(values[number], rows[name]) for name, values in different.items())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Table({"a": [1.0, 2.0], "b": [1.0]}), r"take Product, but their lengths are: a 2, b 1"),
        (lambda: Table({"a": 1.0}), r"a a single value"),
        (lambda: Table({}), r"lengths are: none"),
        (lambda: Product({"a": []}), r"the axis 'a' has values of shape \(0,\)"),
        (lambda: Product({"a": [1.0, 1.0]}), r"the axis 'a' has a value more than once"),
        (lambda: Product({"a": [1.0, np.nan]}), r"the axis 'a' has the values .*; give finite numbers"),
        (lambda: Draws(0, {"a": ("uniform", 0, 1)}), r"count is 0; it must be an integer of at least 1"),
        (lambda: Draws(5, {}), r"there are no columns"),
        (
            lambda: Draws(5, {"a": ("unifrom", 0, 1)}),
            r"no continuous distribution 'unifrom' in scipy\.stats\. Did you mean uniform\?",
        ),
        (lambda: Draws(5, {"a": ("uniform", 1, 0)}), r"takes? the lowest and the highest value|gives no numbers"),
        (lambda: Draws(5, {"a": ("uniform", 1)}), r"uniform with the arguments \(1\.0,\)"),
        (lambda: Draws(5, {"a": ("normal", 0.0, "1")}), r"the column 'a' is \(0\.0, '1'\); give real numbers"),
        (lambda: Draws(5, {"a": 3.0}), r"the column 'a' is 3\.0; give a distribution"),
        (lambda: Draws(5, {"a": ("uniform", 0, 1)}, method="sobel"), r"Did you mean sobol\?"),
        (lambda: Draws(2**23, {"a": ("uniform", 0, 1)}, method="latin-hypercube"), r"take method='random'"),
    ],
)
def test_bad_designs_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_axis_keeps_its_unit():
    design = Product({"omega": Axis([1.0, 2.0], "rad/s", "frequency of the stiff springs")})
    assert design.described()["omega"] == {
        "units": "rad/s",
        "description": "frequency of the stiff springs",
        "values": [1.0, 2.0],
    }
