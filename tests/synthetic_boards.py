"""Random rigs, and what they see of a board that is held in front of them: truth for the tests of the calibration."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.observations import PoseObservation
from scanner.rig import Lens, Rig

CAMERA_SIZE, PROJECTOR_SIZE = (1024, 768), (1280, 800)
CORNER_SIGMA, COLUMN_SIGMA = 0.04, 0.02


def focal(size: tuple[int, int], fov_deg: float) -> float:
    return size[0] / 2 / np.tan(np.radians(fov_deg / 2))


def random_rig(rng: np.random.Generator, distortion: bool = True) -> Rig:
    """Camera of about 29°, projector of about 35° that throws upwards a little, baseline about 180 mm."""
    lenses = []
    for size, fov, offset in ((CAMERA_SIZE, 29, 15), (PROJECTOR_SIZE, 35, 40)):
        f = focal(size, fov) * rng.uniform(0.95, 1.05)
        centre = (np.array(size) - 1) / 2 + rng.normal(0, offset, 2)
        k = np.array([rng.uniform(-0.15, 0.1), rng.uniform(-0.1, 0.2), *rng.normal(0, 5e-4, 2)]) * distortion
        matrix = np.array([[f, 0, centre[0]], [0, f * (1 + rng.normal(0, 5e-4)), centre[1]], [0, 0, 1]])
        lenses.append(Lens(matrix, k, size))
    centre = np.array([rng.uniform(170, 190), rng.uniform(-20, 20), rng.uniform(-20, 20)])
    # The projector looks at the middle of the volume, 600 mm away, but for a few degrees.
    forward = np.array([0, 0, 600.0]) - centre
    right = np.cross([0, 1, 0], forward)
    R = np.stack([v / np.linalg.norm(v) for v in (right, np.cross(forward, right), forward)])
    R = Rotation.from_rotvec(np.radians(rng.normal(0, 1.5, 3))).as_matrix() @ R
    return Rig(lenses[0], lenses[1], R, -R @ centre)


def board_points(columns: int = 13, rows: int = 9, square_mm: float = 18.0) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns]
    flat = np.stack([x - (columns - 1) / 2, y - (rows - 1) / 2], axis=-1).reshape(-1, 2) * square_mm
    return np.column_stack([flat, np.zeros(len(flat))])


@dataclass
class Held:
    rotation: np.ndarray
    translation: np.ndarray


def held(yaw=0.0, pitch=0.0, roll=0.0, distance=600.0, x=0.0, y=0.0) -> Held:
    return Held(Rotation.from_euler("XYZ", [pitch, yaw, roll], degrees=True).as_matrix(), np.array([x, y, distance]))


TILTS = ((0, 0), (28, 0), (-28, 0), (0, 28), (0, -28), (22, 22), (-22, 22), (22, -22), (-22, -22), (35, 10))


def good_poses(rng: np.random.Generator, count: int = 10) -> list[Held]:
    """As a careful person holds a board: all tilts, near and far, in all parts of the picture."""
    return [
        held(
            yaw + rng.normal(0, 4),
            pitch + rng.normal(0, 4),
            rng.normal(0, 12),
            rng.uniform(520, 700),
            rng.uniform(-35, 35),
            rng.uniform(-25, 25),
        )
        for yaw, pitch in (TILTS[i % len(TILTS)] for i in range(count))
    ]


def seen(
    rig: Rig,
    pose: Held,
    rng: np.random.Generator,
    points: np.ndarray | None = None,
    *,
    name: str = "pose",
    corner_sigma: float = CORNER_SIGMA,
    column_sigma: float = COLUMN_SIGMA,
    axes: str = "xy",
    real_points: np.ndarray | None = None,
    read_there: bool = False,
) -> PoseObservation:
    """Noisy observation.

    ``real_points`` is what the board is like when that is not what is believed. With ``read_there`` the projector's
    coordinates are those of the places where the camera found the points, wrong as these are.
    """
    points = board_points() if points is None else points
    X = (points if real_points is None else real_points) @ pose.rotation.T + pose.translation
    camera = rig.camera.project(X)
    projector = rig.projector.project(rig.to_projector_frame(X))
    inside = np.ones(len(X), bool)
    for px, size in ((camera, CAMERA_SIZE), (projector, PROJECTOR_SIZE)):
        inside &= np.isfinite(px).all(1) & (px > 3).all(1) & (px < np.array(size) - 4).all(1)
    n = int(inside.sum())
    sigma = np.full((n, 2), column_sigma)
    measured = projector[inside] + column_sigma * rng.standard_normal((n, 2))
    for axis, letter in enumerate("xy"):
        if letter not in axes:
            measured[:, axis] = np.nan
            sigma[:, axis] = np.nan
    errors = corner_sigma * rng.standard_normal((n, 2))
    gradient = across(rig, pose, points[inside]) if read_there else np.zeros((n, 2, 2))
    return PoseObservation(
        name,
        np.flatnonzero(inside),
        points[inside],
        camera[inside] + errors,
        np.full(n, corner_sigma),
        measured + np.einsum("nij,nj->ni", gradient, errors),
        sigma,
        gradient,
    )


def across(rig: Rig, pose: Held, points: np.ndarray, step_mm: float = 0.01) -> np.ndarray:
    """(n, 2, 2) derivatives of the projector's picture of a board after the camera's, by central differences."""
    sides = []
    for step in (np.array([step_mm, 0, 0]), np.array([0, step_mm, 0])):
        X = [(points + sign * step) @ pose.rotation.T + pose.translation for sign in (1, -1)]
        camera, projector = (
            (rig.camera.project(x) for x in X),
            (rig.projector.project(rig.to_projector_frame(x)) for x in X),
        )
        sides.append([np.subtract(*camera), np.subtract(*projector)])
    by_camera, by_projector = np.moveaxis(np.array(sides), 0, -1)
    return by_projector @ np.linalg.inv(by_camera)


def seen_all(rig: Rig, poses: list[Held], rng: np.random.Generator, **how) -> list[PoseObservation]:
    return [seen(rig, pose, rng, name=f"pose {i + 1}", **how) for i, pose in enumerate(poses)]
