"""The operator's screen as it is shown: what to do in large letters, the live picture, what is covered, the keys."""

from __future__ import annotations

import numpy as np

from calibration.guide.guidance import STEPS, Guidance
from calibration.guide.overlay import draw_live
from calibration.guide.panel import draw_panel
from calibration.guide.sheet import Box, Sheet, cut, height_of, set_in, width_of
from drivers import FrameFormat
from scanner.preview.canvas import Picture, fitted
from scanner.preview.style import BAD, DIM, GOOD, GROUND, INK, TRACK, ZONE

LEAST_SIZE = (800, 600)
"""(width, height) of the smallest canvas on which all is legible, px."""

_CUT_BELOW = (400, 300)
_PANEL_SHARE = 0.29


def draw(guidance: Guidance, size: tuple[int, int]) -> Picture:
    """Draw the whole canvas.

    Parameters
    ----------
    guidance
        What is shown.
    size
        (width, height), px; what is smaller than `LEAST_SIZE` shows less, down to a small part of it all.

    Returns
    -------
    NDArray
        (height, width, 3) red, green, blue.
    """
    width, height = size
    whole = compose(guidance, (max(width, _CUT_BELOW[0]), max(height, _CUT_BELOW[1]))).rendered()
    return np.ascontiguousarray(whole[:height, :width])


def compose(guidance: Guidance, size: tuple[int, int]) -> Sheet:
    """Draw all but the letters, which are still known line by line."""
    sheet = Sheet(size)
    points = letters_of(size)
    _header(sheet, guidance, points)
    box = picture_area(guidance.frame_format, size)
    draw_live(sheet, box, guidance, points)
    draw_panel(sheet, _panel_area(box, size), guidance, points)
    _footer(sheet, guidance, points)
    return sheet


def letters_of(size: tuple[int, int]) -> int:
    """Height of the small letters on a canvas, px: about a fiftieth of its height."""
    return min(max(round(min(size[1] / 50, size[0] / 66)), 11), 24)


def picture_area(frame_format: FrameFormat, size: tuple[int, int]) -> Box:
    """Where the live picture is on a canvas of ``size``."""
    points = letters_of(size)
    top, bottom = _header_height(points), _footer_height(points)
    room = max(size[0] - round(_PANEL_SHARE * size[0]), 64), max(size[1] - top - bottom, 64)
    return Box(0, top, *fitted((frame_format.width, frame_format.height), room, whole=False))


def flashed(picture: Picture, good: bool, text: str) -> Picture:
    """The picture in a broad frame that is seen from the corner of an eye, with a few words across.

    Parameters
    ----------
    picture
        As `draw` gives it.
    good
        Green, or else red.
    text
        Such as ``taken``.
    """
    height, width = picture.shape[:2]
    sheet = Sheet((width, height))
    sheet.pixels[:] = picture
    ink, edge = GOOD if good else BAD, max(height // 30, 6)
    for part in (np.s_[:edge], np.s_[-edge:], np.s_[:, :edge], np.s_[:, -edge:]):
        sheet.pixels[part] = ink
    lines, points = set_in(text, (width - 6 * edge, height // 3), (height // 40, height // 10), bold=True)
    high = height_of(len(lines), points) + points
    band = Box(edge, (height - high) // 2, width - 2 * edge, high)
    sheet.part(band)[:] = ink
    for number, line in enumerate(lines):
        top = band.top + points // 2 + height_of(number, points)
        sheet.write(width / 2, top, line, points, GROUND, bold=True, align=0.5)
    return sheet.rendered()


def _large(points: int) -> int:
    """Letters that are read from two metres."""
    return round(2.3 * points)


def _header_height(points: int) -> int:
    return 2 * points + height_of(1, points) + height_of(2, _large(points))


def _footer_height(points: int) -> int:
    return round(2.9 * points)


def _panel_area(picture: Box, size: tuple[int, int]) -> Box:
    points = letters_of(size)
    left = picture.right + points
    return Box(left, picture.top, size[0] - left - points, size[1] - picture.top - _footer_height(points))


def _header(sheet: Sheet, guidance: Guidance, points: int) -> None:
    """Title, the steps with the present one marked, and the instruction."""
    wide, top = sheet.size[0] - 2 * points, round(0.7 * points)
    left = float(sheet.size[0] - points)
    for step in reversed(STEPS):
        here = step == guidance.step
        length = width_of(step, points, bold=here)
        left -= length
        sheet.write(left, top, step, points, INK if here else DIM, bold=here)
        if here:
            under = Box(round(left), top + height_of(1, points) + 1, length, max(points // 6, 2))
            sheet.part(under)[:] = ZONE
        left -= points
    title = cut(guidance.title, points, round(left) - points, bold=True)
    sheet.write(points, top, title, points, ZONE, bold=True)
    top += height_of(1, points) + round(0.6 * points)
    room = height_of(2, _large(points))
    lines, large = set_in(guidance.instruction, (wide, room), (points, round(1.4 * _large(points))))
    sheet.write_lines(points, top + (room - height_of(len(lines), large)) // 2, lines, large, INK)


def _footer(sheet: Sheet, guidance: Guidance, points: int) -> None:
    """The keys, each on a cap, and whether all this is simulated."""
    width, height = sheet.size
    band = Box(0, height - _footer_height(points), width, _footer_height(points))
    sheet.part(band)[:] = (16, 17, 20)
    right = width - points
    if guidance.simulated:
        stamp = "SIMULATED DATA"
        sheet.write(right, band.top + 0.85 * points, stamp, points, BAD, bold=True, align=1)
        right -= width_of(stamp, points, bold=True) + points
    letters = next((p for p in range(round(1.2 * points), 8, -1) if _keys_width(guidance, p) <= right - points), 8)
    left, top = points, round(band.top + (band.height - 1.2 * letters) / 2)
    for key, what in guidance.keys:
        cap = width_of(key, letters, bold=True) + letters
        if left + cap + width_of(what, letters) + letters > right:
            break
        box = Box(left, band.top + points // 2, cap, band.height - 2 * (points // 2))
        sheet.part(box)[:] = TRACK
        sheet.part(box._replace(top=box.bottom - 2, height=2))[:] = DIM
        sheet.write(left + letters / 2, top, key, letters, INK, bold=True)
        sheet.write(left + cap + letters / 2, top, what, letters, INK)
        left += cap + width_of(what, letters) + 2 * letters


def _keys_width(guidance: Guidance, letters: int) -> int:
    return sum(width_of(key, letters, bold=True) + width_of(what, letters) + 3 * letters for key, what in guidance.keys)
