"""Points that OpenCV projected through both distorted lenses must come back, and scatter as their σ says."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from scanner import optics
from scanner.rig import Lens, Rig
from scanner.triangulation import TriangulationError, epipolar_crossings, triangulate

SIZE = (160, 120)
CAMERA_MATRIX = np.array([[260.0, 0, 80.25], [0, 258.0, 58.5], [0, 0, 1]])
PROJECTOR_MATRIX = np.array([[1700.0, 0, 655.5], [0, 1710.0, 610.0], [0, 0, 1]])
# Barrel and decentring as a good lens has them; then everything OpenCV models, at twice a cheap lens's strength.
MILD = (np.array([-0.08, 0.05, 0.0011, -0.0007, 0.01]), np.array([-0.05, 0.02, -0.0005, 0.001, 0.0]))
FULL = np.array([-0.3, 0.12, 0.003, -0.004, 0.02, 0.05, 0.02, 0.01, 0.004, 0.002, -0.003, 0.001, 0.04, -0.05])
AXES = {"x": (True, False), "y": (False, True), "both": (True, True)}


def rig_of(distortions, rotation=(0.12, -0.28, 0.02), translation=(155.0, -90.0, 28.0)) -> Rig:
    return Rig(
        Lens(CAMERA_MATRIX, distortions[0], SIZE),
        Lens(PROJECTOR_MATRIX, distortions[1], (1280, 800)),
        cv2.Rodrigues(np.array(rotation, float))[0],
        np.array(translation),
        {},
    )


@dataclass
class View:
    """What each camera pixel sees, found without the code under test."""

    points: np.ndarray
    x_p: np.ndarray
    y_p: np.ndarray


def view_of(rig: Rig, surface: str = "sphere") -> View:
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    exactly = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    pixels = np.stack((u, v), -1).reshape(-1, 1, 2)
    xy = cv2.undistortPoints(pixels, CAMERA_MATRIX, rig.camera.distortion, criteria=exactly)
    rays = np.concatenate((xy[:, 0], np.ones((len(xy), 1))), axis=1)
    if surface == "plane":
        normal, offset = np.array([0.2, -0.1, 1.0]), 480.0
        points = rays * (offset / (rays @ normal))[:, None]
    else:  # a sphere of 700 mm around (20, 10, 1150) fills the picture
        centre, radius = np.array([20.0, 10.0, 1150.0]), 700.0
        a, b, c = (rays**2).sum(1), rays @ centre, centre @ centre - radius**2
        points = rays * ((b - np.sqrt(b * b - a * c)) / a)[:, None]
    seen, _ = cv2.projectPoints(
        points, cv2.Rodrigues(rig.rotation)[0], rig.translation, PROJECTOR_MATRIX, rig.projector.distortion
    )
    shape = (SIZE[1], SIZE[0])
    return View(points.reshape(*shape, 3), seen[:, 0, 0].reshape(shape), seen[:, 0, 1].reshape(shape))


def sigmas(value: float = 0.05) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0]), value)


def arguments(view: View, axes: str, sigma_x: np.ndarray | None = None, sigma_y: np.ndarray | None = None) -> tuple:
    x, y = AXES[axes]
    sigma_x, sigma_y = (sigmas() if s is None else s for s in (sigma_x, sigma_y))
    return (view.x_p if x else None, sigma_x if x else None, view.y_p if y else None, sigma_y if y else None)


@pytest.mark.parametrize("distortions", [(np.empty(0), np.empty(0)), MILD, (FULL, FULL)], ids=["none", "mild", "full"])
@pytest.mark.parametrize("surface", ["plane", "sphere"])
@pytest.mark.parametrize("axes", AXES)
def test_points_come_back(distortions, surface: str, axes: str) -> None:
    rig = rig_of(distortions)
    view = view_of(rig, surface)
    found = triangulate(rig, *arguments(view, axes))
    # One rounding to float32 of lengths below 1024 mm is 3e-5 mm; the rest is Newton's.
    np.testing.assert_allclose(found.points, view.points, rtol=0, atol=4e-5)
    assert found.points.dtype == found.sigma_point.dtype == np.float32
    assert np.shares_memory(found.depth, found.points)
    assert (found.epipolar_px is None) == (axes != "both")


@pytest.mark.parametrize("forgotten", ["camera", "projector"])
def test_the_data_tell_a_rig_without_distortion(forgotten: str) -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    kept = {"camera": (np.empty(0), MILD[1]), "projector": (MILD[0], np.empty(0))}[forgotten]
    wrong = triangulate(rig_of(kept), *arguments(view, "x"))
    assert np.nanmax(np.linalg.norm(wrong.points - view.points, axis=-1)) > 0.5


def noisy(view: View, rng: np.random.Generator) -> tuple[View, np.ndarray, np.ndarray]:
    """Coordinates with noise whose σ differs from pixel to pixel and axis to axis."""
    shape = view.x_p.shape
    sigma_x, sigma_y = rng.uniform(0.01, 0.1, shape), rng.uniform(0.02, 0.2, shape)
    x_p = view.x_p + sigma_x * rng.normal(size=shape)
    y_p = view.y_p + sigma_y * rng.normal(size=shape)
    return View(view.points, x_p, y_p), sigma_x, sigma_y


@pytest.mark.parametrize("axes", AXES)
def test_errors_along_the_ray_have_the_predicted_spread(axes: str) -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    measured, sigma_x, sigma_y = noisy(view, np.random.default_rng(11))
    found = triangulate(rig, *arguments(measured, axes, sigma_x, sigma_y))
    error = np.linalg.norm(found.points, axis=-1) - np.linalg.norm(view.points, axis=-1)
    score = error / found.sigma_point
    # Mean and standard deviation of n normal numbers: 1/√n and 1/√(2n), four of them.
    assert abs(score.mean()) < 4 / np.sqrt(score.size)
    assert score.std() == pytest.approx(1, abs=4 / np.sqrt(2 * score.size))
    # The prediction follows each pixel's own σ: the spread of the best and of the worst known tenth.
    order = np.argsort(found.sigma_point, axis=None)
    tenth = score.size // 10
    for part in (order[:tenth], order[-tenth:]):
        assert score.ravel()[part].std() == pytest.approx(1, abs=4 / np.sqrt(2 * tenth))


def test_distances_from_the_epipolar_curve_have_the_predicted_spread() -> None:
    rig = rig_of(MILD)
    measured, sigma_x, sigma_y = noisy(view_of(rig), np.random.default_rng(12))
    found = triangulate(rig, *arguments(measured, "both", sigma_x, sigma_y))
    assert found.epipolar_sigmas is not None
    assert found.epipolar_px is not None
    assert (found.epipolar_px >= 0).all()
    # The square of a normal number has mean 1 and variance 2.
    assert (found.epipolar_sigmas**2).mean() == pytest.approx(1, abs=4 * np.sqrt(2 / found.epipolar_sigmas.size))


def test_a_pair_off_the_curve_is_told_by_its_distance() -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    # Move every pair by 3 px across its curve; the tangent comes from OpenCV, at points 0.1 % further away.
    further, _ = cv2.projectPoints(
        view.points.reshape(-1, 3) * 1.001,
        cv2.Rodrigues(rig.rotation)[0],
        rig.translation,
        PROJECTOR_MATRIX,
        rig.projector.distortion,
    )
    tangent = further.reshape(*view.x_p.shape, 2) - np.stack((view.x_p, view.y_p), -1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    off = View(view.points, view.x_p - 3 * tangent[..., 1], view.y_p + 3 * tangent[..., 0])
    found = triangulate(rig, *arguments(off, "both"))
    np.testing.assert_allclose(found.epipolar_px, 3, atol=0.003)
    np.testing.assert_allclose(found.epipolar_sigmas, 3 / 0.05, rtol=0.001)
    np.testing.assert_allclose(found.depth, view.points[..., 2], rtol=1e-4)


def test_two_axes_carry_the_information_of_both() -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    each = {axes: triangulate(rig, *arguments(view, axes, sigmas(0.03), sigmas(0.07))).sigma_point for axes in AXES}
    np.testing.assert_allclose(each["both"] ** -2.0, each["x"] ** -2.0 + each["y"] ** -2.0, rtol=1e-5)


def test_an_axis_that_knows_nothing_changes_nothing() -> None:
    rig = rig_of(MILD)
    measured, sigma_x, _ = noisy(view_of(rig), np.random.default_rng(13))
    alone = triangulate(rig, *arguments(measured, "x", sigma_x))
    both = triangulate(rig, *arguments(measured, "both", sigma_x, sigmas(1e6)))
    np.testing.assert_allclose(both.points, alone.points, rtol=0, atol=6e-5)
    np.testing.assert_allclose(both.sigma_point, alone.sigma_point, rtol=1e-6)


@pytest.mark.parametrize("axes", AXES)
def test_kernel_and_plain_twin_agree(axes: str) -> None:
    rig = rig_of((FULL, FULL))
    rng = np.random.default_rng(14)
    measured, sigma_x, sigma_y = noisy(view_of(rig), rng)
    # Holes and gross errors, which mislead a start that is taken from the neighbour.
    measured.x_p[rng.random(measured.x_p.shape) < 0.1] = np.nan
    wild = rng.random(measured.x_p.shape) < 0.1
    measured.x_p[wild] += rng.uniform(-300, 300, wild.sum())
    measured.y_p[wild] += rng.uniform(-100, 100, wild.sum())
    found = triangulate(rig, *arguments(measured, axes, sigma_x, sigma_y))

    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    x, y = AXES[axes]
    z, sigma_z, epipolar = optics.triangulate_plain(
        optics.directions_plain(rig.camera.vector, np.column_stack((u.ravel(), v.ravel())).astype(float)),
        rig.projector.vector,
        rig.rotation,
        rig.translation,
        np.array([measured.x_p.ravel() if x else np.zeros(u.size), measured.y_p.ravel() if y else np.zeros(u.size)]),
        np.array(
            [sigma_x.ravel() if x else np.full(u.size, np.inf), sigma_y.ravel() if y else np.full(u.size, np.inf)]
        ),
    )
    depth = found.depth.ravel()
    np.testing.assert_array_equal(np.isnan(depth), np.isnan(z))
    assert 0.8 < np.isfinite(z).mean() <= 1
    # float32 rounding; with gross errors Gauss-Newton is no longer quadratic and stops within 0.01 px of the optimum.
    np.testing.assert_allclose(depth[~wild.ravel()], z[~wild.ravel()], rtol=2e-7)
    np.testing.assert_allclose(depth, z, rtol=1e-5)
    slant = np.linalg.norm(found.points.reshape(-1, 3), axis=1) / depth
    np.testing.assert_allclose(found.sigma_point.ravel(), sigma_z * slant, rtol=1e-4)
    if found.epipolar_px is not None:
        np.testing.assert_allclose(found.epipolar_px.ravel(), np.abs(epipolar), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("axes", AXES)
def test_what_is_not_measured_has_no_point(axes: str) -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    sigma = sigmas()
    for row, bad in enumerate((np.nan, 0.0, -0.1)):
        sigma[row] = bad
    view.x_p[10] = view.y_p[10] = np.nan
    view.x_p[11] = view.y_p[11] = np.inf
    found = triangulate(rig, *arguments(view, axes, sigma, sigma))
    expected = np.ones(sigma.shape, bool)
    expected[[0, 1, 2, 10, 11]] = False
    np.testing.assert_array_equal(np.isfinite(found.points).all(-1), expected)
    for values in (found.sigma_point, found.epipolar_px, found.epipolar_sigmas):
        if values is not None:
            np.testing.assert_array_equal(np.isfinite(values), expected)


def test_two_axes_need_both() -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    view.y_p[:, 50] = np.nan
    found = triangulate(rig, *arguments(view, "both"))
    assert np.isnan(found.points[:, 50]).all()
    assert np.isfinite(found.points[:, 51]).all()


@pytest.mark.parametrize("place", ["behind the camera", "behind the projector"])
def test_no_point_behind_a_lens(place: str) -> None:
    # The projector stands 200 mm before the camera and looks the same way.
    rig = rig_of((np.empty(0), np.empty(0)), rotation=(0, 0, 0), translation=(150, 20, -200))
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    x, y = (u - CAMERA_MATRIX[0, 2]) / CAMERA_MATRIX[0, 0], (v - CAMERA_MATRIX[1, 2]) / CAMERA_MATRIX[1, 1]
    for depth, seen in ((-300.0 if place == "behind the camera" else 100.0, False), (500.0, True)):
        X = np.stack((x, y, np.ones_like(x)), -1) * depth + rig.translation
        image = X @ PROJECTOR_MATRIX.T
        u_p, v_p = image[..., 0] / image[..., 2], image[..., 1] / image[..., 2]
        found = triangulate(rig, u_p, sigmas(), v_p, sigmas())
        assert (np.isfinite(found.depth) == seen).all()


def test_frames_of_another_camera_are_refused() -> None:
    rig = rig_of(MILD)
    view = view_of(rig)
    with pytest.raises(TriangulationError, match=r"x_p is \(60, 80\) px.*120 rows × 160 columns"):
        triangulate(rig, view.x_p[::2, ::2], sigmas()[::2, ::2])
    with pytest.raises(TriangulationError, match="sigma_y is missing"):
        triangulate(rig, view.x_p, sigmas(), view.y_p)
    with pytest.raises(TriangulationError, match="neither"):
        triangulate(rig, None, None)


@pytest.mark.parametrize("distortions", [MILD, (FULL, FULL)], ids=["mild", "full"])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_epipolar_curve_crosses_where_opencv_projects_its_points(distortions, axis):
    rig = rig_of(distortions)
    view = view_of(rig)
    pixels = np.arange(SIZE[0] * SIZE[1])
    along, across = (view.x_p, view.y_p) if axis == "x" else (view.y_p, view.x_p)
    u = np.stack([along.ravel(), along.ravel() + 0.5])
    other, slope = epipolar_crossings(rig, pixels, u, axis)
    # Half a pixel along the curve may leave what the lens models reach, for few.
    ok = np.isfinite(other).all(axis=0)
    assert ok.mean() > 0.95
    assert np.abs(other[0] - across.ravel())[ok].max() < 1e-3
    # The curve bends by less than that over half a pixel.
    assert np.abs((other[1] - other[0]) / 0.5 - slope[0])[ok].max() < 2e-2
    unknown = np.full((1, pixels.size), np.nan)
    assert np.isnan(epipolar_crossings(rig, pixels, unknown, axis)[0]).all()
