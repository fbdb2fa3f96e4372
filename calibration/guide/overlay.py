"""The live picture with what is drawn over it: the board as it is found, and where it is to be held."""

from __future__ import annotations

import numpy as np

from calibration.guide.guidance import Guidance, Nearness
from calibration.guide.sheet import Array, Box, Sheet, arrow, cut, disc, polygon, polyline, ring, width_of
from drivers import FrameFormat
from scanner.preview.canvas import Picture, false_colours
from scanner.preview.style import BAD, GOOD, GROUND, INK, ZONE, Colour

NEARNESS_INKS: dict[Nearness, Colour] = {
    "unseen": BAD,
    "far": (255, 130, 60),
    "near": (195, 225, 80),
    "there": GOOD,
}

_WEDGE_SHARE = 0.16


def on_picture(xy: Array, frame_format: FrameFormat, size: tuple[int, int]) -> Array:
    """(n, 2) camera px as px of a picture of ``size`` (width, height) that shows the whole frame."""
    return (xy + 0.5) * (np.array(size) / (frame_format.width, frame_format.height)) - 0.5


def draw_live(sheet: Sheet, box: Box, guidance: Guidance, points: int) -> None:
    """Draw the frame into ``box`` with saturated pixels red, points and outline of the board, ghost and arrows."""
    size, fmt = (box.width, box.height), guidance.frame_format
    pixels = false_colours(guidance.frame, fmt, size, dark=False)
    ink, thick = NEARNESS_INKS[guidance.nearness], max(round(points / 8), 2)
    if guidance.target is not None:
        _sheet_outline(pixels, on_picture(guidance.target, fmt, size), ZONE, thick, opacity=0.18)
    if guidance.view is not None:
        for x, y in on_picture(guidance.view.xy, fmt, size):
            ring(pixels, (x, y), points / 4, ink, 1)
            disc(pixels, (x, y), 1.0, ink)
    if guidance.outline is not None:
        held = on_picture(guidance.outline, fmt, size)
        _sheet_outline(pixels, held, ink, thick)
        if guidance.target is not None and guidance.nearness != "there":
            for start, end in zip(held, on_picture(guidance.target, fmt, size), strict=True):
                arrow(pixels, start, end, ink, thick, 0.9 * points)
    sheet.part(box)[:] = pixels
    if guidance.is_about_board:
        _badge(sheet, box, guidance, points)


def _sheet_outline(pixels: Picture, corners: Array, ink: Colour, thick: int, opacity: float = 0.0) -> None:
    """Outline with a wedge in its first corner, so that a turned board is not taken for an upright one."""
    if opacity > 0:
        polygon(pixels, corners, ink, opacity)
    polyline(pixels, corners, ink, thick, closed=True)
    first, following, last = corners[0], corners[1], corners[-1]
    wedge = [first, first + _WEDGE_SHARE * (following - first), first + _WEDGE_SHARE * (last - first)]
    polygon(pixels, np.array(wedge), ink, 0.8)


def _badge(sheet: Sheet, box: Box, guidance: Guidance, points: int) -> None:
    """Say in a corner of the picture whether the board is seen, and what is left to do."""
    nearness, count = guidance.nearness, 0 if guidance.view is None else len(guidance.view.ids)
    said = {
        "unseen": "no board seen",
        "far": f"board seen · {count} points",
        "near": "nearly there",
        "there": f"board seen · {count} points" if guidance.target is None else "there: hold it still",
    }[nearness]
    moves = " · ".join(guidance.moves) if nearness in ("far", "near") else ""
    radius, pad = round(1.2 * points), round(0.5 * points)
    room = box.width - 2 * pad - 2 * radius - 4 * pad
    said, moves = cut(said, round(1.3 * points), room, bold=True), cut(moves, points, room)
    wide = max(width_of(said, round(1.3 * points), bold=True), width_of(moves, points))
    ground = Box(box.left + pad, 0, 2 * radius + wide + 3 * pad, 2 * radius + 2 * pad)
    ground = ground._replace(top=box.bottom - ground.height - pad)
    part, ink = sheet.part(ground), NEARNESS_INKS[nearness]
    part[:] = (0.2 * part + 0.8 * np.array(GROUND)).astype(np.uint8)
    centre = np.array((pad + radius, pad + radius), np.float64)
    disc(part, (centre[0], centre[1]), radius, ink)
    if nearness == "unseen":
        strokes = [[(-0.4, -0.4), (0.4, 0.4)], [(-0.4, 0.4), (0.4, -0.4)]]
    else:
        strokes = [[(-0.5, 0.05), (-0.15, 0.4), (0.5, -0.35)]]
    for stroke in strokes:
        polyline(part, centre + radius * np.array(stroke), GROUND, max(round(radius / 4), 2))
    left = ground.left + 2 * radius + 2 * pad
    if moves:
        sheet.write(left, ground.top + 0.5 * pad, said, round(1.3 * points), ink, bold=True)
        sheet.write(left, ground.top + 0.5 * pad + 1.7 * points, moves, points, INK)
    else:
        sheet.write(left, ground.top + pad + radius - 0.8 * points, said, round(1.3 * points), ink, bold=True)
