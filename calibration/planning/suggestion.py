"""Where to hold the board next: the pose that would shrink the uncertainty of the rig most."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calibration.observations import BoardPose
from calibration.planning.poses import placed
from calibration.solver.adjustment import normals, solved
from calibration.solver.measurements import Measurements
from calibration.solver.parameters import State
from calibration.solver.projection import linearised, predicted
from calibration.solver.result import Calibration
from scanner.rig import Lens, Rig

Array = NDArray[np.float64]

_TILTS = ((0, 0), (30, 0), (-30, 0), (0, 30), (0, -30), (22, 22), (-22, 22), (22, -22), (-22, -22))
_DISTANCES = (0.85, 1.0, 1.18)  # of the working distance
_ROLL = 15.0  # °; edges along the pixels' rows meet every pixel alike, and the same error of sampling in all of them
_PLACES = (-1, 0, 1)
_MOST_POINTS = 36  # stand for the whole board: information depends on where it is, not on how finely it is divided

GOOD_FOCAL, GOOD_CENTRE_PX, GOOD_BASELINE = 3e-4, 1.0, 2e-4
"""Standard uncertainties that a good calibration reaches, the first and the last relative: weigh px against mm."""

_MARGIN = 0.03  # of the picture: nobody holds a board to the pixel
_FILL = 0.55


@dataclass(frozen=True)
class Suggestion:
    """A pose to take next.

    Parameters
    ----------
    pose
        Where to hold the board.
    gain
        Share by which it would lower the summed, scaled variances of focal lengths, centres and baseline.
    reason
        For the operator, such as ``tilt the right edge towards the camera, nearer, upper left``.
    """

    pose: BoardPose
    gain: float
    reason: str


def next_pose(
    calibration: Calibration, board_points: Array, candidates: Sequence[BoardPose] | None = None
) -> Suggestion | None:
    """Choose among candidates by the trace of the covariance that they would leave (A-optimal design).

    Every candidate adds its information about the globals, its own pose eliminated, to what the poses so far have
    told (Atkinson & Donev, Optimum Experimental Designs, 1992, ch. 10–11). Counted are the variances of focal lengths,
    principal points and translation, in units of what a good calibration reaches.

    Parameters
    ----------
    calibration
        Of the poses so far, usable or not.
    board_points
        (n, 3) mm.
    candidates
        To choose from; those that camera or projector would not see whole are left out. None takes a grid about the
        distance so far.

    Returns
    -------
    The best, or None where no candidate is seen by both.
    """
    used = [pose for pose in calibration.poses if pose.used]
    distance = float(np.mean([pose.translation[2] for pose in used]))
    pool = list(candidates if candidates is not None else grid(calibration.rig.camera, board_points, distance))
    rig = calibration.rig
    pool = [pose for pose in pool if visible(pose, board_points, rig.camera, rig)]
    if not pool:
        return None
    # Of the chosen terms alone: what omitted ones may do is no matter of poses.
    free = replace(calibration.freedom, board_prior=None)
    system, _, _ = normals(calibration.adjusted.state, calibration.data, free, calibration.adjusted.scales)
    known, _ = system.reduced()
    scale = _tolerances(calibration)
    before = float(np.sum(np.diag(solved(known, np.eye(len(known)))) * scale))
    after = [
        float(np.sum(np.diag(solved(known + share, np.eye(len(known)))) * scale))
        for share in _information(calibration, pool, board_points)
    ]
    best = int(np.argmin(after))
    return Suggestion(pool[best], 1 - after[best] / before, _told(pool[best], rig.camera, distance))


def first_poses(camera: Lens, board_points: Array, rig: Rig | None = None) -> tuple[BoardPose, ...]:
    """Poses to begin with, from a nominal lens: facing, tilted four ways, near, far, and in the corners.

    Parameters
    ----------
    camera
        A guess of the lens; 20 % wrong does no harm.
    board_points
        (n, 3) mm.
    rig
        A guess of the rig; poses that the projector would not see whole are left out.
    """
    turned, _ = placed(BoardPose(1.0, roll_deg=_ROLL))
    width, height = np.ptp(board_points @ turned.T, axis=0)[:2]
    distance = max(
        width * camera.matrix[0, 0] / camera.size[0] / _FILL, height * camera.matrix[1, 1] / camera.size[1] / _FILL
    )
    wanted = [
        (1.0, 0, 0, 0, 0), (1.0, 30, 0, 0, 0), (1.0, -30, 0, 0, 0), (1.0, 0, 30, 0, 0), (1.0, 0, -30, 0, 0),
        (0.9, 22, 22, -1, -1), (0.9, -22, -22, 1, 1), (1.2, 22, -22, 1, -1), (1.2, -22, 22, -1, 1),
    ]  # fmt: skip
    poses = [
        _at(camera, board_points, distance * d, (yaw, pitch, _ROLL * (-1) ** number), x, y)
        for number, (d, yaw, pitch, x, y) in enumerate(wanted)
    ]
    return tuple(pose for pose in poses if visible(pose, board_points, camera, rig))


def grid(camera: Lens, board_points: Array, distance_mm: float) -> Iterable[BoardPose]:
    """Candidates: nine tilts at nine places of the picture and three distances about ``distance_mm``, all rolled."""
    for d, (number, (yaw, pitch)), y, x in product(_DISTANCES, enumerate(_TILTS), _PLACES, _PLACES):
        yield _at(camera, board_points, distance_mm * d, (yaw, pitch, _ROLL * (-1) ** (number + x + y)), x, y)


def visible(pose: BoardPose, board_points: Array, camera: Lens, rig: Rig | None = None) -> bool:
    """Whether the board lies whole in the camera's picture, and in the projector's where a rig is known."""
    R, t = placed(pose)
    X = board_points @ R.T + t
    views = [(camera, X)]
    if rig is not None:
        views.append((rig.projector, rig.to_projector_frame(X)))
    for lens, points in views:
        pixels = lens.project(points)
        size = np.array(lens.size)
        with np.errstate(invalid="ignore"):
            if not np.all((pixels > _MARGIN * size) & (pixels < (1 - _MARGIN) * size - 1)):
                return False
    return True


def _at(
    camera: Lens, board: Array, distance: float, turns: tuple[float, float, float], side: int, height: int
) -> BoardPose:
    """Pose in the middle (0) or as far to a side (±1) as the board still fits the camera's picture."""
    yaw, pitch, roll = turns
    size = np.array(camera.size, np.float64)
    focal = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    R, _ = placed(BoardPose(distance, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll))
    # The board's picture, as wide as its nearest edge makes it.
    X = board @ R.T + np.array([0, 0, distance])
    half = np.abs(X[:, :2] / X[:, 2:] * focal).max(0)
    room = np.maximum((1 - 2 * _MARGIN) * size / 2 - half - 0.02 * size, 0)
    centre = (size - 1) / 2 - np.array([camera.matrix[0, 2], camera.matrix[1, 2]])
    x, y = (centre + room * (side, height)) / focal * distance
    return BoardPose(distance, float(x), float(y), yaw, pitch, roll)


