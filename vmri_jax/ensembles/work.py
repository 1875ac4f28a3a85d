"""The work of an ensemble: everything that a worker has to know to compute some of its runs. It is small, and can be sent."""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from vmri_jax.catalogue import find_problem, find_scheme
from vmri_jax.ensembles.columns import SCHEMES, STEPS, Place, lanes_of, places
from vmri_jax.ensembles.design import Design, Rows, unique_rows
from vmri_jax.ensembles.quantities import Quantity, of_lanes, quantity
from vmri_jax.mechanics.names import near
from vmri_jax.mechanics.state import Problem, State, initial_state
from vmri_jax.mechanics.system import System
from vmri_jax.running import arguments
from vmri_jax.running.arguments import steps_until
from vmri_jax.running.batch import simulate_batch
from vmri_jax.running.simulation import Simulation, simulation
from vmri_jax.running.trajectory import STATUS, Trajectory
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.solvers import Newton

AnyScheme = str | Scheme | Composition | Callable[[int], Scheme | Composition]
"""A scheme, by name or itself, or what makes one for a number of micro steps."""


class Steps(NamedTuple):
    """Steps of runs, as far as they are the same for all of them."""

    t_end: float | None = None
    num_steps: int | None = None
    macro_dt: float | None = None
    micro_dt: float | None = None


class Group(NamedTuple):
    """Runs that one program computes side by side.

    lanes: which rows they are.
    macro_dt: a number, or one for each of them.
    """

    lanes: np.ndarray
    scheme: Scheme | Composition
    macro_dt: Any
    num_steps: int


