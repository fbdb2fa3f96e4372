"""Pictures between their pixels: the cubic spline through them, as `scipy.ndimage.map_coordinates` has it.

The same places are looked up in thousands of pictures, so the weights of the coefficients are worked out once.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.ndimage import spline_filter, spline_filter1d


def coefficients(picture: np.ndarray) -> np.ndarray:
    """Of the spline (height, width) through a picture of that size that goes on beyond its border as it is there."""
    # A fringe is alike in all rows or in all columns: one of them tells the others.
    for axis in (0, 1):
        line = picture.take([0], axis)
        if (picture == line).all():
            found = spline_filter1d(line, order=3, axis=1 - axis, mode="nearest")
            return np.ascontiguousarray(np.broadcast_to(found, picture.shape))
    return spline_filter(picture, order=3, mode="nearest")


def looked_up(x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> sparse.csr_array:
    """(places, pixels) weights of the coefficients of a picture ``shape`` (height, width) at ``x``, ``y``."""
    (height, width), count = shape, x.size
    left, top = np.floor(x.ravel()), np.floor(y.ravel())
    column, row = ((corner[:, None] + np.arange(-1, 3)).astype(int) for corner in (left, top))
    pixel = np.clip(row, 0, height - 1)[:, :, None] * width + np.clip(column, 0, width - 1)[:, None, :]
    weight = _spline(y.ravel() - top)[:, :, None] * _spline(x.ravel() - left)[:, None, :]
    entries = weight.ravel(), (np.repeat(np.arange(count), 16), pixel.ravel())
    return sparse.csr_array(entries, shape=(count, height * width))


def _spline(t: np.ndarray) -> np.ndarray:
    """(n, 4) the cubic B-splines at the fractions ``t`` (n,) between two knots."""
    s = 1 - t
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=1) / 6
