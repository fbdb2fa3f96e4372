"""How well a direct place is known where more than one bounce explains the data; see `scanner.paths.joint`.

The inverse Fisher matrix at a minimum of χ² knows of no other minimum. A σ is therefore so wide that of the posterior
of all the fits that were found at a direct place, each normal about its own, next to nothing lies outside 3σ.

Numba's cache of `joint_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanner.paths.joint_hypotheses import HOPELESS_CHI2, SAME_PX
from scanner.paths.rotation import compiled

Reals = NDArray[np.float64]

OUTSIDE = 0.005
"""Of the posterior of a coordinate, the share that may lie outside three σ."""
_BISECTIONS = 6
"""Halvings of the interval that holds a σ, which leave 2 % of it."""
_TINY = 1e-300


@compiled  # pragma: no cover
def widened(mixture: Reals, count: int, place: float, sigma: float) -> float:
    """σ, at least ``sigma``, so wide that of a mixture a share of `OUTSIDE` at most lies farther than 3σ from a place.

    ``mixture`` (count, 3): weight, place and σ of its parts.
    """
    total, low, high = 0.0, sigma, sigma
    for i in range(count):
        total += mixture[i, 0]
        high = max(high, abs(mixture[i, 1] - place) / 3 + mixture[i, 2])
    if high < 1.1 * low:
        return low
    wide = low
    for turn in range(_BISECTIONS):
        outside = 0.0
        for i in range(count):
            off, scale = abs(mixture[i, 1] - place), math.sqrt(2.0) * max(mixture[i, 2], _TINY)
            beyond = (3 * wide - off) / scale
            # Of a fit elsewhere one tail counts, of one here both.
            if beyond < 3:
                outside += (0.5 if off > scale else 1.0) * mixture[i, 0] * math.erfc(beyond)
        if outside <= OUTSIDE * total:
            if turn == 0:
                return low
            high = wide
        else:
            low = wide
        wide = 0.5 * (low + high)
    return high


@compiled  # pragma: no cover
def by_bounce(posterior: Reals, count: int, place: float, sigma: float, mixture: Reals) -> float:
    """`widened` by the places of the bounce that `nearby` has found about a direct place."""
    least, parts = math.inf, 0
    for i in range(count):
        if abs(posterior[i, 1] - place) < SAME_PX:
            least = min(least, posterior[i, 0])
    for i in range(count):
        if abs(posterior[i, 1] - place) < SAME_PX and posterior[i, 0] < least + HOPELESS_CHI2:
            mixture[parts, 0] = math.exp(0.5 * (least - posterior[i, 0]))
            mixture[parts, 1], mixture[parts, 2] = posterior[i, 1], posterior[i, 2]
            parts += 1
    return widened(mixture, parts, place, sigma) if parts > 0 else sigma
