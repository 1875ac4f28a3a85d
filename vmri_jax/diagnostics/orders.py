"""Observed orders of convergence."""

from typing import NamedTuple

import numpy as np

from vmri_jax.refusals import Refused


class OrderFit(NamedTuple):
    """An observed order, half the width of its 95 % confidence interval (NaN for two points), and the points fitted."""

    order: float
    half_width: float
    points: int


def fit_order(macro_dt, errors, plateau: float = 10.0, floor: float = 0.0) -> OrderFit:
    """Order of convergence: least-squares slope of log error over log step, without the round-off plateau.

    The plateau begins, towards smaller steps, at the first interval after the steepest one with less than half its
    slope. Errors below `plateau` times its level, or times `floor`, are left out; at least the two largest steps stay.

    Args:
        macro_dt: (k,) step sizes.
        errors: (k,) errors; errors that are zero or not finite are ignored.
        plateau: factor by which an error must exceed the round-off plateau to count.
        floor: known error of the reference solution.

    Raises:
        ValueError: fewer than two usable errors.
    """
    from scipy.special import stdtrit  # here: its import takes a tenth of a second

    h, e = np.asarray(macro_dt, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(e) & (e > 0)
    if good.sum() < 2:
        raise Refused(f"fit_order: {good.sum()} usable errors of {np.size(errors)}; at least 2 are needed.")
    order = np.argsort(-h[good])
    h, e = h[good][order], e[good][order]
    slopes = np.diff(np.log(e)) / np.diff(np.log(h))
    flat = np.flatnonzero(slopes < slopes.max() / 2)
    # flat slopes before the steepest one belong to steps that do not resolve the motion
    flat = flat[flat > slopes.argmax()]
    level = max(floor, e[flat[0] + 1 :].max() if flat.size else 0.0)
    keep = e > plateau * level
    keep[:2] = True
    x, y = np.log(h[keep]), np.log(e[keep])
    free = len(x) - 2
    if not free:
        return OrderFit(float(np.diff(y)[0] / np.diff(x)[0]), np.nan, 2)
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    quantile = stdtrit(free, 0.975)  # of Student's t distribution
    return OrderFit(float(slope), float(quantile * np.sqrt(covariance[0, 0])), len(x))
