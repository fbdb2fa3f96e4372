"""Which of a pixel's two paths is the direct one, where each axis was separated by itself (method.md §6)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from scanner.paths.kernels import Floats
from scanner.paths.separation import TwoPaths

_LARGER_IS_DIRECT = 0.9
"""Of bounces, the share that is weaker than the direct light (method.md §6)."""
_EPIPOLAR_PX, _EPIPOLAR_STRAY = 0.1, 0.02
"""Error of a calibrated rig, px, and the share of direct paths that a wrong fringe order throws off the line."""
_RATIO, _RATIO_STRAY = 0.05, 0.1
"""Relative difference of the optics' modulation between the axes, and the share of pixels where it is more."""
_NEIGHBOUR_PX, _NEIGHBOUR_STRAY = 3.0, 0.1
"""Change of a coordinate to the next pixels, px, and the share of pixels beyond a depth edge."""
_SPAN_PX = 1000.0
"""Range over which a coordinate or a distance that is wrong may lie, px."""


@dataclass(frozen=True)
class DirectPath:
    """Which of a pixel's two paths is the direct one.

    Parameters
    ----------
    ix, iy
        (P,) index 0 or 1 into the two paths of the first and of the second axis; equal where there is one axis.
    confidence
        (P,) log-likelihood ratio of the choice against the next best; NaN where an axis has no finite path.
    """

    ix: NDArray[np.intp]
    iy: NDArray[np.intp]
    confidence: Floats


def choose_direct(
    x: TwoPaths,
    y: TwoPaths | None = None,
    *,
    distance_px: ArrayLike | None = None,
    sigma_px: ArrayLike | None = None,
    near_x: ArrayLike | None = None,
    near_y: ArrayLike | None = None,
) -> DirectPath:
    """Choose the direct one of two paths per axis by likelihood (method.md §6).

    Four terms, each with a share of strays so that none overrules all others: the direct pair lies on the pixel's
    epipolar line, a bounce by chance only; the direct path has the same amplitude in both axes; the larger amplitude is
    direct in nine of ten; neighbours see nearby coordinates.

    Parameters
    ----------
    x, y
        Two paths of the same P pixels on one or two axes.
    distance_px, sigma_px
        (4, P) signed distance of (x_i, y_j) from the epipolar line and its standard deviation, px, in the order
        (i, j) = 00, 01, 10, 11; None without a rig. NaN in ``sigma_px`` counts as 0: the rig's own error is added.
    near_x, near_y
        (P,) coordinate that the neighbours suggest, px, NaN where they do not.

    Raises
    ------
    ValueError
        Different numbers of pixels, or a distance without its σ or without a second axis.
    """
    pixels = x.u.shape[1]
    shape = (2, 1 if y is None else 2, pixels)
    if (distance_px is None) != (sigma_px is None) or (distance_px is not None and y is None):
        raise ValueError("the epipolar term needs both axes, distance_px and sigma_px")
    if y is not None and y.u.shape != x.u.shape:
        raise ValueError(f"{pixels} pixels on the first axis, {y.u.shape[1]} on the second")
    score = np.zeros(shape)
    axes: list[tuple[TwoPaths, ArrayLike | None, Any]] = [(x, near_x, (slice(None), None))]
    if y is not None:
        axes.append((y, near_y, (None, slice(None))))
    for paths, near, spread in axes:
        # Where the amplitudes differ by no more than their noise, their order says nothing.
        lead = paths.amplitude[0] - paths.amplitude[1]
        sure = np.nan_to_num(ndtr(lead / (math.sqrt(2) * paths.sigma_amplitude)), nan=0.5)
        larger = _LARGER_IS_DIRECT * sure + (1 - _LARGER_IS_DIRECT) * (1 - sure)
        score += np.log([larger, 1 - larger])[spread] / len(axes)
        score[np.broadcast_to(~np.isfinite(paths.u)[spread], shape)] = -np.inf
        if near is not None:
            off = paths.u - np.asarray(near, np.float64)
            vote = _log_likelihood(off, np.hypot(paths.sigma_u, _NEIGHBOUR_PX), _NEIGHBOUR_STRAY, 1 / _SPAN_PX)
            score += np.nan_to_num(vote)[spread]
    if y is not None:
        one, two = x.amplitude[:, None], y.amplitude[None]
        noise = np.hypot(x.sigma_amplitude, y.sigma_amplitude)
        # Relative, so that the agreement of two weak paths counts no more than that of two strong ones.
        middle = 0.5 * (one + two)
        ratio = _log_likelihood((one - two) / middle, np.hypot(noise / middle, _RATIO), _RATIO_STRAY, 0.25)
        score += np.nan_to_num(ratio)
    if distance_px is not None:
        distance = np.asarray(distance_px, np.float64).reshape(shape)
        noise = np.hypot(np.nan_to_num(np.asarray(sigma_px, np.float64)).reshape(shape), _EPIPOLAR_PX)
        line = _log_likelihood(distance, noise, _EPIPOLAR_STRAY, 1 / _SPAN_PX)
        score += np.where(np.isfinite(distance), line, math.log(_EPIPOLAR_STRAY / _SPAN_PX))
    flat = score.reshape(-1, pixels)
    best = flat.argmax(axis=0)
    ranked = np.sort(flat, axis=0)
    with np.errstate(invalid="ignore"):
        confidence = (ranked[-1] - ranked[-2]).astype(np.float32)
    ix, iy = (best, best) if y is None else (best // 2, best % 2)
    return DirectPath(ix, iy, confidence)


def _log_likelihood(off: Any, sigma: Any, stray: float, density: Any) -> Any:
    """Log density of a deviation that is normal or, in a share ``stray`` of cases, anywhere with ``density``."""
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = -0.5 * (off / sigma) ** 2 - np.log(math.sqrt(2 * math.pi) * sigma)
        return np.logaddexp(math.log(1 - stray) + normal, np.log(stray * density))
