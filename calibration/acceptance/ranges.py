"""The range of distances, as guidelines judge form by it: which points may go, and what noise alone would give."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, norm

Array = NDArray[np.float64]

REJECTED_SHARE = 0.003
"""Of the points, at most so many may be left out (VDI/VDE 2634 part 2: three of a thousand)."""

_NODES = 200  # of the numerical integrals: the errors are below 1e-3 of the range
_COMPONENTS = 256  # different σ that a mixture is represented by


def reject(residuals: Array, share: float = REJECTED_SHARE) -> NDArray[np.bool_]:
    """Say which points stay: the ⌊share·N⌋ of the largest distances go.

    Parameters
    ----------
    residuals
        (N,) signed distances from the fitted element.

    Returns
    -------
    (N,) bool.
    """
    keep = np.ones(residuals.size, bool)
    going = math.floor(share * residuals.size)
    if going:
        keep[np.argpartition(np.abs(residuals), -going)[-going:]] = False
    return keep


def expected_range(sigma: Array, rejected: int = 0) -> tuple[float, float]:
    """Mean and standard deviation of the range that Gaussian noise alone gives, after `reject`.

    The distances are taken as independent draws of the mixture of N(0, σ²). Of n, the largest retained distance T is
    the (n − k)th order statistic of |x|, so H(T) ~ Beta(n − k, k + 1) with H the distribution of |x|. Given T, the
    other n − k − 1 lie in (−T, T) independently; on the side opposite to T the largest of them makes the range T + M
    (David and Nagaraja, Order Statistics, 2003, sections 2.2 and 2.5). With k = 0 this is the classical range, 3.078 σ
    for ten points; with k = 0.3 % it tends to the quantile, 5.94 σ, and hardly spreads.

    Parameters
    ----------
    sigma
        (N,) standard deviation of each distance, mm.
    rejected
        k, how many were left out.

    Returns
    -------
    mean, std
        mm. NaN with fewer than two retained points.
    """
    count = sigma.size
    retained = count - rejected
    if retained < 2:
        return math.nan, math.nan
    some = np.sort(sigma)[((np.arange(_COMPONENTS) + 0.5) * count / _COMPONENTS).astype(int)]
    # H on a grid fine enough to invert it by interpolation.
    reach = float(norm.isf(1e-3 / count)) * float(sigma.max())
    grid = np.linspace(0, reach, 4 * _NODES)
    below = 2 * norm.cdf(grid[:, None] / some).mean(axis=1) - 1
    levels = (np.arange(_NODES) + 0.5) / _NODES
    largest = np.interp(beta.ppf(levels, retained, rejected + 1), below, grid)

    # M given T: P(M ≤ x) = ((H(|x|)·sign(x) / H(T) + 1) / 2)^(n − k − 1) on (−T, T).
    steps = np.linspace(-1, 1, 4 * _NODES + 1)
    x = largest[:, None] * steps
    share = np.sign(x) * np.interp(np.abs(x), grid, below) / np.interp(largest, grid, below)[:, None]
    log_share = np.log(np.maximum((share + 1) / 2, 1e-300))
    distribution = np.exp((retained - 1) * log_share)
    step = largest * (steps[1] - steps[0])
    mean = largest - np.trapezoid(distribution, axis=1) * step
    square = largest**2 - np.trapezoid(2 * x * distribution, axis=1) * step
    first = float((largest + mean).mean())
    second = float((largest**2 + 2 * largest * mean + square).mean())
    return first, math.sqrt(max(second - first**2, 0.0))
