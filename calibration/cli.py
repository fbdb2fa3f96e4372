"""The command line: `calibrate`, and `board`, `verify` and `check` below it.

Exit codes: 0 done; 2 bad configuration or usage; 3 hardware; 4 something was found that must be mended, or the
acceptance fails; 130 interrupted or stopped. The same command goes on where it was left.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scanner.command_line import ConfigOption, QuietOption, SetOption, interruptible, new_app, overrides, run

Paper = Literal["A4", "A3", "A2", "A1", "A0", "sheet"]
StepName = StrEnum("StepName", ["focus", "exposure", "latency", "response", "geometry", "acceptance"])
if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from calibration.work import Work

app = new_app()

FAILED = 4

HeadlessOption = Annotated[
    bool, typer.Option("--headless", help="Nobody is there: the bench itself presents boards and artefacts.")
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder of the calibration; continued where it exists.")]


@app.callback(invoke_without_command=True)
@interruptible
def calibrate(
    context: typer.Context,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="Bench file (YAML).")] = None,
    out: OutOption = Path("calibration-result"),
    headless: HeadlessOption = False,
    step: Annotated[
        list[StepName] | None,
        typer.Option("--step", help="Only this step, again if it is done; may be given several times."),
    ] = None,
    quiet: QuietOption = False,
    sets: SetOption = None,
) -> None:
    """Calibrate a bench: focus, exposure, latency, response, geometry, acceptance; done steps are not repeated."""
    if context.invoked_subcommand is not None:
        return
    if config is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)
    from calibration.guide.guidance import STEPS
    from calibration.wizard import run_steps

    with _work(config, out, headless, quiet, sets) as work:
        if not run_steps(work, [name for name in STEPS if name in (step or ())]):
            raise typer.Exit(FAILED)


@app.command()
@interruptible
def board(
    definition: Annotated[Path, typer.Argument(help="Definition of the board (YAML), as in configs/boards.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, .pdf or .svg.")],
    paper: Annotated[Paper, typer.Option("--paper", help="A4, A3, or sheet: as large as the board.")] = "A4",
) -> None:
    """Write a board to print at true scale, with a ruler to check the print."""
    from calibration.boards import load_board
    from calibration.printing import print_board

    chosen = load_board(definition)
    print_board(chosen, out, paper)
    typer.echo(f"{out}: print it at 100 % (no “fit to page”), and measure the ruler: it must be 100.0 mm long")
    for finding in chosen.findings:
        typer.echo(f"note: {finding.what}. {finding.remedy}")


@app.command()
@interruptible
def verify(
    config: ConfigOption,
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig to verify; default: that of the folder.")] = None,
    out: OutOption = Path("calibration-result"),
    headless: HeadlessOption = False,
    quiet: QuietOption = False,
    sets: SetOption = None,
) -> None:
    """Accept a rig: scan the artefacts of the bench file with it and write the certificate."""
    from calibration.wizard import accepted, rig_to_use

    chosen = rig_to_use(rig, out)
    with _work(config, out, headless, quiet, sets) as work:
        if not accepted(work, chosen, anew=True):
            raise typer.Exit(FAILED)


@app.command()
@interruptible
def check(
    config: ConfigOption,
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig to check; default: that of the folder.")] = None,
    out: OutOption = Path("calibration-result"),
    headless: HeadlessOption = False,
    quiet: QuietOption = False,
    sets: SetOption = None,
) -> None:
    """Say from one pose of the board whether the stored rig still holds."""
    from calibration.steps import drift
    from calibration.wizard import rig_to_use

    chosen = rig_to_use(rig, out)
    with _work(config, out, headless, quiet, sets) as work:
        if not drift.run(work, chosen):
            raise typer.Exit(FAILED)


def _work(config: Path, out: Path, headless: bool, quiet: bool, sets: list[str] | None) -> AbstractContextManager[Work]:
    from calibration.wizard import begin

    return begin(config, overrides(sets), out, headless=headless, quiet=quiet)


def main() -> None:
    """Entry point of `calibrate`."""
    run(app)


if __name__ == "__main__":
    main()
