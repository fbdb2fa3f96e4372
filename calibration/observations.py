"""What one pose of a board tells: where camera and projector see its points, and how surely."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BoardView:
    """Points of a board found in one picture of the camera.

    Parameters
    ----------
    ids
        (n,) int64, which of the board's points (`calibration.boards.Board.points`).
    xy
        (n, 2) camera px.
    sigma
        (n,) standard deviation of either coordinate, px.
    """

    ids: NDArray[np.int64]
    xy: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class PoseObservation:
    """One board pose, as camera and projector see it.

    Parameters
    ----------
    name
        Of the pose, for messages, such as ``pose 3``.
    ids
        (n,) int64, which of the board's points.
    points_board
        (n, 3) mm in the board's frame: origin in the middle of the board, x right, y down as the print is looked at,
        z = 0 for a flat board.
    camera, camera_sigma
        (n, 2) px and their standard deviations.
    projector, projector_sigma
        (n, 2) projector px (column, row) and their standard deviations; NaN where a coordinate was not measured, a
        whole column of it with one-axis plans.
    projector_gradient
        (n, 2, 2), derivatives of column and row after the camera's x and y. A coordinate that was read at the place
        where the camera has found a point errs with it, by this times the camera's error, beside ``projector_sigma``.
        0 where the two were measured apart.
    """

    name: str
    ids: NDArray[np.int64]
    points_board: Array
    camera: Array
    camera_sigma: Array
    projector: Array
    projector_sigma: Array
    projector_gradient: Array = field(default_factory=lambda: np.zeros((2, 2)))


@dataclass(frozen=True)
class BoardPose:
    """Where a board is held: its middle in the camera frame (mm), and its turns (°).

    The turn is R = Rx(pitch)·Ry(yaw)·Rz(roll), X_cam = R X_board + (offset_x, offset_y, distance). At zero the print
    faces the camera upright. Positive yaw turns the front to the left, as `sim_backend.scenes.Pose` has it.
    """

    distance_mm: float
    offset_x_mm: float = 0.0
    offset_y_mm: float = 0.0
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a calibration or a measurement, why, and what to do.

    Parameters
    ----------
    code
        Short name for programs and tests, such as ``too_few_tilts``.
    refuses
        True: the result must not be used; False: a warning that goes with it.
    what
        What was seen, with figures.
    remedy
        What the operator does about it.
    """

    code: str
    refuses: bool
    what: str
    remedy: str
