"""From a picture to a board's points with their standard deviations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.boards import AsymmetricCircles, Board, Charuco, Chessboard, Circles
from calibration.detection.diagnosis import not_found
from calibration.detection.discs import fit_discs
from calibration.detection.mapping import PlaneMap
from calibration.detection.patches import Fit, cut
from calibration.detection.saddles import fit_saddles
from calibration.detection.searching import search, stretched
from calibration.observations import BoardView

Array = NDArray[np.float64]

_FEWEST_POINTS = 6
_WINDOW = 0.42  # of a square, from the corner: what follows is the next corner's
_LARGEST_RADIUS_PX = (10, 24)  # in either pass: the first needs no more than the map
_LARGEST_DISC_PX = 60
_CLEAR_OF_MARKER_PX = 1.5
_BLUR_REACH_PX = 6.0
_LARGEST_MOVE = 0.3  # of the pitch, from where the finder saw a point
_LEAST_CONTRAST = 3.0  # of the noise
_LEAST_SHARE = 0.3  # of the contrast of most points
_OUTLIER = 8.0  # times the median distance from the map, and the median σ …
_OUTLIER_PX = 0.3  # … and this far at least


def find_board(picture: NDArray[Any], board: Board, noise_dn: float) -> BoardView:
    """Find a board and measure its points.

    A finder of OpenCV says where the points are to a pixel; least squares of a blurred edge model around each
    (`calibration.detection.saddles`, `calibration.detection.discs`) then give place and covariance.

    Parameters
    ----------
    picture
        (H, W) grey values: uint8, uint16 or float; NaN is not seen.
    board
        What to look for.
    noise_dn
        Standard deviation of a grey value of this picture; of a mean of k frames that of one over √k.

    Returns
    -------
    The points that were measured, by their ids: of a ChArUco board those that are seen, of other boards nearly all.
    ``sigma`` is √(trace/2) of a point's covariance.

    Raises
    ------
    BoardNotFoundError
        It is not there, or not clearly; the message says why as far as can be told.
    ValueError
        The picture is not (H, W), or the noise is not positive.
    """
    if picture.ndim != 2:
        raise ValueError(f"the picture must be (height, width), not {picture.shape}")
    if not noise_dn > 0:
        raise ValueError(f"noise_dn must be positive, not {noise_dn:g}")
    if np.issubdtype(picture.dtype, np.integer):
        noise_dn = max(noise_dn, math.sqrt(1 / 12))
    grey = stretched(picture)
    found = search(grey, board)
    view = None if found is None else _measured(picture.astype(np.float64), board, *found, noise_dn)
    if view is None:
        raise not_found(picture, grey, board, noise_dn)
    return view


def _measured(picture: Array, board: Board, ids: NDArray[np.int64], start: Array, noise_dn: float) -> BoardView | None:
    plane = PlaneMap.fitted(board.points[ids, :2], start)
    for largest_radius in _LARGEST_RADIUS_PX:
        if plane is None or len(ids) < _FEWEST_POINTS:
            return None
        if isinstance(board, Charuco):
            # The finder needs a readable marker beside each corner; the map says where the others are.
            ids, start = _with_predicted(picture, board, ids, start, plane)
        points = board.points[ids, :2]
        first, second = plane.expanded(points, board.pitch_mm / 10)
        pitch_px = board.pitch_mm * np.linalg.svd(first, compute_uv=False)[:, 1]
        fit = _fit(picture, board, start, first, second, noise_dn, largest_radius)
        xy = start + fit.parameters[:, :2]
        sigma = np.sqrt(np.trace(fit.covariance, axis1=1, axis2=2) / 2)
        contrast = (
            fit.contrast if isinstance(board, Circles | AsymmetricCircles) else _expected(fit.contrast, board, ids)
        )
        is_sound = fit.is_sound & (np.linalg.norm(fit.parameters[:, :2], axis=1) < _LARGEST_MOVE * pitch_px)
        is_sound &= contrast > max(_LEAST_CONTRAST * noise_dn, _LEAST_SHARE * float(np.median(contrast)))
        ids, points, xy, sigma = ids[is_sound], points[is_sound], xy[is_sound], sigma[is_sound]
        plane = PlaneMap.fitted(points, xy, 1 / sigma) if len(ids) >= _FEWEST_POINTS else None
        start = xy
    if plane is None:
        return None
    distance = np.linalg.norm(plane(points) - xy, axis=1)
    fits = distance <= max(_OUTLIER * float(np.median(distance)), _OUTLIER_PX)
    fits &= sigma <= _OUTLIER * float(np.median(sigma))
    return BoardView(ids[fits], xy[fits], sigma[fits]) if fits.sum() >= _FEWEST_POINTS else None


def _with_predicted(
    picture: Array, board: Board, ids: NDArray[np.int64], xy: Array, plane: PlaneMap
) -> tuple[NDArray[np.int64], Array]:
    """Add the points that were not found where the map has them inside the picture."""
    predicted = plane(board.points[:, :2])
    predicted[ids] = xy
    height, width = picture.shape
    inside = ((predicted > 1) & (predicted < (width - 2, height - 2))).all(axis=1)
    everything = np.flatnonzero(inside)
    return everything, predicted[everything]


def _expected(contrast: Array, board: Board, ids: NDArray[np.int64]) -> Array:
    """Turn the contrast of saddles so that those are positive which are bright where the print has it."""
    per_row = int(np.count_nonzero(board.points[:, 1] == board.points[0, 1]))
    turned = np.where((ids // per_row + ids % per_row) % 2 == 0, contrast, -contrast)
    return turned * (np.sign(np.median(turned)) or 1.0)


def _fit(
    picture: Array, board: Board, xy: Array, first: Array, second: Array, noise_dn: float, largest_radius: int
) -> Fit:
    if isinstance(board, Circles | AsymmetricCircles):
        radius_mm = board.diameter_mm / 2
        stretch = np.linalg.svd(first, compute_uv=False)
        gap = (board.pitch_mm - board.diameter_mm) * stretch[:, 1]
        reach = np.minimum(gap / 2, _BLUR_REACH_PX)
        radius = math.ceil(float((radius_mm * stretch[:, 0] + reach).max())) + 1
        patches = cut(picture, xy, min(radius, _LARGEST_DISC_PX))
        return fit_discs(patches, radius_mm, first, second, reach, noise_dn)
    if not isinstance(board, Chessboard | Charuco):
        raise TypeError(f"no model for the points of a {type(board).__name__}")
    half = _WINDOW * board.square_mm
    radius = math.ceil(float((half * np.abs(first).sum(axis=2)).max()))
    patches = cut(picture, xy, min(radius, largest_radius))
    u, v = np.einsum("nab,nbm->anm", np.linalg.inv(first), np.stack((patches.x, patches.y), axis=1))
    seen = (np.abs(u) <= half) & (np.abs(v) <= half)
    edge_px = np.linalg.norm(first, axis=1)  # (n, 2) px/mm along either edge
    if isinstance(board, Charuco):
        rim = (board.square_mm - board.marker_mm) / 2 * edge_px.min(axis=1) - _CLEAR_OF_MARKER_PX
        nearer = np.minimum(np.abs(u) * edge_px[:, 0:1], np.abs(v) * edge_px[:, 1:2])
        seen &= nearer <= np.maximum(rim, _CLEAR_OF_MARKER_PX)[:, None]
    bends = second[:, :, [0, 2]] / edge_px[:, None, :] ** 2
    along = first / edge_px[:, None, :]
    curvatures = along[:, 0] * bends[:, 1] - along[:, 1] * bends[:, 0]
    return fit_saddles(patches.seen(seen), first, curvatures, noise_dn)
