"""A first estimate that needs no guess: homographies give the camera, a resection gives the projector.

Camera: every homography H of a board gives h₁ᵀ ω h₂ = 0 and h₁ᵀ ω h₁ = h₂ᵀ ω h₂ with ω = K⁻ᵀK⁻¹ (Zhang, IEEE TPAMI 22,
1330 (2000)), solved for focal length and principal point with a weak prior, so that frontal views do no harm.
Projector: its picture of the points that the camera's estimate puts into space is linear in P = K [R | T] (direct
linear transformation, Hartley & Zisserman, 2004, §7.1); with one axis only, its two rows 1 and 3.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq
from scipy.optimize import least_squares

Array = NDArray[np.float64]


def homography(board: Array, picture: Array) -> Array:
    """(3, 3) homography from board points (n, 2) to pixels (n, 2), least squares."""
    return np.asarray(cv2.findHomography(board, picture, 0)[0], np.float64)


def camera_start(homographies: Sequence[Array], size: tuple[int, int]) -> Array:
    """(4,) fx, fy, cx, cy with square pixels from the homographies of boards.

    Parameters
    ----------
    homographies
        (3, 3) each, board mm → px.
    size
        (width, height) of the picture.
    """
    centre = (np.array(size) - 1) / 2
    unit = float(max(size))
    shift = np.array([[1 / unit, 0, -centre[0] / unit], [0, 1 / unit, -centre[1] / unit], [0, 0, 1]])
    H = shift @ np.stack(homographies)

    def conflict(p: Array) -> Array:
        f, cx, cy = np.exp(p[0]), p[1], p[2]
        h = np.array([[1 / f, 0, -cx / f], [0, 1 / f, -cy / f], [0, 0, 1]]) @ H
        a, b = (h[:, :, 0] ** 2).sum(1), (h[:, :, 1] ** 2).sum(1)
        mean = (a + b) / 2
        constraints = np.concatenate([(a - b) / mean, 2 * (h[:, :, 0] * h[:, :, 1]).sum(1) / mean])
        # 1e-2: how well a picture with lens distortion keeps the constraints; the prior is a factor of two.
        return np.concatenate([constraints / 1e-2, [(p[0] - np.log(1.7)) / 0.7, cx / 0.1, cy / 0.1]])

    fits = [least_squares(conflict, [np.log(f), 0.0, 0.0]) for f in (0.7, 1.7, 4.0)]
    best = min(fits, key=lambda fit: float(fit.cost)).x
    f = float(np.exp(best[0])) * unit
    return np.array([f, f, best[1] * unit + centre[0], best[2] * unit + centre[1]])


def pose_start(H: Array, lens: Array) -> tuple[Array, Array]:
    """(3, 3) and (3,): X_cam = R X_board + t, mm, of a board with homography ``H`` before a lens (fx, fy, cx, cy)."""
    fx, fy, cx, cy = lens
    h = np.linalg.inv(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])) @ H
    h /= np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    if h[2, 2] < 0:
        h = -h
    u, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, h[:, 2]


def rotation_vector(R: Array) -> Array:
    """(3,) Rodrigues vector of a rotation (3, 3)."""
    return np.asarray(cv2.Rodrigues(R)[0][:, 0], np.float64)


def resection(X: Array, picture: Array) -> tuple[Array, Array, Array] | None:
    """Pinhole that sees points in space at given pixels.

    Parameters
    ----------
    X
        (n, 3) mm in the camera frame.
    picture
        (n, 2) projector px.

    Returns
    -------
    lens
        (4,) fx, fy, cx, cy.
    rotation, translation
        (3, 3), (3,) mm: X_proj = R X_cam + T.

    None where the points do not determine it, as those of one plane, or where only a mirror image could see them so.
    """
    P = _linear(X, picture, (0, 1))
    if P is None:
        return None
    if np.median(P[2] @ np.column_stack([X, np.ones(len(X))]).T) < 0:
        P = -P
    if np.linalg.det(P[:, :3]) < 0:
        return None
    K, R = rq(P[:, :3])
    signs = np.diag(np.sign(np.diag(K)))
    K = K @ signs
    T: Array = np.linalg.solve(K, P[:, 3])
    K = K / K[2, 2]
    rotation: Array = np.array(signs @ R, np.float64)
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), rotation, T


def line_resection(X: Array, coordinate: Array, axis: int) -> tuple[float, float, Array, Array] | None:
    """The same from one projector coordinate only.

    Parameters
    ----------
    X, coordinate
        (n, 3) mm, (n,) px.
    axis
        0 for columns, 1 for rows.

    Returns
    -------
    focal, centre
        px along the axis.
    rotation, translation
        The translation across the axis, which one coordinate cannot know, is 0.

    None where the points do not determine it.
    """
    P = _linear(X, coordinate[:, None], (axis,))
    if P is None:
        return None
    scale = np.linalg.norm(P[1, :3])
    P = P / scale
    if np.median(P[1] @ np.column_stack([X, np.ones(len(X))]).T) < 0:
        P = -P
    forward = P[1, :3]
    centre = float(P[0, :3] @ forward)
    along = P[0, :3] - centre * forward
    focal = float(np.linalg.norm(along))
    if not focal > 0:
        return None
    along = along / focal
    across = np.cross(forward, along) if axis == 0 else np.cross(along, forward)
    R = np.stack([along, across, forward] if axis == 0 else [across, along, forward])
    T = np.zeros(3)
    T[axis], T[2] = (P[0, 3] - centre * P[1, 3]) / focal, P[1, 3]
    return focal, centre, R, T


def _linear(X: Array, picture: Array, axes: tuple[int, ...]) -> Array | None:
    """Rows of the projection matrix by direct linear transformation; None where they are not determined."""
    middle, size = X.mean(0), np.sqrt(X.var(0).sum() / 3)
    centre, spread = picture.mean(0), max(float(picture.std()), 1e-9)
    points = np.column_stack([(X - middle) / size, np.ones(len(X))])
    targets = (picture - centre) / spread
    count = len(axes)
    rows = np.zeros((count, len(X), 4 * (count + 1)))
    for i in range(count):
        rows[i, :, 4 * i : 4 * i + 4] = points
        rows[i, :, 4 * count :] = -targets[:, i : i + 1] * points
    _, singular, vt = np.linalg.svd(rows.reshape(-1, rows.shape[2]), full_matrices=False)
    # Two vanishing singular values: a family of projectors sees the points so.
    if singular[-2] < 1e-4 * singular[0] or singular[-2] < 3 * singular[-1]:
        return None
    P = vt[-1].reshape(count + 1, 4)
    space = np.eye(4)
    space[:3, :3] /= size
    space[:3, 3] = -middle / size
    undo = np.eye(count + 1)
    undo[:count, :count] *= spread
    undo[:count, count] = centre
    return np.asarray(undo @ P @ space)
