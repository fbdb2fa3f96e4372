"""Which point of a grid is which: finders return a grid in some order, a board has one upright."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.detection.mapping import PlaneMap

Array = NDArray[np.float64]

_LARGEST_MISFIT = 0.25  # of the pitch: a wrong order of a shifted grid is off by half a pitch


def labelled(board: Board, grid: Array, grey: NDArray[np.uint8]) -> Array | None:
    """Bring the points of a grid into the order of the board's ids.

    Of all turns (and mirrored orders, which finders may return) that map the board's points onto themselves, those
    count that put the print's dark parts onto dark places and keep its sides. Where a symmetric board leaves more than
    one, the print is taken to stand upright, its x axis most nearly to the right.

    Parameters
    ----------
    board
        A grid whose points are all found.
    grid
        (n, 2) px, in the order of the ids or one that a turn or mirror makes of it.
    grey
        (H, W) the picture.

    Returns
    -------
    (n, 2) px by ids; None where no order fits.
    """
    points = board.points[:, :2]
    best, best_angle = None, math.inf
    for order in _orders(points):
        xy = grid[order]
        plane = PlaneMap.fitted(points, xy)
        if plane is None:
            continue
        first, _ = plane.expanded(np.zeros((1, 2)), board.pitch_mm / 10)
        x_axis = first[0, :, 0]
        pitch_px = board.pitch_mm * math.sqrt(abs(np.linalg.det(first[0])))
        misfit = math.sqrt(float(np.mean(np.sum((plane(points) - xy) ** 2, axis=1))))
        angle = abs(math.atan2(x_axis[1], x_axis[0]))
        keeps_sides = np.linalg.det(first[0]) > 0
        fits = misfit < _LARGEST_MISFIT * pitch_px and keeps_sides and _is_dark_where_printed(board, plane, xy, grey)
        if fits and angle < best_angle:
            best, best_angle = xy, angle
    return best


def _orders(points: Array) -> list[NDArray[np.int64]]:
    """All ways to number the points anew by a turn or a mirror that maps them onto themselves."""
    span = np.ptp(points, axis=0).max()
    orders = []
    for mirror in (1, -1):
        for cos, sin in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            moved = points @ np.array([[cos, sin], [-sin, cos]]) * (mirror, 1)
            distance = np.abs(moved[:, None] - points[None]).max(axis=2)
            if distance.min(axis=1).max() < 1e-6 * span:
                orders.append(distance.argmin(axis=1))
    return orders


def _is_dark_where_printed(board: Board, plane: PlaneMap, xy: Array, grey: NDArray[np.uint8]) -> bool:
    """Whether the middles of the dark polygons are darker than the points, whose surroundings are half dark."""
    if not board.polygons:
        return True
    middles = plane(np.array([polygon.mean(axis=0) for polygon in board.polygons]))
    return _mean_at(grey, middles) < _mean_at(grey, xy)


def _mean_at(grey: NDArray[np.uint8], xy: Array) -> float:
    import cv2

    smooth = cv2.blur(grey, (3, 3))
    columns, rows = np.rint(xy).astype(np.int64).T
    inside = (columns >= 0) & (columns < grey.shape[1]) & (rows >= 0) & (rows < grey.shape[0])
    return float(smooth[rows[inside], columns[inside]].mean()) if inside.any() else math.nan
