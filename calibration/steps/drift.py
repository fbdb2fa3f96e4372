"""Drift: does the stored rig still hold? One pose of the board tells."""

from __future__ import annotations

from pathlib import Path

from calibration.detection import BoardNotFoundError
from calibration.drift import check
from calibration.observations import BoardPose
from calibration.operators import Answer, Outcome, Request, StoppedError, wording
from calibration.steps.geometry import take_pose
from calibration.work import StepFailedError, Work
from scanner.rig import Rig

STEP = "check"


def run(work: Work, rig_path: Path) -> bool:
    """Take one pose of the board and judge the rig at ``rig_path`` by it; says whether it still holds.

    Raises
    ------
    StoppedError
        The operator has left.
    StepFailedError
        The board was not seen.
    """
    rig = Rig.load(rig_path)
    geometry = work.settings.geometry
    pose = BoardPose((geometry.nearest_mm + geometry.farthest_mm) / 2, yaw_deg=15, pitch_deg=10)
    with work.bench() as bench:
        request = Request("geometry", "does the rig still hold?", wording(pose), pose, exact=True)
        if work.operator.hold_board(bench, work.board, request) is not Answer.TAKE:
            raise StoppedError("stopped by the operator", "Nothing was changed.")
        try:
            observation = take_pose(work, bench, STEP)
        except BoardNotFoundError as error:
            raise StepFailedError(f"check: {error.message}", error.remedy) from error
    report = check(rig, observation)
    limits = ", ".join(f"{v:.4f}" for v in report.turn_limit_deg)
    shifts = ", ".join(f"{v:.3f}" for v in report.shift_limit_mm)
    verdict = f"the rig {'holds' if report.holds else 'does not hold'}: {report.reason}"
    work.terminal.say(
        [
            verdict,
            f"off their epipolar lines {report.epipolar_px:.4f} px rms, expected {report.epipolar_expected_px:.4f}",
            f"scale {report.scale:.6f} ± {report.scale_sigma:.6f}",
            f"one pose finds turns of the projector from {limits}° about its axes, and shifts from {shifts} mm",
        ]
    )
    notes = tuple(f"{finding.what}. {finding.remedy}" for finding in report.findings)
    for note in notes:
        work.terminal.note(note)
    work.operator.learn(Outcome("geometry", verdict, notes))
    return report.holds
