"""The result of a fit: the parameters, how well they are known, and how well the motion fits."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from vmri_jax.accuracy.companions import UncertifiedWarning
from vmri_jax.accuracy.simulate import simulate
from vmri_jax.fitting.shooting import Shooting
from vmri_jax.mechanics.arrays import library, whole_number
from vmri_jax.mechanics.state import Problem
from vmri_jax.mechanics.summary import summary
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.trajectory import Trajectory

SINGULAR_VALUE_TOLERANCE = 1e-7
"""Least singular value of the Jacobian in relative changes of the parameters, as a part of the largest one, of a
direction that the data determines. Below it round-off of the runs hides the change of the predictions; a larger one
also drops directions that are determined badly."""
STARTS_RANK_TOLERANCE = 1e-12
"""Smallest singular value, over the largest one, of a direction in the range of the Jacobian in the starts; below it a
direction is round-off. A larger one leaves real effects of the starts to the parameters."""
DOUBTED_PROBABILITY = 1e-6
"""Probability of a chi^2 as large as that of the fit, below which the fit is doubted; a larger one doubts good fits."""
LARGEST_GAP = 1e-4
"""Gap between parts, relative to the motion, above which a fit is doubted: searches that end well leave below 1e-6. A
larger value lets pass a motion that jumps between the parts."""
LARGEST_CHANGE_BY_STEPS = 0.5
"""Change of a parameter by steps of half the length, in its standard errors, above which the fit is doubted: intervals
of 95 % that are off by this contain the parameter in 92 % of all cases. A larger one lets intervals miss it."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters, their covariance, and the quality of the fit.

    Further results: `standard_errors`, `values`, `problem`, `doubts`, `probability`, and the method `intervals`.

    Attributes:
        parameters: values by name.
        labels: names of the p numbers in them.
        covariance: (p, p), ``(J^T J)^-1`` with the Jacobian J of the predictions in standard deviations; infinite for
            parameters that the data does not determine. Where sigma is not known, the estimated one scales it.
        residuals: (m,) predicted minus measured values, in standard deviations.
        freedom: degrees of freedom, m - p.
        sigma: 1, or the estimated standard deviation of the values.
        change_by_half_steps: (p,) change of the parameters with steps of half the length, to first order; of a scheme
            of order 2, three quarters of the error that the steps leave in the parameters.
        undetermined: in words, the combinations of parameters that the data does not determine.
        iterations: of the search.
        success: whether the search ended by its tolerance.
        gap: largest gap between parts of multiple shooting, relative to the size of the motion.
        squares: (starts,) sums of squares at the ends of all searches.
        shooting: the runs of the fit.
        again: ``again(values (k, m))``, parameters (k, p) and covariances (k, p, p) for other values.
    """

    parameters: dict[str, Any]
    labels: list[str]
    covariance: Float[np.ndarray, "p p"]
    residuals: Float[np.ndarray, "m"]
    freedom: int
    sigma: float
    change_by_half_steps: Float[np.ndarray, "p"]
    undetermined: list[str]
    iterations: int
    success: bool
    gap: float
    squares: Float[np.ndarray, "starts"]
    shooting: Shooting = field(repr=False)
    again: Callable = field(repr=False)

    @classmethod
    def of(cls, shooting: Shooting, u, misses, jacobians, change, **search: Any) -> "Fit":
        """The end of a search; `jacobians` as of `_covariance`, `change` by half the steps, the rest by name."""
        unknowns = shooting.unknowns
        parameters = {name: np.asarray(value) for name, value in unknowns.at(u).items()}
        numbers = np.asarray(unknowns.vector(parameters))
        freedom = len(misses) - unknowns.size
        sigma = 1.0
        if not shooting.knows_sigma:
            # s^2 = sum of squares / (m - p)
            sigma = float(np.sqrt(np.sum(misses**2) / max(freedom, 1)))
            misses = misses / sigma
        covariance, undetermined = _covariance(jacobians, numbers, unknowns.labels)
        estimates = parameters, unknowns.labels, sigma**2 * covariance, misses, freedom, sigma, change, undetermined
        return cls(*estimates, shooting=shooting, **search)

    @property
    def problem(self) -> Problem:
        """The problem with the fitted parameters."""
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
        """Confidence intervals of each number by itself, ``x +- q s`` with its standard error s.

        The quantile q is of the normal distribution, or of Student's where sigma is estimated.

        Raises:
            ValueError: a level that is not between 0 and 1.
        """
        tail = _below(level)
        if self.doubts:
            warn_user(f"intervals: the fit is doubted. {' '.join(self.doubts)}", UncertifiedWarning)
        q = stats.norm.ppf(tail) if self.shooting.knows_sigma else stats.t.ppf(tail, max(self.freedom, 1))
        pairs = zip(self.values, self.standard_errors.values(), strict=True)
        return dict(zip(self.labels, ((float(x - q * s), float(x + q * s)) for x, s in pairs), strict=True))

    @property
    def probability(self) -> float:
        """Probability of as large a sum of squares, if model and sigma are right; 1 where sigma is estimated."""
        if not self.shooting.knows_sigma:
            return 1.0
        return float(stats.chi2.sf(np.sum(self.residuals**2), max(self.freedom, 1)))

    def simulate(self, **options) -> Trajectory:
        """The run with the fitted parameters up to the last measurement; `options` as in `vmri_jax.simulate`."""
        settings = {"macro_dt": self.shooting.macro_dt, "num_steps": self.shooting.last} | options
        return simulate(self.problem, self.shooting.scheme, **settings)

    def bootstrap(self, repeats: int, seed: int = 0) -> "Bootstrap":
        """Fits to synthetic measurements: its predictions plus normal errors of its sigma; they show how good they are.

        Args:
            repeats: number of synthetic sets of measurements.
            seed: of their errors.
        """
        whole_number("bootstrap: repeats", repeats)
        # residuals are (predicted - measured) / (sigma of the values, times the estimate)
        exact = self.shooting.values + self.residuals * self.sigma * self.shooting.sigma
        noise = np.random.default_rng(seed).standard_normal((repeats, len(exact)))
        estimates, covariances = self.again(exact + noise * self.sigma * self.shooting.sigma)
        errors = self.sigma * np.sqrt(np.diagonal(np.asarray(covariances), axis1=1, axis2=2))
        return Bootstrap(self.labels, self.values, np.asarray(estimates), errors)

    @property
    def doubts(self) -> list[str]:
        """Reasons to doubt the fit, in sentences; intervals say little then: none are printed, `intervals` warns."""
        sentences = []
        if not self.success:
            remedies = "raise max_steps, start closer, fit a shorter time first, or cut the motion into segments"
            sentences.append(f"The search did not end by its tolerance: {remedies}.")
        if self.gap > LARGEST_GAP:
            jump = f"the largest gap is {self.gap:.1e} of the motion"
            sentences.append(f"The parts do not join, {jump}: start closer, raise max_steps, or take fewer segments.")
        if self.probability < DOUBTED_PROBABILITY:
            remedies = [] if len(self.squares) > 1 else ["starts=8"]
            remedies += [] if self.shooting.segments > 1 else ["segments=10, which cuts the motion into parts"]
            beside = f"the search may have ended beside the best parameters (try {' or '.join(remedies)}), or "
            cause = f"{beside if remedies else ''}the model, its steps or sigma are not right"
            sentences.append(f"Sigma does not explain the misses: {cause}.")
        off = np.abs(self.change_by_half_steps) / np.sqrt(np.diag(self.covariance))
        if np.max(off, initial=0.0) > LARGEST_CHANGE_BY_STEPS:
            i = int(np.argmax(off))
            change = f"{self.change_by_half_steps[i]:+.2g}, {off[i]:.2g} standard errors"
            sentences.append(
                f"The steps are too large for this data: half the steps would change {self.labels[i]} by {change}. "
                "Take a smaller macro_dt, more micro steps, or a scheme of higher order."
            )
        return sentences

    def __repr__(self) -> str:
        width = max(map(len, self.labels))
        lines = [f"{label:{width}}  {x:.6g}" for label, x in zip(self.labels, self.values, strict=True)]
        if not self.doubts:
            known = zip(self.standard_errors.values(), self.intervals().values(), strict=True)
            intervals = [f" +- {float(f'{s:.2g}'):g}   95 %: {low:.6g} .. {high:.6g}" for s, (low, high) in known]
            lines = [line + interval for line, interval in zip(lines, intervals, strict=True)]
        chance, estimate = f"chance of worse {self.probability:.2g}", f"sigma estimated: {self.sigma:.3g}"
        quality = f"{self.freedom} degrees of freedom ({chance if self.shooting.knows_sigma else estimate})"
        squares = float(np.sum(self.residuals**2))
        lines.append(f"chi^2 {squares:.4g} for {quality}")
        lines += self.doubts
        if self.shooting.segments > 1:
            lines.append(f"{self.shooting.segments} segments, largest gap {self.gap:.1e} of the motion")
        return "\n".join(lines + [f"The data does not determine {combination}." for combination in self.undetermined])


@dataclass(frozen=True, repr=False)
class Bootstrap:
    """Fits to synthetic measurements, made by the model with the fitted parameters and the steps of the fit: whether
    model and steps are right they do not show.

    Attributes:
        labels: names of the p numbers.
        truth: (p,) parameters that the measurements were made with.
        estimates: (repeats, p) fitted parameters.
        errors: (repeats, p) their standard errors, for the sigma that the measurements were made with.
    """

    labels: list[str]
    truth: Float[np.ndarray, "p"]
    estimates: Float[np.ndarray, "repeats p"]
    errors: Float[np.ndarray, "repeats p"]

    def __repr__(self) -> str:
        scatter = zip(self.labels, self.truth, self.estimates.std(axis=0), strict=True)
        lines = {label: f"{x:.6g}, estimates scatter by {s:.2g}" for label, x, s in scatter}
        return summary(f"Bootstrap of {len(self.estimates)} fits", lines | {"see": "coverage(), estimates, errors"})

    def coverage(self, level: float = 0.95) -> dict[str, float]:
        """The fraction of the intervals of this level that contain the truth, by label."""
        q = stats.norm.ppf(_below(level))
        covers = np.abs(self.estimates - self.truth) <= q * self.errors
        return dict(zip(self.labels, covers.mean(axis=0).tolist(), strict=True))


def _below(level: float) -> float:
    """The probability of a value below the upper end of an interval of this level."""
    if not 0 < level < 1:
        raise Refused(f"intervals: level is {level}; it must lie between 0 and 1, e.g. 0.95.")
    return (1 + level) / 2


def without_starts(by_parameters, by_starts):
    """The Jacobian (m, p) with respect to the parameters, without changes that other starts make as well: projected on
    the complement of the range of the Jacobian (m, k) with respect to the starts."""
    if not by_starts.size:
        return by_parameters
    q, sizes, _ = library(by_starts).linalg.svd(by_starts, full_matrices=False)
    q = q * (sizes > STARTS_RANK_TOLERANCE * sizes[0])
    return by_parameters - q @ (q.T @ by_parameters)


def _covariance(jacobians, numbers, labels) -> tuple[np.ndarray, list[str]]:
    """``(J^T J)^-1`` of the parameters, and in words their combinations that the data does not determine."""
    by_parameters, by_starts = jacobians
    scale = np.where(numbers == 0, 1.0, np.abs(numbers))
    jacobian = np.asarray(without_starts(by_parameters * scale, by_starts))
    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=False)
    known = sizes > SINGULAR_VALUE_TOLERANCE * sizes[0]
    covariance = directions[known].T @ np.diag(sizes[known] ** -2.0) @ directions[known] * np.outer(scale, scale)
    # A parameter with more than a tenth of the largest share in an undetermined direction has an infinite variance.
    words = []
    for direction in directions[~known]:
        shares = np.abs(direction) > 0.1 * np.abs(direction).max()
        covariance[shares] = covariance[:, shares] = np.nan
        covariance[shares, shares] = np.inf
        names = [label for label, share in zip(labels, shares, strict=True) if share]
        words.append(names[0] if len(names) == 1 else f"a combination of {', '.join(names)}")
    return covariance, words
