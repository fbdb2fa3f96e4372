"""Geometry: the board in many poses, and the rig that explains them all."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np

from calibration.bundle import calibrate_rig
from calibration.capture import capture_fringes
from calibration.correspondence import observe
from calibration.detection import BoardNotFoundError, find_board
from calibration.diagnosis import Expectation, Fringes
from calibration.export import export_opencv
from calibration.folder import OPENCV_RIG, RIG
from calibration.guide.guidance import Step
from calibration.knowledge import known
from calibration.observations import BoardPose, PoseObservation
from calibration.operators import Answer, Request, stopped, wording
from calibration.planning import first_poses, grid, next_pose
from calibration.planning.glimpse import guessed_lens
from calibration.solver.refusal import CalibrationError
from calibration.solver.result import Calibration
from calibration.work import StepFailedError, Work
from drivers import Bench
from scanner.acquisition import AcquisitionError
from scanner.config import ScanSection
from scanner.preflight import ExposureError
from scanner.response import PROJECTOR_RESPONSE
from scanner.session import DISPLAY_LATENCY

STEP: Step = "geometry"

_BEGINNING = 4
"""Poses by a fixed scheme before the covariance of what is known chooses."""

_ROLL = 15.0
"""°, of a board that faces the camera: no edge runs along the pixels' rows."""

_PERIODS = (16.0, 80.0)
"""Fringes that are fine enough for a board's small squares, px; a third spans the projector."""


def run(work: Work) -> None:
    """Take the poses that are still missing, then solve and keep the rig.

    Raises
    ------
    StoppedError
        The operator has left; the poses so far are kept.
    StepFailedError
        No board was found again and again, or the rig is refused, with the reasons.
    """
    wanted = work.settings.geometry.poses
    while True:
        poses, camera_size, projector_size = _collected(work, wanted)
        try:
            _finish(work, poses, camera_size, projector_size)
        except StepFailedError as error:
            if not work.operator.again(STEP, error, "take another pose"):
                raise StepFailedError(
                    error.message,
                    f"{error.remedy}\nMore poses: --set calibration.geometry.poses={len(poses) + 2}; all of them anew: "
                    "--step geometry.",
                ) from error
            wanted = len(poses) + 1
        else:
            return


def _collected(work: Work, wanted: int) -> tuple[list[PoseObservation], tuple[int, int], tuple[int, int]]:
    """All poses, with those that were missing, and the sizes of both pictures."""
    misses = 0
    skipped: list[BoardPose] = []
    solved_for, calibration = -1, None
    with work.bench() as bench:
        sizes = _sizes(bench)
        while len(poses := work.folder.poses()) < wanted:
            if len(poses) != solved_for:
                solved_for, calibration = len(poses), _solved(poses, *sizes)
            request = _request(work, poses, wanted, calibration, sizes[0], skipped)
            answer = work.operator.hold_board(bench, work.board, request)
            if answer is Answer.STOP:
                raise stopped(f"stopped by the operator with {len(poses)} of {wanted} poses")
            if answer is Answer.SKIP:
                skipped.append(request.pose)
            elif answer is Answer.BACK and poses:
                work.folder.drop_pose(poses[-1].name)
                work.terminal.say([f"{poses[-1].name} is left out"])
                work.operator.tell(True, f"{poses[-1].name} is left out")
            elif answer is Answer.TAKE:
                taken = _take(work, bench, request)
                misses = 0 if taken else misses + 1
                if taken:
                    skipped.clear()
            if misses > wanted:
                raise StepFailedError(
                    f"geometry: {misses} poses in turn did not count",
                    "Look at the takes of these poses: is the whole board lit, still, and in the picture?",
                )
    return poses, *sizes


