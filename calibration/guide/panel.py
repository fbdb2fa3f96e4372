"""The column beside the live picture: maps of what is covered, figures as bars, a reading, warnings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from calibration.guide.guidance import Bar, Guidance
from calibration.guide.maps import (
    HELD,
    covered_share,
    depth_width,
    draw_coverage,
    draw_curve,
    draw_depths,
    draw_tilts,
)
from calibration.guide.sheet import Box, Sheet, cut, height_of, shortened, width_of
from scanner.preview.canvas import draw_histogram, draw_magnified, percent
from scanner.preview.style import BAD, CAUTION, DIM, GOOD, INK, TRACK, ZONE, font, wrapped

_LEAST_TILE_PX = 16
_TILES_SHARE = 0.35
"""Maps keep at least this share of the column's height, however many warnings there are."""


@dataclass(frozen=True)
class _Tile:
    """A small picture with a label above: its width by its height, and beside that some px that do not scale."""

    label: str
    aspect: float
    beside_px: int
    draw: Callable[[Box], None]


def draw_panel(sheet: Sheet, box: Box, guidance: Guidance, points: int) -> None:
    """Draw the column into ``box``, with letters ``points`` px high.

    Warnings that have no room end with an ellipsis, bars that have none are left out, the last first.
    """
    gap = points
    bars, hints = guidance.bars, [wrapped(hint, font(points), box.width - gap) for hint in guidance.hints]
    readings = _readings(guidance, points, box.width)
    needed = sum(_bar_height(bar, points, box.width) for bar in bars)
    needed += height_of(len(readings) + guidance.is_about_poses, points)
    needed += sum(height_of(len(lines), points) + gap // 2 for lines in hints)
    tiles = _tiles(sheet, guidance, points)
    top = box.top
    if tiles:
        room = max(box.height - needed - 2 * gap, round(_TILES_SHARE * box.height))
        top = _lay_out(sheet, Box(box.left, box.top, box.width, room), tiles, points) + gap // 2
    if guidance.is_about_poses:
        top = _legend(sheet, box.left, top, points) + gap // 2
    for lines in hints:
        size = box.width - gap, box.bottom - top - height_of(len(readings), points)
        top = _hint(sheet, box.left, top, shortened(lines, points, size), points) + gap // 2
    for bar in bars:
        height = _bar_height(bar, points, box.width)
        if top + height > box.bottom - height_of(len(readings), points):
            break
        _bar(sheet, Box(box.left, top, box.width, height), bar, points)
        top += height
    for text, ink in readings:
        if top + height_of(1, points) <= box.bottom:
            sheet.write(box.left, top, text, points, ink)
        top += height_of(1, points)


def _tiles(sheet: Sheet, guidance: Guidance, points: int) -> list[_Tile]:
    found = []
    fmt = guidance.frame_format
    if guidance.is_about_poses:
        strip, figures = depth_width(points)

        def tilts_and_depths(box: Box) -> None:
            draw_tilts(sheet, Box(box.left, box.top, box.height, box.height), guidance, points)
            draw_depths(sheet, Box(box.left + box.height + points, box.top, strip, box.height), guidance, points)

        found.append(_Tile("tilt · distance, mm", 1.0, points + strip + figures, tilts_and_depths))
        label = f"picture covered {100 * covered_share(guidance):.0f} %"
        found.append(_Tile(label, fmt.width / fmt.height, 0, lambda box: draw_coverage(sheet, box, guidance)))
    if guidance.zone is not None:
        zone = guidance.zone

        def magnifier(box: Box) -> None:
            draw_magnified(sheet.part(box), guidance.frame, fmt, zone, coloured=False)

        found.append(_Tile("magnified", 4 / 3, 0, magnifier))
    if guidance.curve is not None:
        curve = guidance.curve
        found.append(_Tile(curve.title, 1.5, 0, lambda box: draw_curve(sheet, box, curve, points)))
    elif guidance.reading is not None and guidance.step in ("focus", "exposure"):
        shares = guidance.reading.histogram
        found.append(
            _Tile("grey values, black to full scale", 2.5, 0, lambda box: draw_histogram(sheet.part(box), shares))
        )
    return found


def _lay_out(sheet: Sheet, box: Box, tiles: list[_Tile], points: int) -> int:
    """Draw the tiles in the number of columns that makes them largest; returns the row below them."""
    gap, label = points, height_of(1, points)

    def rows_of(columns: int) -> list[tuple[list[_Tile], int]]:
        """Tiles of each row and their height."""
        rows = [tiles[first : first + columns] for first in range(0, len(tiles), columns)]
        room = (box.height - (len(rows) - 1) * gap // 2) // len(rows) - label
        found = []
        for row in rows:
            wide = box.width - (len(row) - 1) * gap - sum(tile.beside_px for tile in row)
            height = min(room, math.floor(wide / sum(tile.aspect for tile in row)))
            found.append((row, max(height, _LEAST_TILE_PX)))
        return found

    def area(columns: int) -> float:
        return sum(height**2 * tile.aspect for row, height in rows_of(columns) for tile in row)

    top = box.top
    for row, height in rows_of(max(range(1, len(tiles) + 1), key=area)):
        left = box.left
        for tile in row:
            width = math.floor(height * tile.aspect) + tile.beside_px
            text = cut(tile.label, points, width if tile is not row[-1] else box.right - left)
            sheet.write(left, top, text, points, DIM)
            tile.draw(Box(left, top + label, width, height))
            left += width + gap
        top += label + height + gap // 2
    return top - gap // 2


def _readings(guidance: Guidance, points: int, wide: int) -> list[tuple[str, tuple[int, int, int]]]:
    """Lines about brightness and focus of the picture."""
    lines = []
    reading = guidance.reading
    if reading is not None:
        too_much = reading.saturated_share > guidance.max_saturated_share
        focus = f" · focus {1000 * reading.focus:.1f}" if math.isfinite(reading.focus) else ""
        lines.append((f"saturated {percent(reading.saturated_share)}", BAD if too_much else INK))
        lines.append((f"brightest {100 * reading.brightest:.0f} %{focus}", INK))
    return [(cut(text, points, wide), ink) for text, ink in lines]


def _legend(sheet: Sheet, left: int, top: int, points: int) -> int:
    """Say which colour is what; returns the row below it."""
    for text, ink in (("taken", GOOD), ("wanted", ZONE), ("now", HELD)):
        sheet.part(Box(left, top + points // 3, points // 2, points // 2))[:] = ink
        sheet.write(left + points, top, text, points, DIM)
        left += 2 * points + width_of(text, points)
    return top + height_of(1, points)


def _hint(sheet: Sheet, left: int, top: int, lines: list[str], points: int) -> int:
    """Draw one warning with a bar at its side; returns the row below it."""
    if not lines:
        return top
    bottom = sheet.write_lines(left + points, top, lines, points, CAUTION)
    sheet.part(Box(left, top, max(points // 4, 2), bottom - top))[:] = CAUTION
    return bottom


def _is_on_one_line(bar: Bar, points: int, wide: int) -> bool:
    return width_of(bar.label, points) + points + width_of(bar.text, points) <= wide


def _bar_height(bar: Bar, points: int, wide: int) -> int:
    lines = 1 if _is_on_one_line(bar, points, wide) else 2
    return height_of(lines, points) + (round(1.3 * points) if math.isfinite(bar.share) else points // 4)


def _bar(sheet: Sheet, box: Box, bar: Bar, points: int) -> None:
    ink = GOOD if bar.good else CAUTION
    sheet.write(box.left, box.top, cut(bar.label, points, box.width), points, INK)
    top = box.top if _is_on_one_line(bar, points, box.width) else box.top + height_of(1, points)
    sheet.write(box.right, top, cut(bar.text, points, box.width), points, ink, align=1)
    if math.isfinite(bar.share):
        track = Box(box.left, top + height_of(1, points), box.width, points // 2)
        sheet.part(track)[:] = TRACK
        sheet.part(track._replace(width=round(min(max(bar.share, 0.0), 1.0) * track.width)))[:] = ink
