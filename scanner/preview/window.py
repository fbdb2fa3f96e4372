"""A window with the live picture on the operator's screen, which is not the one that the bench projects on."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import cv2
from PIL import Image

from scanner.preview.canvas import PANEL_PX, Picture, draw, picture_size
from scanner.preview.live import Live

_SHARE_OF_AREA = 0.85
_FROZEN_S = 0.02
_PLACING_S = 3.0


LEAST_SIZE = (640, 480)
"""(width, height) of the smallest window that shows anything, px."""


class Area(NamedTuple):
    """A part of the desktop, px from its upper left corner."""

    x: int
    y: int
    width: int
    height: int

    def overlaps(self, other: Area) -> bool:
        """True where the two have a pixel in common."""
        return (
            self.x < other.x + other.width
            and other.x < self.x + self.width
            and self.y < other.y + other.height
            and other.y < self.y + self.height
        )

    def without(self, other: Area) -> list[Area]:
        """Largest rectangles of this one that have no pixel in common with ``other``: left, right, above, below."""
        if not self.overlaps(other):
            return [self]
        right, bottom = self.x + self.width, self.y + self.height
        pieces = (
            Area(self.x, self.y, other.x - self.x, self.height),
            Area(other.x + other.width, self.y, right - other.x - other.width, self.height),
            Area(self.x, self.y, self.width, other.y - self.y),
            Area(self.x, other.y + other.height, self.width, bottom - other.y - other.height),
        )
        return [piece for piece in pieces if piece.width > 0 and piece.height > 0]


def projected_areas(document: Mapping[str, Any]) -> list[Area]:
    """Parts of this desktop that a bench projects on: ``screen.area_px`` of any device in its snapshot."""
    found = []
    screen = document.get("screen")
    if isinstance(screen, Mapping) and "area_px" in screen:
        display = (document.get("settings") or {}).get("display")
        if display in (None, os.environ.get("DISPLAY")):
            found.append(Area(*screen["area_px"]))
    for value in document.values():
        if isinstance(value, Mapping):
            found += projected_areas(value)
    return found


def operator_area(taken: Sequence[Area], least: tuple[int, int] = LEAST_SIZE) -> tuple[Any, Area] | None:
    """The largest part of the desktop that nothing is projected on, and the pyglet screen it is on; None for none.

    Parameters
    ----------
    taken
        What is projected on; see `projected_areas`.
    least
        (width, height) that such a part has at least, px.
    """
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        return None
    try:
        import pyglet

        pyglet.options["shadow_window"] = False
        screens = pyglet.display.get_display().get_screens()
    except Exception:  # a library that is not there, a server that refuses: the figures can do without a window
        return None
    free = []
    for screen in screens:
        areas = [Area(screen.x, screen.y, screen.width, screen.height)]
        for other in taken:
            areas = [piece for area in areas for piece in area.without(other)]
        free += [(screen, a) for a in areas if a.width >= least[0] and a.height >= least[1]]
    return max(free, key=lambda found: found[1].width * found[1].height, default=None)


def save(live: Live, picture: Picture, path: Path) -> Path:
    """Write the drawn picture to ``path``, and the frame as the camera gave it beside it; returns where that is."""
    Image.fromarray(picture).save(path, format="PNG")
    frame = path.with_name(f"{path.stem}-frame.png")
    cv2.imwrite(str(frame), live.frame)
    return frame


class PictureWindow:
    """A window on the operator's screen that shows pictures and collects keys and clicks; a context manager.

    Parameters
    ----------
    screen, area
        The pyglet screen to be on, and the part of the desktop to stay in; see `operator_area`.
    caption
        Title of the window.
    size
        (width, height) it begins with, px; None takes most of the area.
    least
        (width, height) to which it can be made smaller, px.
    """

    def __init__(
        self,
        screen: Any,
        area: Area,
        caption: str,
        size: tuple[int, int] | None = None,
        least: tuple[int, int] = LEAST_SIZE,
    ) -> None:
        self._screen = screen
        self._area = area
        self._caption = caption
        self._first_size = size or most_of(area)
        self._least = least
        self._window: Any = None
        self._texture: Any = None
        self._placed_by = 0.0
        self._keys: list[str] = []
        self._clicks: list[tuple[float, float]] = []

    def __enter__(self) -> Self:
        import pyglet

        self._window = pyglet.window.Window(
            *self._first_size, caption=self._caption, resizable=True, screen=self._screen, vsync=False, visible=False
        )
        try:
            self._window.push_handlers(self)
            self._window.set_minimum_size(*self._least)
            self._place()
            self._window.set_visible(True)
            self._placed_by = time.monotonic() + _PLACING_S
        except BaseException:
            self._window.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._window.close()
        self._window = self._texture = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures that fill it now, px."""
        width, height = self._window.get_framebuffer_size()
        return int(width), int(height)

    def show(self, picture: Picture) -> None:
        """Show a picture (H, W, 3) over the whole window, and see what the operator did."""
        import pyglet

        window, (height, width) = self._window, picture.shape[:2]
        window.switch_to()
        if self._texture is None or (self._texture.width, self._texture.height) != (width, height):
            self._texture = pyglet.image.Texture.create(width, height)
        # The array's first row is the top, an OpenGL picture's the bottom: a negative pitch turns it.
        data = pyglet.image.ImageData(width, height, "RGB", picture.tobytes(), pitch=-3 * width)
        self._texture.blit_into(data, 0, 0, 0)
        window.clear()
        self._texture.blit(0, 0, width=window.width, height=window.height)
        window.flip()
        window.dispatch_events()
        if time.monotonic() < self._placed_by:
            self._place()

    def pressed(self) -> list[str]:
        """Keys pressed since the last call, in order.

        Letters and figures are themselves, others have names such as ``space``, ``escape`` and ``left``; ``close`` says
        that the operator wants the window closed.
        """
        found, self._keys = self._keys, []
        return found

    def clicked(self) -> list[tuple[float, float]]:
        """(column, row) of the picture that were clicked since the last call."""
        found, self._clicks = self._clicks, []
        return found

    def ring(self, times: int = 1) -> None:
        """Ring the bell of the screen, where it has one."""
        display = getattr(getattr(self._window, "display", None), "_display", None)
        if display is not None and sys.platform.startswith("linux"):
            from pyglet.libs.x11 import xlib

            for _ in range(times):
                xlib.XBell(display, 0)
            xlib.XFlush(display)

    def _place(self) -> None:
        """Move the window to the middle of its area unless it is inside; window managers put new ones elsewhere."""
        window, area = self._window, self._area
        x, y = window.get_location()
        inside = area.x <= x and x + window.width <= area.x + area.width
        if not (inside and area.y <= y and y + window.height <= area.y + area.height):
            left, top = (area.width - window.width) // 2, (area.height - window.height) // 2
            window.set_location(area.x + left, area.y + top)

    def on_key_press(self, symbol: int, modifiers: int) -> bool:
        """Keep the key."""
        from pyglet.window import key

        self._keys.append(key.symbol_string(symbol).removeprefix("_").lower())
        return True  # pyglet's own Escape does not ask whether the projector is dark

    def on_mouse_press(self, x: int, y: int, button: int, modifiers: int) -> None:
        """Keep where the operator points."""
        width, height = self.size
        scale = width / self._window.width
        self._clicks.append((x * scale, height - y * scale))

    def on_close(self) -> bool:
        """Say so; whoever shows pictures ends."""
        self._keys.append("close")
        return True


