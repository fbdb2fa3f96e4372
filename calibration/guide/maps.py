"""Small maps of what earlier poses cover: tilts, distances, the picture; and curves of what a step measures."""

from __future__ import annotations

import math

import numpy as np

from calibration.guide.guidance import Curve, Guidance, coverage
from calibration.guide.sheet import Array, Box, Place, Sheet, cross, cut, disc, polyline, ring, width_of
from scanner.preview.style import DIM, GOOD, TRACK, ZONE, Colour

TILT_RANGE_DEG = 50.0
"""The tilt map reaches from minus to plus this, °."""

CELLS = (8, 6)
"""Cells of the coverage map across and down."""

ENOUGH_POINTS = 4
"""Points in a cell of the coverage map from which it is full."""

HELD: Colour = (120, 190, 255)
"""What the board does now."""

_RINGS_DEG = (15, 30, 45)


def tilt_place(tilt: tuple[float, float] | Array, box: Box) -> Place:
    """Where a tilt (yaw, pitch in °) is on the map in ``box``: as far from its middle as the front looks aside.

    A positive yaw turns the front to the left, a positive pitch turns it down, as `calibration.observations.BoardPose`
    has them. What lies beyond the map is put on its edge.
    """
    yaw, pitch = (min(max(float(angle), -TILT_RANGE_DEG), TILT_RANGE_DEG) / TILT_RANGE_DEG for angle in tilt)
    return box.left + (1 - yaw) / 2 * (box.width - 1), box.top + (1 + pitch) / 2 * (box.height - 1)


def draw_tilts(sheet: Sheet, box: Box, guidance: Guidance, points: int) -> None:
    """Map of where the board's front looked in earlier poses, looks now, and is to look next."""
    pixels, own = sheet.part(box), Box(0, 0, box.width, box.height)
    pixels[:] = TRACK
    middle, radius = tilt_place((0, 0), own), 0.03 * box.width
    for degrees in _RINGS_DEG:
        ring(pixels, middle, degrees / TILT_RANGE_DEG * (box.width - 1) / 2, (82, 86, 95))
    cross(pixels, middle, box.width / 2, (82, 86, 95))
    for tilt in guidance.tilts:
        disc(pixels, tilt_place(tilt, own), radius, GOOD)
    if guidance.wanted_tilt is not None:
        ring(pixels, tilt_place(guidance.wanted_tilt, own), 2.2 * radius, ZONE, max(round(0.6 * radius), 2))
    if guidance.held_tilt is not None:
        cross(pixels, tilt_place(guidance.held_tilt, own), 2 * radius, HELD, max(round(0.5 * radius), 2))
    small = round(0.8 * points)
    sheet.write(box.right - 3, box.bottom - round(1.25 * small), f"{_RINGS_DEG[-1]}°", small, DIM, align=1)


def depth_place(distance_mm: float, limits_mm: tuple[float, float], box: Box) -> float:
    """Row at which a distance is on the strip in ``box``: the far end is at the top, the near end at the bottom."""
    near, far = limits_mm
    share = min(max((distance_mm - near) / (far - near), 0.0), 1.0)
    return box.top + (1 - share) * (box.height - 1)


def depth_limits(guidance: Guidance) -> tuple[float, float]:
    """Nearest and farthest distance on the strip, mm: the working volume, or what the poses span and a tenth more."""
    if guidance.depth_range_mm is not None:
        return guidance.depth_range_mm
    others = [d for d in (guidance.wanted_distance_mm, guidance.held_distance_mm) if d is not None]
    known = np.concatenate((guidance.distances_mm, others))
    if not len(known):
        return 0.0, 1.0
    return 0.9 * float(known.min()), 1.1 * float(known.max())


