"""Designs: the runs of an ensemble. A design is a table with a row for each run; only the rows of a chunk are made at a
time.

    Product({"omega": [10, 50], "num_micro": [1, 5]})          all combinations, the last axis varies fastest
    Table({"omega": [10, 50], "v_s[0]": [0.1, 0.2]})           a run for each row: 10 with 0.1, 50 with 0.2
    Draws(1000, {"omega": ("uniform", 10, 50)}, seed=1)        1000 runs with random values

A function ``(problem, row) -> problem`` makes the problem of a run from the values of its row by column; columns with
the names macro_dt, num_steps, num_micro and scheme choose steps and schemes instead.

Rows are numbered from 0. Any row can be made without the others: a random row depends on the seed and on its number
alone.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from vmri_jax.mechanics.arrays import real_array, whole_number
from vmri_jax.mechanics.names import near, unknown
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused

Rows = dict[str, np.ndarray]
"""Some rows of a design: an array for each column, its first axis the rows."""

MOST_POINTS = {"sobol": 2**30, "latin-hypercube": 2**22, "random": np.inf}
"""Largest number of rows by the method that draws them. The numbers of a sequence of Sobol have 30 bits, after which
the sequence ends. Every worker makes the whole table of a Latin hypercube: 32 MiB for each column, more with a larger
number."""
ALIASES = {"normal": "norm", "exponential": "expon"}
"""Further names of distributions, and the names that `scipy.stats` has for them."""
STEPS = ("macro_dt", "num_steps")
SCHEMES = ("scheme", "num_micro")

Row = Mapping[str, Any]
"""The value of each column in a row of a design."""
Vary = Callable[[Problem, Row], Problem]
"""A function that makes the problem of a run from a problem and a row."""


@dataclass(frozen=True)
class Axis:
    """Values of a column, with its unit and meaning.

    values: numbers, or labels of schemes.
    unit, description: stored with the results.
    """

    values: Any
    unit: str = ""
    description: str = ""


@dataclass(frozen=True)
class Draw:
    """A distribution from which the values of a column are drawn.

    name: "uniform" (lowest, highest), "loguniform" (lowest, highest), "normal" (mean, standard deviation), or any
        continuous distribution of `scipy.stats` with its arguments.
    unit, description: stored with the results.
    """

    name: str
    arguments: tuple[float, ...] = ()
    unit: str = ""
    description: str = ""

    def quantiles(self, at: np.ndarray) -> np.ndarray:
        """Quantiles of the distribution at the probabilities `at`, between 0 and 1.

        Raises:
            ValueError: an unknown distribution, or arguments that it does not take.
        """
        from scipy import stats  # the import takes a third of a second

        name = ALIASES.get(self.name, self.name)
        distribution = getattr(stats, name, None)
        if not isinstance(distribution, stats.rv_continuous):
            known = [*ALIASES, *(n for n, d in vars(stats).items() if isinstance(d, stats.rv_continuous))]
            missing = f"there is no continuous distribution {self.name!r} in scipy.stats"
            raise Refused(f"Draws: {missing}.{near(self.name, known)}")
        arguments = self.arguments
        try:
            if name == "uniform" and arguments:  # scipy takes the lowest value and the width
                low, high = arguments
                arguments = low, high - low if high > low else np.nan
            values = np.asarray(distribution.ppf(at, *arguments), dtype=float)
        except (TypeError, ValueError) as error:
            raise Refused(f"Draws: {self.name} with the arguments {self.arguments}: {error}.") from None
        if not np.isfinite(values).all():
            takes = "uniform and loguniform take the lowest and the highest value, normal mean and standard deviation"
            raise Refused(f"Draws: {self.name} with the arguments {self.arguments} gives no numbers; {takes}.")
        return values


@dataclass(frozen=True)
class Product:
    """All combinations of the values of some axes. The last axis varies fastest, as in C order.

    axes: for each column, values or an `Axis`. Without any axis there is a single run.

    Raises:
        ValueError: an axis without values, with a value twice, or with values that are not finite.
    """

    axes: Mapping[str, Any]

    def __post_init__(self):
        axes = _axes("the axis", self.axes)
        for name, axis in axes.items():
            values = axis.values
            if values.ndim != 1 or not values.size:
                raise Refused(f"Product: the axis {name!r} has values of shape {values.shape}; give a list of numbers.")
            if len(np.unique(values)) < values.size:
                raise Refused(f"Product: the axis {name!r} has a value more than once: {values.tolist()}.")
        object.__setattr__(self, "axes", axes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes."""
        return tuple(axis.values.size for axis in self.axes.values())

    def __len__(self) -> int:
        return math.prod(self.shape)

    def rows(self, first: int, last: int) -> Rows:
        """Rows number `first` to `last - 1`."""
        places = np.unravel_index(np.arange(first, last), self.shape) if self.axes else ()
        return {name: axis.values[place] for (name, axis), place in zip(self.axes.items(), places, strict=True)}

    def described(self) -> dict[str, dict]:
        """The columns as plain data, for the store."""
        return {name: {**_words(axis), "values": axis.values.tolist()} for name, axis in self.axes.items()}


