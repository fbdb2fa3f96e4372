"""Sets of poses that make no rig, and what is said of them; good sets, of which nothing is said."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_boards import (
    CAMERA_SIZE,
    PROJECTOR_SIZE,
    TILTS,
    Held,
    board_points,
    good_poses,
    held,
    random_rig,
    seen_all,
)

from calibration.bundle import calibrate_rig
from calibration.diagnosis import Expectation, Fringes
from calibration.observations import PoseObservation
from calibration.solver.refusal import CalibrationError
from calibration.solver.result import Calibration
from calibration.solver.selection import Terms
from scanner.rig import Rig

ALL = Terms(("k1", "k2", "p1p2"), ("k1", "k2", "p1p2"))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(77)


@pytest.fixture
def rig(rng: np.random.Generator) -> Rig:
    return random_rig(rng)


@pytest.fixture
def good(rig: Rig, rng: np.random.Generator) -> list[PoseObservation]:
    return seen_all(rig, good_poses(rng), rng)


def calibrated(observations: list[PoseObservation], **how) -> Calibration:
    return calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, **{"terms": ALL} | how)


def codes(found: Calibration | CalibrationError, refusing: bool | None = None) -> set[str]:
    return {finding.code for finding in found.findings if refusing is None or finding.refuses == refusing}


def refused(observations: list[PoseObservation]) -> CalibrationError:
    with pytest.raises(CalibrationError) as caught:
        calibrated(observations)
    assert all(finding.what and finding.remedy for finding in caught.value.findings)
    return caught.value


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_said_of_good_sets(seed):
    rng = np.random.default_rng(1000 + seed)
    rig = random_rig(rng)
    baseline = float(np.linalg.norm(rig.translation))
    found = calibrated(
        seen_all(rig, good_poses(rng), rng), expected=Expectation(baseline * 1.04), fringes=Fringes(1 / 16, 1 / 16, 12)
    )
    assert found.findings == ()


def test_five_near_frontal_views(rig, rng):
    poses = [held(*rng.normal(0, 1.5, 3), rng.uniform(560, 640), *rng.uniform(-20, 20, 2)) for _ in range(5)]
    found = calibrated(seen_all(rig, poses, rng))
    assert "too_few_tilts" in codes(found, refusing=True)
    assert not found.usable


def test_frontal_views_at_one_depth(rig, rng):
    poses = [held(0, 0, rng.normal(0, 10), 600, *rng.uniform(-25, 25, 2)) for _ in range(8)]
    found = calibrated(seen_all(rig, poses, rng), terms=Terms())
    assert {"too_few_tilts", "focal_undetermined"} <= codes(found, refusing=True)
    assert "one_depth" in codes(found)


def test_tilted_boards_at_one_depth(rig, rng):
    poses = [
        held(yaw + rng.normal(0, 3), pitch, rng.normal(0, 8), 600, *rng.uniform(-25, 25, 2)) for yaw, pitch in TILTS
    ]
    found = calibrated(seen_all(rig, poses, rng))
    assert "one_depth" in codes(found)
    assert found.usable


def test_tilts_about_one_axis_only(rig, rng):
    poses = [held(yaw, 0, rng.normal(0, 8), rng.uniform(550, 650)) for yaw in (-30, -20, -10, 10, 20, 30)]
    assert "too_few_tilts" in codes(calibrated(seen_all(rig, poses, rng)), refusing=False)


def test_one_pose_repeated(rig, rng):
    found = calibrated(seen_all(rig, [held(20, 10)] * 8, rng), terms=Terms())
    assert {"repeated_pose", "too_few_poses"} <= codes(found, refusing=True)


def test_some_poses_repeated(rig, rng):
    poses = good_poses(rng, 7)
    found = calibrated(seen_all(rig, [*poses, poses[2]], rng))
    assert codes(found) >= {"repeated_pose"}
    assert found.usable


def test_too_few_poses(good):
    assert "too_few_poses" in codes(refused(good[:2]), refusing=True)
    assert "too_few_poses" in codes(calibrated(good[:4]), refusing=False)


def mislabelled(o: PoseObservation, rng: np.random.Generator) -> PoseObservation:
    order = np.arange(len(o.ids))
    half = rng.permutation(len(order))[: len(order) // 2]
    order[half] = rng.permutation(half)
    return replace(o, ids=o.ids[order], points_board=o.points_board[order])


def test_half_of_the_corners_mislabelled(good, rng):
    error = refused([mislabelled(o, rng) for o in good])
    assert "mislabelled_points" in codes(error, refusing=True)


def test_half_of_the_corners_of_one_pose_mislabelled(good, rng):
    found = calibrated([mislabelled(good[0], rng), *good[1:]])
    assert "mislabelled_points" in codes(found, refusing=False)
    assert found.dropped == ("pose 1",)
    assert found.usable


def test_labels_shifted_by_a_square_in_half_of_the_board(good):
    def shifted(o: PoseObservation) -> PoseObservation:
        return replace(o, points_board=o.points_board + (o.points_board[:, :1] > 0) * [18.0, 0, 0])

    assert "mislabelled_points" in codes(refused([shifted(o) for o in good]), refusing=True)


def test_swapped_axes(good):
    assert "swapped_axes" in codes(refused([replace(o, projector=o.projector[:, ::-1]) for o in good]), refusing=True)


def test_a_mirrored_axis(good):
    mirrored = [replace(o, projector=o.projector * [-1, 1] + [PROJECTOR_SIZE[0] - 1, 0]) for o in good]
    assert "mirrored_axes" in codes(refused(mirrored), refusing=True)


def test_swapped_single_axis(good):
    rows_as_columns = [
        replace(o, projector=np.column_stack([o.projector[:, 1], np.full(len(o.ids), np.nan)])) for o in good
    ]
    assert "swapped_axes" in codes(calibrated(rows_as_columns, terms=Terms(("k1",), ("k1",))), refusing=True)


def test_wrong_square_size(good, rig):
    told = Expectation(baseline_mm=float(np.linalg.norm(rig.translation)))
    small = [replace(o, points_board=o.points_board * 15 / 18) for o in good]
    found = calibrated(small, expected=told)
    assert "wrong_scale" in codes(found, refusing=True)
    assert "1.2" in next(finding.what for finding in found.findings if finding.code == "wrong_scale")
    told = Expectation(distance_mm=float(np.linalg.norm(calibrated(good).poses[0].translation)))
    assert "wrong_scale" in codes(calibrated(small, expected=told), refusing=True)
    assert "scale_not_checked" in codes(calibrated(small), refusing=False)


@pytest.mark.parametrize("stretch", [1.005, 1.1])
def test_a_board_that_is_not_square(rig, rng, stretch):
    points = board_points(square_mm=15)
    observations = seen_all(rig, good_poses(rng, 6), rng, points=points, real_points=points * [1, stretch, 1])
    found = calibrated(observations)
    assert "wrong_board" in codes(found, refusing=True)
    what = next(finding.what for finding in found.findings if finding.code == "wrong_board")
    assert f"{100 * stretch:.1f}"[:4] in what


def test_a_pose_during_which_the_board_moved(good):
    moved = [*good[:3], replace(good[3], projector=good[3].projector + np.array([1.5, 0.8])), *good[4:]]
    found = calibrated(moved)
    assert found.dropped == ("pose 4",)
    assert "poses_disagree" in codes(found, refusing=False)
    assert found.scale_projector < 1.1


def test_residuals_that_follow_the_fringes(good):
    """A ripple of 0.05 px three times per fringe, as the second harmonic makes with three steps."""
    rippled = [replace(o, projector=o.projector + 0.05 * np.sin(2 * np.pi * 3 / 16 * o.projector)) for o in good]
    found = calibrated(rippled, fringes=Fringes(1 / 16, 1 / 16, 3))
    assert "fringe_residuals" in codes(found)
    what = next(finding.what for finding in found.findings if finding.code == "fringe_residuals")
    assert "along x 3× per fringe with 0.0" in what
    assert "along y 3× per fringe with 0.0" in what


def test_noise_that_is_stated_too_small(good):
    found = calibrated([replace(o, projector_sigma=o.projector_sigma / 3) for o in good])
    assert "noise_underestimated" in codes(found, refusing=False)
    assert found.scale_projector == pytest.approx(3, rel=0.05)


def test_boards_in_the_middle_only(rig, rng):
    poses = [Held(p.rotation, np.array([0, 0, p.translation[2]])) for p in good_poses(rng, 6)]
    found = calibrated(seen_all(rig, poses, rng, points=board_points(7, 5, 10)))
    assert "coverage" in codes(found, refusing=False)
