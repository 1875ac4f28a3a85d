"""The work of an ensemble: a small object that pickle can send, with which a worker computes some of the runs; and its
preparation, the checks of all arguments, its chunks, the arrays of its store, and the record that identifies it."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from operator import is_
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from vmri_jax.accuracy.companions import resting
from vmri_jax.accuracy.simulate import simulate_batch
from vmri_jax.catalogue import find_problem, find_scheme
from vmri_jax.ensembles.design import (
    SCHEMES,
    STEPS,
    Axis,
    Chunks,
    Design,
    Draws,
    Product,
    Row,
    Rows,
    Vary,
    columns_of_problems,
    combinations,
    numbers_in,
    unique_rows,
)
from vmri_jax.ensembles.quantities import OVER_NODES, Quantity, Saved, label_of, of_lanes, quantity, what_is_kept
from vmri_jax.mechanics.arrays import is_concrete, whole_number
from vmri_jax.mechanics.checks import check_type, digest, traced
from vmri_jax.mechanics.names import Names, near, unknown
from vmri_jax.mechanics.places import START
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.structure import depends_on
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.arguments import Save, check_step_size, steps_until
from vmri_jax.running.batch import consistent_states, lanes_at_once
from vmri_jax.running.export import STATUS
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.store.identity import describe, environment, identity, operations
from vmri_jax.running.store.layout import Kept, rows_per_chunk
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver

MOST_CHUNKS = 20_000
"""Largest number of chunks of an ensemble, unless limits need more. A scheduler hands out some hundreds of tasks a
second, and every chunk has its files: a larger number costs more time than the runs."""
FEWEST_CHUNKS = 64
"""Target for the smallest number of chunks, so that workers share the runs evenly; batches that are computed side by
side are not cut for it. A larger one makes chunks so small that writing their files takes most of the time."""
MICRO_STEP_NANOSECONDS = {"explicit": 1.0, "implicit": 25.0}
"""Rough nanoseconds of a micro step, for each coordinate of each run in a batch, by kind of step. They only choose the
size of chunks: with larger ones chunks have fewer runs."""

AnyScheme = str | SchemeLike | Callable[[int], SchemeLike]
"""A scheme, the name of one, or a function from the number of micro steps to a scheme."""


class Group(NamedTuple):
    """Runs of one compiled program, by the numbers of their rows; `macro_dt` may have a value for each run."""

    lanes: np.ndarray
    scheme: SchemeLike
    macro_dt: Any
    num_steps: int


@dataclass(frozen=True)
class Work:
    """The arguments of `ensemble` that all runs share, and the columns that change some of them for each run.

    steps: t_end, num_steps and macro_dt by name, as far as the user gave them.
    sources: digests of the user's files, by path.
    """

    system: str | Problem
    schemes: Mapping[str, AnyScheme]
    columns: tuple[str, ...]
    steps: Mapping[str, Any]
    num_micro: int | None = None
    solver: Solver | None = None
    project: bool | None = None
    save: tuple[Saved, ...] = ("end",)
    num_saves: int = 1
    vary: Vary | None = None
    sources: Mapping[str, str] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        return {part.name: getattr(self, part.name) for part in fields(self)}  # without cached properties

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Refuse a worker on which a file of the user is missing, or differs from the file where the ensemble was
        started."""
        self.__dict__.update(state)
        for file, digest_at_start in self.sources.items():
            if not Path(file).is_file():
                raise FileNotFoundError(f"{file} does not exist on this worker; put it where all workers see it.")
            if digest(Path(file).read_bytes()) != digest_at_start:
                raise Refused(f"{file} differs from the file of the process that started the ensemble.")

    def with_sources(self) -> "Work":
        """This work with absolute paths of the user's files, and with digests of them."""
        names = [name for name in (self.system, *self.save) if isinstance(name, str)]
        files = {name.partition(":")[0] for name in names}
        resolved = {file: str(Path(file).resolve()) for file in files if Path(file).suffix and Path(file).is_file()}

        def located(name):
            file, colon, attribute = name.partition(":") if isinstance(name, str) else ("", "", "")
            return f"{resolved[file]}{colon}{attribute}" if file in resolved else name

        sources = {file: digest(Path(file).read_bytes()) for file in resolved.values()}
        return replace(self, system=located(self.system), save=tuple(map(located, self.save)), sources=sources)

    @cached_property
    def problem(self) -> Problem:
        """The problem whose parameters and start the columns change."""
        return find_problem(self.system) if isinstance(self.system, str) else self.system

    def lane(self, problem: Problem, row: Row) -> tuple[Any, tuple[Any, ...]]:
        """The parameters of the run of a row, None if `vary` changes none, and its start (t, q_s, q_f, v_s, v_f).

        The problem is an argument, since this function is traced: a problem that it made would have tracers. `vary`
        gets the columns in their order in the design, which JAX would sort.
        """
        columns = columns_of_problems(self.columns)
        if self.vary is None and columns:
            known = near(columns[0], (*STEPS, *SCHEMES))
            reason = f"the column {columns[0]!r} is neither a step nor a scheme"
            raise Refused(f"ensemble: {reason}.{known} Give vary= for it.")
        params = problem.system.params
        # with dictionaries of its own, which `vary` may change in place
        copied = replace(problem, system=problem.system.with_params(jax.tree.map(lambda leaf: leaf, params)))
        changed = copied if self.vary is None else self.vary(copied, {name: row[name] for name in columns})
        check_type("ensemble: vary(problem, row)", changed, Problem, "dataclasses.replace(problem, q_s=...)")
        _check_only_values_differ(problem, changed)
        if "t_end" in self.steps and changed.t is not problem.t:
            raise Refused("ensemble: vary changes t, so that t_end does not fix the number of steps; give num_steps.")
        is_same = all(map(is_, jax.tree.leaves(changed.system.params), jax.tree.leaves(params)))
        return None if is_same else changed.system.params, tuple(getattr(changed, part) for part in START)

    @cached_property
    def lanes(self) -> Callable[[Rows, int], tuple]:
        """The compiled function from the numbers of some rows, and their count, to the parameters and starts of their
        runs."""
        lane = partial(self.lane, self.problem)
        return jax.jit(lambda rows, count: jax.vmap(lane, axis_size=count)(rows), static_argnums=1)

    @cached_property
    def quantities(self) -> list[Quantity]:
        """The quantities that are kept."""
        return list(map(quantity, self.save))

    @cached_property
    def told_apart(self) -> list[str]:
        """Columns of which every value needs a group: schemes, number of steps, and step sizes that decide it."""
        knows_number = "t_end" not in self.steps or "num_steps" in (*self.columns, *self.steps)
        steps = ("num_steps",) if knows_number else STEPS
        return [name for name in self.columns if name in (*SCHEMES, *steps)]

    def groups(self, rows: Rows, count: int) -> Iterator[Group]:
        """Divide rows into groups, one for each compiled program."""
        different, number = unique_rows({name: rows[name] for name in self.told_apart})
        if not self.told_apart:
            number = np.zeros(count, dtype=int)
        for i in range(number.max() + 1):
            lanes = np.flatnonzero(number == i)
            values = {name: values[i] for name, values in different.items()}
            dt = {name: rows[name][lanes] for name in ("macro_dt",) if name in rows and name not in values}
            scheme = self._scheme(values)
            yield Group(lanes, scheme, *self._steps(values | dt))

    def simulation(self, group: Group) -> Simulation:
        """The first run of a group, after a check of its arguments."""
        macro_dt, num_steps = float(np.ravel(group.macro_dt)[0]), group.num_steps
        state = self.problem.state(self.project)
        save = Save(number=self.num_saves)
        return simulation(self.problem, group.scheme, state, self.solver, macro_dt, num_steps, save=save)

    def compute(self, rows: Rows, count: int, width: int) -> dict[str, np.ndarray]:
        """Kept quantities and status of the runs of `count` rows, `width` of them side by side; arrays by name, a row
        for each run."""
        arrays: dict[str, np.ndarray] = {}
        for group in self.groups(rows, count):
            part = self._compute(group, {name: values[group.lanes] for name, values in rows.items()}, width)
            for name, values in part.items():
                array = arrays.setdefault(name, np.empty((count, *values.shape[1:]), values.dtype))
                array[group.lanes] = values
        return arrays

    def _compute(self, group: Group, rows: Rows, width: int) -> dict[str, np.ndarray]:
        count = len(group.lanes)
        # Copies of the last run fill up the batch: one program, compiled for `width` runs, computes all batches.
        filled = np.minimum(np.arange(max(count, width)), count - 1)
        rows = {name: values[filled] for name, values in rows.items()}
        macro_dt = group.macro_dt[filled] if np.ndim(group.macro_dt) else group.macro_dt
        params, start = self.lanes(numbers_in(rows), len(filled))
        project = self.problem.project if self.project is None else self.project
        states = consistent_states(self.problem.system, params, start, project)
        steps = {"macro_dt": macro_dt, "num_steps": group.num_steps, "save": Save(number=self.num_saves)}
        how = {"params": params, "solver": self.solver, "chunk": width, "warn": False}
        trajectory = simulate_batch(self.problem, group.scheme, states, **steps, **how)
        kept = {name: np.asarray(getattr(trajectory, name)) for name in STATUS} | of_lanes(self.quantities, trajectory)
        return {name: np.asarray(value)[:count] for name, value in kept.items()}

    def _scheme(self, values: Mapping[str, Any]) -> SchemeLike:
        label = str(values.get("scheme", next(iter(self.schemes))))
        if label not in self.schemes:
            raise Refused(f"ensemble: {unknown('scheme', label, self.schemes)}")
        scheme = self.schemes[label]
        num_micro = _whole("num_micro", values["num_micro"]) if "num_micro" in values else self.num_micro
        if isinstance(scheme, SchemeLike):
            if num_micro is not None:
                raise Refused(f"ensemble: the scheme {label!r} has its num_micro already; give its name or function.")
            return scheme
        if num_micro is None:
            raise Refused(f"ensemble: num_micro is missing for the scheme {label!r}, as argument or column.")
        made = find_scheme(scheme, num_micro) if isinstance(scheme, str) else scheme(num_micro)
        check_type(f"ensemble: the value of the scheme {label!r}", made, SchemeLike, "a Scheme")
        return made

    def _steps(self, values: Mapping[str, Any]) -> tuple[Any, int]:
        """Macro step, a number or one for each run, and number of macro steps."""
        arguments = self.steps if self.num_micro is None else {**self.steps, "num_micro": self.num_micro}
        twice = sorted(set(arguments) & set(self.columns))
        if twice:
            raise Refused(f"ensemble: {', '.join(twice)} is a column and an argument; leave one of them out.")
        steps = {**self.steps, **{name: values[name] for name in STEPS if name in values}}
        if len(steps) != 2:
            got = ", ".join(sorted(steps)) or "nothing"
            raise Refused(f"ensemble: got {got}; give two of t_end, num_steps and macro_dt, as arguments or columns.")
        start = float(self.problem.t)
        num_steps: Any = _whole("num_steps", steps["num_steps"]) if "num_steps" in steps else None
        if "macro_dt" not in steps:
            return (float(steps["t_end"]) - start) / num_steps, num_steps
        macro_dt = np.asarray(steps["macro_dt"], dtype=float)
        check_step_size(macro_dt, "ensemble", ndim=None)
        macro_dt = float(macro_dt) if macro_dt.ndim == 0 else macro_dt
        return macro_dt, num_steps or steps_until(steps["t_end"], start, macro_dt)


