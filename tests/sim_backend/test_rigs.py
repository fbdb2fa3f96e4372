"""Lenses and poses of the simulated bench against OpenCV's model and plain geometry."""

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from sim_backend.settings import CameraSettings, ProjectorSettings, SimulatedSettings

FULL = {
    "distortion_k1": -0.12,
    "distortion_k2": 0.08,
    "distortion_p1": 1.5e-3,
    "distortion_p2": -1e-3,
    "distortion_k3": -0.03,
    "principal_offset_px": [12.5, -7.25],
}


def test_a_lens_is_that_of_opencv():
    settings = CameraSettings(width_px=640, height_px=480, field_of_view_deg=40.0, **FULL)
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-0.3, 0.3, (200, 2)), np.ones(200))) * rng.uniform(300, 900, (200, 1))
    focal = 320 / np.tan(np.radians(20))
    matrix = np.array([[focal, 0, 319.5 + 12.5], [0, focal, 239.5 - 7.25], [0, 0, 1]])
    terms = np.array([FULL[f"distortion_{name}"] for name in ("k1", "k2", "p1", "p2", "k3")])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, terms)
    np.testing.assert_allclose(settings.lens().project(points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "field_of_view_deg", "terms"),
    [
        (CameraSettings, 80.0, {"distortion_k1": -0.3}),
        (CameraSettings, 70.0, {"distortion_k1": 0.1, "distortion_k2": -0.6}),
        (ProjectorSettings, 50.0, {"distortion_k3": -2.0, "principal_offset_px": [500.0, 0.0]}),
    ],
)
def test_a_lens_that_folds_back_within_its_picture_is_refused(settings, field_of_view_deg, terms):
    fine = settings(field_of_view_deg=25.0, **(terms | {"principal_offset_px": [0.0, 0.0]}))
    assert np.isfinite(fine.lens().pixel_rays()).all()
    with pytest.raises(ValidationError, match="folds back"):
        settings(field_of_view_deg=field_of_view_deg, **terms)


def test_the_projector_stands_where_the_settings_say():
    settings = SimulatedSettings(
        baseline_mm=160.0, convergence_mm=620.0, projector_height_mm=45.0, projector_roll_deg=7.0
    )
    rig = settings.rig()
    np.testing.assert_allclose(rig.projector_centre_cam, [-160, -45, 0], atol=1e-9)
    np.testing.assert_allclose(rig.rotation @ rig.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rig.rotation) == pytest.approx(1)
    target = np.array([0.0, 0.0, 620.0])
    np.testing.assert_allclose(rig.projector.project(rig.to_projector_frame(target)), [639.5, 399.5], atol=1e-6)
    # Its picture turns about its middle, clockwise for the camera beside it: what was to the right goes down.
    unrolled = settings.model_copy(update={"projector_roll_deg": 0.0}).rig()
    point = unrolled.projector_centre_cam + unrolled.rotation.T @ [50.0, 0.0, 640.0]
    x, y = rig.projector.project(rig.to_projector_frame(point)) - [639.5, 399.5]
    focal = rig.projector.matrix[0, 0]
    np.testing.assert_allclose(
        [x, y], 50 / 640 * focal * np.array([np.cos(0.12217305), -np.sin(0.12217305)]), atol=1e-4
    )
    # Unrolled, its rows stay level.
    assert unrolled.rotation[0, 1] == pytest.approx(0, abs=1e-15)


def test_every_part_of_a_general_rig_is_in_the_light(truth):
    changes = {
        "camera": FULL | {"principal_offset_px": [2.0, 5.0]},
        "projector": FULL | {"distortion_k1": 0.06},
        "projector_height_mm": -30.0,
        "projector_roll_deg": -4.0,
        "transport": {"supersample": 1},
    }
    found = truth(scene={"name": "plane"}, **changes)
    lit = np.isfinite(found.x_p)
    assert lit.mean() > 0.3
    camera = found.rig.camera
    px = np.argwhere(lit)[:, ::-1].astype(np.float64)
    # The points lie on the camera's rays, and the projector sees them where the truth says, both by OpenCV.
    again, _ = cv2.projectPoints(found.points[lit], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    np.testing.assert_allclose(again[:, 0], px, atol=1e-3)
    turn, _ = cv2.Rodrigues(found.rig.rotation)
    projector = found.rig.projector
    expected, _ = cv2.projectPoints(
        found.points[lit], turn, found.rig.translation, projector.matrix, projector.distortion
    )
    np.testing.assert_allclose(np.stack((found.x_p[lit], found.y_p[lit]), 1), expected[:, 0], atol=1e-3)
