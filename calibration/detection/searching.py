"""Where a board's points are to a pixel or so, by the finders of OpenCV."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.boards import AsymmetricCircles, Board, Charuco, Chessboard, Circles
from calibration.detection.labelling import labelled

Array = NDArray[np.float64]
Grey8 = NDArray[np.uint8]

_ENOUGH_CORNERS = 8  # of a ChArUco board, to trust the map that they give
_FEWEST_MARKERS = 3
_AGREEING_MARKERS = 0.8
_LARGEST_SEARCH_PX = 2200  # finders are slow on larger pictures and find no more there


def stretched(picture: NDArray[Any]) -> Grey8:
    """(H, W) uint8 with nearly all grey values of ``picture`` spread over the range."""
    sample = picture[::3, ::3]
    sample = sample[np.isfinite(sample)]
    low, high = np.percentile(sample, (0.2, 99.8)) if sample.size else (0.0, 1.0)
    scaled = (np.nan_to_num(picture.astype(np.float32)) - low) * (255 / max(high - low, 1e-6))
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def search(grey: Grey8, board: Board) -> tuple[NDArray[np.int64], Array] | None:
    """Find a board's points in a picture.

    Returns
    -------
    ids (n,) and pixels (n, 2), to about a pixel; None where they are not found.
    """
    import cv2

    factor = max(1, -(-max(grey.shape) // _LARGEST_SEARCH_PX))
    smaller = grey
    if factor > 1:
        size = (grey.shape[1] // factor, grey.shape[0] // factor)
        whole = grey[: size[1] * factor, : size[0] * factor]
        smaller = np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)
    if isinstance(board, Charuco):
        found = _charuco(smaller, board)
    else:
        grid = _chessboard(smaller, board) if isinstance(board, Chessboard) else _circles(smaller, board)
        ordered = None if grid is None else labelled(board, grid, smaller)
        found = None if ordered is None else (np.arange(len(ordered)), ordered)
    if found is None:
        return None
    return found[0].astype(np.int64), found[1] * factor + (factor - 1) / 2


def _chessboard(grey: Grey8, board: Chessboard) -> Array | None:
    import cv2

    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    is_there, corners = cv2.findChessboardCorners(grey, size, flags=flags)
    if not is_there:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        is_there, corners = cv2.findChessboardCornersSB(grey, size, flags=flags)
    return corners.reshape(-1, 2).astype(np.float64) if is_there else None


def _charuco(grey: Grey8, board: Charuco) -> tuple[NDArray[np.int64], Array] | None:
    import cv2

    corners, ids, markers, marker_ids = cv2.aruco.CharucoDetector(board.opencv).detectBoard(grey)
    if ids is not None and len(ids) >= _ENOUGH_CORNERS:
        return np.asarray(ids).ravel().astype(np.int64), np.asarray(corners).reshape(-1, 2).astype(np.float64)
    if marker_ids is None or len(marker_ids) < _FEWEST_MARKERS:
        return None
    # Few neighbouring markers could be read; those that were tell where all corners are.
    there = dict(zip(board.opencv.getIds().ravel().tolist(), board.opencv.getObjPoints(), strict=True))
    pairs = [(there[i], xy) for i, xy in zip(np.ravel(marker_ids).tolist(), markers, strict=True) if i in there]
    if len(pairs) < _FEWEST_MARKERS:
        return None
    printed = np.concatenate([np.asarray(known)[:, :2] for known, _ in pairs]).astype(np.float64)
    seen = np.concatenate([np.asarray(xy).reshape(4, 2) for _, xy in pairs]).astype(np.float64)
    homography, agrees = cv2.findHomography(printed, seen, cv2.RANSAC, 3.0)
    if homography is None or np.mean(agrees) < _AGREEING_MARKERS:
        return None
    points = board.points[:, :2] + np.array(board.pattern_mm) / 2
    xy = np.asarray(cv2.perspectiveTransform(points[:, None], homography), np.float64)[:, 0]
    inside = ((xy > 1) & (xy < np.array(grey.shape[::-1]) - 2)).all(axis=1)
    return np.flatnonzero(inside), xy[inside]


def _circles(grey: Grey8, board: Board) -> Array | None:
    import cv2

    if not isinstance(board, Circles | AsymmetricCircles):
        raise TypeError(f"no finder for a {type(board).__name__}")
    layout = cv2.CALIB_CB_SYMMETRIC_GRID if isinstance(board, Circles) else cv2.CALIB_CB_ASYMMETRIC_GRID
    size, detector = (board.columns, board.rows), blob_detector(grey, board)
    for flags in (layout, layout | cv2.CALIB_CB_CLUSTERING):
        is_there, centres = cv2.findCirclesGrid(grey, size, flags=flags, blobDetector=detector)
        if is_there:
            return np.asarray(centres).reshape(-1, 2).astype(np.float64)
    return None


def blob_detector(grey: Grey8, board: Board) -> Any:
    """Make OpenCV's detector of dark blobs, for discs of any size that fits as often as the board has them."""
    import cv2

    options = cv2.SimpleBlobDetector.Params()
    options.filterByColor, options.blobColor = True, 0
    options.filterByArea, options.minArea, options.maxArea = True, 12, grey.size / len(board.points)
    options.filterByConvexity, options.minConvexity = True, 0.9
    options.filterByCircularity = False
    options.filterByInertia, options.minInertiaRatio = True, 0.1
    options.minDistBetweenBlobs = 3
    return cv2.SimpleBlobDetector.create(options)
