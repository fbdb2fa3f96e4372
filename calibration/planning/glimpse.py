"""Where a board is held, roughly, as long as no lens is known: for pictures that lead a person, not for measuring."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.solver.start import homography, pose_start
from scanner.rig import Lens

Array = NDArray[np.float64]


def guessed_lens(points_board: Array, xy: Array, distance_mm: float, size: tuple[int, int]) -> Lens:
    """A lens by which a board that faces the camera at ``distance_mm`` looks as large as it does.

    Parameters
    ----------
    points_board
        (n, 3) mm.
    xy
        (n, 2) camera px.
    distance_mm
        Where the board was asked for.
    size
        (width, height) of the picture, px.
    """
    flat, seen = (p - p.mean(axis=0) for p in (points_board[:, :2], xy))
    # The largest stretch of the affine map: that of the direction which no tilt foreshortens.
    stretch = np.linalg.svd(np.linalg.lstsq(flat, seen, rcond=None)[0], compute_uv=False)[0]
    focal = float(stretch) * distance_mm
    width, height = size
    return Lens(np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]), np.zeros(0), size)


def held(lens: Lens, points_board: Array, xy: Array) -> tuple[Array, Array]:
    """(3, 3), (3,) mm of X_cam = R X_board + t, by the homography of the points (n, 3) mm at ``xy`` (n, 2) px."""
    m = lens.matrix
    return pose_start(homography(points_board[:, :2], xy), np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2]]))


def outline(lens: Lens, size_mm: tuple[float, float], rotation: Array, translation: Array) -> Array:
    """(4, 2) camera px of a sheet's corners, clockwise from the print's upper left; NaN behind the camera."""
    w, h = size_mm[0] / 2, size_mm[1] / 2
    corners = np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]])
    return lens.project(corners @ rotation.T + translation)
