"""Estimates by tile of the picture: their scatter tells σ, of noise and of all that differs from place to place."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def scattered(estimate: Callable[[NDArray[np.intp]], Array], count: int, tiles: int) -> tuple[Array, Array]:
    """Estimate from all pixels, and its covariance by the delete-one-tile jackknife.

    Parameters
    ----------
    estimate
        From the numbers of the pixels to use, in picture order, to (n,) values.
    count
        How many pixels there are; consecutive ones make a tile.
    tiles
        How many tiles.

    Returns
    -------
    value, covariance
        (n,) and (n, n).

    Notes
    -----
    Efron & Stein, Ann. Stat. 9, 586 (1981): cov = (m − 1)/m · Σ (θ₍ᵢ₎ − θ̄)(θ₍ᵢ₎ − θ̄)ᵀ.
    """
    everything = np.arange(count)
    edges = np.linspace(0, count, tiles + 1).astype(int)
    left_out = np.array([estimate(np.delete(everything, slice(low, high))) for low, high in pairwise(edges)])
    off = left_out - left_out.mean(axis=0)
    return estimate(everything), np.asarray((tiles - 1) / tiles * off.T @ off)
