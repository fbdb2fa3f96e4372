"""Which parts of a picture the board has been seen in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.observations import PoseObservation
from calibration.solver.result import Calibration

Array = NDArray[np.float64]

CELLS = (12, 9)
"""Columns and rows of cells into which a picture is divided."""


def coverage(observations: Sequence[PoseObservation], camera_size: tuple[int, int]) -> NDArray[np.int64]:
    """(9, 12) in how many poses the board covered each cell of the camera's picture.

    Parameters
    ----------
    observations
        Poses so far.
    camera_size
        (width, height), px.
    """
    return covered([o.camera[np.isfinite(o.camera).all(axis=1)] for o in observations], camera_size)


def covered(points: Sequence[Array], size: tuple[int, int]) -> NDArray[np.int64]:
    """(9, 12) how often the convex hull of points (n, 2) px of a pose covers the middle of each cell of a picture."""
    columns, rows = CELLS
    v, u = np.mgrid[:rows, :columns]
    centres = np.stack([(u.ravel() + 0.5) * size[0] / columns, (v.ravel() + 0.5) * size[1] / rows], axis=1) - 0.5
    counts = np.sum([_inside(pose, centres) for pose in points], axis=0, dtype=np.int64)
    return np.asarray(counts, np.int64).reshape(rows, columns) if len(points) else np.zeros((rows, columns), np.int64)


def inside_any(points: Sequence[Array], places: Array) -> NDArray[np.bool_]:
    """(n,) which ``places`` (n, 2) px lie in the convex hull of any pose's points."""
    return np.asarray(np.any([_inside(pose, places) for pose in points], axis=0))


@dataclass(frozen=True, eq=False)
class CommonView:
    """Where the pictures overlap: the same places in the camera's and in the projector's picture, (n, 2) px each."""

    camera: Array
    projector: Array


def common_view(calibration: Calibration) -> CommonView:
    """Grid over the camera's picture, as far as the projector reaches it at the mean distance of the boards."""
    rig, (columns, rows) = calibration.rig, CELLS
    v, u = np.mgrid[:rows, :columns]
    width, height = rig.camera.size
    camera = np.stack([u.ravel() * (width - 1) / (columns - 1), v.ravel() * (height - 1) / (rows - 1)], axis=1)
    distance = np.mean([pose.translation[2] for pose in calibration.poses if pose.used])
    projector = rig.projector.project(rig.to_projector_frame(rig.camera.rays(camera) * distance))
    with np.errstate(invalid="ignore"):
        lit = np.all((projector >= 0) & (projector <= np.array(rig.projector.size) - 1), axis=1)
    return CommonView(camera[lit], projector[lit])


def _inside(points: Array, places: Array) -> NDArray[np.bool_]:
    if len(points) < 3:
        return np.zeros(len(places), bool)
    hull = cv2.convexHull(np.asarray(points, np.float32))
    return np.array([cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in places], bool)