@dataclass(frozen=True)
class Table:
    """Given rows.

    columns: for each column, values or an `Axis`; the first axis of the array is the runs. A value may be a vector, for
        a whole q_s or v_f.

    Raises:
        ValueError: no column, columns of different length, or values that are not finite.
    """

    columns: Mapping[str, Any]

    def __post_init__(self):
        columns = _axes("the column", self.columns)
        lengths = {name: axis.values.shape[:1] for name, axis in columns.items()}
        if len(set(lengths.values())) != 1 or () in lengths.values() or (0,) in lengths.values():
            texts = [f"{name} {shape[0] if shape else 'a single value'}" for name, shape in lengths.items()]
            lengths = ", ".join(texts) or "none"
            raise Refused(f"Table: give columns of one length, or take Product, but their lengths are: {lengths}.")
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())).values)

    def rows(self, first: int, last: int) -> Rows:
        """Rows number `first` to `last - 1`."""
        return {name: axis.values[first:last] for name, axis in self.columns.items()}

    def described(self) -> dict[str, dict]:
        """The columns as plain data, without their values, which the store has in arrays."""
        return {name: _words(axis) for name, axis in self.columns.items()}


@dataclass(frozen=True)
class Draws:
    """Random rows.

    count: number of runs.
    columns: for each column a `Draw`, or a tuple of the name of a distribution and its arguments,
        ``("uniform", 10, 50)``.
    method: "sobol" (a scrambled sequence: averages converge faster), "latin-hypercube", or "random" (independent).
    seed: of the generator of random numbers; the same seed gives the same rows.

    Raises:
        ValueError: bad arguments; more rows than a method can make.
    """

    count: int
    columns: Mapping[str, Any]
    method: str = "sobol"
    seed: int = 0

    def __post_init__(self):
        whole_number("Draws: count", self.count)
        whole_number("Draws: seed", self.seed, least=0)
        if self.method not in list(MOST_POINTS):
            raise Refused(f"Draws: {unknown('method', str(self.method), MOST_POINTS)}")
        most = MOST_POINTS[self.method]
        if self.count > most:
            raise Refused(f"Draws: count is {self.count}, more than {most} of {self.method}; take method='random'.")
        if not self.columns:
            raise Refused("Draws: there are no columns; give at least one, e.g. {'omega': ('uniform', 10, 50)}.")
        columns = {name: _draw(name, draw) for name, draw in self.columns.items()}
        for draw in columns.values():
            draw.quantiles(np.array([0.5]))
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return self.count

    def rows(self, first: int, last: int) -> Rows:
        """Rows number `first` to `last - 1`."""
        points = np.clip(self._points(first, last), 2.0**-53, 1 - 2.0**-53)  # quantiles of 0 and 1 may be infinite
        return {name: draw.quantiles(points[:, i]) for i, (name, draw) in enumerate(self.columns.items())}

    def described(self) -> dict[str, dict]:
        """The columns as plain data, for the store."""
        distributions = {name: [draw.name, *draw.arguments] for name, draw in self.columns.items()}
        return {name: {**_words(draw), "distribution": distributions[name]} for name, draw in self.columns.items()}

    def _points(self, first: int, last: int) -> np.ndarray:
        """(last - first, number of columns) numbers between 0 and 1."""
        size = len(self.columns)
        if self.method == "latin-hypercube":
            return _latin_hypercube(self.count, size, self.seed)[first:last]
        if self.method == "random":
            blocks = -(-size // 4)  # the generator makes four numbers at a time
            generator = np.random.Generator(np.random.Philox(key=self.seed).advance(first * blocks))
            return generator.random((last - first, 4 * blocks))[:, :size]
        from scipy.stats import qmc

        sequence = qmc.Sobol(size, rng=np.random.default_rng(self.seed))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The balance properties")  # a chunk is no power of two
            return sequence.fast_forward(first).random(last - first) if first else sequence.random(last)


Design = Product | Table | Draws


class Chunks(NamedTuple):
    """The runs of an ensemble, the runs of a chunk (the last one may have fewer), and those computed side by side."""

    lanes: int
    size: int
    width: int

    @property
    def count(self) -> int:
        """Number of chunks."""
        return -(-self.lanes // self.size)

    def ends(self, number: int) -> tuple[int, int]:
        """Number of the first run of a chunk, and of the first run after it."""
        return number * self.size, min((number + 1) * self.size, self.lanes)


def combinations(design: Design, names: Sequence[str]) -> Rows:
    """All different combinations of the values of some columns; drawn values are all different, and refused."""
    if not names:
        return {}
    if isinstance(design, Draws):
        raise Refused(f"Draws: {', '.join(names)} cannot be drawn: each value needs a program. Give a Table.")
    if isinstance(design, Table):
        return unique_rows({name: design.columns[name].values for name in names})[0]
    part = Product({name: design.axes[name] for name in names})
    return part.rows(0, len(part))


def unique_rows(rows: Rows) -> tuple[Rows, np.ndarray]:
    """The distinct rows, and for each row the number of the distinct row that it equals."""
    if not rows:
        return {}, np.zeros(0, dtype=int)
    _, first, inverse = np.unique(np.rec.fromarrays(list(rows.values())), return_index=True, return_inverse=True)
    return {name: values[first] for name, values in rows.items()}, inverse


@lru_cache(maxsize=2)
def _latin_hypercube(count: int, size: int, seed: int) -> np.ndarray:
    from scipy.stats import qmc

    return qmc.LatinHypercube(size, rng=np.random.default_rng(seed)).random(count)


def _draw(name: str, entry) -> Draw:
    if isinstance(entry, Draw):
        return entry
    if not (isinstance(entry, Sequence) and len(entry) and isinstance(entry[0], str)) or isinstance(entry, str):
        raise Refused(f"Draws: the column {name!r} is {entry!r}; give a distribution, e.g. ('uniform', 10, 50).")
    return Draw(entry[0], tuple(map(float, real_array(f"Draws: the column {name!r}", entry[1:], ndim=1))))


def _axes(subject: str, columns: Mapping[str, Any]) -> dict[str, Axis]:
    """An `Axis` for each column, its values as an array."""
    axes = {name: axis if isinstance(axis, Axis) else Axis(axis) for name, axis in columns.items()}
    return {name: replace(axis, values=_values(f"{subject} {name!r}", axis.values)) for name, axis in axes.items()}


def _values(subject: str, values) -> np.ndarray:
    """Numbers as float64, whole numbers as int64, labels as strings."""
    array = np.asarray(values)
    if array.dtype.kind in "US":
        return array.astype(str)
    if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise Refused(f"{subject} has the values {values!r}; give finite numbers, or labels of schemes.")
    return array.astype(np.int64 if array.dtype.kind in "iu" else np.float64)


def _words(axis: Axis | Draw) -> dict[str, str]:
    texts = {"units": axis.unit, "description": axis.description}
    return {name: text for name, text in texts.items() if text}


def columns_of_problems(columns: Sequence[str]) -> list[str]:
    """The columns that choose neither steps nor schemes."""
    return [name for name in columns if name not in (*STEPS, *SCHEMES)]


def numbers_in(rows: Rows) -> Rows:
    """The columns of numbers that change the problem; steps and schemes are left out."""
    for name, values in rows.items():
        if name != "scheme" and values.dtype.kind not in "if":
            raise Refused(f"ensemble: the column {name!r} has labels; give numbers. Only 'scheme' may have labels.")
    return {name: rows[name] for name in columns_of_problems(list(rows))}