def fringes(work: Work, projector_size: tuple[int, int]) -> ScanSection:
    """What is projected on the board."""
    periods = {
        axis: [p for p in _PERIODS if p < extent] + [float(extent)]
        for axis, extent in zip(("x", "y"), projector_size, strict=True)
    }
    wanted = work.loaded.config.scan.model_dump(mode="json") | {
        "method": "tps",
        "steps": work.settings.geometry.steps,
        "frequencies_per_px": None,
        "exposures": [1],
        "max_regional_sequences": 1,
        "periods_px": {axis: periods[axis] for axis in work.loaded.config.scan.axes},
    }
    return ScanSection.model_validate_json(json.dumps(wanted))


def take_pose(work: Work, bench: Bench, name: str, **notes: object) -> PoseObservation:
    """Photograph fringes on the board as it is held, and find its points in camera and projector.

    Raises
    ------
    BoardNotFoundError, AcquisitionError, ExposureError
        The board is not seen, it moved, or it is too bright there.
    """
    scan = fringes(work, bench.projector_size)
    with work.listening(name) as listener:
        maps, noise = capture_fringes(
            bench, scan, work.response, work.folder.new_take(name), work.occasion(STEP, **notes), listener
        )
    # The mean of all fringes is a picture in steady light, with the noise of one over the root of their number.
    level = float(np.quantile(maps.brightness, 0.9))
    frames = scan.steps * sum(len(scan.frequencies(axis) or ()) for axis in scan.axes)
    view = find_board(maps.brightness, work.board, math.sqrt(float(noise.variance(level)) / frames))
    return observe(name, view, work.board, maps.x_p, maps.sigma_x, maps.y_p, maps.sigma_y, maps.modulation, maps.valid)


def _take(work: Work, bench: Bench, request: Request) -> bool:
    name = work.folder.next_pose()
    try:
        observation = take_pose(work, bench, name, asked=vars(request.pose))
    except (BoardNotFoundError, AcquisitionError, ExposureError) as error:
        work.terminal.note(f"{name} does not count: {error.message}. {error.remedy}")
        work.operator.tell(False, f"does not count: {error.message}")
        return False
    work.folder.add_pose(name, observation)
    seen = np.isfinite(observation.projector).any(axis=1).sum()
    work.terminal.say([f"{name}: {len(observation.ids)} points, {seen} of them in the projector's picture as well"])
    work.operator.tell(True, f"taken: {len(observation.ids)} points")
    return True


def _sizes(bench: Bench) -> tuple[tuple[int, int], tuple[int, int]]:
    fmt = bench.frame_format
    return (fmt.width, fmt.height), bench.projector_size


def _request(
    work: Work,
    poses: list[PoseObservation],
    wanted: int,
    calibration: Calibration | None,
    camera_size: tuple[int, int],
    skipped: list[BoardPose],
) -> Request:
    """The next pose, other than those that the operator would not hold."""
    settings = work.settings.geometry
    middle = (settings.nearest_mm + settings.farthest_mm) / 2
    facing = BoardPose(middle, roll_deg=_ROLL)
    bars, lens = ((), None) if calibration is None else (known(calibration), calibration.rig.camera)
    pose, reason = facing, ""
    if calibration is None or len(poses) < _BEGINNING:
        if poses:
            guess = guessed_lens(poses[0].points_board, poses[0].camera, middle, camera_size)
            scheme = [_within(work, p) for p in first_poses(guess, work.board.points)]
            left = [p for p in scheme[len(poses) :] + scheme if p not in skipped]
            pose = left[0] if left else facing
    else:
        pool = [_within(work, p) for p in grid(calibration.rig.camera, work.board.points, middle)]
        found = next_pose(calibration, work.board.points, [p for p in pool if p not in skipped])
        if found is not None:
            pose, reason = found.pose, f"lowers the uncertainty by {100 * found.gain:.0f} %"
    return Request(STEP, f"pose {len(poses) + 1} of {wanted}", wording(pose), pose, True, reason, bars, lens)


