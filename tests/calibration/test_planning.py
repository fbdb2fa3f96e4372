"""Where to hold the board next: judged by what the pose then does to the uncertainties."""

import numpy as np
import pytest
from synthetic_boards import CAMERA_SIZE, PROJECTOR_SIZE, Held, board_points, held, random_rig, seen_all

from calibration.bundle import calibrate_rig
from calibration.observations import BoardPose
from calibration.planning import coverage, placed, pose_of
from calibration.planning.suggestion import first_poses, next_pose, visible
from calibration.solver.selection import Terms
from scanner.rig import Lens
from sim_backend.scenes import PlaneScene

TERMS = Terms(("k1",), ("k1",))


def test_poses_are_those_of_the_simulated_bench():
    pose = BoardPose(640, 12, -7, yaw_deg=25, pitch_deg=-18)
    R, t = placed(pose)
    scene = PlaneScene(distance_mm=640, offset_x_mm=12, offset_y_mm=-7, yaw_deg=25, pitch_deg=-18)
    for point in ((0, 0, 0), (30, 0, 0), (0, 40, 0), (5, 6, 7)):
        np.testing.assert_allclose(R @ point + t, scene.placed(point), atol=1e-9)


def test_pose_of_is_the_inverse():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = BoardPose(600, *rng.uniform(-90, 90, 2), *rng.uniform(-80, 80, 2), rng.uniform(-170, 170))
        back = pose_of(*placed(pose))
        np.testing.assert_allclose(list(vars(back).values()), list(vars(pose).values()), atol=1e-9)


@pytest.fixture(scope="module")
def begun():
    rng = np.random.default_rng(21)
    rig = random_rig(rng)
    poses = [held(3, 2, 0, 600), held(-4, 3, 5, 640), held(2, -5, -4, 580), held(12, -3, 2, 610)]
    return rig, poses, calibrate_rig(seen_all(rig, poses, rng), CAMERA_SIZE, PROJECTOR_SIZE, terms=TERMS)


def uncertainty(rig, poses, pose) -> tuple[float, float]:
    """Standard uncertainties of the camera's focal length and of the baseline with one more pose."""
    rng = np.random.default_rng(22)
    more = [*poses, Held(*placed(pose))]
    found = calibrate_rig(seen_all(rig, more, rng), CAMERA_SIZE, PROJECTOR_SIZE, terms=TERMS)
    return found.value("camera.fx")[1], found.baseline[1]


def test_the_suggested_pose_helps_more_than_others(begun):
    rig, poses, found = begun
    suggestion = next_pose(found, board_points())
    assert suggestion is not None
    assert 0 < suggestion.gain < 1
    best = uncertainty(rig, poses, suggestion.pose)
    before = found.value("camera.fx")[1], found.baseline[1]
    for other in (BoardPose(600), BoardPose(610, 5, 5, yaw_deg=10), BoardPose(600, pitch_deg=12)):
        assert uncertainty(rig, poses, other)[0] > best[0]
    # Nothing but tilted boards was missing: one of them halves the uncertainty at least.
    assert best[0] < before[0] / 2
    assert max(abs(suggestion.pose.yaw_deg), abs(suggestion.pose.pitch_deg)) > 20
    assert "towards the camera" in suggestion.reason


def test_only_poses_that_both_see_are_suggested(begun):
    rig, _, found = begun
    suggestion = next_pose(found, board_points())
    assert suggestion is not None
    X = board_points() @ placed(suggestion.pose)[0].T + placed(suggestion.pose)[1]
    for pixels, size in (
        (rig.camera.project(X), CAMERA_SIZE),
        (rig.projector.project(rig.to_projector_frame(X)), PROJECTOR_SIZE),
    ):
        assert np.all((pixels > 0) & (pixels < np.array(size) - 1))
    assert next_pose(found, board_points(), [BoardPose(600, offset_x_mm=400), BoardPose(150)]) is None


@pytest.mark.parametrize(
    ("pose", "told"),
    [
        (BoardPose(600, yaw_deg=30), "tilt the right edge towards the camera"),
        (BoardPose(600, yaw_deg=-30), "tilt the left edge towards the camera"),
        (BoardPose(600, pitch_deg=30), "tilt the top edge towards the camera"),
        (BoardPose(600, pitch_deg=-30), "tilt the bottom edge towards the camera"),
        (BoardPose(510), "nearer"),
        (BoardPose(700), "further away"),
        (BoardPose(650, -30, -25), "upper left"),
    ],
)
def test_the_reason_says_which_edge_comes_nearer(begun, pose, told):
    _, _, found = begun
    small = board_points(7, 5, 15)
    suggestion = next_pose(found, small, [pose])
    assert suggestion is not None
    assert told in suggestion.reason
    if "edge" in told:
        edges = {"right": [50, 0, 0], "left": [-50, 0, 0], "top": [0, -50, 0], "bottom": [0, 50, 0]}
        depth = {name: (placed(pose)[0] @ point)[2] for name, point in edges.items()}
        assert min(depth, key=lambda name: depth[name]) in told


def test_first_poses_make_a_calibration():
    rng = np.random.default_rng(23)
    rig = random_rig(rng)
    guess = Lens([[1900, 0, 511.5], [0, 1900, 383.5], [0, 0, 1]], [], CAMERA_SIZE)
    poses = first_poses(guess, board_points(), rig)
    assert len(poses) >= 5
    assert all(visible(pose, board_points(), guess, rig) for pose in poses)
    found = calibrate_rig(
        seen_all(rig, [Held(*placed(pose)) for pose in poses], rng), CAMERA_SIZE, PROJECTOR_SIZE, terms=TERMS
    )
    assert found.usable
    assert found.value("camera.fx")[1] < 1e-3 * found.value("camera.fx")[0]


def test_coverage_counts_poses():
    rng = np.random.default_rng(24)
    rig = random_rig(rng, distortion=False)
    left, right = held(0, 0, 0, 600, -40), held(0, 0, 0, 600, 40)
    counts = coverage(seen_all(rig, [left, right, right], rng, points=board_points(7, 5, 12)), CAMERA_SIZE)
    assert counts.shape == (9, 12)
    assert counts[4, 4] in (1, 3)
    assert counts.max() <= 3
    assert counts[:, 7:].sum() > 1.5 * counts[:, :5].sum()
    assert counts[0].sum() == 0
