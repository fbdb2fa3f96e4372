"""Points that do not belong to their board are left out before anything is estimated.

A flat board and its picture are related by a homography, whatever the lens, up to its distortion: points far from the
homography that most of a pose agrees on are mislabelled or misdetected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.observations import PoseObservation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_POINTS = 8
"""Points a pose needs: twice what its homography takes, so that a false one shows."""
LARGEST_SHARE = 0.15
"""Share of strangers beyond which nothing in a pose is believed: labels that are wrong come in rows."""
_DISTORTION = 0.02  # of the board's picture: what a lens bends a homography by, at the very most
_LEAST_PX = 3.0


@dataclass(frozen=True, eq=False)
class Screened:
    """What is left of the observations.

    Parameters
    ----------
    keep
        (n,) per pose: points that agree with their pose.
    strangers
        (m,) share of the points of every pose that do not.
    usable
        (m,) whether the pose takes part.
    """

    keep: tuple[Mask, ...]
    strangers: Array
    usable: Mask


def screened(observations: Sequence[PoseObservation]) -> Screened:
    """Compare every pose with its homographies board → camera and camera → projector."""
    keep: list[Mask] = []
    strangers: list[float] = []
    usable: list[bool] = []
    for o in observations:
        finite = np.asarray(np.isfinite(o.camera).all(1) & np.isfinite(o.points_board).all(1))
        good = finite.copy()
        if np.count_nonzero(finite) >= LEAST_POINTS:
            good[finite] = _agree(o.points_board[finite, :2], o.camera[finite])
        both = good & np.isfinite(o.projector).all(1)
        if np.count_nonzero(both) >= LEAST_POINTS:
            good[both] = _agree(o.camera[both], o.projector[both])
        keep.append(good)
        strangers.append(1 - int(np.count_nonzero(good)) / max(int(np.count_nonzero(finite)), 1))
        measured = good & np.isfinite(o.projector).any(1)
        usable.append(strangers[-1] <= LARGEST_SHARE and int(np.count_nonzero(measured)) >= LEAST_POINTS)
    return Screened(tuple(keep), np.array(strangers), np.array(usable, bool))


def _agree(plane: Array, picture: Array) -> Mask:
    limit = max(_LEAST_PX, _DISTORTION * float(np.ptp(picture, axis=0).max()))
    # Random sampling inside OpenCV is seeded: the same points give the same answer.
    _, inside = cv2.findHomography(plane, picture, cv2.RANSAC, limit, maxIters=2000, confidence=0.9999)
    return np.zeros(len(plane), bool) if inside is None else np.asarray(inside[:, 0] > 0)
