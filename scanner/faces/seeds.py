"""Where faces begin: connected pixels around which the surface is smooth."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

WINDOW = 3
"""Half of the window in which a plane is fitted, cells."""

SHARPEST_DEG = 25.0
"""Normals of windows side by side differ by less than this on a face; a ball of twenty pixels has more at its limb."""

_ROUGH = 1 / 3
"""On a face coordinates lie this near (rms) to the plane of a window, in units of what continues it; more is a step."""

_LEAST_SEED = 50
"""Cells; smaller ones are bits between edges."""

_FULL = 0.5
"""Share of a window's cells that a plane is fitted to at least."""


def seeds(
    w: NDArray[np.float64],
    rays: tuple[NDArray[np.float64], NDArray[np.float64]],
    scale: NDArray[np.float64],
    tolerance_px: float,
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.bool_]]:
    """Find where faces begin: numbers of seeds, normals, and cells that lie at creases and steps.

    Parameters
    ----------
    w
        (H, W) inverse depth, 1/mm: on a plane it is linear in the direction of the ray. NaN where not known.
    rays
        (H, W) x and y of the viewing rays, z = 1.
    scale
        (H, W) how far the projector coordinate moves with w, px mm.
    tolerance_px
        By how much what continues a face may miss it.

    Returns
    -------
    tuple
        (H, W) number of the seed that a cell belongs to, 0 for none; (H, W, 3) unit normals, NaN where too little is
        known; and (H, W) bool, the cells at creases and steps.
    """
    known = np.isfinite(w)
    if not known.any():
        return np.zeros(w.shape, np.int32), np.full((*w.shape, 3), np.nan), ~known
    normals, rough = _planes(w, known, rays)
    bend = _bend(normals)
    with np.errstate(invalid="ignore"):
        sharp = known & ((bend >= SHARPEST_DEG) | (rough * scale >= _ROUGH * tolerance_px))
        # Beside what is not known nobody sees whether there is a crease: no seed reaches there.
        smooth = known & ~sharp & np.isfinite(bend)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(smooth.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_SEED
    large[0] = False
    number = np.where(large, np.cumsum(large), 0)
    return np.asarray(number[labels], np.int32), normals, sharp


def _planes(
    w: NDArray[np.float64], known: NDArray[np.bool_], rays: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit normal (H, W, 3) of the plane through every window, and how far w is off it (rms)."""
    x, y = rays
    middle = float(np.median(w[known]))
    one, value = known.astype(np.float64), np.where(known, w / middle - 1, 0)

    def total(plane: NDArray[np.float64]) -> NDArray[np.float64]:
        side = 2 * WINDOW + 1
        return np.asarray(
            cv2.boxFilter(plane, cv2.CV_64F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    n = total(one)
    full = n >= _FULL * (2 * WINDOW + 1) ** 2
    n = np.maximum(n, 1)
    mx, my, mv = (total(one * a) / n for a in (x, y, value))
    xx, xy, yy = total(one * x * x) / n - mx * mx, total(one * x * y) / n - mx * my, total(one * y * y) / n - my * my
    vx, vy, vv = total(value * x) / n - mv * mx, total(value * y) / n - mv * my, total(value * value) / n - mv * mv
    det = np.where(full, xx * yy - xy * xy, 1)
    a, b = (yy * vx - xy * vy) / det, (xx * vy - xy * vx) / det
    normals = np.stack([a, b, 1 + mv - a * mx - b * my], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[~full] = np.nan
    return normals, middle * np.sqrt(np.maximum(vv - a * vx - b * vy, 0))


def _bend(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest angle (H, W) between the normals on opposite sides of a cell, degrees; NaN where one is missing."""
    height, width = normals.shape[:2]
    bend = np.full((height, width), np.nan)
    reach = WINDOW + 1
    bend[reach : height - reach, reach : width - reach] = 0
    for down, across in ((0, WINDOW + 1), (WINDOW + 1, 0), (WINDOW, WINDOW), (WINDOW, -WINDOW)):
        side = abs(across)
        if height <= 2 * down or width <= 2 * side:
            continue
        middle = bend[down : height - down, side : width - side]

        def shifted(
            rows: int, columns: int, down: int = down, side: int = side, shape: tuple[int, ...] = middle.shape
        ) -> NDArray[np.float64]:
            top, left = down + rows, side + columns
            return normals[top : top + shape[0], left : left + shape[1]]

        half = np.linalg.norm(shifted(down, across) - shifted(-down, -across), axis=-1) / 2
        np.maximum(middle, np.degrees(2 * np.arcsin(np.minimum(half, 1))), out=middle)
    return bend