@dataclass(frozen=True)
class Work:
    """What is the same for all runs of an ensemble, and how columns of its design change it.

    system: name of a system, or a problem that can be pickled.
    schemes: by label.
    columns: names of the columns of the design.
    steps, num_micro, solver, project: as of `ensemble`.
    save: names of what is kept; num_saves: saved nodes after the start.
    sources: digests of the user's files that are named here.
    """

    system: str | Problem
    schemes: Mapping[str, AnyScheme]
    columns: tuple[str, ...]
    steps: Steps
    num_micro: int | None = None
    solver: Newton | None = None
    project: bool | None = None
    save: tuple[str, ...] = ("end",)
    num_saves: int = 1
    sources: Mapping[str, str] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in fields(self)}  # without what was made of them here

    def with_sources(self) -> "Work":
        """The same that knows what is in the user's files, which get their whole path."""
        names = [name for name in (self.system, *self.save) if isinstance(name, str)]
        files = {name.partition(":")[0] for name in names}
        whole = {file: str(Path(file).resolve()) for file in files if Path(file).suffix and Path(file).is_file()}

        def located(name):
            file, colon, rest = name.partition(":") if isinstance(name, str) else ("", "", "")
            return f"{whole[file]}{colon}{rest}" if file in whole else name

        sources = {file: _digest(file) for file in whole.values()}
        return replace(self, system=located(self.system), save=tuple(map(located, self.save)), sources=sources)

    def check_sources(self) -> None:
        """Refuse files of the user that are missing or others than those the ensemble was started with.

        Raises:
            FileNotFoundError, ValueError: with the file.
        """
        for file, digest in self.sources.items():
            if not Path(file).is_file():
                raise FileNotFoundError(
                    f"{file} does not exist on this worker. Put it where all workers see it, or install it as a package and give "
                    "my_package.my_module:name."
                )
            if _digest(file) != digest:
                raise ValueError(f"{file} is another file on this worker than where the ensemble was started.")

    @cached_property
    def problem(self) -> Problem:
        """The problem that columns change."""
        return find_problem(self.system) if isinstance(self.system, str) else self.system

    @cached_property
    def places(self) -> dict[str, Place]:
        """Where columns belong."""
        return places(self.problem, self.columns)

    @cached_property
    def quantities(self) -> list[Quantity]:
        """What is kept."""
        return [quantity(name) for name in self.save]

    @cached_property
    def told_apart(self) -> list[str]:
        """Columns whose different values need programs, or calls, of their own."""
        steps = STEPS if self.steps.t_end is not None and not self._has("num_steps") else ("num_steps",)
        return [name for name in self.columns if name in (*SCHEMES, *steps)]

    def groups(self, rows: Rows, count: int) -> Iterator[Group]:
        """Rows by what one program computes.

        Raises:
            ValueError, TypeError: values that make no run.
        """
        different, number = unique_rows({name: rows[name] for name in self.told_apart})
        if not self.told_apart:
            number = np.zeros(count, dtype=int)
        for i in range(number.max() + 1):
            lanes = np.flatnonzero(number == i)
            values = {name: values[i] for name, values in different.items()}
            dt = {name: rows[name][lanes] for name in ("macro_dt", "micro_dt") if name in rows and name not in values}
            scheme = self._scheme(values)
            yield Group(lanes, scheme, *self._steps(values | dt, scheme))

    def simulation(self, group: Group) -> Simulation:
        """One run of a group, whose arguments are checked.

        Raises:
            ValueError, TypeError: bad arguments.
        """
        macro_dt, num_steps = float(np.ravel(group.macro_dt)[0]), group.num_steps
        if num_steps % self.num_saves:
            raise ValueError(
                f"ensemble: {num_steps} macro steps are no multiple of num_saves = {self.num_saves}, so that the last saved node "
                "would not be the end."
            )
        state = self.problem.state(self.project)
        every = num_steps // self.num_saves
        steps = arguments.Steps(macro_dt, num_steps=num_steps, save_every=every)
        return simulation(self.problem, group.scheme, state, self.solver, steps)

    def check_values(self, rows: Rows) -> None:
        """Refuse values of columns that do not fit what they replace.

        Raises:
            ValueError: with the column.
        """
        lanes_of(self.problem, self.places, rows, len(next(iter(rows.values()))) if rows else 1)

    def compute(self, rows: Rows, count: int, width: int) -> dict[str, np.ndarray]:
        """What is kept of some runs, and their status.

        Args:
            rows: of the design.
            count: number of rows.
            width: lanes that are computed side by side.
        """
        found: dict[str, np.ndarray] = {}
        for group in self.groups(rows, count):
            part = self._compute(group, {name: values[group.lanes] for name, values in rows.items()}, width)
            for name, values in part.items():
                whole = found.setdefault(name, np.empty((count, *values.shape[1:]), values.dtype))
                whole[group.lanes] = values
        return found

    def _compute(self, group: Group, rows: Rows, width: int) -> dict[str, np.ndarray]:
        count = len(group.lanes)
        filled = np.minimum(np.arange(max(count, width)), count - 1)  # copies of the last run: one program for all
        rows = {name: values[filled] for name, values in rows.items()}
        macro_dt = group.macro_dt[filled] if np.ndim(group.macro_dt) else group.macro_dt
        lanes = lanes_of(self.problem, self.places, rows, len(filled))
        start = tuple(lanes.start.values())
        project = self.problem.project if self.project is None else self.project
        states = _states(self.problem.system, lanes.params, start, project)
        trajectory = simulate_batch(
            self.problem,
            group.scheme,
            states,
            macro_dt=macro_dt,
            num_steps=group.num_steps,
            save_every=group.num_steps // self.num_saves,
            params=lanes.params,
            solver=self.solver,
            chunk=width,
            warn=False,
        )
        kept = {name: np.asarray(getattr(trajectory, name))[:count] for name in STATUS}
        return kept | {name: np.asarray(value)[:count] for name, value in self._kept(trajectory).items()}

    @cached_property
    def _kept(self) -> Callable[[Trajectory], dict[str, Any]]:
        return _kept_of(self.save, tuple(self.sources.items()))

    def _scheme(self, values: Mapping[str, Any]) -> Scheme | Composition:
        label = str(values.get("scheme", next(iter(self.schemes))))
        if label not in self.schemes:
            raise ValueError(
                f"ensemble: there is no scheme {label!r}.{near(label, self.schemes)} Those given are {', '.join(self.schemes)}."
            )
        scheme = self.schemes[label]
        num_micro = _whole("num_micro", values["num_micro"]) if "num_micro" in values else self.num_micro
        if isinstance(scheme, Scheme | Composition):
            if num_micro is not None:
                raise ValueError(
                    f"ensemble: the scheme {label!r} has its num_micro already; give what makes one, vmri_jax.fully_implicit "
                    "say, or the name of a scheme."
                )
            return scheme
        if num_micro is None:
            raise ValueError(f"ensemble: num_micro is missing for the scheme {label!r}; give it, or a column of it.")
        made = find_scheme(scheme, num_micro) if isinstance(scheme, str) else scheme(num_micro)
        if not isinstance(made, Scheme | Composition):
            raise TypeError(f"ensemble: the scheme {label!r} makes {type(made).__name__}; it must make a Scheme.")
        return made

    def _has(self, name: str) -> bool:
        return name in self.columns or getattr(self.steps, name) is not None

    def _steps(self, values: Mapping[str, Any], scheme) -> tuple[Any, int]:
        """Macro step and number of steps."""
        given = {name: value for name, value in self.steps._asdict().items() if value is not None}
        both = sorted(set(given) & set(values))
        if both:
            raise ValueError(f"ensemble: {', '.join(both)} is a column and an argument; give it once.")
        given |= {name: values[name] for name in STEPS if name in values}
        known = set(given)
        if len(known) != 2 or known == {"macro_dt", "micro_dt"}:
            raise ValueError(
                f"ensemble: of the steps {', '.join(sorted(known)) or 'nothing'} is given; give two of t_end, num_steps and one of "
                "macro_dt and micro_dt, as arguments or columns."
            )
        if "t" in self.columns and "t_end" in known:
            raise ValueError("ensemble: t is a column, so that t_end is no number of steps; give num_steps and a step.")
        if "num_steps" in given:
            given["num_steps"] = _whole("num_steps", given["num_steps"])
        start = float(self.problem.t)
        if known == {"t_end", "num_steps"}:
            return (float(given["t_end"]) - start) / given["num_steps"], given["num_steps"]
        factor = scheme.num_micro if "micro_dt" in given else 1
        macro_dt = factor * np.asarray(given["micro_dt" if "micro_dt" in given else "macro_dt"], dtype=float)
        if not np.all(macro_dt > 0):
            raise ValueError(f"ensemble: a step is {np.min(macro_dt)}; steps must be positive.")
        macro_dt = float(macro_dt) if macro_dt.ndim == 0 else macro_dt
        return macro_dt, given.get("num_steps") or steps_until(given["t_end"], start, macro_dt)


