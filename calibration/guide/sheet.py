"""A picture that is being drawn: shapes at once, letters at the end, so that none is painted over."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from scanner.preview.canvas import Picture
from scanner.preview.style import GROUND, INK, Colour, font, wrapped

Array = NDArray[np.float64]
Place = tuple[float, float]

LINE_SHARE = 1.25
"""Distance of lines of text by the height of their letters."""

_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


class Box(NamedTuple):
    """A part of the picture, px."""

    left: int
    top: int
    width: int
    height: int

    @property
    def right(self) -> int:
        """First column to the right of it."""
        return self.left + self.width

    @property
    def bottom(self) -> int:
        """First row below it."""
        return self.top + self.height

    def inner(self, margin: int) -> Box:
        """The same without ``margin`` px on all sides."""
        return Box(self.left + margin, self.top + margin, self.width - 2 * margin, self.height - 2 * margin)


class Words(NamedTuple):
    """One line of text: its upper left corner, what it says, how high its letters are, and their colour."""

    left: int
    top: int
    text: str
    points: int
    ink: Colour
    bold: bool


@dataclass
class Sheet:
    """A picture of ``size`` (width, height) to draw on."""

    size: tuple[int, int]
    pixels: Picture = field(init=False)
    words: list[Words] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.pixels = np.empty((self.size[1], self.size[0], 3), np.uint8)
        self.pixels[:] = GROUND

    def part(self, box: Box) -> Picture:
        """The pixels in ``box`` to be drawn on."""
        return self.pixels[box.top : box.bottom, box.left : box.right]

    def write(
        self,
        left: float,
        top: float,
        text: str,
        points: int,
        ink: Colour = INK,
        *,
        bold: bool = False,
        align: float = 0,
    ) -> None:
        """Put one line of text; ``align`` 0.5 centres it at ``left``, 1 ends it there."""
        left -= align * width_of(text, points, bold=bold)
        self.words.append(Words(round(left), round(top), text, points, ink, bold))

    def write_lines(
        self, left: float, top: float, lines: list[str], points: int, ink: Colour = INK, *, bold: bool = False
    ) -> int:
        """Put lines of text below each other; returns the row below them."""
        for line in lines:
            self.write(left, top, line, points, ink, bold=bold)
            top += round(LINE_SHARE * points)
        return round(top)

    def rendered(self) -> Picture:
        """The picture with its letters."""
        image = Image.fromarray(self.pixels)
        pen = ImageDraw.Draw(image)
        for word in self.words:
            pen.text((word.left, word.top), word.text, fill=word.ink, font=font(word.points, bold=word.bold))
        return np.asarray(image)


def width_of(text: str, points: int, *, bold: bool = False) -> int:
    """How long a line is, px."""
    return round(font(points, bold=bold).getlength(text))


def height_of(lines: int, points: int) -> int:
    """How high some lines are, px."""
    return lines * round(LINE_SHARE * points)


def cut(text: str, points: int, wide: int, *, bold: bool = False) -> str:
    """The text, or as much of its beginning as ``wide`` px hold and an ellipsis."""
    letters = font(points, bold=bold)
    if letters.getlength(text) <= wide:
        return text
    while text and letters.getlength(f"{text}…") > wide:
        text = text[:-1].rstrip()
    return f"{text}…"


def set_in(text: str, size: tuple[int, int], points: tuple[int, int], *, bold: bool = False) -> tuple[list[str], int]:
    """Break a text so that it fits into ``size`` px with letters as large as can be.

    Parameters
    ----------
    text
        Any length.
    size
        (width, height), px.
    points
        Smallest and largest letters; what does not fit in the smallest is cut off with an ellipsis.
    bold
        In bold letters.

    Returns
    -------
    lines, points
        And how high their letters are.
    """
    smallest, largest = points
    for tried in range(largest, smallest - 1, -1):
        lines = wrapped(text, font(tried, bold=bold), size[0])
        if height_of(len(lines), tried) <= size[1]:
            return _balanced(text, lines, size[0], tried, bold=bold), tried
    return shortened(lines, smallest, size, bold=bold), smallest


def _balanced(text: str, lines: list[str], wide: int, points: int, *, bold: bool) -> list[str]:
    """Break into as many lines of about the same length, so that no word stands alone."""
    narrower = lines
    while len(narrower) == len(lines) > 1:
        lines, wide = narrower, wide - points
        narrower = wrapped(text, font(points, bold=bold), wide)
    return lines


def shortened(lines: list[str], points: int, size: tuple[int, int], *, bold: bool = False) -> list[str]:
    """As many of the lines as ``size`` holds; the last one says with an ellipsis that there were more."""
    room = max(size[1] // height_of(1, points), 0)
    if len(lines) <= room:
        return lines
    kept = lines[:room]
    if kept:
        kept[-1] = cut(f"{kept[-1]} {' '.join(lines[room:])}", points, size[0], bold=bold)
    return kept


def polyline(pixels: Picture, points: Array, ink: Colour, thick: int = 1, *, closed: bool = False) -> None:
    """Join (n, 2) points by smooth lines, to fractions of a pixel."""
    cv2.polylines(pixels, [_fixed(points)], closed, ink, thick, cv2.LINE_AA, _SHIFT)


def polygon(pixels: Picture, points: Array, ink: Colour, opacity: float = 1.0) -> None:
    """Fill (n, 2) points."""
    if opacity >= 1:
        cv2.fillPoly(pixels, [_fixed(points)], ink, cv2.LINE_AA, _SHIFT)
        return
    over = pixels.copy()
    cv2.fillPoly(over, [_fixed(points)], ink, cv2.LINE_AA, _SHIFT)
    pixels[:] = cv2.addWeighted(over, opacity, pixels, 1 - opacity, 0)


def disc(pixels: Picture, centre: Place, radius: float, ink: Colour) -> None:
    """Fill a circle."""
    cv2.circle(pixels, _point(centre), round(radius * 2**_SHIFT), ink, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def ring(pixels: Picture, centre: Place, radius: float, ink: Colour, thick: int = 1) -> None:
    """Draw a circle."""
    cv2.circle(pixels, _point(centre), round(radius * 2**_SHIFT), ink, thick, cv2.LINE_AA, _SHIFT)


def cross(pixels: Picture, centre: Place, radius: float, ink: Colour, thick: int = 1) -> None:
    """Draw an upright cross."""
    x, y = centre
    polyline(pixels, np.array([(x - radius, y), (x + radius, y)]), ink, thick)
    polyline(pixels, np.array([(x, y - radius), (x, y + radius)]), ink, thick)


def arrow(pixels: Picture, start: Array, end: Array, ink: Colour, thick: int, head: float) -> None:
    """Draw an arrow whose head is ``head`` px long."""
    length = float(np.hypot(*(end - start)))
    if length < 1:
        return
    along = (end - start) / length
    across = np.array([-along[1], along[0]])
    head = min(head, length)
    neck = end - head * along
    polyline(pixels, np.array([start, neck]), ink, thick)
    polygon(pixels, np.array([end, neck + 0.45 * head * across, neck - 0.45 * head * across]), ink)


def _fixed(points: Array) -> NDArray[np.int32]:
    # OpenCV's coordinates overflow far outside of the picture.
    near = np.clip(points, -30_000, 30_000)
    return np.asarray(np.rint(near * 2**_SHIFT), np.int32).reshape(-1, 1, 2)


def _point(place: Place) -> tuple[int, int]:
    x, y = _fixed(np.array([place])).reshape(2)
    return int(x), int(y)
