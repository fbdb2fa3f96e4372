"""Camera, projector and board poses from synthetic observations, against the truth that made them and OpenCV."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic_boards import (
    CAMERA_SIZE,
    CORNER_SIGMA,
    PROJECTOR_SIZE,
    board_points,
    good_poses,
    random_rig,
    seen_all,
)

from calibration.bundle import calibrate_rig
from calibration.export import export_opencv
from calibration.solver.adjustment import adjusted
from calibration.solver.measurements import gathered
from calibration.solver.model import Model
from calibration.solver.parameters import DISTORTION, NAMES, State
from calibration.solver.projection import linearised, predicted
from calibration.solver.result import Calibration
from calibration.solver.selection import Terms
from scanner.rig import Lens, Rig, RigError

RIGS = 6
ALL = Terms(("k1", "k2", "p1p2"), ("k1", "k2", "p1p2"))


def truth(rig: Rig) -> dict[str, float]:
    out = {}
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        K = lens.matrix
        out |= {f"{name}.fx": K[0, 0], f"{name}.fy": K[1, 1], f"{name}.cx": K[0, 2], f"{name}.cy": K[1, 2]}
        out |= {
            f"{name}.{term}": value for term, value in zip(DISTORTION, np.pad(lens.distortion, (0, 10)), strict=True)
        }
    return out | {f"translation.{axis}": value for axis, value in zip("xyz", rig.translation, strict=True)}


def in_sigmas(found: Calibration, rig: Rig) -> dict[str, float]:
    """Errors of all parameters over their standard uncertainties."""
    true = truth(rig)
    out = {n: (found.value(n)[0] - true[n]) / found.value(n)[1] for n in found.names if n in true}
    turn = cv2.Rodrigues(found.rig.rotation @ rig.rotation.T)[0][:, 0]
    out |= {f"rotation.{axis}": turn[i] / found.value(f"rotation.{axis}")[1] for i, axis in enumerate("xyz")}
    out["baseline"] = (found.baseline[0] - np.linalg.norm(rig.translation)) / found.baseline[1]
    return out


@pytest.fixture(scope="module")
def random_rigs() -> list[tuple[Rig, Calibration]]:
    pairs = []
    for seed in range(RIGS):
        rng = np.random.default_rng(seed)
        rig = random_rig(rng)
        pairs.append((rig, calibrate_rig(seen_all(rig, good_poses(rng), rng), CAMERA_SIZE, PROJECTOR_SIZE)))
    return pairs


def test_focal_lengths_and_baseline_of_ten_poses(random_rigs):
    for rig, found in random_rigs:
        assert found.usable
        camera = np.diag(found.rig.camera.matrix)[:2] / np.diag(rig.camera.matrix)[:2]
        projector = np.diag(found.rig.projector.matrix)[:2] / np.diag(rig.projector.matrix)[:2]
        assert np.abs(camera - 1).max() < 3e-4
        assert np.abs(projector - 1).max() < 6e-4
        assert found.baseline[0] == pytest.approx(np.linalg.norm(rig.translation), rel=2e-4)


def test_reprojection_errors_are_those_of_the_noise(random_rigs):
    for _, found in random_rigs:
        assert found.rms_camera == pytest.approx(found.expected_camera, rel=0.15)
        assert found.rms_projector == pytest.approx(found.expected_projector, rel=0.15)
        # √2 σ per point, less what the parameters take up.
        assert 0.9 * np.sqrt(2) * CORNER_SIGMA < found.expected_camera < np.sqrt(2) * CORNER_SIGMA


def test_true_values_lie_in_the_intervals(random_rigs):
    errors = [in_sigmas(found, rig) for rig, found in random_rigs]
    inside = np.concatenate([[abs(z) < 1.959964 for z in error.values()] for error in errors])
    assert inside.mean() > 0.90
    # Intervals that are right because they are far too wide would show here.
    focal = [error[f"{lens}.fx"] for error in errors for lens in ("camera", "projector")]
    assert 0.5 < np.sqrt(np.mean(np.square(focal))) < 1.5


def test_coordinates_read_at_the_camera_s_points():
    """Their common error is no error of the rig: uncertainties are smaller than with errors apart, and true."""
    rng = np.random.default_rng(21)
    rig = random_rig(rng)
    poses = good_poses(rng, 6)
    noise = {"corner_sigma": 0.05, "column_sigma": 0.01}
    start = calibrate_rig(seen_all(rig, poses, rng, read_there=True, **noise), CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL)
    assert start.rms_projector == pytest.approx(start.expected_projector, rel=0.1)
    assert start.rms_projector > 4 * np.sqrt(2) * noise["column_sigma"]
    assert start.scale_projector == pytest.approx(1, abs=0.1)
    total = np.hypot(noise["column_sigma"], 1.3 * noise["corner_sigma"])
    apart = calibrate_rig(
        seen_all(rig, poses, rng, corner_sigma=0.05, column_sigma=total), CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL
    )
    free = Model(start.adjusted.state, (True, True), CAMERA_SIZE, PROJECTOR_SIZE).freedom(ALL)
    fits = [
        adjusted(
            start.adjusted.state, gathered(seen_all(rig, poses, rng, read_there=True, **noise)), free, np.ones(2)
        ).state.values
        for _ in range(30)
    ]
    ratio = np.std(fits, axis=0, ddof=1) @ np.abs(free.spread) / start.standard_uncertainty
    chosen = [not name.startswith("rotation") for name in start.names]
    # σ of a standard deviation of 30: 13 %.
    assert np.all((ratio[chosen] > 0.55) & (ratio[chosen] < 1.5))
    assert ratio[chosen].mean() == pytest.approx(1, abs=0.15)
    assert start.value("camera.fx")[1] < 0.85 * apart.value("camera.fx")[1]


@pytest.mark.parametrize("read_there", [False, True])
def test_derivatives_are_those_of_finite_differences(read_there):
    rng = np.random.default_rng(4)
    rig = random_rig(rng)
    data = gathered(seen_all(rig, good_poses(rng, 3), rng, read_there=read_there))
    values = np.concatenate(
        [
            *([lens.matrix[0, 0], lens.matrix[1, 1], *lens.matrix[:2, 2], *rng.normal(0, 0.02, 14)]
              for lens in (rig.camera, rig.projector)),
            cv2.Rodrigues(rig.rotation)[0][:, 0],
            rig.translation,
            [1.3, -0.8, 0.4, 0.01],
        ]
    )  # fmt: skip
    poses = good_poses(np.random.default_rng(5), 3)
    board = rng.normal(0, 0.1, (data.board_size, 3))
    state = State(values, np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses]), board)
    _, by_globals, by_pose, by_point = linearised(state, data)
    still = np.zeros((3, 6))
    for i, name in enumerate(NAMES):
        step = np.zeros(len(NAMES))
        step[i] = 1e-3 if abs(values[i]) > 10 else 1e-6
        ahead, behind = (predicted(state.moved(sign * step, still), data) for sign in (1, -1))
        numeric = (ahead - behind) / (2 * step[i])
        np.testing.assert_allclose(by_globals[..., i], numeric, atol=2e-6 * max(1, np.abs(numeric).max()), err_msg=name)
    for i in range(6):
        steps = np.zeros((3, 6))
        steps[:, i] = 1e-6 if i < 3 else 1e-3
        ahead, behind = (predicted(state.moved(np.zeros(len(NAMES)), sign * steps), data) for sign in (1, -1))
        numeric = (ahead - behind) / (2 * steps[0, i])
        np.testing.assert_allclose(by_pose[..., i], numeric, atol=2e-6 * np.abs(numeric).max())
    for i in range(3):
        steps = np.zeros((data.board_size, 3))
        steps[:, i] = 1e-3
        ahead, behind = (predicted(state.moved(np.zeros(len(NAMES)), still, sign * steps), data) for sign in (1, -1))
        numeric = (ahead - behind) / 2e-3
        np.testing.assert_allclose(by_point[..., i], numeric, atol=2e-6 * np.abs(numeric).max())


def test_the_optimum_is_opencvs():
    rng = np.random.default_rng(9)
    rig = random_rig(rng)
    # OpenCV weighs all px alike.
    observations = seen_all(rig, good_poses(rng, 6), rng, corner_sigma=0.03, column_sigma=0.03)
    ours = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL)
    points = [o.points_board.astype(np.float32) for o in observations]
    camera = [o.camera.astype(np.float32) for o in observations]
    projector = [o.projector.astype(np.float32) for o in observations]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    start = ours.rig
    rms, K1, D1, K2, _, _, T, *_ = cv2.stereoCalibrate(
        points, camera, projector,
        start.camera.matrix.copy(), np.append(start.camera.distortion, 0.0),
        start.projector.matrix.copy(), np.append(start.projector.distortion, 0.0), CAMERA_SIZE,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3, criteria=criteria,
    )  # fmt: skip
    sigma = {name: ours.value(name)[1] for name in ours.names}
    # Huber's weights (of one point in a hundred) and OpenCV's float32 points move the optimum by a part of σ.
    assert K1[0, 0] == pytest.approx(ours.rig.camera.matrix[0, 0], abs=0.3 * sigma["camera.fx"])
    assert K2[1, 1] == pytest.approx(ours.rig.projector.matrix[1, 1], abs=0.3 * sigma["projector.fy"])
    assert D1.ravel()[0] == pytest.approx(ours.rig.camera.distortion[0], abs=0.3 * sigma["camera.k1"])
    for axis, name in enumerate("xyz"):
        assert T.ravel()[axis] == pytest.approx(ours.rig.translation[axis], abs=0.3 * sigma[f"translation.{name}"])
    assert ours.rms_stereo == pytest.approx(rms, rel=0.01)


def test_information_takes_the_terms_there_are():
    rng = np.random.default_rng(3)
    rig = random_rig(rng)
    plain = replace(rig, camera=Lens(rig.camera.matrix, [-0.1, 0, 0, 0], CAMERA_SIZE),
                    projector=Lens(rig.projector.matrix, [], PROJECTOR_SIZE))  # fmt: skip
    found = calibrate_rig(seen_all(plain, good_poses(rng), rng), CAMERA_SIZE, PROJECTOR_SIZE)
    assert found.terms == Terms(("k1",), ())
    tried = {(trial.lens, trial.group) for trial in found.table if not trial.taken}
    assert {("camera", "p1p2"), ("camera", "k2"), ("projector", "k1"), ("projector", "p1p2")} <= tried


@pytest.mark.parametrize("axis", ["x", "y"])
def test_one_axis(axis):
    rng = np.random.default_rng(6)
    rig = random_rig(rng)
    found = calibrate_rig(seen_all(rig, good_poses(rng), rng, axes=axis), CAMERA_SIZE, PROJECTOR_SIZE)
    assert found.usable
    assert "single_axis" in {finding.code for finding in found.findings}
    i = "xy".index(axis)
    name = f"projector.f{axis}"
    focal = rig.projector.matrix[i, i]
    assert found.value(name)[0] == pytest.approx(focal, abs=4 * found.value(name)[1])
    assert found.value(name)[1] < 1e-3 * focal
    # What one axis sees: the column (row) of a camera pixel at a depth.
    X = np.array([0, 0, 610.0]) + board_points() * 0.8
    pixels = rig.camera.project(X)
    seen = found.rig.epipolar_curve(pixels, X[:, 2])[:, i]
    assert np.abs(seen - rig.epipolar_curve(pixels, X[:, 2])[:, i]).max() < 0.15


def test_a_bent_board_is_straightened():
    rng = np.random.default_rng(7)
    rig = random_rig(rng)
    flat = board_points()
    bent = flat.copy()
    half = np.ptp(flat[:, 0]) / 2
    bent[:, 2] = 0.4 * (flat[:, 0] / half) ** 2 - 0.2 * (flat[:, 1] / half) ** 2
    observations = seen_all(rig, good_poses(rng), rng, real_points=bent)
    straightened = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, bend=True, terms=ALL)
    assert straightened.value("board.bend_xx")[0] == pytest.approx(0.4, abs=4 * straightened.value("board.bend_xx")[1])
    assert straightened.value("board.bend_yy")[0] == pytest.approx(-0.2, abs=4 * straightened.value("board.bend_yy")[1])
    assert straightened.scale_camera < 1.1
    as_if_flat = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL)
    assert "noise_underestimated" in {finding.code for finding in as_if_flat.findings}


def test_a_print_that_is_neither_exact_nor_flat():
    rng = np.random.default_rng(14)
    rig = random_rig(rng)
    flat = board_points()
    printed = flat + rng.normal(0, 0.03, flat.shape)
    observations = seen_all(rig, good_poses(rng, 6), rng, real_points=printed)
    as_if_exact = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL)
    found = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL, board_sigma_mm=0.03)
    assert as_if_exact.scale_camera > 2
    assert found.scale_camera < 1.1
    # Up to where the board lies and how large it is, which nobody can see.
    off = found.adjusted.state.board - (printed - flat)
    shifts = [np.tile(axis, (len(flat), 1)) for axis in np.eye(3)]
    turns = [np.cross(axis, flat) for axis in np.eye(3)]
    gauge = np.stack([free.ravel() for free in (*shifts, *turns, flat)], axis=1)
    rest = off.ravel() - gauge @ np.linalg.lstsq(gauge, off.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(rest**2)) < 0.012
    for name, lens in (("camera.fx", rig.camera), ("projector.fx", rig.projector)):
        value, sigma = found.value(name)
        assert abs(value - lens.matrix[0, 0]) < 4 * sigma < 2e-3 * value


def test_strangers_do_not_move_the_rig():
    rng = np.random.default_rng(8)
    rig = random_rig(rng)
    observations = seen_all(rig, good_poses(rng), rng)
    for o in observations:
        wrong = rng.choice(len(o.ids), 4, replace=False)
        o.camera[wrong] += rng.normal(0, 1.0, (4, 2))
        o.projector[wrong[:2]] += rng.normal(0, 0.5, (2, 2))
    found = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL)
    assert found.usable
    assert found.rig.camera.matrix[0, 0] == pytest.approx(rig.camera.matrix[0, 0], rel=4e-4)
    assert found.baseline[0] == pytest.approx(np.linalg.norm(rig.translation), rel=3e-4)


def test_stated_noise_that_is_too_small_widens_the_intervals():
    rng = np.random.default_rng(10)
    rig = random_rig(rng)
    observations = seen_all(rig, good_poses(rng), rng)
    boast = [replace(o, camera_sigma=o.camera_sigma / 4) for o in observations]
    honest, found = (calibrate_rig(o, CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL) for o in (observations, boast))
    assert found.scale_camera == pytest.approx(4, rel=0.05)
    assert found.scale_projector == pytest.approx(1, rel=0.05)
    assert found.value("camera.fx")[1] == pytest.approx(honest.value("camera.fx")[1], rel=0.1)


def test_the_first_estimate_needs_no_guess():
    rng = np.random.default_rng(11)
    for focal in (700.0, 6000.0):
        rig = random_rig(rng, distortion=False)
        matrix = rig.camera.matrix.copy()
        matrix[0, 0] = matrix[1, 1] = focal
        rig = replace(rig, camera=Lens(matrix, [], CAMERA_SIZE))
        scale = 60 if focal > 5000 else 240
        points = board_points(9, 7, scale / 12)
        observations = seen_all(rig, good_poses(rng, 6), rng, points=points)
        found = calibrate_rig(observations, CAMERA_SIZE, PROJECTOR_SIZE, terms=Terms())
        assert found.value("camera.fx")[0] == pytest.approx(focal, abs=4 * found.value("camera.fx")[1])


def test_the_rig_carries_its_calibration_and_exports(tmp_path, random_rigs):
    _, found = random_rigs[0]
    found.rig.save(tmp_path / "rig.json")
    notes = Rig.load(tmp_path / "rig.json").metadata["calibration"]
    assert notes["parameters"] == list(found.names)
    np.testing.assert_array_equal(notes["covariance"], found.covariance)
    assert notes["poses"] == [f"pose {i}" for i in range(1, 11)]
    for name in ("rig.yml", "rig.xml", "rig.json.gz"):
        export_opencv(found.rig, tmp_path / name)
        back = Rig.load(tmp_path / name)
        for lens in ("camera", "projector"):
            ours, theirs = getattr(found.rig, lens), getattr(back, lens)
            np.testing.assert_array_equal(theirs.matrix, ours.matrix)
            np.testing.assert_array_equal(theirs.distortion, ours.distortion)
            assert theirs.size == ours.size
        np.testing.assert_array_equal(back.rotation, found.rig.rotation)
        np.testing.assert_array_equal(back.translation, found.rig.translation)
    with pytest.raises(RigError, match="cannot write"):
        export_opencv(found.rig, tmp_path / "nowhere" / "rig.yml")


def test_validity_is_kept():
    rng = np.random.default_rng(12)
    rig = random_rig(rng)
    found = calibrate_rig(
        seen_all(rig, good_poses(rng, 5), rng), CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL, validity={"temperature_c": 21.5}
    )
    assert found.rig.metadata["calibration"]["temperature_c"] == 21.5


def test_uncertainties_are_those_of_repetition():
    """Standard uncertainties against the scatter of repeated noise, the model given (no choice of terms)."""
    rng = np.random.default_rng(13)
    rig = random_rig(rng)
    poses = good_poses(rng, 6)
    start = calibrate_rig(seen_all(rig, poses, rng), CAMERA_SIZE, PROJECTOR_SIZE, terms=ALL)
    model = Model(start.adjusted.state, (True, True), CAMERA_SIZE, PROJECTOR_SIZE)
    free = model.freedom(ALL)
    fits = [
        adjusted(start.adjusted.state, gathered(seen_all(rig, poses, rng)), free, np.ones(2)).state.values
        for _ in range(40)
    ]
    scatter = np.std(fits, axis=0, ddof=1) @ np.abs(free.spread)
    ratio = scatter / start.standard_uncertainty
    # Rotations are kept as a vector, whose scatter is not that of small turns.
    chosen = [not name.startswith("rotation") for name in start.names]
    # σ of a standard deviation of 40: 11 %.
    assert np.all((ratio[chosen] > 0.6) & (ratio[chosen] < 1.45))
    assert ratio[chosen].mean() == pytest.approx(1, abs=0.12)