def draw_depths(sheet: Sheet, box: Box, guidance: Guidance, points: int) -> None:
    """Strip of the distances of earlier poses, of the board now, and the wanted one."""
    limits = depth_limits(guidance)
    pixels, own = sheet.part(box), Box(0, 0, box.width, box.height)
    pixels[:] = TRACK
    thick = max(box.height // 60, 2)

    def mark(distance_mm: float, ink: Colour, reach: float, thick: int) -> None:
        row, inset = depth_place(distance_mm, limits, own), (1 - reach) / 2 * box.width
        polyline(pixels, np.array([(inset, row), (box.width - 1 - inset, row)]), ink, thick)

    for distance in guidance.distances_mm:
        mark(float(distance), GOOD, 0.6, thick)
    if guidance.wanted_distance_mm is not None:
        row, half = depth_place(guidance.wanted_distance_mm, limits, own), 2.5 * thick
        row = min(max(row, half), box.height - 1 - half)
        corners = [(1, row - half), (box.width - 2, row - half), (box.width - 2, row + half), (1, row + half)]
        polyline(pixels, np.array(corners), ZONE, thick, closed=True)
    if guidance.held_distance_mm is not None:
        mark(guidance.held_distance_mm, HELD, 1.0, thick)
    if limits != (0.0, 1.0):
        small = round(0.8 * points)
        sheet.write(box.right + 4, box.top - 1, f"{limits[1]:.0f}", small, DIM)
        sheet.write(box.right + 4, box.bottom - round(1.25 * small), f"{limits[0]:.0f}", small, DIM)


def depth_width(points: int) -> tuple[int, int]:
    """Width of the strip, and of its figures beside it, px."""
    return 2 * points, width_of("0000", round(0.8 * points)) + 4


def draw_coverage(sheet: Sheet, box: Box, guidance: Guidance) -> None:
    """Map of the picture: cells filled by the points of earlier poses, and where the board is wanted next."""
    pixels = sheet.part(box)
    pixels[:] = TRACK
    filled = np.minimum(coverage(guidance.seen, guidance.frame_format, CELLS) / ENOUGH_POINTS, 1.0)
    columns, rows = (
        np.linspace(0, n, cells + 1).round().astype(int)
        for n, cells in zip((box.width, box.height), CELLS, strict=True)
    )
    for (down, across), share in np.ndenumerate(filled):
        cell = pixels[rows[down] + 1 : rows[down + 1], columns[across] + 1 : columns[across + 1]]
        ground, full = np.array((36, 39, 45)), 0.7 * np.array(GOOD)
        cell[:] = (ground + share * (full - ground)).astype(np.uint8)
    scale = box.width / guidance.frame_format.width, box.height / guidance.frame_format.height
    for outline, ink in ((guidance.target, ZONE), (guidance.outline, HELD)):
        if outline is not None:
            polyline(pixels, (outline + 0.5) * scale - 0.5, ink, max(box.width // 120, 1), closed=True)


def covered_share(guidance: Guidance) -> float:
    """Share of the coverage map's cells that are full."""
    return float((coverage(guidance.seen, guidance.frame_format, CELLS) >= ENOUGH_POINTS).mean())


def draw_curve(sheet: Sheet, box: Box, curve: Curve, points: int) -> None:
    """Plot measured points and what was fitted to them."""
    small = round(0.85 * points)
    line = round(1.25 * small)
    x_ticks, y_ticks = _ticks(_limits(curve.x)), _ticks(_limits(curve.y, curve.fitted))
    y_wide = max(width_of(tick, small) for tick in y_ticks) + 6
    plot = Box(box.left + y_wide, box.top + line, box.width - y_wide, box.height - 3 * line - 4)
    if plot.width < 20 or plot.height < 20:
        return
    sheet.part(plot)[:] = TRACK
    (x_least, x_most), (y_least, y_most) = _limits(curve.x), _limits(curve.y, curve.fitted)
    low, scale = np.array((x_least, y_most)), np.array((x_most - x_least, y_least - y_most))
    inside = np.array((plot.width - 1, plot.height - 1)) - 8.0

    def places(x: Array, y: Array) -> Array:
        xy = np.column_stack((x, y))
        found: Array = (xy[np.isfinite(xy).all(axis=1)] - low) / scale * inside + 4
        return found

    pixels = sheet.part(plot)
    measured = places(curve.x, curve.y)
    modelled = measured if curve.fitted is None else places(curve.x, curve.fitted)
    if len(modelled) > 1:
        polyline(pixels, modelled, DIM if curve.fitted is None else ZONE, 2)
    for place in measured:
        disc(pixels, (float(place[0]), float(place[1])), max(points / 5, 2), GOOD)
    sheet.write(box.left, box.top, cut(curve.y_label, small, box.width), small, DIM)
    for tick, top in zip(y_ticks, (plot.bottom - line, plot.top), strict=True):
        sheet.write(plot.left - 6, top, tick, small, DIM, align=1)
    for tick, left, align in zip(x_ticks, (plot.left, plot.right), (0, 1), strict=True):
        sheet.write(left, plot.bottom + 3, tick, small, DIM, align=align)
    sheet.write(plot.left, plot.bottom + 3 + line, cut(curve.x_label, small, plot.width), small, DIM)


def _limits(*values: Array | None) -> tuple[float, float]:
    known = np.concatenate([v[np.isfinite(v)] for v in values if v is not None])
    if not len(known):
        return 0.0, 1.0
    least, most = float(known.min()), float(known.max())
    return (least, most) if most > least else (least - 0.5, most + 0.5)


def _ticks(limits: tuple[float, float]) -> tuple[str, str]:
    """Both ends of an axis in words, to a hundredth of its length."""
    decimals = 2 - math.floor(math.log10(limits[1] - limits[0]))
    least, most = (f"{round(value, decimals) + 0.0:.10g}" for value in limits)
    return least, most
