"""What fringes can reach at best: coordinate error, fringe order, least bounce."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import ncx2, norm

from scanner.design.demand import Demand
from scanner.patterns import Axis

Floats = NDArray[np.float64]

_LAG_STEP_PX = 0.5
"""Steps in the search for side lobes, a fraction of a fringe."""


@dataclass(frozen=True)
class AxisBounds:
    """What the fringes of one axis can reach.

    Parameters
    ----------
    sigma_px
        Least standard deviation of a coordinate, px.
    wrong_orders
        Probability of a wrong fringe order.
    delta_px, least_bounce
        (n,) Δu and the amplitude ratio α₅₀ that is detected there every other time.
    """

    sigma_px: float
    wrong_orders: float
    delta_px: Floats
    least_bounce: Floats

    @property
    def worst_bounce(self) -> float:
        """α₅₀ at the worst Δu."""
        return float(self.least_bounce.max())

    @property
    def typical_bounce(self) -> float:
        """α₅₀, geometric mean over Δu."""
        return float(np.exp(np.log(self.least_bounce).mean()))

    @property
    def cost(self) -> float:
        """Coordinate error and least bounce (half its mean, half its worst), as the logarithm of their product."""
        return math.log(self.sigma_px) + 0.5 * (math.log(self.worst_bounce) + math.log(self.typical_bounce))


def contrast(frequencies: Floats, blur_px: float) -> Floats:
    """(T,) m_t that a Gaussian blur leaves of fringes."""
    return np.asarray(np.exp(-2 * (np.pi * frequencies * blur_px) ** 2))


def coordinate_bound(frequencies: Floats, steps: int, relative_noise: float, blur_px: float = 0.0) -> float:
    """Cramér-Rao bound of one coordinate, px."""
    power = np.square(contrast(frequencies, blur_px) * frequencies).sum()
    return float(math.sqrt(2 / steps) * relative_noise / (2 * np.pi * math.sqrt(power)))


def wrong_order_probability(
    frequencies: Floats, steps: int, relative_noise: float, extent: float, blur_px: float = 0.0
) -> float:
    """Union bound over the side lobes of the likelihood, for places spread evenly over the projector.

    A side lobe at lag δ is beaten by Σ m_t² (1 - cos 2πf_t δ), with the noise of the difference: Q(√(that/2)/σ_z).
    """
    weights = np.square(contrast(frequencies, blur_px))
    lag = np.arange(0.5 / frequencies.max(), extent, _LAG_STEP_PX)
    lost = (weights * (1 - np.cos(2 * np.pi * np.outer(lag, frequencies)))).sum(axis=1)
    lobe = np.flatnonzero((lost[1:-1] <= lost[:-2]) & (lost[1:-1] <= lost[2:])) + 1
    sigma_z = math.sqrt(2 / steps) * relative_noise
    chance = norm.sf(np.sqrt(np.maximum(lost[lobe], 0) / 2) / sigma_z)
    return float(min(1.0, (2 * (1 - lag[lobe] / extent) * chance).sum()))


def noncentrality(
    frequencies: Floats, steps: int, relative_noise: float, delta_px: Floats, alpha: float, blur_px: float = 0.0
) -> Floats:
    """(n,) noncentrality of the one-path χ² for a bounce of ratio ``alpha`` at ``delta_px`` (n,), to first order."""
    m = contrast(frequencies, blur_px)
    bounce = m * np.exp(2j * np.pi * np.outer(delta_px, frequencies))
    # The fit takes a change of amplitude (along m) and of coordinate (along i m f), which are orthogonal.
    power = m @ m - (bounce.real @ m) ** 2 / (m @ m)
    power -= (bounce.imag @ (m * frequencies)) ** 2 / np.square(m * frequencies).sum()
    return np.asarray(alpha**2 * np.maximum(power, 0) * steps / (2 * relative_noise**2))


def detection_power(noncentralities: Floats, dof: int, false_alarm_rate: float) -> Floats:
    """Share of bounces that χ² with ``dof`` degrees of freedom detects."""
    return np.asarray(ncx2.sf(chi2_distribution.isf(false_alarm_rate, dof), dof, np.maximum(noncentralities, 1e-12)))


@lru_cache(maxsize=256)
def even_noncentrality(dof: int, false_alarm_rate: float) -> float:
    """Noncentrality that is detected every other time."""
    threshold = float(chi2_distribution.isf(false_alarm_rate, dof))
    return float(brentq(lambda value: ncx2.sf(threshold, dof, value) - 0.5, 1e-9, 4 * threshold))


def least_bounce(one: Floats, demand: Demand, dof: int) -> Floats:
    """α₅₀ where a bounce as strong as the direct path has the noncentrality ``one``."""
    return np.asarray(np.sqrt(even_noncentrality(dof, demand.false_alarm_rate) / np.maximum(one, 1e-12)))


def bounds(frequencies: Sequence[float], steps: int, demand: Demand, axis: Axis, dof: int) -> AxisBounds:
    """What fringes of one axis reach; ``dof`` are the degrees of freedom of all axes together."""
    f = np.asarray(frequencies, np.float64)
    delta = demand.deltas(axis)
    return AxisBounds(
        coordinate_bound(f, steps, demand.relative_noise, demand.blur_px),
        wrong_order_probability(f, steps, demand.relative_noise, demand.extent(axis), demand.blur_px),
        delta,
        least_bounce(noncentrality(f, steps, demand.relative_noise, delta, 1.0, demand.blur_px), demand, dof),
    )