def _information(calibration: Calibration, pool: Sequence[BoardPose], board_points: Array) -> Array:
    """(m, q, q) what every candidate would tell about the globals."""
    step = max(1, len(board_points) // _MOST_POINTS)
    points = board_points[::step]
    matrices = [placed(pose) for pose in pool]
    state = State(
        calibration.adjusted.state.values,
        np.stack([R for R, _ in matrices]),
        np.stack([t for _, t in matrices]),
        np.zeros((len(points), 3)),
    )
    count = len(points) * len(pool)
    weight = np.zeros((2, count, 2))
    for lens in range(2):
        for axis in range(2):
            known = calibration.data.weight[lens, :, axis] > 0
            if known.any():
                weight[lens, :, axis] = (
                    np.median(calibration.data.weight[lens, known, axis]) * len(board_points) / len(points)
                )
    flat = Measurements(
        np.tile(points, (len(pool), 1)),
        np.repeat(np.arange(len(pool)), len(points)),
        np.tile(np.arange(len(points)), len(pool)),
        np.zeros((2, count, 2)),
        weight,
        np.zeros((count, 2, 2)),
        calibration.data.extent,
        len(pool),
    )
    if calibration.data.gradient.any():
        # How the board takes the camera's picture to the projector's.
        _, _, _, by_point = linearised(state, flat)
        flat = replace(flat, gradient=by_point[1][..., :2] @ np.linalg.inv(by_point[0][..., :2]))
    free = replace(calibration.freedom, board_prior=None)
    system, _, _ = normals(state, replace(flat, measured=predicted(state, flat)), free, calibration.adjusted.scales)
    return system.shares()[0]


def _tolerances(calibration: Calibration) -> Array:
    """(q,) 1/tolerance² of the parameters of interest, 0 for the others."""
    out = np.zeros(len(calibration.names))
    baseline, _ = calibration.baseline
    for i, name in enumerate(calibration.names):
        if name.endswith((".fx", ".fy")):
            out[i] = (GOOD_FOCAL * calibration.values[i]) ** -2.0
        elif name.endswith((".cx", ".cy")):
            out[i] = GOOD_CENTRE_PX**-2.0
        elif name.startswith("translation"):
            out[i] = (GOOD_BASELINE * baseline) ** -2.0
    return out


def _told(pose: BoardPose, camera: Lens, distance: float) -> str:
    parts = []
    for angle, edges in ((pose.yaw_deg, ("right", "left")), (pose.pitch_deg, ("top", "bottom"))):
        if abs(angle) > 5:
            parts.append(f"{edges[0] if angle > 0 else edges[1]} edge")
    told = [f"tilt the {' and the '.join(parts)} towards the camera"] if parts else ["hold the board facing the camera"]
    if abs(pose.distance_mm / distance - 1) > 0.05:
        told.append("nearer" if pose.distance_mm < distance else "further away")
    middle = camera.project(np.array([pose.offset_x_mm, pose.offset_y_mm, pose.distance_mm]))
    off = (middle - (np.array(camera.size) - 1) / 2) / np.array(camera.size)
    rows = "upper" if off[1] < -0.04 else "lower" if off[1] > 0.04 else ""
    columns = "left" if off[0] < -0.04 else "right" if off[0] > 0.04 else ""
    told.append(" ".join(word for word in (rows, columns) if word) or "in the middle of the picture")
    return ", ".join(told)
