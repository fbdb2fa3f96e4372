"""The calibration that SLStudio published with its frames, repeated from those frames."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.boards import Chessboard
from calibration.bundle import calibrate_rig
from calibration.correspondence import observe
from calibration.detection.finding import find_board
from calibration.diagnosis import Expectation
from calibration.observations import PoseObservation
from calibration.solver.refusal import CalibrationError
from calibration.solver.result import Calibration
from calibration.solver.selection import Terms
from scanner.rig import Rig
from scanner.triangulation import triangulate

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "slstudio" / "calibration"
SKULL = FOLDER.parent / "skull_2x3"

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"the real captures {FOLDER} are not on this machine")

BOARD = Chessboard(columns=13, rows=9, square_mm=10)
CAMERA_SIZE, PROJECTOR_SIZE = (1688, 1352), (1824, 1140)
NOISE_DN, FRINGES = 1.2, 16


def decoded(frames: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinate, σ and modulation from three steps of 16 fringes and three of one; I_i = A + B cos(2πx/p − 2πi/3)."""
    turn = np.exp(2j * np.pi * np.arange(3) / 3)[:, None, None]
    fine, coarse = (2 / 3 * (turn * three).sum(axis=0) for three in (frames[:3], frames[3:]))
    phase = np.angle(fine) / (2 * np.pi) % 1
    order = np.round(FRINGES * (np.angle(coarse) / (2 * np.pi) % 1) - phase)
    modulation = np.abs(fine)
    sigma = np.sqrt(2 / 3) * NOISE_DN / np.maximum(modulation, 1e-6) / (2 * np.pi) * width / FRINGES
    place = np.where(modulation > 8, (order + phase) / FRINGES * width, np.nan)
    return place.astype(np.float32), sigma.astype(np.float32), modulation.astype(np.float32)


