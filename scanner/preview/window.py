"""A window with the live picture on the operator's screen, which is not the one that the bench projects on."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

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


def operator_area(taken: Sequence[Area]) -> tuple[Any, Area] | None:
    """The largest part of the desktop that nothing is projected on, and the pyglet screen it is on; None for none."""
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
        free += [(screen, a) for a in areas if a.width >= LEAST_SIZE[0] and a.height >= LEAST_SIZE[1]]
    return max(free, key=lambda found: found[1].width * found[1].height, default=None)


def save(live: Live, picture: Picture, path: Path) -> Path:
    """Write the drawn picture to ``path``, and the frame as the camera gave it beside it; returns where that is."""
    Image.fromarray(picture).save(path, format="PNG")
    frame = path.with_name(f"{path.stem}-frame.png")
    cv2.imwrite(str(frame), live.frame)
    return frame


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
        self._screen = screen
        self._area = area
        self.coloured = coloured
        self.folder = folder
        self.frozen = False
        self._note = ""
        self._texture: Any = None
        self._open = False
        self._placed_by = 0.0
        self._size = (1, 1)
        self._pixels_per_unit = 1.0

    def run(self) -> None:
        """Take and show frames until the operator quits."""
        with self._window() as window:
            while self._open:
                if not self.frozen:
                    self.live.take()
                self._show(window)
                window.dispatch_events()
                if time.monotonic() < self._placed_by:
                    self._place(window)
                if self.frozen:
                    time.sleep(_FROZEN_S)

    @contextlib.contextmanager
    def _window(self) -> Iterator[Any]:
        import pyglet

        area = self._area
        size = round(area.width * _SHARE_OF_AREA), round(area.height * _SHARE_OF_AREA)
        needed = max(picture_size(self.live.bench.frame_format, size)[1], PANEL_PX[1])
        size = size[0], min(size[1], needed)
        window = pyglet.window.Window(
            *size,
            caption=f"scan preview – {self.live.bench.name}",
            resizable=True,
            screen=self._screen,
            vsync=False,
            visible=False,
        )
        try:
            window.push_handlers(self)
            window.set_minimum_size(*LEAST_SIZE)
            self._place(window)
            window.set_visible(True)
            self._placed_by = time.monotonic() + _PLACING_S
            self._open = True
            yield window
        finally:
            window.close()

    def _place(self, window: Any) -> None:
        """Move the window to the middle of its area unless it is inside; window managers put new ones elsewhere."""
        area, (x, y) = self._area, window.get_location()
        inside = area.x <= x and x + window.width <= area.x + area.width
        if not (inside and area.y <= y and y + window.height <= area.y + area.height):
            left, top = (area.width - window.width) // 2, (area.height - window.height) // 2
            window.set_location(area.x + left, area.y + top)

    def _show(self, window: Any) -> None:
        import pyglet

        self._size = size = window.get_framebuffer_size()
        self._pixels_per_unit = size[0] / window.width
        picture = self._draw(size)
        window.switch_to()
        if self._texture is None or (self._texture.width, self._texture.height) != size:
            self._texture = pyglet.image.Texture.create(*size)
        # The array's first row is the top, an OpenGL picture's the bottom: a negative pitch turns it.
        data = pyglet.image.ImageData(size[0], size[1], "RGB", picture.tobytes(), pitch=-3 * size[0])
        self._texture.blit_into(data, 0, 0, 0)
        window.clear()
        self._texture.blit(0, 0, width=window.width, height=window.height)
        window.flip()

    def _draw(self, size: tuple[int, int]) -> Picture:
        note = "frozen: space goes on" if self.frozen else self._note
        return draw(self.live, size, coloured=self.coloured, note=note)

    def on_key_press(self, symbol: int, modifiers: int) -> bool:
        """Do what the key says."""
        from pyglet.window import key

        if symbol in (key.Q, key.ESCAPE):
            self._open = False
        elif symbol == key.SPACE:
            self.frozen = not self.frozen
        elif symbol == key.C:
            self.coloured = not self.coloured
        elif symbol == key.B:
            self.live.look_at(self.live.centre)
        elif symbol == key.S:
            path = self.folder / f"preview-{datetime.now():%Y%m%d-%H%M%S}.png"
            save(self.live, self._draw((1280, 800)), path)
            self._note = f"saved {path.name}"
        return True  # pyglet's own Escape does not ask whether the projector is dark

    def on_mouse_press(self, x: int, y: int, button: int, modifiers: int) -> None:
        """Look where the operator points."""
        width, height = picture_size(self.live.bench.frame_format, self._size)
        column, row = x * self._pixels_per_unit, self._size[1] - y * self._pixels_per_unit
        if column < width and row < height:
            self.live.look_at((column / width, row / height))

    def on_close(self) -> None:
        """End the loop; the window is closed behind it."""
        self._open = False
