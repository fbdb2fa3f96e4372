"""The guide where there is no screen for it: plain lines in the terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.text import Text

from calibration.guide.guidance import Guidance
from calibration.guide.keys import meant
from scanner.preview.canvas import percent
from scanner.preview.lines import read_keys

EVERY_S = 1.0
"""Least time between two lines about the same instruction, s."""

_STYLES = {"unseen": "red", "far": "yellow", "near": "yellow", "there": "green"}


class GuideLines:
    """Shows guidance in the terminal with the methods of `calibration.guide.window.GuideWindow`; a context manager.

    Keys are read without waiting where the standard input is a terminal; elsewhere there are none.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stack = ExitStack()
        self._typed: Callable[[], list[str]] = list
        self._told = ("", "", "")
        self._hints: tuple[str, ...] = ()
        self._state = ""
        self._at = -math.inf

    def __enter__(self) -> Self:
        self._typed = self._stack.enter_context(read_keys())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def show(self, guidance: Guidance) -> list[str]:
        """Print what is new; returns the keys pressed since the last call, in order, without waiting.

        An instruction and a warning are printed when they change; what the board and the figures do, at most once in
        `EVERY_S`.
        """
        told = guidance.step, guidance.title, guidance.instruction
        if told != self._told:
            stamp = "SIMULATED DATA · " if guidance.simulated else ""
            self._say(Text(f"{stamp}{guidance.step} · {guidance.title}", "dim"))
            self._say(Text(guidance.instruction, "bold"))
            if guidance.keys:
                self._say(Text(" · ".join(f"{key} {what}" for key, what in guidance.keys), "dim"))
            self._state, self._hints, self._at = "", (), -math.inf
        self._told = told
        for hint in guidance.hints:
            if hint not in self._hints:
                self._say(Text(f"! {hint}", "yellow"))
        self._hints = guidance.hints
        state = state_line(guidance)
        if state != self._state and time.monotonic() - self._at >= EVERY_S:
            self._say(Text(state, _STYLES[guidance.nearness] if guidance.is_about_board else ""))
            self._state, self._at = state, time.monotonic()
        return meant(self._typed())

    def flash(self, good: bool, text: str) -> None:
        """Print a few words in green or red, with the terminal's bell, once for good and twice for bad."""
        if self._console.is_terminal:
            self._console.bell()
            if not good:
                self._console.bell()
        self._say(Text(f"{'✓' if good else '✗'} {text}", "bold green" if good else "bold red"))

    def _say(self, text: Text) -> None:
        self._console.print(text, soft_wrap=True)


def state_line(guidance: Guidance) -> str:
    """Say in one line how the board is held, and the figures."""
    parts = []
    if guidance.is_about_board:
        count = 0 if guidance.view is None else len(guidance.view.ids)
        parts.append("no board seen" if guidance.nearness == "unseen" else f"board seen, {count} points")
        if guidance.target is not None and guidance.nearness == "there":
            parts.append("there: hold it still")
        parts += guidance.moves
    parts += [f"{bar.label} {bar.text}" for bar in guidance.bars]
    reading = guidance.reading
    if reading is not None:
        parts.append(f"saturated {percent(reading.saturated_share)}")
        parts.append(f"brightest {100 * reading.brightest:.0f} %")
        if math.isfinite(reading.focus):
            parts.append(f"focus {1000 * reading.focus:.1f}")
    return " · ".join(parts)
