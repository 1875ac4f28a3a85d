"""The work of an ensemble: a small object that pickle can send, with which a worker computes some of the runs."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from vmri_jax.accuracy.batch import simulate_batch
from vmri_jax.catalogue import find_problem, find_scheme
from vmri_jax.ensembles.columns import SCHEMES, STEPS, Lanes, Row, Vary, columns_of_problems, lane_function, numbers_in
from vmri_jax.ensembles.design import Design, Rows, combinations, unique_rows
from vmri_jax.ensembles.quantities import Quantity, Saved, of_lanes, quantity
from vmri_jax.mechanics.checks import check_type, digest
from vmri_jax.mechanics.names import unknown
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused
from vmri_jax.running.arguments import Save, Steps, check_step_size, steps_until
from vmri_jax.running.batch import consistent_states
from vmri_jax.running.export import STATUS
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.schemes.composition import SchemeLike
from vmri_jax.steppers.solver import Solver

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
        """Refuse a worker on which a file of the user is missing, or differs from the file where the ensemble was started."""
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

    @cached_property
    def lane(self) -> Callable[[Row], Lanes]:
        """The function from the numbers of a row to the parameters and the start of its run."""
        names = columns_of_problems(self.columns)
        return lane_function(self.problem, self.vary, names, "t_end" in self.steps)

    @cached_property
    def lanes(self) -> Callable[[Rows, int], Lanes]:
        """The compiled function from the numbers of some rows, and their count, to the parameters and starts of their runs."""
        return jax.jit(lambda rows, count: jax.vmap(self.lane, axis_size=count)(rows), static_argnums=1)

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
        steps = Steps(macro_dt, num_steps, save=Save(number=self.num_saves))
        return simulation(self.problem, group.scheme, state, self.solver, steps)

    def compute(self, rows: Rows, count: int, width: int) -> dict[str, np.ndarray]:
        """Kept quantities and status of the runs of `count` rows, `width` of them side by side; arrays by name, a row for each run."""
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
        twice = sorted(set(self.steps) & set(values))
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


def _whole(name: str, value) -> int:
    if float(value) != int(value) or value < 1:
        raise Refused(f"ensemble: a value of {name} is {value}; it must be a whole number of at least 1.")
    return int(value)
