"""The wizard: which steps are still to be done, in their order, on one bench and in one folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from calibration.boards import load_board
from calibration.folder import RIG, CalibrationFolder
from calibration.operators import Operator, ScriptedOperator
from calibration.settings import CalibrationSettings
from calibration.work import Work
from drivers import OperatorError
from scanner.config import load_config
from scanner.terminal import Terminal

STEPS = ("focus", "exposure", "latency", "response", "geometry", "acceptance")


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
    ConfigError
        The file is wrong, or has no section ``calibration``.
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
    board = load_board(loaded.path.parent / settings.board)
    terminal = Terminal(quiet)
    with CalibrationFolder(out, board.model_dump(mode="json")) as folder:
        operator: Operator
        if headless:
            operator = ScriptedOperator(settings.hand)
            yield Work(loaded, overrides, settings, board, folder, operator, terminal)
        else:
            from calibration.person import PersonOperator

            with PersonOperator(settings, folder, terminal) as operator:
                yield Work(loaded, overrides, settings, board, folder, operator, terminal)


def run_steps(work: Work, only: Sequence[str] = ()) -> bool:
    """Go through the steps that are not done yet, or through those in ``only`` again.

    Returns
    -------
    False where the acceptance does not pass.

    Raises
    ------
    UsageError
        There is no such step.
    StepFailedError
        A step found something that must be mended first.
    StoppedError
        The operator has left.
    """
    from calibration.acceptance.figures import Verdict
    from calibration.steps import acceptance, exposure, focus, geometry, latency, response

    unknown = [name for name in only if name not in STEPS]
    if unknown:
        raise UsageError(f"there is no step {unknown[0]!r}", f"The steps are {', '.join(STEPS)}.")
    steps: dict[str, Callable[[Work], None]] = {
        "focus": focus.run,
        "exposure": exposure.run,
        "latency": latency.run,
        "response": response.run,
        "geometry": geometry.run,
    }
    for name, step in steps.items():
        if only and name not in only:
            continue
        if not only and work.folder.finding(name) is not None:
            work.terminal.say([f"{name}: done before"])
            continue
        if name == "geometry" and work.folder.finding(name) is not None:
            work.folder.drop_all_poses()
        work.folder.forget(name)
        step(work)
    if only and "acceptance" not in only:
        return True
    if not work.settings.acceptance.artefacts:
        work.terminal.say(["acceptance: no artefact is named in calibration.acceptance of the bench file"])
        return True
    return acceptance.run(work, work.folder.path / RIG) not in (Verdict.FAIL, Verdict.UNCERTAIN, Verdict.MISSING)
