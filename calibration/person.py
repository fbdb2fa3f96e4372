"""A person at the bench, led by a live picture on their own screen, or by lines in the terminal where there is none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

import numpy as np

from calibration.boards import Board
from calibration.detection import BoardNotFoundError, find_board
from calibration.folder import CalibrationFolder
from calibration.guide.guidance import Guidance
from calibration.guide.window import Guide, guide_for
from calibration.observations import BoardView
from calibration.operators import Answer, Request, wording
from calibration.planning import placed, pose_of
from calibration.planning.glimpse import guessed_lens, held, outline
from calibration.settings import CalibrationSettings
from drivers import Bench, HardwareError, Pixels
from scanner.preview.measures import focus_measure, read_frame
from scanner.rig import Lens
from scanner.terminal import Terminal

_KEYS = {"space": Answer.TAKE, "s": Answer.SKIP, "b": Answer.BACK, "q": Answer.STOP}
_TRIES = 3
_NOISE_DN = 1.5  # of a live picture: where the board is matters here, not how exactly
_LIVE_LEVEL = 160


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
        geometry = self._settings.geometry
        wanted, fmt = request.pose, bench.frame_format
        poses = self._folder.poses()
        lens: Lens | None = None
        if poses:
            middle = (geometry.nearest_mm + geometry.farthest_mm) / 2
            lens = guessed_lens(poses[0].points_board, poses[0].camera, middle, (fmt.width, fmt.height))
        before = [] if lens is None else [pose_of(*held(lens, p.points_board, p.camera)) for p in poses]

        def guidance(frame: Pixels, focus: float) -> Guidance:
            try:
                view: BoardView | None = find_board(frame, board, _NOISE_DN)
            except BoardNotFoundError:
                view = None
            here = None if view is None or lens is None else held(lens, board.points[view.ids], view.xy)
            now = None if here is None else pose_of(*here)
            return Guidance(
                step=request.step,
                title=request.title,
                instruction=wording(wanted),
                frame=frame,
                frame_format=fmt,
                simulated=bench.simulated,
                view=view,
                board_wanted=True,
                target=None if lens is None else outline(lens, board.size_mm, *placed(wanted)),
                outline=None if lens is None or here is None else outline(lens, board.size_mm, *here),
                seen=np.concatenate([p.camera for p in poses]) if poses else np.empty((0, 2)),
                tilts=np.array([(p.yaw_deg, p.pitch_deg) for p in before]).reshape(-1, 2),
                held_tilt=None if now is None else (now.yaw_deg, now.pitch_deg),
                wanted_tilt=(wanted.yaw_deg, wanted.pitch_deg),
                distances_mm=np.array([p.distance_mm for p in before]),
                held_distance_mm=None if now is None else now.distance_mm,
                wanted_distance_mm=wanted.distance_mm,
                depth_range_mm=(geometry.nearest_mm, geometry.farthest_mm),
                reading=read_frame(frame, fmt, focus),
                hints=tuple(text for text in (request.instruction, request.reason) if text),
                keys=(("space", "take it"), ("s", "skip"), ("b", "last one again"), ("q", "stop; resume later")),
            )

        return self._live(bench, guidance)

    def keep(self, bench: Bench) -> None:
        """The person has let go of nothing."""

    def place(self, bench: Bench, what: str, scene: Mapping[str, Any]) -> Answer:
        """Ask for an artefact, and show the live picture until the person presses a key."""
        fmt = bench.frame_format

        def guidance(frame: Pixels, focus: float) -> Guidance:
            return Guidance(
                step="acceptance",
                title=what,
                instruction=f"Place this: {what}. Nothing may move until the scan is done.",
                frame=frame,
                frame_format=fmt,
                simulated=bench.simulated,
                reading=read_frame(frame, fmt, focus),
                keys=(("space", "it stands there"), ("q", "stop; resume later")),
            )

        return self._live(bench, guidance)

    def _live(self, bench: Bench, guidance: Callable[[Pixels, float], Guidance]) -> Answer:
        if self._guide is None:
            self._guide = guide_for(bench.describe(), self._terminal.console)
            self._stack.enter_context(self._guide)
        guide = self._guide
        width, height = bench.projector_size
        steady = [np.full((height, width), _LIVE_LEVEL, np.uint8)]
        fmt = bench.frame_format
        frame, former = np.zeros(fmt.shape, fmt.dtype), np.zeros(fmt.shape, fmt.dtype)
        bench.prepare(steady)
        failures = 0
        while True:
            frame, former = former, frame
            try:
                bench.expose(0, frame)
                failures = 0
            except HardwareError as error:
                failures += 1
                if not error.repeatable or failures == _TRIES:
                    raise
                bench.prepare(steady)
                continue
            for key in guide.show(guidance(frame, focus_measure(former, frame, fmt.saturated_dn))):
                if key in _KEYS:
                    bench.darken()
                    guide.flash(_KEYS[key] is Answer.TAKE, str(_KEYS[key]))
                    return _KEYS[key]