def observed(number: int) -> PoseObservation:
    frames = np.array(
        [cv2.imread(str(FOLDER / f"calseq{number}" / f"{i:02d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(12)], float
    )
    view = find_board(frames.mean(axis=0), BOARD, NOISE_DN / np.sqrt(12))
    x, sigma_x, modulation = decoded(frames[:6], PROJECTOR_SIZE[0])
    y, sigma_y, _ = decoded(frames[6:], PROJECTOR_SIZE[1])
    return observe(f"calseq{number}", view, BOARD, x, sigma_x, y, sigma_y, modulation)


@pytest.fixture(scope="module")
def poses() -> list[PoseObservation]:
    return [observed(number) for number in range(1, 7)]


@pytest.fixture(scope="module")
def published() -> Rig:
    return Rig.load(FOLDER / "calibration.xml")


@pytest.fixture(scope="module")
def calibration(poses: list[PoseObservation]) -> Calibration:
    # An office print on a plate: its corners are out by 0.03 mm along it and 0.05 mm across, alike in all poses.
    return calibrate_rig(poses, CAMERA_SIZE, PROJECTOR_SIZE, board_sigma_mm=0.05)


def test_all_six_poses_agree_better_than_published(calibration: Calibration):
    assert calibration.usable
    assert calibration.dropped == ()
    assert calibration.rms_stereo <= 0.35  # published: 0.422


def test_focal_length_and_baseline_are_those_published(calibration: Calibration, published: Rig):
    focal = np.diag(calibration.rig.camera.matrix)[:2]
    assert np.abs(focal / published.camera.matrix[0, 0] - 1).max() < 0.005
    # 1.1 % above the published 164.5 mm whatever is assumed (exact or estimated board, k1 or all terms, without any one
    # pose: 166.1 to 166.7 mm). The next two tests say why it is not 1 %.
    assert calibration.baseline[0] == pytest.approx(np.linalg.norm(published.translation), rel=0.013)


def test_the_authors_way_gives_what_they_published(poses: list[PoseObservation], published: Rig):
    """OpenCV with their restrictions and from their five poses: the points are theirs, the rig differs by the model.

    They hold the camera's centre in the middle of its picture, which these frames place 13 px (18 σ) off, and the
    lenses as calibrated one by one while the projector's pose is estimated.
    """
    board, camera, projector = [], [], []
    for pose in (poses[i] for i in (0, 2, 3, 4, 5)):
        both = np.isfinite(pose.projector).all(axis=1)
        for points, kept in ((pose.points_board, board), (pose.camera, camera), (pose.projector, projector)):
            kept.append(points[both].astype(np.float32))
    plain = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    _, camera_matrix, camera_terms, *_ = cv2.calibrateCamera(
        board, camera, CAMERA_SIZE, None, None, flags=plain | cv2.CALIB_FIX_PRINCIPAL_POINT
    )
    guess = np.array([[2600.0, 0, 911.5], [0, 2600, 1100], [0, 0, 1]])
    _, projector_matrix, projector_terms, *_ = cv2.calibrateCamera(
        board, projector, PROJECTOR_SIZE, guess, np.zeros(5), flags=plain | cv2.CALIB_USE_INTRINSIC_GUESS
    )
    *_, shift, _, _ = cv2.stereoCalibrate(
        board, camera, projector, camera_matrix, camera_terms, projector_matrix, projector_terms, CAMERA_SIZE,
        flags=cv2.CALIB_FIX_INTRINSIC,
    )  # fmt: skip
    assert camera_matrix[0, 0] == pytest.approx(published.camera.matrix[0, 0], rel=0.005)
    assert projector_matrix[0, 0] == pytest.approx(published.projector.matrix[0, 0], rel=0.001)
    assert np.linalg.norm(shift) == pytest.approx(np.linalg.norm(published.translation), rel=0.01)


def test_the_published_rig_does_not_fit_the_frames_it_came_with(poses: list[PoseObservation], published: Rig):
    """Its camera does; its projector misses the same corners by pixels, where it is said to err by 0.46 px."""
    camera, projector = [], []
    for pose in poses:
        both = np.isfinite(pose.projector).all(axis=1)
        board, seen = pose.points_board[both], pose.camera[both]
        _, turn, shift = cv2.solvePnP(board, seen, published.camera.matrix, published.camera.distortion)
        X = board @ cv2.Rodrigues(turn)[0].T + shift.ravel()
        camera.append(published.camera.project(X) - seen)
        projector.append(published.projector.project(published.to_projector_frame(X)) - pose.projector[both])
    camera_rms, projector_rms = (np.sqrt((np.concatenate(e) ** 2).sum(axis=1).mean()) for e in (camera, projector))
    assert camera_rms < 0.282  # as published
    assert 3 < projector_rms < 4.5


def test_the_skull_by_this_rig_and_by_others(poses: list[PoseObservation], calibration: Calibration, published: Rig):
    """Shapes up to a rigid motion: rigs of five poses agree to 0.1 mm, the published one differs by its projector."""
    frames = np.array([cv2.imread(str(SKULL / f"{i:02d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(6)], float)
    column, sigma, _ = decoded(frames, PROJECTOR_SIZE[0])

    def shape(rig: Rig) -> np.ndarray:
        return triangulate(rig, column, sigma).points.astype(float)

    own = shape(calibration.rig)
    exact = [calibrate_rig(poses[:i] + poses[i + 1 :], CAMERA_SIZE, PROJECTOR_SIZE).rig for i in range(6)]
    others = [apart(own, shape(rig)) for rig in exact]
    from_published = apart(own, shape(published))
    print("\nskull, r.m.s. mm: rigs without one pose", np.round(others, 3), "published rig", round(from_published, 3))
    assert np.median(others) < 0.15
    # 0.15 mm was asked for. OpenCV's calibration in the authors' way, from the same points, is 0.27 mm from theirs.
    assert from_published < 0.30


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """Root mean square distance of corresponding points after the best rigid motion (Kabsch, 1976)."""
    depth = first[..., 2]
    # A skull is within a hand's breadth of its median; what is beyond are fringe orders that the coarse phase missed.
    near = np.abs(depth - np.nanmedian(depth)) < 100
    both = near & np.isfinite(second[..., 2])
    a, b = (points[both] - points[both].mean(axis=0) for points in (first, second))
    u, _, vt = np.linalg.svd(a.T @ b)
    return float(np.sqrt(((a - b @ (u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt).T) ** 2).sum(axis=1).mean()))


def test_an_exact_board_fits_worse_but_meets_the_same_figures(poses: list[PoseObservation], published: Rig):
    exact = calibrate_rig(poses, CAMERA_SIZE, PROJECTOR_SIZE)
    assert exact.dropped == ()
    assert exact.rms_stereo <= 0.35
    assert exact.rig.camera.matrix[0, 0] == pytest.approx(published.camera.matrix[0, 0], rel=0.005)
    assert "noise_underestimated" in {finding.code for finding in exact.findings}


def test_a_caliper_tells_the_size_of_the_squares(poses: list[PoseObservation]):
    """A reader who took 15 mm for the squares is told by the baseline."""
    wrong = [replace(pose, points_board=pose.points_board * 1.5) for pose in poses]
    found = calibrate_rig(
        wrong, CAMERA_SIZE, PROJECTOR_SIZE, terms=Terms(("k1",), ("k1",)), expected=Expectation(baseline_mm=165)
    )
    assert "wrong_scale" in {finding.code for finding in found.findings if finding.refuses}


def test_the_wrong_order_of_axes_is_named(poses: list[PoseObservation]):
    with pytest.raises(CalibrationError, match="x and y are swapped"):
        calibrate_rig([replace(pose, projector=pose.projector[:, ::-1]) for pose in poses], CAMERA_SIZE, PROJECTOR_SIZE)
