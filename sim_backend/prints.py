"""Dark figures printed on a sheet, and how much of a small place they cover, exactly.

A camera's ray stands for a square of the picture, which on the print is a parallelogram. What polygons cover of it is
an integral along their edges (Green's theorem); the edge of a disc is straight within it to w²/24r, w its width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_backend.surfaces import Array

_CELLS_PER_FIGURE = 4
_MOST_CELLS = 512
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Print:
    """Dark polygons and discs in a plane, mm, sorted into a grid of cells.

    Parameters
    ----------
    vertices
        (n, 2) those of all polygons, one after the other.
    begin
        (polygons + 1,) where each polygon begins in ``vertices``.
    discs
        (discs, 3) x, y, radius.
    cells
        (figures, 4) first and last column, first and last row of the cells that each figure may touch; polygons first.
    cell_begin
        (cells + 1,) where each cell, counted row by row, begins in ``cell_figure``.
    cell_figure
        Numbers of the figures that may touch the cells.
    grid
        (4,) x and y of the grid's corner, cells per mm along x and y.
    shape
        (rows, columns) of the grid.
    """

    vertices: Array
    begin: NDArray[np.int64]
    discs: Array
    cells: NDArray[np.int64]
    cell_begin: NDArray[np.int64]
    cell_figure: NDArray[np.int64]
    grid: Array
    shape: tuple[int, int]

    @classmethod
    def of(
        cls,
        polygons: Sequence[Sequence[tuple[float, float]]],
        discs: Sequence[tuple[float, float, float]],
    ) -> Print:
        """Sort figures into a grid.

        Parameters
        ----------
        polygons
            Each a ring of three or more (x, y) in mm, in either direction, whose sides do not cross; no two overlap.
        discs
            (x, y, radius) in mm; none overlaps another figure.
        """
        rings = [np.asarray(ring, np.float64).reshape(-1, 2) for ring in polygons]
        round_ones = np.asarray(discs, np.float64).reshape(-1, 3)
        low = np.array([*(r.min(0) for r in rings), *(round_ones[:, :2] - round_ones[:, 2:])]).reshape(-1, 2)
        high = np.array([*(r.max(0) for r in rings), *(round_ones[:, :2] + round_ones[:, 2:])]).reshape(-1, 2)
        corner, end = low.min(0, initial=math.inf), high.max(0, initial=-math.inf)
        if not len(low):
            corner, end = np.zeros(2), np.ones(2)
        size = np.maximum(end - corner, _TINY)
        pitch = math.sqrt(size.prod() / max(1, _CELLS_PER_FIGURE * len(low)))
        count = np.clip(np.ceil(size / max(pitch, _TINY)), 1, _MOST_CELLS).astype(np.int64)
        per_mm = count / size
        first, last = (np.clip(((p - corner) * per_mm).astype(np.int64), 0, count - 1) for p in (low, high))
        cells = np.stack((first[:, 0], last[:, 0], first[:, 1], last[:, 1]), 1)
        cell, figure = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for number, (left, right, top, bottom) in enumerate(cells):
            touched = (np.arange(top, bottom + 1)[:, None] * count[0] + np.arange(left, right + 1)).ravel()
            cell.append(touched)
            figure.append(np.full(touched.size, number))
        where, which = np.concatenate(cell), np.concatenate(figure)
        by_cell = np.argsort(where, kind="stable")
        return cls(
            np.concatenate([np.empty((0, 2)), *rings]),
            np.cumsum([0, *(len(ring) for ring in rings)]),
            round_ones,
            cells,
            np.concatenate(([0], np.cumsum(np.bincount(where, minlength=int(count.prod()))))),
            which[by_cell],
            np.concatenate((corner, per_mm)),
            (int(count[1]), int(count[0])),
        )

    def dark_share(self, place: Array, sides: Array) -> Array:
        """How much of small parallelograms is dark.

        Parameters
        ----------
        place
            (n, 2) their middles, mm.
        sides
            (n, 2, 2) their two sides, mm; zero for points.

        Returns
        -------
        (n,) 0..1.
        """
        return np.asarray(
            _dark_share(
                np.ascontiguousarray(place),
                np.ascontiguousarray(sides),
                self.vertices,
                self.begin,
                self.discs,
                self.cells,
                self.cell_begin,
                self.cell_figure,
                self.grid,
                self.shape,
            )
        )


@njit(cache=True, nogil=True)
def _dark_share(place, sides, vertices, begin, discs, cells, cell_begin, cell_figure, grid, shape):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    polygons = begin.size - 1
    share = np.zeros(len(place))
    for i in range(len(place)):
        x, y = place[i, 0], place[i, 1]
        ux, uy, vx, vy = sides[i, 0, 0], sides[i, 0, 1], sides[i, 1, 0], sides[i, 1, 1]
        reach_x, reach_y = 0.5 * (abs(ux) + abs(vx)), 0.5 * (abs(uy) + abs(vy))
        left, right = (x - reach_x - grid[0]) * grid[2], (x + reach_x - grid[0]) * grid[2]
        top, bottom = (y - reach_y - grid[1]) * grid[3], (y + reach_y - grid[1]) * grid[3]
        # NaN fails the comparisons.
        if not (right >= 0 and bottom >= 0 and left <= shape[1] and top <= shape[0]):
            continue
        column_0, column_1 = int(max(left, 0.0)), int(min(right, shape[1] - 1.0))
        row_0, row_1 = int(max(top, 0.0)), int(min(bottom, shape[0] - 1.0))
        column_0, row_0 = min(column_0, column_1), min(row_0, row_1)
        total = 0.0
        for row in range(row_0, row_1 + 1):
            for column in range(column_0, column_1 + 1):
                cell = row * shape[1] + column
                for k in range(cell_begin[cell], cell_begin[cell + 1]):
                    figure = cell_figure[k]
                    # A figure in several of these cells counts in the first.
                    if column != max(cells[figure, 0], column_0) or row != max(cells[figure, 2], row_0):
                        continue
                    if figure < polygons:
                        total += _of_polygon(vertices, begin[figure], begin[figure + 1], x, y, ux, uy, vx, vy)
                    else:
                        total += _of_disc(discs[figure - polygons], x, y, ux, uy, vx, vy)
        share[i] = min(total, 1.0)
    return share


@njit(cache=True, nogil=True)
def _of_polygon(vertices, begin, end, x, y, ux, uy, vx, vy):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Share of the parallelogram about (x, y) with sides u, v that a polygon covers."""
    det = ux * vy - uy * vx
    point = abs(det) < 1e-12
    inside = False
    area = 0.0
    px, py = vertices[end - 1, 0] - x, vertices[end - 1, 1] - y
    for k in range(begin, end):
        qx, qy = vertices[k, 0] - x, vertices[k, 1] - y
        if point:
            if (py > 0) != (qy > 0) and px - py * (qx - px) / (qy - py) > 0:
                inside = not inside
        else:
            # In units of the sides the parallelogram is the square -½..½, and the area within it is that integral of
            # clamp(a) + ½ over b along the polygon.
            area += _beside(
                (px * vy - py * vx) / det,
                (py * ux - px * uy) / det,
                (qx * vy - qy * vx) / det,
                (qy * ux - qx * uy) / det,
            )
        px, py = qx, qy
    if point:
        return 1.0 if inside else 0.0
    return min(abs(area), 1.0)


