"""Somebody who calibrates a simulated bench by what the screen shows: moves the board as asked and presses keys."""

from __future__ import annotations

import os
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from desktop import Desktop
from PIL import Image

import calibration.person
from calibration.guide.guidance import Guidance
from calibration.guide.window import GuideWindow
from calibration.person import PersonOperator
from sim_backend.xserver import XServer

_OFF = {"distance_mm": 25.0, "offset_x_mm": 20.0, "yaw_deg": -12.0}
"""How far off the board is held at first."""

_LOOKS = 400
"""Pictures of one request after which this person gives up."""


class Hand:
    """Holds the board off the pose that is asked for, then there, and presses the space bar when the screen agrees.

    Parameters
    ----------
    server
        On which the guide's window is.
    pictures
        Folder for what the screen shows; None for none.
    """

    def __init__(self, server: XServer, pictures: Path | None = None) -> None:
        self._server = server
        self._desktop = Desktop(server.display, "calibrate")
        self._pictures = pictures
        self._looks = 0
        self._decided = False
        self._place = lambda: None
        self._saved: set[str] = set()
        self.comes({})

    def comes(self, presses: dict[int, str]) -> None:
        """Begin a day; ``presses`` are keys instead of the space bar, by the number of the decision."""
        self._presses = presses
        self.decisions: list[tuple[str, str, str]] = []
        self.shown: list[Guidance] = []

    def begins(self, bench, scenes) -> None:
        """A new request: present the first scene at once, the second after a look at it."""
        self._looks, self._decided = 0, False
        bench.present(scenes[0])
        self._place = lambda: bench.present(scenes[-1])

    def sees(self, guidance: Guidance) -> None:
        """Do what the screen asks for."""
        keys = dict(guidance.keys)
        self.shown.append(replace(guidance, frame=np.empty((0, 0), np.uint8)))
        is_result = guidance.title in ("done", "to be mended")
        if "space" not in keys:
            self._save(guidance, "wait")
            return
        self._looks += 1
        assert self._looks < _LOOKS, (
            f"the screen never agreed: {guidance.step}, {guidance.title}, {guidance.nearness}, {guidance.moves}"
        )
        if self._looks == 6 and not is_result:
            self._save(guidance, "before")
            self._place()
        if self._decided or (not is_result and self._looks < 10):
            return
        if is_result or not guidance.is_about_board or guidance.nearness == "there":
            key = self._presses.get(len(self.decisions), "space")
            self._save(guidance, "after" if not is_result else "result")
            self.decisions.append((guidance.step, guidance.title, key))
            self._decided = True
            self._desktop.press(key)

    def goes_on(self) -> None:
        """Another screen is to be decided on."""
        self._looks, self._decided = 0, False

    def _save(self, guidance: Guidance, moment: str) -> None:
        name = f"{guidance.step}-{moment}" + (f"-{guidance.title[:6]}" if guidance.step == "geometry" else "")
        if self._pictures is None or name in self._saved:
            return
        self._saved.add(name)
        Image.fromarray(self._server.surface()).save(self._pictures / f"{name.replace(' ', '_')}.png")


@contextmanager
def person(size=(1280, 800), pictures=None):
    """Within it calibrations that are not headless are done by a `Hand`, which it gives; once for each process."""
    with XServer(*size) as server:
        os.environ["DISPLAY"] = server.display
        hand = Hand(server, pictures)

        class Guided(PersonOperator):
            """Asks a person whose hands move the board of a simulated bench."""

            def hold_board(self, bench, board, request):
                off = replace(request.pose, **{k: getattr(request.pose, k) + v for k, v in _OFF.items()})
                hand.begins(bench, [board.scene(off), board.scene(request.pose)])
                self.held = board.scene(request.pose)
                return super().hold_board(bench, board, request)

            def keep(self, bench):
                bench.present(self.held)

            def place(self, bench, what, scene):
                hand.begins(bench, [scene])
                return super().place(bench, what, scene)

            def learn(self, outcome):
                hand.goes_on()
                super().learn(outcome)

            def again(self, step, error, what):
                hand.goes_on()
                return super().again(step, error, what)

        show = GuideWindow.show

        def seen(window, guidance):
            keys = show(window, guidance)
            hand.sees(guidance)
            return keys

        with patch.object(calibration.person, "PersonOperator", Guided), patch.object(GuideWindow, "show", seen):
            yield hand
