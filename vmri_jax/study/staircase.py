"""What schemes of a kind reach: the least time by which an error is reached, and stays reached with smaller steps.

A run counts with the largest error e of itself and of all runs of its scheme with smaller steps,

    e_i = max(error_j: n_j >= n_i),

and only if one of them has at least `CONFIRMING` times its steps: an error that is small by chance, as where it changes its sign at the compared node,
is none that the scheme reaches. Of the runs that count, those that no other one beats in error and in time are the staircase.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from vmri_jax.accuracy.companions import ratio
from vmri_jax.accuracy.families import Family
from vmri_jax.study.program import joined
from vmri_jax.study.work import WorkRow

if TYPE_CHECKING:
    from vmri_jax.study.advisor import Search

SINGLE, MICRO, COMPOSED, INTERVALS = (
    "single steps of order 2",
    "micro steps of order 2",
    "composed to order 4, 6, 8",
    "intervals of high degree",
)
"""Kinds of schemes by their structure."""
KINDS = (SINGLE, MICRO, COMPOSED, INTERVALS)
CONFIRMING = 1.3
"""Steps of the run that confirms another one, over those of the other: errors that are small by chance are so over a few percent of the steps. A larger
factor needs more runs."""
COMPARED = 2
"""Runs of micro steps that single steps are tried beside; each takes up to the number of micro steps times as long."""
MORE_STEPS = 1.5
"""Steps of runs that are made to confirm others, over those of the others."""


@dataclass(frozen=True)
class Stair:
    """A run of a staircase.

    error: the confirmed one.
    fast_share: part of the error that more micro steps take away, between 0 and 1; NaN where it was not measured.
    """

    row: WorkRow
    error: float
    fast_share: float = np.nan

    @property
    def seconds(self) -> float:
        """Time of the run."""
        return self.row.seconds


def kind_of(row: WorkRow) -> str:
    """One of the four kinds of schemes."""
    if row.stages > 1:
        return COMPOSED
    if row.degree > 1:
        return INTERVALS
    return SINGLE if row.num_micro == 1 else MICRO


def confirmed(rows: Sequence[WorkRow]) -> list[Stair]:
    """The runs that count, with their confirmed errors.

    Args:
        rows: of any number of schemes.
    """
    found = []
    for _, group in groupby(sorted(rows, key=lambda r: (r.scheme, r.num_steps)), key=lambda r: r.scheme):
        of_scheme = list(group)
        errors = np.array([row.error_q if np.isfinite(row.error_q) else np.inf for row in of_scheme])
        largest = np.maximum.accumulate(errors[::-1])[::-1]
        most = of_scheme[-1].num_steps / CONFIRMING
        found += [
            Stair(row, float(error))
            for row, error in zip(of_scheme, largest, strict=True)
            if np.isfinite(error) and row.num_steps <= most and np.isfinite(row.seconds)
        ]
    return found


def front(stairs: Sequence[Stair]) -> list[Stair]:
    """Those that no other one beats both in error and in time, the fastest first."""
    best: list[Stair] = []
    for stair in sorted(stairs, key=lambda s: (s.seconds, s.error)):
        if not best or stair.error < best[-1].error:
            best.append(stair)
    return best


def staircases(rows: Sequence[WorkRow]) -> dict[str, list[Stair]]:
    """The staircase of each kind of schemes, empty where no run counts."""
    stairs = confirmed(rows)
    return {kind: front([stair for stair in stairs if kind_of(stair.row) == kind]) for kind in KINDS}


def confirm(search: "Search") -> None:
    """Run the best schemes of each kind with more steps, where no run confirms theirs yet.

    Args:
        search: its runs; the new ones are added to them.
    """
    _try_single_steps(search)
    best: list[Stair] = []
    settings = search.settings.values()
    for kind in KINDS:
        best += front(
            [Stair(s.row, s.row.error_q) for s in settings if kind_of(s.row) == kind and np.isfinite(s.row.error_q)]
        )
    known = {s.row.scheme: (s.family, s.num_micro) for s in settings}
    finest: dict[str, int] = {}
    for stair in best:
        finest[stair.row.scheme] = max(stair.row.num_steps, finest.get(stair.row.scheme, 0))
    for scheme, num_steps in finest.items():
        most = max(s.num_steps for s in settings if s.row.scheme == scheme)
        if most < CONFIRMING * num_steps:
            unit = search.reference.num_saves
            search.at(*known[scheme], unit * int(np.ceil(MORE_STEPS * num_steps / unit)))


def _try_single_steps(search: "Search") -> None:
    """Where no single steps were tried, as many as there are micro steps in the fastest runs of order 2: micro steps are held against them."""
    settings = list(search.settings.values())
    if any(kind_of(setting.row) == SINGLE for setting in settings):
        return
    of_micro = [s for s in settings if kind_of(s.row) == MICRO and np.isfinite(s.row.error_q)]
    for setting in sorted(of_micro, key=lambda s: s.row.seconds)[:COMPARED]:
        search.at(setting.family, 1, setting.num_steps * setting.num_micro)


def with_shares(search: "Search", stairs: dict[str, list[Stair]]) -> dict[str, list[Stair]]:
    """The staircases with fast shares at the runs of one scheme of each kind, the one with the most runs there: each is compiled with twice its micro steps.

    Args:
        search: that made the runs.
        stairs: by kind.
    """
    known = {s.row.scheme: (s.family, s.num_micro) for s in search.settings.values()}
    found = {}
    for kind, of_kind in stairs.items():
        schemes = [stair.row.scheme for stair in of_kind]
        measured = max(schemes, key=schemes.count, default="")
        found[kind] = [
            replace(s, fast_share=_fast_share(search, *known[measured], s.row)) if s.row.scheme == measured else s
            for s in of_kind
        ]
    return found


def _fast_share(search: "Search", family: Family, num_micro: int, row: WorkRow) -> float:
    """``F / (F + S)`` of the largest fast and slow shares of the error of a run, see `vmri_jax.accuracy.companions`; NaN where the run with twice the micro steps fails."""
    coarse, finer = (joined(search.program(family, n)(row.num_steps))[0] for n in (num_micro, 2 * num_micro))
    by_fast = ratio(row.order) * (coarse - finer)
    fast, slow = (float(np.abs(part).max()) for part in (by_fast, coarse - search.reference.q - by_fast))
    return fast / (fast + slow) if fast + slow > 0 else np.nan