@njit(inline="always")
def _beside(a_0, b_0, a_1, b_1):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Integral of clamp(a) + ½ over b in -½..½ along a straight line, clamp to -½..½."""
    low, high = min(max(b_0, -0.5), 0.5), min(max(b_1, -0.5), 0.5)
    if low == high or (a_0 <= -0.5 and a_1 <= -0.5):
        return 0.0
    if a_0 >= 0.5 and a_1 >= 0.5:
        return high - low
    slope = (a_1 - a_0) / (b_1 - b_0)
    from_a, to_a = a_0 + (low - b_0) * slope, a_0 + (high - b_0) * slope
    if abs(to_a - from_a) < 1e-9:
        return (high - low) * (min(max(0.5 * (from_a + to_a), -0.5), 0.5) + 0.5)
    return (high - low) * (_ramp(to_a) - _ramp(from_a)) / (to_a - from_a)


@njit(inline="always")
def _ramp(a):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Integral of clamp(a) + ½."""
    if a <= -0.5:
        return 0.0
    return 0.5 * (a + 0.5) ** 2 if a < 0.5 else a


@njit(cache=True, nogil=True)
def _of_disc(disc, x, y, ux, uy, vx, vy):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Share of the parallelogram about (x, y) with sides u, v that a disc covers."""
    dx, dy = x - disc[0], y - disc[1]
    distance = math.sqrt(dx * dx + dy * dy)
    nx, ny = (dx / distance, dy / distance) if distance > 0 else (1.0, 0.0)
    a, b = abs(ux * nx + uy * ny), abs(vx * nx + vy * ny)
    depth = disc[2] - distance
    if depth >= 0.5 * (a + b):
        return 1.0
    if depth <= -0.5 * (a + b):
        return 0.0
    if abs(depth) <= 0.5 * abs(a - b):
        return 0.5 + depth / max(a, b)
    corner = (0.5 * (a + b) - abs(depth)) ** 2 / (2 * a * b)
    return corner if depth < 0 else 1 - corner
