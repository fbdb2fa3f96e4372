"""Where a rig sees the points of a board, and how that changes with every unknown.

X_cam = R (X_board + bend) + t and X_proj = R_rig X_cam + T go through OpenCV's lens model; `cv2.projectPoints` gives
the derivatives after its lens and, through its translation, after the point. The rest is the chain rule.

The projector's coordinate x was read at the place c where the camera has found a point, so that an error e of c errs it
by G e. What is predicted for it is therefore x(θ) + G (c − c(θ)): the residuals of camera and projector are then
independent, and their weights those of their own errors (Cholesky's factor of the joint covariance, in closed form).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.solver.measurements import Measurements
from calibration.solver.parameters import ASPECT, BEND, CAMERA, NAMES, PROJECTOR, ROTATION, TRANSLATION, State

Array = NDArray[np.float64]


def predicted(state: State, data: Measurements) -> Array:
    """(2, N, 2) px of all points in camera and projector, the latter's at the places where the camera found them."""
    board, _ = _board(state, data)
    X = np.einsum("nij,nj->ni", state.turns[data.pose], board) + state.shifts[data.pose]
    Y = X @ state.rotation.T + state.values[TRANSLATION]
    camera, projector = _lens(state.values[CAMERA], X)[0], _lens(state.values[PROJECTOR], Y)[0]
    return np.stack([camera, projector + _moved(data, camera)])


def linearised(state: State, data: Measurements) -> tuple[Array, Array, Array, Array]:
    """Predicted pixels and their derivatives.

    Returns
    -------
    pixels
        (2, N, 2) px.
    by_globals
        (2, N, 2, 46) per unit of `calibration.solver.parameters.NAMES`.
    by_pose
        (2, N, 2, 6) per rad of a turn about the camera's axes (applied from the left) and per mm of a shift of the
        point's own pose.
    by_point
        (2, N, 2, 3) per mm of a shift of the point on its board.
    """
    board, basis = _board(state, data)
    turn, rotation = state.turns[data.pose], state.rotation
    turned = np.einsum("nij,nj->ni", turn, board)
    X = turned + state.shifts[data.pose]
    rotated = X @ rotation.T
    count = len(X)
    X_pose = np.concatenate([_minus_cross(turned), np.broadcast_to(np.eye(3), (count, 3, 3))], axis=2)
    X_board = np.einsum("nij,njk->nik", turn, basis)

    pixels = np.empty((2, count, 2))
    by_globals = np.zeros((2, count, 2, len(NAMES)))
    by_pose = np.empty((2, count, 2, 6))
    camera, by_X, by_lens = _lens(state.values[CAMERA], X)
    pixels[0], by_globals[0, :, :, CAMERA] = camera, by_lens
    by_pose[0] = by_X @ X_pose
    by_globals[0, :, :, BEND.start :] = by_X @ X_board

    projector, by_Y, by_lens = _lens(state.values[PROJECTOR], rotated + state.values[TRANSLATION])
    pixels[1], by_globals[1, :, :, PROJECTOR] = projector + _moved(data, camera), by_lens
    by_globals[1, :, :, ROTATION] = by_Y @ _minus_cross(rotated)
    by_globals[1, :, :, TRANSLATION] = by_Y
    through = by_Y @ rotation
    by_pose[1] = through @ X_pose
    by_globals[1, :, :, BEND.start :] = through @ X_board
    by_point = np.stack([by_X @ turn, through @ turn])
    for derivatives in (by_globals, by_pose, by_point):
        derivatives[1] -= data.gradient @ derivatives[0]
    return pixels, by_globals, by_pose, by_point


def _moved(data: Measurements, camera: Array) -> Array:
    """(N, 2) by how much projector coordinates are others because the camera's points are not where they should be."""
    return np.asarray(np.einsum("nij,nj->ni", data.gradient, data.measured[0] - camera))


def _board(state: State, data: Measurements) -> tuple[Array, Array]:
    """Points (N, 3) of the board as it is, and their derivatives (N, 3, 4) after bend and aspect."""
    x, y = data.points[:, 0] / data.extent, data.points[:, 1] / data.extent
    basis = np.zeros((len(x), 3, 4))
    basis[:, 2, :3] = np.stack([x * x, y * y, x * y], axis=1)
    basis[:, 1, 3] = data.points[:, 1]
    bent = basis @ np.append(state.values[BEND], state.values[ASPECT])
    return data.points + state.board[data.point] + bent, basis


def _lens(values: Array, X: Array) -> tuple[Array, Array, Array]:
    """Pixels (N, 2) of points (N, 3) in the lens's frame, derivatives (N, 2, 3) and (N, 2, 18)."""
    fx, fy, cx, cy = values[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixels, jacobian = cv2.projectPoints(X, np.zeros(3), np.zeros(3), matrix, values[4:])[:2]
    jacobian = np.asarray(jacobian, np.float64).reshape(-1, 2, 24)
    return np.asarray(pixels[:, 0], np.float64), jacobian[..., 3:6], jacobian[..., 6:]


def _minus_cross(v: Array) -> Array:
    """(N, 3, 3) −[v]×: how a point v moves with a small turn."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = v[:, 2], -v[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -v[:, 2], v[:, 0]
    out[:, 2, 0], out[:, 2, 1] = v[:, 1], -v[:, 0]
    return out
