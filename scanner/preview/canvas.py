"""The live picture as it is shown: grey values with false colours, a magnifier, and the figures beside it.

Everything is drawn into an array, so that window, saved picture and tests see the same, whatever the screen can do.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from drivers import FrameFormat, Pixels
from scanner.preview.measures import dark_below_dn
from scanner.preview.style import BAD, CAUTION, DIM, GOOD, GROUND, INK, TRACK, ZONE, font, wrapped

if TYPE_CHECKING:
    from scanner.preview.live import Live

Picture = NDArray[np.uint8]
"""(H, W, 3) red, green, blue."""

SATURATED = (255, 0, 0)
DARK = (0, 0, 160)
PANEL_PX = (340, 640)
"""(width, height) that the column of figures takes."""

_MARGIN = 14
_KEYS = "q quit · space freeze · s save · c colours · b best anew · click: look there"


def false_colours(
    frame: Pixels, frame_format: FrameFormat, size: tuple[int, int], coloured: bool = True, *, dark: bool = True
) -> Picture:
    """Grey picture of ``size`` (width, height) with saturated pixels red and too dark ones blue.

    However much it is shrunk, a spot that holds a single saturated pixel is red.

    Parameters
    ----------
    frame
        (H, W) grey values.
    frame_format
        Says what is saturated.
    size
        Of the result, px.
    coloured
        False leaves the colours out.
    dark
        False leaves out the colour of too dark pixels only.
    """
    shrinks = size[0] < frame.shape[1] or size[1] < frame.shape[0]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    full = frame_format.saturated_dn
    grey = cv2.resize(cv2.convertScaleAbs(frame, alpha=255 / full), size, interpolation=how)
    shown: Picture = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8, copy=False)
    if coloured:
        # A spot is dark where all its pixels are, and saturated where one is.
        if dark:
            too_dark = 255 * (frame < dark_below_dn(full)).view(np.uint8)
            shown[cv2.resize(too_dark, size, interpolation=how) == 255] = DARK
        saturated = 255 * (frame >= full).view(np.uint8)
        shown[cv2.resize(saturated, size, interpolation=how) > 0] = SATURATED
    return shown


def fitted(frame_size: tuple[int, int], room: tuple[int, int], *, whole: bool = True) -> tuple[int, int]:
    """Largest (width, height) of the frame's aspect in ``room``; magnified by whole numbers only, or by any."""
    scale = min(room[0] / frame_size[0], room[1] / frame_size[1])
    if scale >= 1 and whole:
        scale = math.floor(scale)
    return max(round(frame_size[0] * scale), 1), max(round(frame_size[1] * scale), 1)