def all_groups(work: Work, design: Design) -> Iterator[Group]:
    """All groups that the rows of a design can form, each with a single row."""
    rows = combinations(design, work.told_apart)
    step_columns = [name for name in ("macro_dt",) if name in work.columns and name not in rows]
    first = design.rows(0, 1) if step_columns else {}
    count = max((len(values) for values in rows.values()), default=1)
    yield from work.groups(rows | {name: np.repeat(first[name], count) for name in step_columns}, count)


def _check_only_values_differ(problem: Problem, changed: Problem) -> None:
    """Refuse a row whose run the program of the problem cannot compute: another system but for parameters, or arrays of
    other shapes."""
    leaves, structure = jax.tree.flatten(problem.system.replace(params=None))
    new_leaves, new_structure = jax.tree.flatten(changed.system.replace(params=None))
    are_equal = (a is b or (is_concrete(b) and np.array_equal(a, b)) for a, b in zip(leaves, new_leaves, strict=False))
    same_system = structure == new_structure and all(are_equal)
    before, after = ((entry.system.params, [getattr(entry, part) for part in START]) for entry in (problem, changed))
    same_shapes = jax.tree.map(np.shape, before) == jax.tree.map(np.shape, after)
    if not (same_system and same_shapes):
        changes = "the system besides its params" if same_shapes else "the structure or shape of one of them"
        raise Refused(f"ensemble: vary changes {changes}; it may change values of system.params and of the start.")


