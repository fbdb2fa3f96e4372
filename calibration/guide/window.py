"""The guide in a window on the operator's screen, which is not the one that the bench projects on."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

from rich.console import Console

from calibration.guide.canvas import LEAST_SIZE, draw, flashed
from calibration.guide.guidance import Guidance
from calibration.guide.keys import meant
from calibration.guide.lines import GuideLines
from drivers import OperatorError
from scanner.preview.canvas import Picture
from scanner.preview.lines import read_keys
from scanner.preview.window import PictureWindow, most_of, operator_area, projected_areas

FLASH_S = 1.2
"""How long a flash is seen, s."""


class GuideError(OperatorError):
    """The guide cannot be shown."""


class GuideWindow:
    """A window that shows guidance and gives the keys that were pressed; a context manager.

    Keys that are typed in the terminal count as well, so that it does not matter which of the two has the focus.

    Parameters
    ----------
    document
        Snapshot of the bench (`drivers.Bench.describe`), which tells what is projected on.
    caption
        Of the window.

    Raises
    ------
    GuideError
        No screen is free of the projector's picture.
    """

    def __init__(self, document: Mapping[str, Any], caption: str = "calibrate") -> None:
        place = operator_area(projected_areas(document), LEAST_SIZE)
        if place is None:
            raise GuideError(
                f"no screen has {LEAST_SIZE[0]} × {LEAST_SIZE[1]} px that are free of the projector's picture",
                "Connect a screen beside the projector, or set DISPLAY to the desktop you sit at; without one, "
                "calibrate is led by plain lines in the terminal.",
            )
        screen, area = place
        wide, high = (max(wanted, least) for wanted, least in zip(most_of(area), LEAST_SIZE, strict=True))
        self._window = PictureWindow(screen, area, caption, (wide, high), LEAST_SIZE)
        self._stack = ExitStack()
        self._typed: Callable[[], list[str]] = list
        self._shown: Picture | None = None
        self._flash: tuple[bool, str] = False, ""
        self._flash_until = 0.0

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._typed = stack.enter_context(read_keys())
            stack.enter_context(self._window)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def show(self, guidance: Guidance) -> list[str]:
        """Draw and show at once; returns the keys pressed since the last call, in order, without waiting.

        Letters and figures are themselves, others are ``space``, ``left``, ``backspace`` and so on; see
        `calibration.guide.keys.meant`.
        """
        self._shown = draw(guidance, self._window.size)
        self._paint()
        return meant((*self._window.pressed(), *self._typed()))

    def flash(self, good: bool, text: str) -> None:
        """Put a green or red frame and a few words around what is shown, at once and for `FLASH_S`, and ring the bell.

        The bell rings once for good and twice for bad.
        """
        self._flash, self._flash_until = (good, text), time.monotonic() + FLASH_S
        self._window.ring(1 if good else 2)
        self._paint()

    def _paint(self) -> None:
        if self._shown is None:
            return
        flashes = time.monotonic() < self._flash_until
        self._window.show(flashed(self._shown, *self._flash) if flashes else self._shown)


Guide = GuideWindow | GuideLines
"""What shows guidance."""


def guide_for(document: Mapping[str, Any], console: Console, caption: str = "calibrate") -> Guide:
    """A window where a screen is free for it, or else lines in the terminal.

    Parameters
    ----------
    document
        Snapshot of the bench.
    console
        For the lines.
    caption
        Of the window.
    """
    try:
        return GuideWindow(document, caption)
    except GuideError as error:
        console.print(f"{error.message}: plain lines instead", style="dim", markup=False)
        return GuideLines(console)
