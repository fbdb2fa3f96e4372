"""How a board is held, as an operator turns it and as matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calibration.observations import BoardPose

Array = NDArray[np.float64]


def placed(pose: BoardPose) -> tuple[Array, Array]:
    """(3, 3), (3,) mm of X_cam = R X_board + t, with R = Rx(pitch)·Ry(yaw)·Rz(roll)."""
    turn = Rotation.from_euler("XYZ", [pose.pitch_deg, pose.yaw_deg, pose.roll_deg], degrees=True)
    return turn.as_matrix(), np.array([pose.offset_x_mm, pose.offset_y_mm, pose.distance_mm], np.float64)


def pose_of(rotation: ArrayLike, translation: ArrayLike) -> BoardPose:
    """Inverse of `placed`; the yaw comes out between −90° and 90°."""
    pitch, yaw, roll = Rotation.from_matrix(np.asarray(rotation, np.float64)).as_euler("XYZ", degrees=True)
    x, y, z = np.asarray(translation, np.float64)
    return BoardPose(float(z), float(x), float(y), float(yaw), float(pitch), float(roll))
