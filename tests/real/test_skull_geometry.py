"""A real capture of SLStudio (a skull, 2 × 3 steps) with its published rig, against a triangulation by OpenCV."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import spearmanr

from scanner.cloud import Cloud
from scanner.rig import Rig
from scanner.triangulation import Triangulation, triangulate

SLSTUDIO = Path(__file__).resolve().parents[3] / "shared" / "data" / "slstudio"
FRAMES, CALIBRATION = SLSTUDIO / "skull_2x3", SLSTUDIO / "calibration" / "calibration.xml"

pytestmark = pytest.mark.skipif(not FRAMES.is_dir(), reason=f"the real capture {FRAMES} is not on this machine")

WIDTH_PX, FINE_PERIODS = 1824, 16
LEAST_MODULATION_DN = 8


@dataclass
class Decoded:
    x_p: np.ndarray
    sigma_x: np.ndarray
    brightness: np.ndarray
    modulation: np.ndarray


@pytest.fixture(scope="module")
def decoded() -> Decoded:
    """Three steps of 16 fringes, then three of one; I_i = A + B cos(2πx/p − 2πi/3)."""
    frames = np.array([cv2.imread(str(FRAMES / f"{i:02d}.png"), cv2.IMREAD_UNCHANGED) for i in range(6)], float)
    turn = np.exp(2j * np.pi * np.arange(3) / 3)[:, None, None]
    fine, coarse = (2 / 3 * (turn * three).sum(axis=0) for three in (frames[:3], frames[3:]))
    phase = np.angle(fine) / (2 * np.pi) % 1
    order = np.round(FINE_PERIODS * (np.angle(coarse) / (2 * np.pi) % 1) - phase)
    modulation = np.abs(fine)
    x_p = np.where(modulation > LEAST_MODULATION_DN, (order + phase) / FINE_PERIODS * WIDTH_PX, np.nan)
    # Phase noise √(2/N) σ_I / B with σ_I = 1 DN, N = 3.
    sigma_x = np.sqrt(2 / 3) / np.maximum(modulation, 1e-6) / (2 * np.pi) * WIDTH_PX / FINE_PERIODS
    return Decoded(x_p, sigma_x, frames[:3].mean(axis=0), modulation)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig.load(CALIBRATION)


@pytest.fixture(scope="module")
def found(rig: Rig, decoded: Decoded) -> Triangulation:
    return triangulate(rig, decoded.x_p, decoded.sigma_x)


@pytest.fixture(scope="module")
def published() -> dict[str, np.ndarray]:
    storage = cv2.FileStorage(str(CALIBRATION), cv2.FILE_STORAGE_READ)
    return {name: storage.getNode(name).mat().astype(float) for name in ("Kc", "kc", "Kp", "kp", "Rp", "Tp")}


def test_the_published_rig_is_read_as_it_is(rig: Rig, published: dict[str, np.ndarray]) -> None:
    assert rig.camera.size == (1688, 1352)
    assert rig.projector.size == (1824, 1140)
    assert rig.metadata["stereo_error"] == pytest.approx(0.42199749739974501)
    np.testing.assert_array_equal(rig.camera.matrix, published["Kc"])
    np.testing.assert_array_equal(rig.projector.distortion, published["kp"].ravel())
    np.testing.assert_array_equal(rig.translation, published["Tp"].ravel())


def test_as_many_points_as_published_where_the_skull_is(found: Triangulation) -> None:
    depth = found.depth[np.isfinite(found.depth)]
    assert depth.size == pytest.approx(381_000, rel=0.005)
    assert np.median(depth) == pytest.approx(386, abs=1)
    # A skull is within a hand's breadth of its median; what is beyond are fringe orders that the coarse phase missed.
    assert (np.abs(depth - np.median(depth)) < 100).mean() > 0.97


def triangulated_by_opencv(x_p: np.ndarray, rig: dict[str, np.ndarray]) -> np.ndarray:
    """Depth (n,) of pixels with a column: undistort both pictures, find y on the epipolar line, `triangulatePoints`.

    To undistort the projector's x its y is needed, and that comes with the point: repeated until both agree.
    """
    rows, columns = np.nonzero(np.isfinite(x_p))
    exactly = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 1e-12)
    pixels = np.column_stack((columns, rows)).astype(float)[:, None]
    seen = cv2.undistortPoints(pixels, rig["Kc"], rig["kc"], criteria=exactly)[:, 0]
    turn, shift = rig["Rp"], rig["Tp"].ravel()
    essential = np.array([[0, -shift[2], shift[1]], [shift[2], 0, -shift[0]], [-shift[1], shift[0], 0]]) @ turn
    a, b, c = cv2.computeCorrespondEpilines(seen[:, None], 1, essential)[:, 0].T
    camera, projector = np.eye(3, 4), np.column_stack((turn, shift))
    y_p = np.full(len(rows), 570.0)
    for _ in range(5):
        lit = np.column_stack((x_p[rows, columns], y_p))[:, None]
        x = cv2.undistortPoints(lit, rig["Kp"], rig["kp"], criteria=exactly)[:, 0, 0]
        y = -(a * x + c) / b
        points = cv2.triangulatePoints(camera, projector, seen.T, np.array([x, y]))
        points = (points[:3] / points[3]).T
        before, y_p = y_p, cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, rig["Kp"], rig["kp"])[0][:, 0, 1]
    assert np.median(np.abs(y_p - before)) < 1e-6
    return points[:, 2]


def test_the_depth_is_that_of_opencv(found: Triangulation, decoded: Decoded, published: dict[str, np.ndarray]) -> None:
    x_p = np.where(np.isfinite(found.depth), decoded.x_p, np.nan)
    x_p[np.arange(len(x_p)) % 4 > 0] = np.nan  # every fourth row is 95 000 points
    expected = triangulated_by_opencv(x_p, published)
    error = np.abs(found.depth[np.isfinite(x_p)] - expected)
    # Half a float32 step at 386 mm is 1.5e-5 mm; a misread distortion or a half-pixel shift is above 0.1 mm.
    assert np.median(error) < 3e-5
    assert np.percentile(error, 99.9) < 3e-4


def test_the_spread_of_neighbours_is_of_the_predicted_size(found: Triangulation, decoded: Decoded) -> None:
    # On smooth bone the second difference of depth along a row is noise, √6 σ. The prediction is for σ_I = 1 DN; an
    # 8-bit camera has between its quantisation, 0.3 DN, and the shot noise of a well of 10⁴ electrons, some 2 DN.
    z, sigma = found.depth.astype(float), found.sigma_point
    bend = (z[:, 2:] - 2 * z[:, 1:-1] + z[:, :-2]) / (np.sqrt(6) * sigma[:, 1:-1])
    strong = decoded.modulation[:, 1:-1] > 30
    observed = 1.4826 * np.nanmedian(np.abs(bend[strong]))
    assert 0.3 < observed < 2


def test_normals_explain_the_shading(found: Triangulation, decoded: Decoded, rig: Rig) -> None:
    cloud = Cloud.from_grid(found.points, found.sigma_point, decoded.brightness.astype(np.float32), simulated=False)
    assert len(cloud.points) == np.isfinite(found.depth).sum()
    known = np.isfinite(cloud.normals).all(axis=1)
    assert known.mean() > 0.98
    assert (cloud.normals * cloud.points).sum(axis=1)[known].max() < 0
    # Lambert: matt bone sends back the projector's light by the cosine of incidence. Chance would correlate by 0.002.
    to_projector = rig.projector_centre_cam - cloud.points
    incidence = (cloud.normals * to_projector).sum(axis=1) / np.linalg.norm(to_projector, axis=1)
    modulation = decoded.modulation[np.isfinite(found.depth)]
    assert spearmanr(incidence[known], modulation[known]).statistic > 0.7