def _within(work: Work, pose: BoardPose) -> BoardPose:
    """The pose, brought into the range of distances and tilts that the bench file gives."""
    settings = work.settings.geometry
    distance = float(np.clip(pose.distance_mm, settings.nearest_mm, settings.farthest_mm))
    ratio = distance / pose.distance_mm
    tilt = max(abs(pose.yaw_deg), abs(pose.pitch_deg), 1e-9)
    turned = min(1.0, settings.tilt_deg / tilt)
    return replace(
        pose,
        distance_mm=distance,
        offset_x_mm=pose.offset_x_mm * ratio,
        offset_y_mm=pose.offset_y_mm * ratio,
        yaw_deg=pose.yaw_deg * turned,
        pitch_deg=pose.pitch_deg * turned,
    )


def _solved(
    poses: list[PoseObservation], camera_size: tuple[int, int], projector_size: tuple[int, int]
) -> Calibration | None:
    """The calibration of the poses so far; None where they do not make one yet."""
    if len(poses) < _BEGINNING:
        return None
    try:
        return calibrate_rig(poses, camera_size, projector_size)
    except CalibrationError:
        return None


def _finish(
    work: Work, poses: list[PoseObservation], camera_size: tuple[int, int], projector_size: tuple[int, int]
) -> None:
    settings = work.settings
    steps = settings.geometry.steps
    work.terminal.say([f"geometry: computing the rig from {len(poses)} poses"])
    work.operator.wait(f"computing the rig from {len(poses)} poses", 0, 0)
    try:
        found = calibrate_rig(
            poses,
            camera_size,
            projector_size,
            bend=settings.geometry.bend,
            board_sigma_mm=settings.geometry.board_sigma_mm,
            expected=Expectation(baseline_mm=settings.expected.baseline_mm, tolerance=settings.expected.tolerance),
            fringes=Fringes(1 / _PERIODS[0], 1 / _PERIODS[0], steps),
            validity={
                "board": work.board.name,
                "temperature_celsius": settings.temperature_celsius,
                "notes": settings.notes,
                "exposure": work.folder.finding("exposure"),
                "focus": work.folder.finding("focus"),
            },
        )
    except CalibrationError as error:
        raise StepFailedError.of(STEP, error.findings) from error
    rig = found.rig
    metadata = dict(rig.metadata)
    if work.latency is not None:
        metadata[DISPLAY_LATENCY] = work.latency.to_json()
    if work.response is not None:
        metadata[PROJECTOR_RESPONSE] = work.response.to_json()
    response = work.folder.finding("response")
    if response is not None:
        metadata["mtf"] = response["mtf"]
    rig = replace(rig, metadata=metadata)
    lines = [
        f"{len(poses) - len(found.dropped)} poses"
        + (f", {', '.join(found.dropped)} left out" if found.dropped else ""),
        f"reprojection error {found.rms_camera:.4f} px in the camera (expected {found.expected_camera:.4f}), "
        f"{found.rms_projector:.4f} px in the projector (expected {found.expected_projector:.4f})",
        *(_line(found, lens) for lens in ("camera", "projector")),
        f"baseline {found.baseline[0]:.3f} ± {found.baseline[1]:.3f} mm",
    ]
    if found.usable:
        rig.save(work.folder.path / RIG)
        export_opencv(rig, work.folder.path / OPENCV_RIG)
        lines.append(f"the rig is {work.folder.path / RIG}; name it in the bench file as `rig:`")
    rms = {"camera": found.rms_camera, "projector": found.rms_projector}
    work.report(STEP, {"rms_px": rms}, found.findings, lines, bars=known(found), large=" · ".join(lines[:2]))


def _line(found: Calibration, lens: str) -> str:
    focal, sigma = found.value(f"{lens}.fx")
    terms = getattr(found.terms, lens)
    return f"{lens}: focal length {focal:.2f} ± {sigma:.2f} px, distortion {', '.join(terms) or 'none'}"
