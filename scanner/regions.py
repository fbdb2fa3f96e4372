"""Which projector pixels round two lights (method.md §5).

*sound*: where the detected pixels' direct light can come from, and nothing else. *literal*: the paper's Eq. 21, which
darkens only what undetected camera pixels map to and so leaves lit every emitter that the camera does not see.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_DENSITY = 3
"""A projector pixel is believed when at least this many coordinates fall on it and its 8 neighbours."""


def sound_mask(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    size: tuple[int, int],
    margin_px: float,
    emitters: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
) -> NDArray[np.bool_]:
    """Light the direct coordinates of the detected pixels, grown by a margin, except where the bounces come from.

    Parameters
    ----------
    x, y
        (P,) direct projector coordinates of the detected pixels, px; NaN where not known. With ``y`` all NaN whole
        columns are lit (one axis, no rig), with ``x`` all NaN whole rows.
    size
        Projector (width, height), px.
    margin_px
        How far the lit set is grown, so that fringes are not cut where they are measured.
    emitters
        (x, y) of the second paths: the margin does not grow onto them.

    Returns
    -------
    NDArray
        (height, width) bool.
    """
    core = _close(_believed(_splat(x, y, size)))
    reach = int(np.ceil(margin_px))
    grown = cv2.dilate(core.astype(np.uint8), _disc(reach)) > 0 if reach else core
    if emitters is not None:
        source = _close(_believed(_splat(*emitters, size)))
        grown &= core | ~source
    return np.asarray(grown)


def literal_mask(x: NDArray[np.float32], y: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Light everything but the pixels that undetected camera pixels map to (the paper's Eq. 21).

    Parameters
    ----------
    x, y
        (P,) coordinates of the undetected pixels, px.

    Notes
    -----
    Gaps of up to two projector pixels between neighbouring camera pixels are closed: the paper's camera samples the
    projector several times over and has none.
    """
    return ~_close(_splat(x, y, size) > 0)


def inside(
    mask: NDArray[np.bool_], x: NDArray[np.float32], y: NDArray[np.float32], clearance_px: int
) -> NDArray[np.bool_]:
    """Whether projector coordinates lie in ``mask``, at least ``clearance_px`` from where it ends; False for NaN."""
    core = cv2.erode(mask.astype(np.uint8), _disc(clearance_px), borderType=cv2.BORDER_CONSTANT, borderValue=1) > 0
    height, width = mask.shape
    known = np.isfinite(x) & np.isfinite(y)
    column = np.clip(np.rint(np.where(known, x, 0)), 0, width - 1).astype(np.intp)
    row = np.clip(np.rint(np.where(known, y, 0)), 0, height - 1).astype(np.intp)
    return np.asarray(known & core[row, column])


def _splat(x: NDArray[np.float32], y: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.int32]:
    """(height, width) number of coordinates that round to each projector pixel."""
    width, height = size
    if np.isnan(y).all():
        column = np.rint(x[np.isfinite(x)]).astype(np.intp)
        counts = np.bincount(column[(column >= 0) & (column < width)], minlength=width)
        return np.broadcast_to(counts.astype(np.int32), (height, width))
    if np.isnan(x).all():
        return _splat(y, x, (height, width)).T
    known = np.isfinite(x) & np.isfinite(y)
    column, row = np.rint(x[known]).astype(np.intp), np.rint(y[known]).astype(np.intp)
    ok = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    counts = np.bincount(row[ok] * width + column[ok], minlength=width * height)
    return counts.reshape(height, width).astype(np.int32)


def _believed(counts: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels that enough coordinates fall on or beside: a single wrong one must not light an emitter."""
    near = cv2.boxFilter(counts.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return (counts > 0) & (near >= _DENSITY)


def _close(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    # A border of its own: closing must not lose what touches the picture's edge.
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 4, 4, 4, 4, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(2))[4:-4, 4:-4] > 0)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
