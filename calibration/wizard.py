"""The wizard: which steps are still to be done, in their order, on one bench and in one folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from calibration.boards import Board, load_board
from calibration.detection import BoardNotFoundError
from calibration.folder import RIG, CalibrationFolder
from calibration.guide.guidance import Step
from calibration.operators import Operator, ScriptedOperator, StoppedError, UnattendedError
from calibration.photometry import PhotometryError
from calibration.settings import CalibrationSettings
from calibration.work import StepFailedError, Work
from drivers import OperatorError
from scanner.config import LoadedConfig, load_config
from scanner.preflight import ExposureError
from scanner.rig import Rig
from scanner.terminal import Terminal

_TO_MEND = (PhotometryError, BoardNotFoundError, ExposureError)
"""What a step meets where light, focus or board are not as they must be."""


class UsageError(OperatorError):
    """The command asks for something that is not there."""


@contextmanager
def begin(
    config: Path, overrides: Mapping[str, Any], out: Path, *, headless: bool = False, quiet: bool = False
) -> Iterator[Work]:
    """Enter the folder of a calibration, with an operator.

    Parameters
    ----------
    config, overrides
        Bench file, and values that replace some of it.
    out
        The folder, begun or continued.
    headless
        Nobody is there.
    quiet
        Plain lines.

    Raises
    ------
    ConfigError, UsageError
        The file is wrong, has no section ``calibration``, or names a board that is none.
    CalibrationFolderError
        The folder cannot be used.
    """
    loaded = load_config(config, overrides)
    if loaded.config.calibration is None:
        raise UsageError(
            f"{config} has no section `calibration:`",
            "Add one with `board:` below it; configs/bench.yaml shows all that can be set.",
        )
    settings = cast(CalibrationSettings, loaded.config.calibration)
    board = _board(loaded, settings)
    terminal = Terminal(quiet)
    try:
        with CalibrationFolder(out, board.model_dump(mode="json")) as folder:
            operator: Operator
            if headless:
                operator = ScriptedOperator(settings.hand)
                yield Work(loaded, overrides, settings, board, folder, operator, terminal)
            else:
                from calibration.person import PersonOperator

                with PersonOperator(settings, folder, terminal) as operator:
                    yield Work(loaded, overrides, settings, board, folder, operator, terminal)
    except KeyboardInterrupt as interruption:
        interruption.add_note(f"everything so far is kept in {out}; the same command goes on from here")
        raise


def _board(loaded: LoadedConfig, settings: CalibrationSettings) -> Board:
    path = loaded.path.parent / settings.board
    if not path.is_file():
        raise UsageError(
            f"{loaded.path}: calibration.board: there is no file {path}",
            "Name one of configs/boards, or write your own; the path is relative to the bench file.",
        )
    return load_board(path)


def rig_to_use(rig: Path | None, out: Path) -> Path:
    """The rig that was named, or that of the folder.

    Raises
    ------
    OperatorError
        There is none, or it cannot be read.
    """
    path = out / RIG if rig is None else rig
    if rig is None and not path.is_file():
        raise UsageError(
            f"{out} holds no {RIG}",
            "Name one with --rig, or the folder of a calibration with --out, or calibrate first.",
        )
    Rig.load(path)
    return path


def run_steps(work: Work, only: Sequence[Step] = ()) -> bool:
    """Go through the steps that are not done yet, or through those in ``only`` again.

    Returns
    -------
    False where the acceptance does not pass.

    Raises
    ------
    StepFailedError
        A step found something that must be mended first.
    StoppedError
        The operator has left.
    """
    from calibration.steps import exposure, focus, geometry, latency, response

    steps: dict[Step, Callable[[Work], None]] = {
        "focus": focus.run,
        "exposure": exposure.run,
        "latency": latency.run,
        "response": response.run,
        "geometry": geometry.run,
    }
    for name, step in steps.items():
        is_done = work.folder.finding(name) is not None
        if only and name not in only:
            continue
        if not only and is_done:
            work.terminal.say([f"{name}: done before"])
            continue
        if name == "geometry" and is_done:
            work.folder.drop_all_poses()
        work.folder.forget(name)
        if name == "geometry":
            work.folder.forget("acceptance")
        _until_done(work, name, step)
    if only and "acceptance" not in only:
        _say_what_follows(work, only)
        return True
    if not work.settings.acceptance.artefacts:
        work.terminal.say(["acceptance: no artefact is named in calibration.acceptance of the bench file"])
        passes = True
    else:
        passes = accepted(work, work.folder.path / RIG, anew=bool(only))
    _say_where_to_write(work)
    return passes


def accepted(work: Work, rig: Path, *, anew: bool = False) -> bool:
    """Scan the artefacts with a rig, write the certificate, and say whether nothing speaks against it.

    Parameters
    ----------
    work
        The calibration.
    rig
        To be judged.
    anew
        Scan again what a finished acceptance has scanned.

    Raises
    ------
    UsageError
        No artefact is named.
    """
    from calibration.acceptance.figures import Verdict
    from calibration.steps import acceptance

    if not work.settings.acceptance.artefacts:
        raise UsageError(
            f"{work.loaded.path}: calibration.acceptance.artefacts names nothing to scan",
            "Name at least one artefact and its calibrated figures there; configs/bench.yaml shows how.",
        )
    if anew and work.folder.finding("acceptance") is not None:
        work.folder.forget("acceptance")
        work.folder.drop_scans()
    verdicts = []
    _until_done(work, "acceptance", lambda work: verdicts.append(acceptance.run(work, rig)))
    return verdicts[-1] not in (Verdict.FAIL, Verdict.UNCERTAIN, Verdict.MISSING)


def _until_done(work: Work, name: Step, step: Callable[[Work], None]) -> None:
    """Do a step, again where it fails and the operator has mended it."""
    while True:
        try:
            step(work)
        except (StoppedError, UnattendedError):
            raise
        except OperatorError as error:
            failed = StepFailedError(f"{name}: {error.message}", error.remedy) if isinstance(error, _TO_MEND) else error
            # The geometry has asked by itself whether to take more poses.
            has_asked = name == "geometry" and isinstance(failed, StepFailedError)
            if not has_asked and work.operator.again(name, failed, "try again"):
                continue
            if isinstance(failed, StepFailedError):
                then = "Then run the same command: it goes on from here."
                raise StepFailedError(failed.message, f"{failed.remedy}\n{then}") from error
            raise
        return


def _say_what_follows(work: Work, redone: Sequence[Step]) -> None:
    """What was found before a step was done again, and may hold no more."""
    if "focus" in redone and "geometry" not in redone and work.folder.finding("geometry") is not None:
        work.terminal.note(
            "the rig was found before this: where focus or aperture were touched it holds no more. `calibrate check` "
            "tells, `--step geometry` finds it anew"
        )
    if "geometry" in redone and work.settings.acceptance.artefacts:
        work.terminal.note("the new rig has no certificate yet: the same command without --step scans the artefacts")


def _say_where_to_write(work: Work) -> None:
    """What the bench file needs, so that scans use what was found."""
    where = work.loaded.path
    lines = [f"rig: {os.path.relpath(work.folder.path / RIG, where.resolve().parent)}"]
    exposure = work.folder.finding("exposure")
    if exposure is not None and exposure["adjustable"]:
        lines.append(f"bench.camera.exposure_us: {exposure['exposure_us']:.0f}")
    work.terminal.say([f"put into {where}:", *(f"  {line}" for line in lines)])
