"""What is read off a live picture: brightness, saturation, focus, and what to do about the exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, Pixels

BRIGHTEST = 0.995
"""Quantile that stands for the brightest grey value: a glint or a hot pixel does not move it."""

TARGET = 0.9
"""Share of full scale at which the brightest pixels are best; more leaves no room for noise."""

_WELL = (0.7, 0.98)
_BINS = 64
_LEAST_PIXELS = 64


@dataclass(frozen=True)
class Reading:
    """What one frame tells.

    Parameters
    ----------
    brightest
        Grey value that 99.5 % of the pixels do not exceed, as a share of full scale.
    mean
        Mean grey value as a share of full scale.
    saturated
        Number of saturated pixels.
    saturated_share, dark_share
        Shares of all pixels that are saturated, and too dark to measure with.
    focus
        See `focus_measure`; NaN where it is not known.
    histogram
        (64,) shares of the pixels by grey value, from black to full scale.
    """

    brightest: float
    mean: float
    saturated: int
    saturated_share: float
    dark_share: float
    focus: float
    histogram: NDArray[np.float64]


def dark_below_dn(saturated_dn: int) -> float:
    """Grey value (DN) below which a pixel is too dark: the contrast that the scan's exposure check asks for."""
    return max(0.02 * saturated_dn, 4.0)


def read_frame(frame: Pixels, frame_format: FrameFormat, focus: float = math.nan) -> Reading:
    """Read brightness and saturation off a frame.

    Parameters
    ----------
    frame
        (H, W) grey values.
    frame_format
        Says what is saturated.
    focus
        Put into the reading as it is.
    """
    full = frame_format.saturated_dn
    # Counted by grey value, so that everything below costs one pass over the pixels.
    counts = cv2.calcHist([frame], [0], None, [full + 1], [0, full + 1]).reshape(-1).astype(np.float64)
    saturated = int(np.count_nonzero(frame >= full))
    levels = np.arange(full + 1)
    cumulated = np.cumsum(counts)
    return Reading(
        brightest=float(np.searchsorted(cumulated, BRIGHTEST * frame.size)) / full,
        mean=float(counts @ levels) / frame.size / full,
        saturated=saturated,
        saturated_share=saturated / frame.size,
        dark_share=float(counts[levels < dark_below_dn(full)].sum()) / frame.size,
        focus=focus,
        histogram=np.add.reduceat(counts, np.arange(_BINS) * (full + 1) // _BINS) / frame.size,
    )


def focus_measure(first: Pixels, second: Pixels, saturated_dn: int) -> float:
    """How sharp two frames of the same unmoved scene are: RMS gradient over mean brightness, 1/px.

    The gradients of one frame are multiplied with those of the other: what the scene puts there is in both, noise is
    not, and its product averages out. So a darker picture is not taken for a sharper one, and no noise model is needed.

    Parameters
    ----------
    first, second
        (H, W) grey values of frames that were taken one after the other.
    saturated_dn
        Grey value of saturated pixels; they and their neighbours are left out.

    Returns
    -------
    float
        Blurring the scene lowers it; a fringe m·(1 + c·cos ωx) blurred with σ gives c·sin(ω)·exp(-σ²ω²/2)/√2.
        NaN where hardly a pixel is left or the picture is black.

    Notes
    -----
    Tenengrad's gradient energy (Krotkov 1988; Pertuz, Puig, Garcia 2013, GRAE) with Scharr's operator, normalised by
    brightness; the product of two frames in place of a square is this project's.
    """
    good = ((first < saturated_dn) & (second < saturated_dn)).astype(np.uint8)
    inner = cv2.erode(good, np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0
    if np.count_nonzero(inner) < _LEAST_PIXELS:
        return math.nan
    product = np.zeros(inner.shape, np.float32)
    for x, y in ((1, 0), (0, 1)):
        a, b = (cv2.Scharr(f, cv2.CV_32F, x, y, scale=1 / 32)[1:-1, 1:-1] for f in (first, second))
        product += a * b
    level = float(first[1:-1, 1:-1][inner].mean() + second[1:-1, 1:-1][inner].mean()) / 2
    if level <= 0:
        return math.nan
    return math.sqrt(max(float(product[inner].mean(dtype=np.float64)), 0.0)) / level


def exposure_hint(
    reading: Reading, max_saturated_share: float, exposure_s: float | None = None, period_s: float | None = None
) -> str:
    """One line about the exposure of the brightest picture that is projected.

    Parameters
    ----------
    reading
        Of a frame under full light.
    max_saturated_share
        Share of saturated pixels with which a scan still starts.
    exposure_s
        The camera's exposure time, s; None where not known.
    period_s
        The projector's, s: an exposure is kept a whole multiple of it. None where there is no such need.
    """
    if reading.saturated_share > max_saturated_share:
        # How far beyond full scale the light goes cannot be seen; half of it is a safe next try.
        told, factor = f"{100 * reading.saturated_share:.1f} % of the pixels are saturated", 0.5
    else:
        told = f"brightest 99.5 % at {100 * reading.brightest:.0f} % of full scale"
        if _WELL[0] <= reading.brightest <= _WELL[1]:
            return f"{told}: good"
        factor = TARGET / max(reading.brightest, 0.01)
    brighter = factor > 1
    other = f"{'open' if brighter else 'close'} the aperture for {factor:.2g} × the light"
    if exposure_s is None:
        return f"{told}: {'lengthen' if brighter else 'shorten'} the exposure to {factor:.2g} ×, or {other}"
    wanted = exposure_s * factor
    if period_s is not None:
        periods = math.floor(wanted / period_s * (1 + 1e-6))
        wanted = periods * period_s
        if periods == 0 or (brighter and wanted <= exposure_s * (1 + 1e-3)):
            return f"{told}: {other} (the exposure stays a multiple of the projector's {1000 * period_s:.4g} ms)"
    return f"{told}: {'lengthen' if brighter else 'shorten'} to {1000 * wanted:.4g} ms"
