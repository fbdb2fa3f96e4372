"""What all steps of a calibration work with: the bench as it is known by now, the folder, and the operator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from calibration.boards import Board
from calibration.capture import Occasion
from calibration.folder import CalibrationFolder
from calibration.guide.guidance import Bar, Curve, Step
from calibration.observations import BoardPose, Finding
from calibration.operators import Answer, Operator, Outcome, Request, stopped
from calibration.settings import CalibrationSettings
from drivers import Bench, DisplayLatency, LatencyBound, OperatorError
from scanner.acquisition import Listener, Progress, ScanState
from scanner.config import LoadedConfig, load_config, open_bench
from scanner.response import ProjectorResponse
from scanner.terminal import Terminal

_EXPOSURE = "bench.camera.exposure_us"


class StepFailedError(OperatorError):
    """A step has found something that must be mended before the next one makes sense."""

    exit_code = 4

    @classmethod
    def of(cls, step: str, findings: Sequence[Finding]) -> StepFailedError:
        """Tell all findings that refuse."""
        refusing = [f for f in findings if f.refuses]
        what = "\n".join(f"{f.code}: {f.what}" for f in refusing)
        return cls(f"{step}: {what}", "\n".join(dict.fromkeys(f.remedy for f in refusing)))


@dataclass
class Work:
    """A calibration at work.

    Parameters
    ----------
    loaded
        The configuration as the file has it.
    overrides
        Values that replace those of the file, as given to `load_config`.
    settings, board
        Its section ``calibration`` and the board that this names.
    folder
        Entered.
    operator
        Holds the board and places artefacts.
    terminal
        Tells how it goes.
    """

    loaded: LoadedConfig
    overrides: Mapping[str, Any]
    settings: CalibrationSettings
    board: Board
    folder: CalibrationFolder
    operator: Operator
    terminal: Terminal

    def configured(self, **more: Any) -> LoadedConfig:
        """The configuration with the exposure that was found, and with ``more`` values (dots as double underscores)."""
        changes = dict(self.overrides)
        exposure = self.folder.finding("exposure")
        if exposure is not None and exposure["adjustable"]:
            changes[_EXPOSURE] = exposure["exposure_us"]
        changes |= {name.replace("__", "."): value for name, value in more.items()}
        return load_config(self.loaded.path, changes)

    @contextmanager
    def bench(self, *, still: bool = False, **more: Any) -> Iterator[Bench]:
        """An open bench.

        Parameters
        ----------
        still
            One picture stays on, so that no latency matters; needed before it is measured.
        more
            Values that replace those of the file, such as ``bench__camera__exposure_us``.
        """
        with open_bench(self.configured(**more)) as bench:
            if isinstance(bench, LatencyBound):
                bench.use_latency(DisplayLatency(0.0, 0.0, 0) if still else self.latency)
            yield bench

    @property
    def latency(self) -> DisplayLatency | None:
        """Of the display, where it was measured."""
        found = self.folder.finding("latency")
        document = None if found is None else found.get("latency")
        return None if document is None else DisplayLatency.from_json(document)

    @property
    def response(self) -> ProjectorResponse | None:
        """Of the projector, where it was measured and is to be used."""
        found = self.folder.finding("response")
        if found is None or not self.settings.response.correct:
            return None
        return ProjectorResponse.from_json(found["response"])

    def occasion(self, step: str, **notes: Any) -> Occasion:
        """For the manifest of a take."""
        return Occasion(step, self.loaded.config.model_dump(mode="json"), notes)

    @contextmanager
    def counting(self, what: str) -> Iterator[Callable[[int, int], None]]:
        """Show terminal and operator how many of a number of things are done, by a function of (done, total)."""
        with self.terminal.counting(what) as count:

            def tell(done: int, total: int) -> None:
                count(done, total)
                self.operator.wait(what, done, total)

            yield tell

    @contextmanager
    def listening(self, what: str) -> Iterator[Listener]:
        """Show terminal and operator how the frames of a capture come in."""
        with self.counting(f"{what}: frame") as count:
            yield FrameCounter(count, self.terminal.note)

    def hold_facing(self, bench: Bench, step: Step, title: str, instruction: str, *, nearest: bool = False) -> None:
        """Have the board held in the middle of the working volume, or where it is brightest, facing the camera.

        Raises
        ------
        StoppedError
            The operator has left.
        """
        geometry = self.settings.geometry
        pose = BoardPose(geometry.nearest_mm if nearest else (geometry.nearest_mm + geometry.farthest_mm) / 2)
        answer = self.operator.hold_board(bench, self.board, Request(step, title, instruction, pose))
        if answer is Answer.STOP:
            raise stopped()

    def report(
        self,
        step: Step,
        document: Mapping[str, Any],
        findings: Sequence[Finding],
        lines: Sequence[str],
        curve: Curve | None = None,
        bars: tuple[Bar, ...] = (),
        large: str = "",
    ) -> None:
        """Tell what a step has found, keep it, and stop where it cannot be gone on with.

        Parameters
        ----------
        step
            Which.
        document
            What is kept in the folder, JSON-ready.
        findings
            What is wrong with it.
        lines
            The figures in words, for the terminal.
        curve, bars
            The same as the operator's screen shows them.
        large
            What the screen writes large; empty for all lines.

        Raises
        ------
        StepFailedError
            A finding refuses; the step is not marked as done.
        StoppedError
            The operator has left after that.
        """
        self.terminal.say([f"{step}: {line}" for line in lines])
        notes = [f"{finding.what}. {finding.remedy}" for finding in findings if not finding.refuses]
        for note in notes:
            self.terminal.note(note)
        if any(f.refuses for f in findings):
            raise StepFailedError.of(step, findings)
        self.folder.finish(step, {**document, "findings": [vars(f) for f in findings]})
        self.operator.learn(Outcome(step, large or " · ".join(lines), tuple(notes), curve, bars))


@dataclass
class FrameCounter:
    """Listens to an acquisition and counts its frames.

    Parameters
    ----------
    count
        Is told of (done, total) frames.
    remark
        Is told what the operator should read.
    """

    count: Callable[[int, int], None]
    remark: Callable[[str], None]

    def state(self, state: ScanState, what: str) -> None:
        """Not shown: a count says enough."""

    def frame(self, progress: Progress) -> None:
        """Count."""
        self.count(progress.done, progress.total)

    def note(self, text: str) -> None:
        """Show what was repeated, and why."""
        self.remark(text)