def most_of(area: Area) -> tuple[int, int]:
    """(width, height) of a new window that leaves something of ``area`` to see around it, px."""
    return round(area.width * _SHARE_OF_AREA), round(area.height * _SHARE_OF_AREA)


class PreviewWindow:
    """A window that shows a `Live` until it is closed.

    Parameters
    ----------
    live
        What is shown.
    screen, area
        The pyglet screen to be on, and the part of the desktop to stay in; see `operator_area`.
    coloured
        Begin with saturated and dark pixels marked.
    folder
        Where pictures are saved.
    """

    def __init__(self, live: Live, screen: Any, area: Area, *, coloured: bool = True, folder: Path = Path()) -> None:
        self.live = live
        self.coloured = coloured
        self.folder = folder
        self.frozen = False
        self._note = ""
        size = most_of(area)
        needed = max(picture_size(live.bench.frame_format, size)[1], PANEL_PX[1])
        self._window = PictureWindow(screen, area, f"scan preview – {live.bench.name}", (size[0], min(size[1], needed)))

    def run(self) -> None:
        """Take and show frames until the operator quits."""
        with self._window as window:
            while True:
                if not self.frozen:
                    self.live.take()
                window.show(self._draw(window.size))
                for click in window.clicked():
                    self._look_at(click)
                for key in window.pressed():
                    if key in ("q", "escape", "close"):
                        return
                    self._obey(key)
                if self.frozen:
                    time.sleep(_FROZEN_S)

    def _draw(self, size: tuple[int, int]) -> Picture:
        note = "frozen: space goes on" if self.frozen else self._note
        return draw(self.live, size, coloured=self.coloured, note=note)

    def _obey(self, key: str) -> None:
        """Do what the key says."""
        if key == "space":
            self.frozen = not self.frozen
        elif key == "c":
            self.coloured = not self.coloured
        elif key == "b":
            self.live.look_at(self.live.centre)
        elif key == "s":
            path = self.folder / f"preview-{datetime.now():%Y%m%d-%H%M%S}.png"
            save(self.live, self._draw((1280, 800)), path)
            self._note = f"saved {path.name}"

    def _look_at(self, place: tuple[float, float]) -> None:
        """Look where the operator points."""
        width, height = picture_size(self.live.bench.frame_format, self._window.size)
        if place[0] < width and place[1] < height:
            self.live.look_at((place[0] / width, place[1] / height))
