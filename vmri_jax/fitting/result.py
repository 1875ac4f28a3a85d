"""What a fit tells: the parameters, how well they are known, and how well the motion fits."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from vmri_jax.accuracy.simulate import simulate
from vmri_jax.fitting.shooting import Shooting
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.trajectory import Trajectory

UNDETERMINED = 1e-7
"""Directions that change the predictions by less than this part of the best determined one, relative to the parameters, count as none."""
RANK = 1e-12
"""Directions of the starts with singular values below this part of the largest count as none."""
UNLIKELY = 1e-6
"""Chance of misses as large as they are, below which the report doubts the fit."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that were found, with what the data says about them.

    Attributes:
        parameters: by name.
        labels: of all p numbers among them.
        covariance: (p, p), ``(J^T J)^-1`` with the Jacobian J of the predictions in standard deviations; infinite rows for what
            is not determined. Without a known sigma it is that of the misses.
        residuals: (m,) misses in standard deviations, one for each value.
        freedom: number of values less that of the unknowns.
        sigma: 1, or the standard deviation that was estimated where it is not known.
        undetermined: in words, the combinations of parameters that the data says nothing about.
        iterations: of the search.
        converged: whether it ended by its tolerance.
        gap: the most that a part of multiple shooting misses the next one by, over the size of the motion.
        squares: (starts,) sums of squares at the ends of all searches.
    """

    parameters: dict[str, Any]
    labels: list[str]
    covariance: Float[np.ndarray, "p p"]
    residuals: Float[np.ndarray, "m"]
    freedom: int
    sigma: float
    undetermined: list[str]
    iterations: int
    converged: bool
    gap: float
    squares: Float[np.ndarray, "starts"]
    shooting: Shooting = field(repr=False)
    again: Callable = field(repr=False)

    @classmethod
    def of(
        cls, shooting: Shooting, u, misses, *, by_parameters, by_starts, iterations, converged, gap, squares, again
    ) -> "Fit":
        """From the end of a search."""
        unknowns = shooting.unknowns
        parameters = {name: np.asarray(value) for name, value in unknowns.at(u).items()}
        numbers = np.asarray(unknowns.vector(parameters))
        freedom = len(misses) - unknowns.size
        sigma = 1.0
        if not shooting.knows_sigma:
            sigma = float(np.sqrt(np.sum(misses**2) / max(freedom, 1)))
            misses = misses / sigma
        covariance, undetermined = _covariance(by_parameters, by_starts, numbers, unknowns.labels)
        return cls(
            parameters,
            unknowns.labels,
            sigma**2 * covariance,
            misses,
            freedom,
            sigma,
            undetermined,
            iterations,
            converged,
            gap,
            squares,
            shooting,
            again,
        )

    @property
    def problem(self) -> Problem:
        """The problem with the parameters that were found."""
        return self.shooting.model(self.parameters)

    @property
    def values(self) -> np.ndarray:
        """(p,) all numbers of the parameters."""
        return np.concatenate([np.ravel(value) for value in self.parameters.values()])

    @property
    def standard_errors(self) -> dict[str, float]:
        """Square roots of the diagonal of the covariance, by label."""
        return dict(zip(self.labels, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals of each number by itself, ``x +- q s``, with q of Student's distribution where sigma is estimated."""
        if not 0 < level < 1:
            raise ValueError(f"intervals: level is {level}; it must lie between 0 and 1, e.g. 0.95.")
        q = self._quantile(level)
        return {
            label: (float(x - q * s), float(x + q * s))
            for (label, s), x in zip(self.standard_errors.items(), self.values, strict=True)
        }

    def _quantile(self, level: float) -> float:
        known = self.shooting.knows_sigma
        return float(stats.norm.ppf((1 + level) / 2) if known else stats.t.ppf((1 + level) / 2, max(self.freedom, 1)))

    @property
    def probability(self) -> float:
        """Of a sum of squares at least as large, if model and sigma are right; 1 where sigma is estimated."""
        if not self.shooting.knows_sigma:
            return 1.0
        return float(stats.chi2.sf(np.sum(self.residuals**2), max(self.freedom, 1)))

    def simulate(self, **options) -> Trajectory:
        """The run with the parameters that were found, up to the last measurement; `options` as of `vmri_jax.simulate`."""
        given = {"macro_dt": self.shooting.macro_dt, "num_steps": self.shooting.last} | options
        return simulate(self.problem, self.shooting.scheme, **given)

    def bootstrap(self, repeats: int, seed: int = 0) -> "Bootstrap":
        """Fits to measurements that are made up from what was found, with errors of the given sigma: how good the intervals are.

        Args:
            repeats: made-up sets of measurements.
            seed: of their errors.
        """
        exact = self.shooting.values + self.residuals * self.sigma * self.shooting.sigma
        noise = np.random.default_rng(seed).standard_normal((repeats, len(exact)))
        found, covariances = self.again(exact + noise * self.sigma * self.shooting.sigma)
        errors = self.sigma * np.sqrt(np.diagonal(np.asarray(covariances), axis1=1, axis2=2))
        return Bootstrap(self.labels, self.values, np.asarray(found), errors)

    @property
    def doubts(self) -> list[str]:
        """What speaks against the fit, in sentences; then its intervals say little, and are not printed."""
        found = []
        if not self.converged:
            found.append(
                "The search did not end by its tolerance: raise max_steps, start closer, or cut the motion into segments."
            )
        if self.probability < UNLIKELY:
            more = [] if len(self.squares) > 1 else ["starts=8"]
            more += [] if self.shooting.segments > 1 else ["segments=10, which cuts the motion into parts"]
            beside = (
                f"the search may have ended beside the best parameters (try {' or '.join(more)}), or " if more else ""
            )
            found.append(f"Sigma does not explain the misses: {beside}the model or sigma is not right.")
        return found

    def __repr__(self) -> str:
        width = max(map(len, self.labels))
        lines = [f"{label:{width}}  {x:.6g}" for label, x in zip(self.labels, self.values, strict=True)]
        if not self.doubts:
            known = zip(self.standard_errors.values(), self.intervals().values(), strict=True)
            intervals = [f" +- {s:.2g}   95 %: {low:.6g} .. {high:.6g}" for s, (low, high) in known]
            lines = [line + interval for line, interval in zip(lines, intervals, strict=True)]
        how = (
            f"chance of worse {self.probability:.2g}"
            if self.shooting.knows_sigma
            else f"sigma estimated: {self.sigma:.3g}"
        )
        squares = float(np.sum(self.residuals**2))
        lines.append(f"chi^2 {squares:.4g} for {self.freedom} degrees of freedom ({how}), {self.iterations} iterations")
        lines += self.doubts
        if self.shooting.segments > 1:
            lines.append(f"{self.shooting.segments} segments, largest gap {self.gap:.1e} of the motion")
        return "\n".join(lines + [f"The data does not determine {what}." for what in self.undetermined])


