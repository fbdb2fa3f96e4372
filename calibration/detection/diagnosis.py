"""Why a board was not found, as far as the picture tells."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board, Charuco, Chessboard
from calibration.detection.searching import blob_detector
from drivers.errors import OperatorError

Grey8 = NDArray[np.uint8]

_SATURATED_SHARE = 0.02
_DARK = 15.0  # times the noise: the contrast that edges need
_BLURRED_PX = 4.0


class BoardNotFoundError(OperatorError):
    """A picture does not show a board, or not clearly.

    Parameters
    ----------
    message, remedy
        See `drivers.errors.OperatorError`.
    reason
        Short name for programs: ``too_dark``, ``saturated``, ``other_board``, ``partly_outside``, ``blurred`` or
        ``not_seen``.
    """

    def __init__(self, message: str, remedy: str, reason: str = "not_seen") -> None:
        super().__init__(message, remedy)
        self.reason = reason


def not_found(picture: NDArray[Any], grey: Grey8, board: Board, noise_dn: float) -> BoardNotFoundError:
    """Say why a board was not found.

    Parameters
    ----------
    picture
        (H, W) as the camera gave it.
    grey
        (H, W) the same, stretched (`calibration.detection.searching.stretched`).
    board
        What was looked for.
    noise_dn
        Standard deviation of a grey value.
    """
    known = picture[np.isfinite(picture)].astype(np.float64)
    dark, bright = np.percentile(known, (1, 99)) if known.size else (0.0, 0.0)
    contrast = float(bright - dark)
    if contrast < _DARK * noise_dn:
        return BoardNotFoundError(
            f"the picture is too dark to see the {board.name}: its grey values differ by {contrast:.0f}, "
            f"{contrast / noise_dn:.0f} times the noise of {noise_dn:.2g}",
            "Expose longer, open the aperture or let the projector light the board.",
            "too_dark",
        )
    other = _other_chessboard(grey, board) if isinstance(board, Chessboard) else None
    if other is not None:
        return other
    share = float(np.mean(known >= known.max()))
    if share > _SATURATED_SHARE:
        return BoardNotFoundError(
            f"the {board.name} was not found, and {share:.0%} of the picture is saturated at {known.max():.0f}: white "
            "runs over the edges of the print",
            "Expose shorter or close the aperture until no white of the board is saturated.",
            "saturated",
        )
    blur = _blur_px(picture, contrast)
    if blur > _BLURRED_PX:
        return BoardNotFoundError(
            f"the {board.name} was not found, and the sharpest edges of the picture are blurred over {blur:.0f} px",
            "Focus the camera on the board, close the aperture, and hold the board still.",
            "blurred",
        )
    return _little_seen(grey, board)


def _other_chessboard(grey: Grey8, board: Chessboard) -> BoardNotFoundError | None:
    """Look for a chessboard of any size: another one, or the part of this one that is inside the picture."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    is_there, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags=flags)
    if not is_there:
        return None
    rows, columns = meta.shape[:2]
    grid = np.asarray(corners, np.float64).reshape(rows, columns, 2)
    long, short = max(rows, columns), min(rows, columns)
    wanted = (max(board.columns, board.rows), min(board.columns, board.rows))
    if (long, short) == wanted:
        return None
    seen = f"{long} × {short} inner corners"
    pitch = max(np.linalg.norm(np.diff(grid, axis=axis), axis=2).max() for axis in (0, 1))
    flat = grid.reshape(-1, 2)
    to_edge = min(flat.min(), (np.array(grey.shape[::-1]) - 1 - flat).min())
    if long <= wanted[0] and short <= wanted[1] and to_edge < 1.5 * pitch:
        return BoardNotFoundError(
            f"the {board.name} is partly outside of the picture: {seen} of {wanted[0]} × {wanted[1]} "
            f"are seen, up to {to_edge:.0f} px from its edge",
            "Hold the board so that all of it and its white margin are inside the picture.",
            "partly_outside",
        )
    hint = ""
    if (long, short) == (wanted[0] - 1, wanted[1] - 1):
        hint = "; the definition counts squares, it seems: inner corners are one fewer"
    return BoardNotFoundError(
        f"the picture shows a chessboard of {seen}, not the {board.columns} × {board.rows} of the {board.name}{hint}",
        f"Correct columns and rows in the board's file, or hold the board that it describes ({board.wording}). If "
        "a part is hidden, uncover it.",
        "other_board",
    )


def _blur_px(picture: NDArray[Any], contrast: float) -> float:
    """Standard deviation of the blur of the sharpest edges: a step of height C has at most the slope C/(√2π s)."""
    import cv2

    smooth = cv2.GaussianBlur(np.nan_to_num(picture.astype(np.float32)), (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)) / 8
    steepest = float(np.percentile(slope, 99.8))
    return contrast / (math.sqrt(2 * math.pi) * steepest) if steepest > 0 else math.inf


def _little_seen(grey: Grey8, board: Board) -> BoardNotFoundError:
    """Count what there is of the board."""
    if isinstance(board, Charuco):
        return _few_markers(grey, board)
    if isinstance(board, Chessboard):
        what = "no chessboard is seen"
    else:
        what = f"{len(blob_detector(grey, board).detect(grey))} dark discs are seen, {len(board.points)} are expected"
    return BoardNotFoundError(
        f"the {board.name} was not found: {what}",
        "Hold the board wholly inside the picture with its white margin, tilted less than 60°, evenly lit and without "
        f"reflections; check that it is the one described: {board.wording}.",
        "not_seen",
    )


def _few_markers(grey: Grey8, board: Charuco) -> BoardNotFoundError:
    import cv2

    wanted = len(board.opencv.getIds())

    def seen(dictionary: str) -> set[int]:
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))
        ids = detector.detectMarkers(grey)[1]
        return set() if ids is None else {int(i) for i in np.ravel(ids)}

    own = seen(board.dictionary)
    families = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
    others = {name: len(seen(name)) for name in families if name.split("_")[1] not in board.dictionary}
    most = max(others, key=others.__getitem__)
    if others[most] > max(3, 2 * len(own)):
        return BoardNotFoundError(
            f"the picture shows {others[most]} markers of the family of {most} and {len(own)} of {board.dictionary}, "
            f"which the {board.name} has",
            "Correct dictionary in the board's file, or hold the board that it describes.",
            "other_board",
        )
    foreign = sorted(own - set(range(wanted)))
    if len(own) > 3:
        odd = f", of them {len(foreign)} that this board does not have" if foreign else ""
        return BoardNotFoundError(
            f"{len(own)} of the {wanted} markers of the {board.name} are seen{odd}, but no corners between them",
            "Check squares_x, squares_y, marker_mm and legacy against the print, and hold more of it into the picture.",
            "other_board",
        )
    return BoardNotFoundError(
        f"{len(own)} of the {wanted} markers of the {board.name} are seen; the corners lie between them",
        "Hold more of the board into the picture, nearer or less tilted: a marker's cell needs about 4 px.",
        "not_seen",
    )
