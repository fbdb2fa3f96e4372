"""A person at the bench, led by a live picture on their own screen, or by lines in the terminal where there is none."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.focus import CAMERA_SPOT_PX, EdgeBlur, edge_blur
from calibration.folder import CalibrationFolder
from calibration.ghost import Ghost
from calibration.guide.guidance import Bar, Guidance, Step
from calibration.guide.lines import GuideLines
from calibration.guide.window import Guide, GuideWindow, guide_for
from calibration.looking import Looking, glimpsed
from calibration.observations import BoardView
from calibration.operators import Answer, Outcome, Request, UnattendedError, stopped
from calibration.settings import CalibrationSettings
from drivers import Bench, HardwareError, OperatorError, Pixels
from scanner.preview.measures import focus_measure, read_frame
from scanner.terminal import Terminal

_ANSWERS = {"space": Answer.TAKE, "s": Answer.SKIP, "b": Answer.BACK, "q": Answer.STOP}
_LEVELS = (40, 80, 160, 255)
_FIRST_LEVEL = 2
_TRIES = 3
_SHOWN_EVERY_S = 0.1
_MAGNIFIED_SHARE = 8
_TOO_BRIGHT_SHARE = 0.02
_TOO_DARK = 0.15


@dataclass(frozen=True, eq=False)
class _Sight:
    """What a look at a live picture has told."""

    view: BoardView | None
    blur: EdgeBlur | None


class PersonOperator:
    """Shows what is wanted beside what is there, until a key is pressed; a context manager.

    Parameters
    ----------
    settings, folder
        Of the calibration; the poses so far are shown.
    terminal
        For lines where there is no screen.
    """

    def __init__(self, settings: CalibrationSettings, folder: CalibrationFolder, terminal: Terminal) -> None:
        self._settings = settings
        self._folder = folder
        self._terminal = terminal
        self._guide: Guide | None = None
        self._shown: Guidance | None = None
        self._shown_at = 0.0
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._guide = None
        self._stack.close()

    def hold_board(self, bench: Bench, board: Board, request: Request) -> Answer:
        """Show the live picture, the board in it and where it is wanted, until the person presses a key."""
        fmt = bench.frame_format
        size = fmt.width, fmt.height
        ghost = Ghost.of(self._settings, self._folder, board, size, request.lens) if request.exact else None
        is_focusing = request.step == "focus"

        def look(frame: Pixels) -> _Sight:
            return _Sight(glimpsed(frame, board), edge_blur(frame, fmt.saturated_dn) if is_focusing else None)

        keys = (("space", "take it"), ("s", "another pose"), ("b", "last one again"))
        with Looking(look) as looking:

            def guidance(frame: Pixels, focus: float) -> Guidance:
                sight = looking.at(frame) or _Sight(None, None)
                plain = Guidance(
                    step=request.step,
                    title=request.title + (f" · {request.reason}" if request.reason else ""),
                    instruction=request.instruction,
                    frame=frame,
                    frame_format=fmt,
                    simulated=bench.simulated,
                    view=sight.view,
                    board_wanted=request.step != "response",
                    bars=request.bars if sight.blur is None else (_sharpness(sight.blur),),
                    reading=read_frame(frame, fmt, focus),
                    zone=_zone(sight.view, fmt.shape) if is_focusing else None,
                    keys=(*(keys if request.exact else keys[:1]), ("↑ ↓", "light"), ("q", "stop; resume later")),
                )
                return plain if ghost is None else ghost.shown(plain, request.pose)

            return self._live(bench, guidance, must_be_seen=request.exact)

    def keep(self, bench: Bench) -> None:
        """The person has let go of nothing."""

    def place(self, bench: Bench, what: str, scene: Mapping[str, Any]) -> Answer:
        """Ask for an artefact, and show the live picture until the person presses a key."""
        fmt = bench.frame_format

        def guidance(frame: Pixels, focus: float) -> Guidance:
            return Guidance(
                step="acceptance",
                title="artefacts",
                instruction=what,
                frame=frame,
                frame_format=fmt,
                simulated=bench.simulated,
                reading=read_frame(frame, fmt, focus),
                keys=(("space", "it stands there"), ("↑ ↓", "light"), ("q", "stop; resume later")),
            )

        return self._live(bench, guidance)

    def wait(self, what: str, done: int, total: int) -> None:
        """Keep the window alive, with a bar that grows."""
        if self._shown is None or not isinstance(self._guide, GuideWindow):
            return
        if done < total and time.monotonic() - self._shown_at < _SHOWN_EVERY_S:
            return
        self._shown_at = time.monotonic()
        share = done / total if total else 0.0
        keys = self._guide.show(
            replace(
                self._shown,
                title=what,
                instruction="Hold still: nothing may move.",
                bars=(Bar(what, share, True, f"{done} of {total}"),) if total else (),
                board_wanted=False,
                zone=None,
                hints=(),
                keys=(("q", "stop; resume later"),),
            )
        )
        if "q" in keys:
            raise stopped()

    def tell(self, good: bool, text: str) -> None:
        """Flash and ring: whoever holds a board looks elsewhere."""
        if self._guide is not None:
            self._guide.flash(good, text)

    def learn(self, outcome: Outcome) -> None:
        """Show figures, curve and warnings until a key is pressed; without a window the terminal has said it all."""
        if not isinstance(self._guide, GuideWindow) or self._still(
            outcome.step,
            "done",
            outcome.text,
            (("space", "go on"), ("q", "stop; resume later")),
            bars=outcome.bars,
            curve=outcome.curve,
            hints=outcome.notes,
        ):
            return
        raise stopped()

    def again(self, step: Step, error: OperatorError, what: str) -> bool:
        """Show what is wrong and what to do, until the person has done it or leaves."""
        if self._guide is None:
            return False
        if isinstance(self._guide, GuideWindow):
            self._terminal.say([f"{step}: {error}"])
        hints = tuple(error.remedy.splitlines())
        keys = (("space", what), ("q", "stop; resume later"))
        self._guide.flash(False, f"{step}: not yet")
        return self._still(step, "to be mended", error.message.replace("\n", " · "), keys, hints=hints)

    def _still(self, step: Step, title: str, instruction: str, keys: tuple[tuple[str, str], ...], **more: Any) -> bool:
        """Show the last picture with something to read; whether the person goes on. True where nothing is shown yet."""
        if self._guide is None or self._shown is None:
            return True
        last = self._shown
        shown = Guidance(
            step,
            title,
            instruction,
            last.frame,
            last.frame_format,
            last.simulated,
            **more,
            board_wanted=False,
            keys=keys,
        )
        self._guide.show(shown)
        while True:
            pressed = self._guide.show(shown)
            if "q" in pressed:
                return False
            if "space" in pressed:
                return True
            time.sleep(_SHOWN_EVERY_S / 2)

    def _live(
        self, bench: Bench, guidance: Callable[[Pixels, float], Guidance], *, must_be_seen: bool = False
    ) -> Answer:
        guide = self._guide_of(bench)
        level = _FIRST_LEVEL
        fmt = bench.frame_format
        frame, former = np.zeros(fmt.shape, fmt.dtype), np.zeros(fmt.shape, fmt.dtype)
        bench.prepare(_steady(bench, level))
        failures, warned, is_first = 0, False, True
        while True:
            frame, former = former, frame
            try:
                bench.expose(0, frame)
                failures = 0
            except HardwareError as error:
                failures += 1
                if not error.repeatable or failures == _TRIES:
                    raise
                bench.prepare(_steady(bench, level))
                continue
            self._shown = shown = _with_light(guidance(frame, focus_measure(former, frame, fmt.saturated_dn)))
            pressed = guide.show(shown)
            if is_first:
                # What was typed before this could be seen was meant for something else.
                is_first = False
                continue
            for key in pressed:
                if key in ("up", "down"):
                    level = min(max(level + (1 if key == "up" else -1), 0), len(_LEVELS) - 1)
                    bench.prepare(_steady(bench, level))
                answer = _ANSWERS.get(key)
                if answer is None or (answer in (Answer.SKIP, Answer.BACK) and not must_be_seen):
                    continue
                if answer is Answer.TAKE and must_be_seen and shown.view is None and not warned:
                    warned = True
                    guide.flash(False, "no board seen; once more takes it all the same")
                    continue
                bench.darken()
                self._shown = replace(shown, frame=frame.copy())
                return answer

    def _guide_of(self, bench: Bench) -> Guide:
        if self._guide is None:
            guide: Guide = guide_for(bench.describe(), self._terminal.console)
            if isinstance(guide, GuideLines) and not sys.stdin.isatty():
                raise UnattendedError(
                    "there is neither a screen to show on nor a terminal to read keys from",
                    "Run `calibrate` in a terminal, or set DISPLAY to the desktop you sit at; with --headless a bench "
                    "that can do it presents the boards itself.",
                )
            self._stack.enter_context(guide)
            self._guide = guide
        return self._guide


def _steady(bench: Bench, level: int) -> list[NDArray[np.uint8]]:
    width, height = bench.projector_size
    return [np.full((height, width), _LEVELS[level], np.uint8)]


def _with_light(guidance: Guidance) -> Guidance:
    """With a word about a picture that is too bright or too dark to find anything in."""
    reading = guidance.reading
    if reading is None:
        return guidance
    if reading.saturated_share > _TOO_BRIGHT_SHARE:
        word = "too bright: press ↓, close the aperture, or shorten bench.camera.exposure_us"
    elif reading.brightest < _TOO_DARK:
        word = "too dark: press ↑, open the aperture, or lengthen bench.camera.exposure_us"
    else:
        return guidance
    return replace(guidance, hints=(*guidance.hints, word))


def _sharpness(blur: EdgeBlur) -> Bar:
    share = CAMERA_SPOT_PX / blur.spot_px
    limit = 2.563 * CAMERA_SPOT_PX
    return Bar("sharpness of printed edges", share, share >= 1, f"{blur.width_px:.1f} px wide, at most {limit:.1f}")


def _zone(view: BoardView | None, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of an eighth of the picture about the board's middle, or its own."""
    middle = np.array(shape) / 2 if view is None else view.xy.mean(axis=0)[::-1]
    extent = np.array(shape) // _MAGNIFIED_SHARE
    first = np.clip(np.rint(middle - extent / 2), 0, np.array(shape) - extent).astype(int)
    rows, columns = (slice(int(a), int(a + n)) for a, n in zip(first, extent, strict=True))
    return rows, columns