@dataclass(frozen=True)
class Bootstrap:
    """Fits to made-up measurements.

    Attributes:
        labels: of the p numbers.
        truth: (p,) what the measurements were made up with.
        found, errors: (repeats, p) what was found, and its standard errors.
    """

    labels: list[str]
    truth: Float[np.ndarray, "p"]
    found: Float[np.ndarray, "repeats p"]
    errors: Float[np.ndarray, "repeats p"]

    def coverage(self, level: float = 0.95) -> dict[str, float]:
        """The part of the intervals of this level that cover the truth, by label."""
        q = stats.norm.ppf((1 + level) / 2)
        covers = np.abs(self.found - self.truth) <= q * self.errors
        return dict(zip(self.labels, covers.mean(axis=0).tolist(), strict=True))


def without_starts(by_parameters, by_starts):
    """The Jacobian by the parameters, without what the starts of the parts can do instead."""
    if not by_starts.size:
        return by_parameters
    q, sizes, _ = jnp.linalg.svd(by_starts, full_matrices=False)
    q = q * (sizes > RANK * sizes[0])
    return by_parameters - q @ (q.T @ by_parameters)


def _covariance(by_parameters, by_starts, numbers, labels) -> tuple[np.ndarray, list[str]]:
    """``(J^T J)^-1`` of the parameters, and the combinations of them that are not determined."""
    scale = np.where(numbers == 0, 1.0, np.abs(numbers))
    jacobian = np.asarray(without_starts(by_parameters * scale, by_starts))
    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=False)
    known = sizes > UNDETERMINED * sizes[0]
    covariance = directions[known].T @ np.diag(sizes[known] ** -2.0) @ directions[known] * np.outer(scale, scale)
    words = []
    for direction in directions[~known]:
        shares = np.abs(direction) > 0.1 * np.abs(direction).max()
        covariance[shares] = covariance[:, shares] = np.nan
        covariance[shares, shares] = np.inf
        names = [label for label, share in zip(labels, shares, strict=True) if share]
        words.append(names[0] if len(names) == 1 else f"a combination of {', '.join(names)}")
    return covariance, words