def _whole(name: str, value) -> int:
    if float(value) != int(value) or value < 1:
        raise Refused(f"ensemble: a value of {name} is {value}; it must be a whole number of at least 1.")
    return int(value)


def prepared(work: Work, design: Design, chunk: int | None = None) -> tuple[dict[str, Any], dict[str, Kept], Chunks]:
    """Attributes and arrays of the store of an ensemble, and the division of its runs, after all checks; nothing is
    computed.

    Attributes: the design, names of coordinates, the record that identifies the ensemble, versions.
    """
    row, lane = _first_row(design), partial(work.lane, work.problem)  # a problem made within a trace would have tracers
    with traced("ensemble: vary"):
        used = depends_on(lambda *values: lane(dict(zip(row, values, strict=True))), *row.values())
    unused = [name for name, is_used in zip(row, used, strict=True) if not is_used]
    if unused:
        warn_user(f"ensemble: no run depends on {', '.join(unused)}: vary does not use these columns.")
    if "macro_dt" in work.columns:
        check_step_size(design.rows(0, len(design))["macro_dt"], "ensemble", ndim=None)
    runs = [work.simulation(group) for group in all_groups(work, design)]  # one of each group
    runs[0].check("ensemble: the start", constraints=False)
    over_nodes = [name for name in OVER_NODES if name in work.save]
    if over_nodes and work.num_saves == 1:
        looks = f"{', '.join(over_nodes)} looks at the saved nodes of a run"
        raise Refused(f"ensemble: {looks}, and only its end is saved; give num_saves, for example 50.")
    runs.sort(key=lambda run: run.num_steps * run.scheme.num_micro, reverse=True)
    run = runs[0]
    arrays = {
        "result": Kept(np.empty((), np.int32), (), "status of the run, see flag_meanings"),
        "failed_at": Kept(np.empty((), np.int32), (), "macro step that failed, -1 if none did"),
    }
    arrays |= what_is_kept(work.quantities, run)
    chunks = _chunks(runs, len(design), arrays, chunk)
    names = (run.names or Names()).of_coordinates(run.state.q_s.size, run.state.q_f.size)
    drawn = {"method": design.method, "seed": design.seed} if isinstance(design, Draws) else {}
    attributes = {
        "kind": "ensemble",
        "rows": chunks.lanes,
        "chunk": chunks.size,
        "width": chunks.width,
        "design": {"kind": type(design).__name__, "columns": design.described()} | drawn,
        "system": work.system if isinstance(work.system, str) else "a problem",
        "slow": names.slow_coordinates,
        "fast": names.fast_coordinates,
        "identity": _identity(work, design, run) | {name: str(value) for name, value in drawn.items()},
        "made_with": environment(),
    }
    return attributes, arrays, chunks


