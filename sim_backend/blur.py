"""Gaussian blur of pictures."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ive

Floats = NDArray[np.float32]


def blurred(picture: Floats, sigma_px: float) -> Floats:
    """A picture (height, width) blurred; beyond its border it stays as it is there."""
    if sigma_px == 0:
        return picture
    kernel = gaussian(sigma_px)
    return np.asarray(cv2.sepFilter2D(picture, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)


def blurred_within_more(picture: Floats, sigma_px: float) -> Floats:
    """A picture (height, width) blurred that is a part of a larger one.

    An odd reflection at the border continues fringes in phase; a copy of the border would shift them by a tenth of a
    pixel there.
    """
    margin = math.ceil(4 * sigma_px)
    wider = np.pad(picture, margin, mode="reflect", reflect_type="odd") if margin else picture
    return blurred(wider, sigma_px)[margin : margin + picture.shape[0], margin : margin + picture.shape[1]]


@cache
def gaussian(sigma_px: float) -> Floats:
    """Kernel of a Gaussian on a grid: e^(-σ²) I_n(σ²), whose variance is σ² even for narrow ones.

    A sampled Gaussian of σ = 0.5 px is 14 % too small there (Lindeberg, IEEE TPAMI 12(3), 1990). The blurs of two such
    kernels one after the other are that of a third, of the variances' sum, exactly.
    """
    reach = math.ceil(4 * sigma_px) + 1
    kernel = ive(np.abs(np.arange(-reach, reach + 1)), sigma_px**2)
    return np.asarray(kernel / kernel.sum(), np.float32)