def all_groups(work: Work, design: Design) -> Iterator[Group]:
    """Every kind of group that there may be in a design, of a single row each."""
    rows = design.combinations(work.told_apart)
    others = [name for name in ("macro_dt", "micro_dt") if name in work.columns and name not in rows]
    first = design.rows(0, 1) if others else {}
    count = max((len(values) for values in rows.values()), default=1)
    yield from work.groups(rows | {name: np.repeat(first[name], count) for name in others}, count)


@eqx.filter_jit
def _states(system: System, params, start: tuple, project: bool) -> State:
    """Consistent states with these starts, (t, q_s, q_f, v_s, v_f), and parameters, a lane each."""

    def of_one(own, one):
        t, q_s, q_f, v_s, v_f = one
        lane = system if own is None else system.replace(params=own)
        return initial_state(lane, q_s, q_f, v_s, v_f, t, project=project)

    return jax.vmap(of_one, (None if params is None else 0, 0))(params, start)


@lru_cache(maxsize=8)
def _kept_of(save: tuple[str, ...], sources: tuple) -> Callable[[Trajectory], dict[str, Any]]:
    """What is kept, compiled once for all ensembles of a process that keep the same, by functions of the same files."""
    return of_lanes([quantity(name) for name in save])


def _whole(name: str, value) -> int:
    if float(value) != int(value) or value < 1:
        raise ValueError(f"ensemble: a value of {name} is {value}; it must be a whole number of at least 1.")
    return int(value)


def _digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16]