def _first_row(design: Design) -> Row:
    """The numbers of the first row of a design."""
    return {name: values[0] for name, values in numbers_in(design.rows(0, 1)).items()}


def _chunks(runs: list[Simulation], lanes: int, arrays: dict[str, Kept], chunk: int | None) -> Chunks:
    """Chunks of about `CHUNK_SECONDS`, of a power of two times `width` runs; `width` runs are computed side by side."""
    run = runs[0]
    # A chunk has runs of every group: a batch wider than the share of one group would be filled with copies.
    width = min(lanes_at_once(run), 2 ** (-(-lanes // len(runs)) - 1).bit_length(), lanes)
    if chunk is not None:
        size = min(whole_number("ensemble: chunk", chunk, otherwise=", or None"), lanes)
        return Chunks(lanes, size, min(width, size))
    kind = "implicit" if run.system.is_constrained or run.plan.has_fallback else "explicit"
    size_q = run.state.q_s.size + run.state.q_f.size
    micro_steps = run.num_steps * run.scheme.num_micro
    seconds = 1e-9 * MICRO_STEP_NANOSECONDS[kind] * micro_steps * run.scheme.degree**2 * size_q
    array_bytes = sum(kept.value.dtype.itemsize * int(np.prod(kept.value.shape)) for kept in arrays.values())
    bytes_of_run = array_bytes + 8 * (2 * size_q + 8) * (run.num_saves + 1)
    most_lanes = min(rows_per_chunk(lanes, seconds, bytes_of_run, MOST_CHUNKS), lanes / FEWEST_CHUNKS)
    size = width * 2 ** max(0, int(np.log2(max(most_lanes / width, 1.0))))
    return Chunks(lanes, min(size, lanes), width)


def _identity(work: Work, design: Design, run: Simulation) -> dict[str, str]:
    """In words and digests, by name, everything that the results depend on."""
    about_run = identity(run).items()
    identity_record = {name: text for name, text in about_run if not name.startswith(("scheme", "macro_dt"))}
    for label, scheme in work.schemes.items():
        name = scheme if isinstance(scheme, str) else getattr(scheme, "__qualname__", None)
        identity_record |= {f"scheme {label}": name} if name else describe(f"scheme {label}", scheme)
    identity_record |= {name: str(value) for name, value in work.steps.items()}
    saved = [label_of(entry) if callable(entry) else Path(entry).name for entry in work.save]
    identity_record |= {"num_micro": str(work.num_micro), "save": ", ".join(saved)}
    for entry in filter(callable, work.save):
        identity_record |= {f"operations of {label_of(entry)}": operations(quantity(entry), resting(run))}
    identity_record |= {"num_saves": str(work.num_saves), "project": str(work.project), "runs": str(len(design))}
    identity_record |= {f"file {Path(file).name}": digest for file, digest in work.sources.items()}
    if work.vary is not None:
        identity_record |= describe("vary", work.vary)
        identity_record |= {"operations of vary": operations(partial(work.lane, work.problem), _first_row(design))}
    identity_record |= {"design": type(design).__name__}
    for name, column in (design.axes if isinstance(design, Product) else design.columns).items():
        values = column.values if isinstance(column, Axis) else (column.name, *column.arguments)
        identity_record |= describe(f"column {name}", values)
    return identity_record
