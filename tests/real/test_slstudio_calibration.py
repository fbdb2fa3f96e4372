"""The calibration that SLStudio published with its frames, repeated from those frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.boards import Chessboard
from calibration.bundle import calibrate_rig
from calibration.correspondence import observe
from calibration.detection.finding import find_board
from calibration.observations import PoseObservation
from calibration.solver.result import Calibration
from calibration.solver.selection import Terms
from scanner.rig import Rig

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "slstudio" / "calibration"

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
    return calibrate_rig(poses, CAMERA_SIZE, PROJECTOR_SIZE)


def test_all_six_poses_agree_better_than_published(calibration: Calibration):
    assert calibration.usable
    assert calibration.dropped == ()
    assert calibration.rms_stereo <= 0.35  # published: 0.422


def test_focal_length_and_baseline_are_those_published(calibration: Calibration, published: Rig):
    focal = np.diag(calibration.rig.camera.matrix)[:2]
    assert np.abs(focal / published.camera.matrix[0, 0] - 1).max() < 0.005
    assert calibration.baseline[0] == pytest.approx(np.linalg.norm(published.translation), rel=0.01)