def picture_size(frame_format: FrameFormat, size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of the live picture on a canvas of ``size``; its corner is the canvas's."""
    room = max(size[0] - PANEL_PX[0], 64), max(size[1], 64)
    return fitted((frame_format.width, frame_format.height), room)


def draw(live: Live, size: tuple[int, int], *, coloured: bool = True, note: str = "") -> Picture:
    """The whole canvas: live picture on the left, magnifier and figures on the right.

    Parameters
    ----------
    live
        With a frame.
    size
        (width, height), px.
    coloured
        Mark saturated and dark pixels.
    note
        One more line, such as ``frozen``.
    """
    fmt = live.bench.frame_format
    canvas = np.empty((size[1], size[0], 3), np.uint8)
    canvas[:] = GROUND
    width, height = picture_size(fmt, size)
    canvas[:height, :width] = false_colours(live.frame, fmt, (width, height), coloured)[: size[1], : size[0]]
    rows, columns = live.zone
    scale = width / fmt.width
    first = round(columns.start * scale), round(rows.start * scale)
    last = round(columns.stop * scale) - 1, round(rows.stop * scale) - 1
    cv2.rectangle(canvas, first, last, ZONE, 1)
    _panel(canvas, size[0] - PANEL_PX[0], live, coloured, note)
    return canvas


def _panel(canvas: Picture, left: int, live: Live, coloured: bool, note: str) -> None:
    canvas[:, left:] = GROUND
    x, wide = left + _MARGIN, PANEL_PX[0] - 2 * _MARGIN
    fmt, reading = live.bench.frame_format, live.reading
    top = _MARGIN
    magnifier = (wide, wide * 3 // 4)
    draw_magnified(canvas[top : top + magnifier[1], x : x + wide], live.frame, fmt, live.zone, coloured)
    top += magnifier[1] + 10
    draw_histogram(canvas[top : top + 90, x : x + wide], reading.histogram)
    top += 96
    image = Image.fromarray(canvas[:, left:])
    pen = ImageDraw.Draw(image)

    def line(text: str, ink: tuple[int, int, int] = INK, points: int = 14, gap: int = 6) -> None:
        nonlocal top
        for part in wrapped(text, font(points), wide):
            pen.text((_MARGIN, top), part, fill=ink, font=font(points))
            top += points + gap

    def bar(share: float, ink: tuple[int, int, int]) -> None:
        nonlocal top
        pen.rectangle((_MARGIN, top, _MARGIN + wide, top + 10), fill=TRACK)
        if math.isfinite(share) and share > 0:
            pen.rectangle((_MARGIN, top, _MARGIN + round(wide * min(share, 1.0)), top + 10), fill=ink)
        top += 18

    line("grey values, black to full scale", DIM, 11)
    too_much = reading.saturated_share > live.scan.max_saturated_share
    line(f"saturated {percent(reading.saturated_share)}   {reading.saturated:,} px", BAD if too_much else INK)
    line(f"too dark {percent(reading.dark_share)}   mean {100 * reading.mean:.0f} % of full scale")
    if live.hint:
        line(live.hint, GOOD if live.hint.endswith("good") else INK)
    top += 6
    ratio = reading.focus / live.best_focus if live.best_focus > 0 else math.nan
    line(focus_line(live))
    bar(ratio, GOOD if ratio > 0.97 else CAUTION)
    top += 4
    period = f" · {live.frames_per_s:.1f} frames/s" if math.isfinite(live.frames_per_s) else ""
    line(f"{fmt.width} × {fmt.height} px, {fmt.bits} bit{period}", DIM, 12)
    line(f"{live.bench.name} · {live.pattern}", DIM, 12)
    if live.bench.simulated:
        line("SIMULATED DATA", BAD, 14)
    if live.trouble:
        line(live.trouble, BAD, 12)
    if note:
        line(note, GOOD, 14)
    top = max(top + 6, canvas.shape[0] - 36)
    line(_KEYS, DIM, 11, 3)
    canvas[:, left:] = np.asarray(image)


def focus_line(live: Live) -> str:
    """Focus and the best of it so far, in words."""
    if not math.isfinite(live.reading.focus):
        return "focus: nothing to see here"
    share = f"   {100 * live.reading.focus / live.best_focus:.0f} % of the best" if live.best_focus > 0 else ""
    return f"focus {1000 * live.reading.focus:.2f}{share}"


def percent(share: float) -> str:
    """A share with two digits, and never 0 % where there is something."""
    return f"{100 * share:.2f} %" if share == 0 or share >= 5e-5 else "< 0.01 %"


def draw_magnified(
    place: Picture, frame: Pixels, frame_format: FrameFormat, zone: tuple[slice, slice], coloured: bool = True
) -> None:
    """Fill ``place`` with the middle of a zone, at least twice as large as in the camera's own pixels.

    Parameters
    ----------
    place
        (h, w, 3) the part of a canvas to draw on.
    frame, frame_format
        (H, W) grey values.
    zone
        Rows and columns of the frame.
    coloured
        Mark saturated and dark pixels.
    """
    rows, columns = zone
    height, width = place.shape[:2]
    zoom = 2
    while (columns.stop - columns.start) * zoom < width or (rows.stop - rows.start) * zoom < height:
        zoom += 1
    width, height = width // zoom, height // zoom
    left = max((columns.start + columns.stop - width) // 2, 0)
    top = max((rows.start + rows.stop - height) // 2, 0)
    part = frame[top : top + height, left : left + width]
    shown = false_colours(part, frame_format, (part.shape[1] * zoom, part.shape[0] * zoom), coloured)
    seen = place[: shown.shape[0], : shown.shape[1]]
    seen[:] = shown[: seen.shape[0], : seen.shape[1]]


def draw_histogram(place: Picture, shares: NDArray[np.float64]) -> None:
    """Bars on a root scale over all of ``place`` (h, w, 3), so that few bright pixels are seen beside many dark ones.

    Parameters
    ----------
    place
        The part of a canvas to draw on.
    shares
        (n,) of the pixels by grey value, from black to full scale.
    """
    bottom, width = place.shape[0] - 1, place.shape[1]
    edges = np.linspace(0, width, len(shares) + 1).round().astype(int)
    heights = np.sqrt(shares / max(float(shares.max()), 1e-9)) * bottom
    place[bottom:] = DIM
    for number, height in enumerate(heights):
        ink = SATURATED if number == len(shares) - 1 else INK
        place[bottom - round(height) : bottom, edges[number] : max(edges[number + 1] - 1, edges[number] + 1)] = ink
