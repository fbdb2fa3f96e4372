"""Does light grow as the exposures say? What fusing rests on: grey value = black level + exposure · light.

The black level drops out: only differences between patterns are compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers import Pixels

_STRONG = 4.0
"""Temporal standard deviation, in units of the noise, from which a pixel's frames tell a ratio."""

_FEWEST = 200
"""Pixels that are enough to tell it."""


class LightRatios:
    """The light of every exposure over that of the longest, measured where both are good.

    The slope of one's frames against the other's, frame by frame about their mean, over all pixels; the noise of the
    abscissa, which would flatten it, is known and taken off (errors-in-variables; Fuller, Measurement Error Models,
    1987, §1.2).

    Parameters
    ----------
    longest
        Number of the exposure that the others are compared with.
    good
        (E, P) bool, pixels that each exposure measures.
    variance
        (P,) of a frame of the longest, DN².
    """

    def __init__(self, longest: int, good: NDArray[np.bool_], variance: NDArray[np.float32]) -> None:
        self._longest = longest
        self._good = good
        self._variance = variance
        self._products = np.zeros(len(good))
        self._squares = np.zeros(len(good))
        self._pixels = np.zeros(len(good), int)

    def add(self, values: Sequence[NDArray[np.float32]]) -> None:
        """Take over the (N, P) grey values of one sequence at every exposure."""
        anchor = values[self._longest] - values[self._longest].mean(axis=0)
        power = np.square(anchor).sum(axis=0)
        noise = (len(anchor) - 1) * self._variance
        strong = power > (1 + _STRONG**2) * noise
        for k, other in enumerate(values):
            both = self._good[k] & self._good[self._longest] & strong
            self._pixels[k] = max(self._pixels[k], np.count_nonzero(both))
            self._products[k] += float((anchor[:, both] * other[:, both]).sum())
            self._squares[k] += float((power[both] - noise[both]).sum())

    @property
    def measured(self) -> list[float]:
        """(E,) light over that of the longest exposure; NaN where too few pixels are good in both."""
        return [
            p / s if n >= _FEWEST else float("nan")
            for p, s, n in zip(self._products, self._squares, self._pixels, strict=True)
        ]


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
