"""How well a direct place is known where more than one bounce explains the data; see `scanner.paths.joint`.

The inverse Fisher matrix at a minimum of χ² knows of no other minimum. A σ is therefore so wide that of the posterior
of all the fits that were found at a direct place, each normal about its own, next to nothing lies outside 3σ.

Numba's cache of `joint_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scanner.paths.joint_hypotheses import HOPELESS_CHI2, SAME_PX
from scanner.paths.rotation import compiled

Reals = NDArray[np.float64]

OUTSIDE = 0.005
"""Of the posterior of a coordinate, the share that may lie outside three σ."""
_BISECTIONS = 6
"""Halvings of the interval that holds a σ, which leave 2 % of it."""
_NEXT_TO_NOTHING = 1.1
"""Factor of σ that is not worth the widening."""
_TINY = 1e-300
_TAIL_SIGMAS, _TAIL_STEPS = 4.5, 64
"""Range of the table of the normal distribution's tail, and steps a σ: it is off by 3e-5 at most."""
_TAIL = ndtr(-np.arange(-_TAIL_SIGMAS, _TAIL_SIGMAS + 2 / _TAIL_STEPS, 1 / _TAIL_STEPS))


@compiled  # pragma: no cover
def _tail(sigmas: float) -> float:
    """Share of a normal distribution that lies more than so many σ above its middle."""
    at = (sigmas + _TAIL_SIGMAS) * _TAIL_STEPS
    if not at > 0:
        return 1.0
    if at >= 2 * _TAIL_SIGMAS * _TAIL_STEPS:
        return 0.0
    k = int(at)
    return float(_TAIL[k] + (at - k) * (_TAIL[k + 1] - _TAIL[k]))


@compiled  # pragma: no cover
def widened(mixture: Reals, count: int, place: float, sigma: float) -> float:
    """σ, at least ``sigma``, so wide that of a mixture a share of `OUTSIDE` at most lies farther than 3σ from a place.

    ``mixture`` (count, 3): weight, place and σ of its parts; is overwritten.
    """
    total, high = 0.0, sigma
    for i in range(count):
        off = abs(mixture[i, 1] - place)
        high = max(high, off / 3 + mixture[i, 2])
        total += mixture[i, 0]
        # Of a fit elsewhere one tail counts, of one here both.
        mixture[i, 0] *= 1.0 if off > math.sqrt(2.0) * mixture[i, 2] else 2.0
        mixture[i, 2] = 1 / max(mixture[i, 2], _TINY)
        mixture[i, 1] = off * mixture[i, 2]
    low = wide = sigma
    if high < _NEXT_TO_NOTHING * low:
        return low
    for turn in range(_BISECTIONS):
        outside = 0.0
        for i in range(count):
            outside += mixture[i, 0] * _tail(3 * wide * mixture[i, 2] - mixture[i, 1])
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
    least, high, parts = math.inf, sigma, 0
    for i in range(count):
        off = abs(posterior[i, 1] - place)
        if off < SAME_PX:
            least = min(least, posterior[i, 0])
            high = max(high, off / 3 + posterior[i, 2])
    if high < _NEXT_TO_NOTHING * sigma:
        return sigma
    for i in range(count):
        if abs(posterior[i, 1] - place) < SAME_PX and posterior[i, 0] < least + HOPELESS_CHI2:
            mixture[parts, 0] = math.exp(0.5 * (least - posterior[i, 0]))
            mixture[parts, 1], mixture[parts, 2] = posterior[i, 1], posterior[i, 2]
            parts += 1
    return widened(mixture, parts, place, sigma)
