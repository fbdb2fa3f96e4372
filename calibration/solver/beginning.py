"""The first estimate of everything, and whether the axes are the right way round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Finding
from calibration.solver.adjustment import adjusted
from calibration.solver.measurements import Measurements
from calibration.solver.model import Model
from calibration.solver.parameters import CAMERA, NAMES, PROJECTOR, ROTATION, TRANSLATION, State
from calibration.solver.selection import Terms
from calibration.solver.start import camera_start, homography, line_resection, pose_start, resection, rotation_vector

Array = NDArray[np.float64]

_NOMINAL_BASELINE_MM = 200.0
_NOMINAL_FOCAL = 1.6  # picture widths; common for projectors and for machine-vision lenses


def measured_axes(data: Measurements) -> tuple[bool, bool]:
    """Which projector coordinates were measured at more than a twentieth of the points."""
    share = data.known[1].mean(axis=0)
    return bool(share[0] > 0.05), bool(share[1] > 0.05)


def begun(data: Measurements, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> Model:
    """Model with a first estimate good to some px.

    The camera is adjusted alone first, so that the projector's resection has points in space to go by.
    """
    axes = measured_axes(data)
    rows = data.slices()
    plane = [data.points[r, :2] for r in rows]
    seen = [homography(p, data.measured[0, r]) for p, r in zip(plane, rows, strict=True)]
    lens = camera_start(seen, camera_size)
    poses = [pose_start(H, lens) for H in seen]
    values = np.zeros(len(NAMES))
    values[CAMERA][:4] = lens
    values[PROJECTOR][:4] = _nominal(projector_size)
    flat = np.zeros((data.board_size, 3))
    state = State(values, np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]), flat)
    model = Model(state, axes, camera_size, projector_size)
    state = adjusted(state, data.of_camera(), model.camera_only(Terms(("k1",)))).state
    X = np.einsum("nij,nj->ni", state.turns[data.pose], data.points) + state.shifts[data.pose]
    lens, R, T = _projector(X, data, axes, projector_size, state)
    values = state.values.copy()
    values[PROJECTOR][:4], values[ROTATION], values[TRANSLATION] = lens, rotation_vector(R), T
    # Distortion is for the selection to find; the camera alone may have bent k1 to its poses.
    values[CAMERA][4:] = 0.0
    return Model(State(values, state.turns, state.shifts, flat), axes, camera_size, projector_size)


def reversed_axes(data: Measurements) -> Finding | None:
    """Say whether the projector's picture is a mirror image of the camera's: swapped or turned axes.

    Camera and projector look at the same side of the board, so their pictures are turned the same way round, in every
    pose; exchanging the projector's axes, or counting one from its other end, turns one of them over.
    """
    if not all(measured_axes(data)):
        return None
    slopes = []
    for rows in data.slices():
        both = data.known[1, rows].all(axis=1)
        if np.count_nonzero(both) >= 4:
            camera, projector = data.measured[0, rows][both], data.measured[1, rows][both]
            centred = camera - camera.mean(0)
            slopes.append(np.linalg.lstsq(centred, projector - projector.mean(0), rcond=None)[0].T)
    turned_over = [slope for slope in slopes if np.linalg.det(slope) < 0]
    if 2 * len(turned_over) <= len(slopes):
        return None
    mean = np.abs(np.mean(turned_over, axis=0))
    if mean[0, 1] + mean[1, 0] > mean[0, 0] + mean[1, 1]:
        return Finding(
            "swapped_axes",
            True,
            f"projector x and y are swapped: in {len(turned_over)} of {len(slopes)} poses the projector's column grows "
            "down the camera's picture and its row across it, which no projector can do",
            "Decode the first sequences as the axis along which their fringes vary: exchange x and y in the plan.",
        )
    return Finding(
        "mirrored_axes",
        True,
        f"one axis of the projector runs backwards: in {len(turned_over)} of {len(slopes)} poses its picture is a "
        "mirror image of the camera's",
        "Count columns from the left and rows from the top of the projector's picture; switch off rear projection and "
        "the camera's mirroring.",
    )


def _nominal(size: tuple[int, int]) -> Array:
    f = _NOMINAL_FOCAL * max(size)
    return np.array([f, f, (size[0] - 1) / 2, (size[1] - 1) / 2])


def _projector(
    X: Array, data: Measurements, axes: tuple[bool, bool], size: tuple[int, int], state: State
) -> tuple[Array, Array, Array]:
    lens = _nominal(size)
    known = data.known[1]
    if all(axes):
        both = known.all(axis=1)
        found = resection(X[both], data.measured[1][both])
        if found is not None and _plausible(found[0], size):
            return found
        return _from_boards(data, lens, state)
    axis = 0 if axes[0] else 1
    line = line_resection(X[known[:, axis]], data.measured[1][known[:, axis], axis], axis)
    if line is None or not _plausible(np.array([line[0], line[0], line[1], lens[3]]), size):
        T = np.zeros(3)
        T[axis] = -_NOMINAL_BASELINE_MM
        return lens, np.eye(3), T
    lens[:2] = line[0]
    lens[2 + axis] = line[1]
    return lens, line[2], line[3]


def _plausible(lens: Array, size: tuple[int, int]) -> bool:
    """No projector's picture is wider than 160°, narrower than 3°, or lies further off its axis than twice its size."""
    f = lens[:2] / max(size)
    return bool(np.all((f > 0.1) & (f < 20)) and np.all(np.abs(lens[2:] - np.array(size) / 2) < 2.5 * max(size)))


def _from_boards(data: Measurements, lens: Array, state: State) -> tuple[Array, Array, Array]:
    """The same from homographies before a nominal lens, for sets that do not determine it."""
    turns, shifts = [], []
    for i, rows in enumerate(data.slices()):
        both = data.known[1, rows].all(axis=1)
        if np.count_nonzero(both) >= 4:
            H = homography(data.points[rows][both, :2], data.measured[1, rows][both])
            R, t = pose_start(H, lens)
            turns.append(R @ state.turns[i].T)
            shifts.append(t - turns[-1] @ state.shifts[i])
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    return lens, u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, np.median(shifts, axis=0)
