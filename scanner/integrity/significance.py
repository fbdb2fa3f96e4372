"""How far an error is beyond what noise makes of it, and what does no harm, where the noise itself is measured."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.sampling import Noise

UNCERTAIN_NOISE = 0.3
"""The variance of the noise may be off by such a share where pixels differ, whatever was measured."""

FEWEST_OF_TILE = 40
"""Pixels of a tile below which it is not judged."""

_SIGNIFICANT = 6.5
"""Standard deviations of a normal variable that noise does not reach."""


def beyond(
    energy: NDArray[np.float64],
    noise: NDArray[np.float64] | float,
    let_pass: NDArray[np.float64],
    pixels: NDArray[np.float64],
    freedom: float,
) -> NDArray[np.float64]:
    """(…, tiles + 1) mean square of an error over what may pass, unless it is not significant; above 1 is an alarm.

    Parameters
    ----------
    energy
        Mean square as measured, DN².
    noise
        What noise adds to it, DN².
    let_pass
        Mean square that does no harm, DN².
    pixels
        (tiles + 1,) over how many pixels it was taken.
    freedom
        Degrees of freedom of what ``noise`` was measured by.
    """
    harmful = (energy - noise) / (let_pass + UNCERTAIN_NOISE * noise)
    found = np.minimum(harmful, normal_deviate(energy / noise, pixels, freedom) / _SIGNIFICANT)
    found[..., pixels < FEWEST_OF_TILE] = 0
    return np.asarray(found)


def normal_deviate(ratio: NDArray[np.float64], above: NDArray[np.float64] | float, below: float) -> NDArray[np.float64]:
    """Ratios of two measured variances, made standard normal.

    The cube root of χ² over its degrees of freedom is normal but for little (Wilson & Hilferty, PNAS 17, 684 (1931)),
    and so is the difference of two of them (Paulson, Ann. Math. Stat. 13, 233 (1942)).

    Parameters
    ----------
    ratio
        F, any shape.
    above, below
        Degrees of freedom of its numerator and denominator.
    """
    root, spread, unsure = np.cbrt(ratio), 2 / (9 * np.asarray(above)), 2 / (9 * below)
    return np.asarray(((1 - unsure) * root - (1 - spread)) / np.sqrt(unsure * root**2 + spread))


def highest_by_chance(probability: float, degrees: int, noise: Noise) -> float:
    """Energy, in units of the variance of ``noise``, that ``degrees`` measurements have with this probability at most.

    A quantile of χ²; of F where the noise is measured as well.
    """
    return _highest_by_chance(probability, degrees, noise.freedom)


@lru_cache(maxsize=64)  # asked for every frame in every tile of a sequence
def _highest_by_chance(probability: float, degrees: int, freedom: float) -> float:
    # Heavy, and not needed where the steps are few.
    from scipy.stats import chi2, f

    if not np.isfinite(freedom):
        return float(chi2.isf(probability, degrees))
    return float(degrees * f.isf(probability, degrees, freedom))
