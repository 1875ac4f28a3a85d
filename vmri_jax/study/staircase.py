"""Staircases: for each kind of schemes the least time in which an error is reached and kept with smaller steps.

A run with n_i steps has the confirmed error

    e_i = max(error_j: n_j >= n_i)    over the runs j of the same scheme,

and counts only if one of these runs has at least `CONFIRMING_RATIO` times its steps. This leaves out errors that are small by
chance, as where the error changes sign at the compared node. The staircase is the Pareto front of the confirmed runs in time and
error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from vmri_jax.accuracy.companions import ratio
from vmri_jax.accuracy.families import Family
from vmri_jax.study.program import joined
from vmri_jax.study.search import Search
from vmri_jax.study.work import WorkRow, pareto_front

KINDS = "single steps of order 2", "micro steps of order 2", "composed to order 4, 6, 8", "intervals of high degree"
"""Kinds of schemes by their structure."""
SINGLE, MICRO, COMPOSED, INTERVALS = KINDS
CONFIRMING_RATIO = 1.3
"""Least ratio of the steps of a confirming run to the steps of the run that it confirms. An error that is small by chance grows again
within a few percent more steps; a larger ratio leaves fewer runs confirmed."""
ADDED_STEPS_RATIO = 1.5
"""Ratio of the steps of a run that `confirm` adds to the steps of the run that it confirms, above CONFIRMING_RATIO to allow for
rounding; a larger ratio takes longer."""
SINGLE_STEP_RUNS = 2
"""Number of runs of micro steps for which `confirm` adds a run of single steps; each takes up to num_micro times as long."""


@dataclass(frozen=True)
class Stair:
    """A run of a staircase with its confirmed error.

    fast_share: part of the error that more micro steps remove, between 0 and 1; NaN where it was not measured.
    """

    row: WorkRow
    error: float
    fast_share: float = np.nan

    @property
    def seconds(self) -> float:
        """Time of the run."""
        return self.row.seconds


def kind_of(row: WorkRow) -> str:
    """The kind, one of KINDS, of the scheme of a run."""
    if row.stages > 1:
        return COMPOSED
    if row.degree > 1:
        return INTERVALS
    return SINGLE if row.num_micro == 1 else MICRO


def confirmed(rows: Sequence[WorkRow]) -> list[Stair]:
    """The runs, of any number of schemes, that runs with more steps confirm, with their confirmed errors."""
    stairs = []
    for _, group in groupby(sorted(rows, key=lambda r: (r.scheme, r.num_steps)), key=lambda r: r.scheme):
        runs = list(group)  # of one scheme, the fewest steps first
        errors = np.array([row.error_q if np.isfinite(row.error_q) else np.inf for row in runs])
        confirmed_errors = np.maximum.accumulate(errors[::-1])[::-1]  # e_i
        most_steps = runs[-1].num_steps / CONFIRMING_RATIO
        stairs += [
            Stair(row, float(error))
            for row, error in zip(runs, confirmed_errors, strict=True)
            if np.isfinite(error) and row.num_steps <= most_steps and np.isfinite(row.seconds)
        ]
    return stairs


def staircases(rows: Sequence[WorkRow]) -> dict[str, list[Stair]]:
    """The staircase of each kind of schemes, empty where no run is confirmed."""
    stairs = confirmed(rows)
    by_kind = {kind: [stair for stair in stairs if kind_of(stair.row) == kind] for kind in KINDS}
    return {kind: pareto_front(of_kind, "seconds", "error") for kind, of_kind in by_kind.items()}


def confirm(search: Search) -> None:
    """Run the best schemes of each kind with more steps, where no run of the search confirms them yet."""
    _try_single_steps(search)
    settings = search.settings.values()
    schemes = {s.row.scheme: (s.family, s.num_micro) for s in settings}
    finest: dict[str, int] = {}  # by scheme, the most steps of a run on the unconfirmed staircase
    for kind in KINDS:
        for row in pareto_front([s.row for s in settings if kind_of(s.row) == kind], "seconds", "error_q"):
            finest[row.scheme] = max(row.num_steps, finest.get(row.scheme, 0))
    for scheme, num_steps in finest.items():
        most_steps = max(s.num_steps for s in settings if s.row.scheme == scheme)
        if most_steps < CONFIRMING_RATIO * num_steps:
            unit = search.reference.num_saves  # numbers of steps are multiples of it
            search.run(*schemes[scheme], unit * int(np.ceil(ADDED_STEPS_RATIO * num_steps / unit)))


def _try_single_steps(search: Search) -> None:
    """Add runs of single steps if there are none, with the micro step of the fastest runs of micro steps, for comparison with these."""
    settings = list(search.settings.values())
    if any(kind_of(setting.row) == SINGLE for setting in settings):
        return
    of_micro = [s for s in settings if kind_of(s.row) == MICRO and np.isfinite(s.row.error_q)]
    for setting in sorted(of_micro, key=lambda s: s.row.seconds)[:SINGLE_STEP_RUNS]:
        search.run(setting.family, 1, setting.num_steps * setting.num_micro)


def with_shares(search: Search, stairs_by_kind: dict[str, list[Stair]]) -> dict[str, list[Stair]]:
    """The result of `staircases` with fast shares: in each kind, of the runs of the scheme with the most runs on the staircase.

    One scheme only, because a fast share needs a second program, with twice the micro steps.
    """
    schemes = {s.row.scheme: (s.family, s.num_micro) for s in search.settings.values()}
    with_fast_shares = {}
    for kind, stairs in stairs_by_kind.items():
        labels = [stair.row.scheme for stair in stairs]
        measured = max(labels, key=labels.count, default="")
        with_fast_shares[kind] = [
            replace(s, fast_share=_fast_share(search, *schemes[measured], s.row)) if s.row.scheme == measured else s
            for s in stairs
        ]
    return with_fast_shares


def _fast_share(search: Search, family: Family, num_micro: int, row: WorkRow) -> float:
    """``F / (F + S)`` of the largest fast and slow shares of the error of a run; NaN where the run with twice the micro steps fails.

    With N micro steps q_N has the error ``F + S``, and twice the micro steps divide F by ``2^order``, so that
    ``F = ratio (q_N - q_2N)``, see `vmri_jax.accuracy.companions`.
    """
    q_N, q_2N = (joined(search.program(family, n)(row.num_steps))[0] for n in (num_micro, 2 * num_micro))
    fast_error = ratio(row.order) * (q_N - q_2N)
    slow_error = q_N - search.reference.q - fast_error
    fast, slow = float(np.abs(fast_error).max()), float(np.abs(slow_error).max())
    return fast / (fast + slow) if fast + slow > 0 else np.nan
