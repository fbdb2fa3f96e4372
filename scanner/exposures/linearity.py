"""Does light grow as the exposures say? What fusing rests on: grey value = black level + exposure · light.

The black level drops out: only differences between patterns are compared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers import Pixels

_STRONG = 4.0
"""Temporal standard deviation, in units of the noise, from which a pixel's frames tell a ratio."""

_FEWEST = 200
"""Pixels that are enough to tell it."""


class LightRatio:
    """The light of one exposure over that of a longer one, measured where both are good.

    The slope of one's frames against the other's, frame by frame about their mean, over all pixels; the noise of the
    abscissa, which would flatten it, is known and taken off (errors-in-variables; Fuller, Measurement Error Models,
    1987, §1.2). Bright pixels count most, so that grey values cut off at 0 do not tell.

    Parameters
    ----------
    good
        (P,) bool, pixels that both exposures measure.
    variance
        (P,) of a frame of the longer, DN².
    """

    def __init__(self, good: NDArray[np.bool_], variance: NDArray[np.float32]) -> None:
        self._good = good
        self._variance = variance
        self._products = self._squares = 0.0
        self._pixels = 0

    def add(self, longer: NDArray[np.float32], shorter: NDArray[np.float32]) -> None:
        """Take over the (N, P) grey values of one sequence at both exposures."""
        off = longer - longer.mean(axis=0)
        power = np.square(off).sum(axis=0)
        noise = (len(off) - 1) * self._variance
        told = self._good & (power > (1 + _STRONG**2) * noise)
        self._pixels = max(self._pixels, int(np.count_nonzero(told)))
        self._products += float((off[:, told] * shorter[:, told]).sum())
        self._squares += float((power[told] - noise[told]).sum())

    @property
    def measured(self) -> float:
        """The ratio; NaN where too few pixels are good in both."""
        return self._products / self._squares if self._pixels >= _FEWEST else float("nan")


def contrast_ratio(
    one: tuple[Pixels, Pixels], other: tuple[Pixels, Pixels], bright_dn: float, noise_dn: float
) -> float:
    """Light of ``other`` over that of ``one``, each (bright, dark) frames (H, W) of the same two pictures.

    Parameters
    ----------
    bright_dn
        Grey value from which a pixel is left out.
    noise_dn
        Contrast of ``one`` from which a pixel tells anything, DN.

    Returns
    -------
    The ratio; NaN where too few pixels tell it.
    """
    a, b = (np.subtract(bright, dark, dtype=np.float32) for bright, dark in (one, other))
    told = (one[0] < bright_dn) & (other[0] < bright_dn) & (a > noise_dn)
    if np.count_nonzero(told) < _FEWEST:
        return float("nan")
    return float((a[told] * b[told]).sum() / np.square(a[told]).sum())
