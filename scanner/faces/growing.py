"""How faces grow over places that round one leaves open."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.faces.seeds import SHARPEST_DEG
from scanner.kernels import over_pixels

_REACH = 8
"""Half of the window that says how a face goes on, cells."""

_FEWEST = 40
"""Cells that say so at least: a straight end of a face has three times as many, a bottleneck fewer."""

_LAYERS = 400
"""A face grows by so many cells at most."""

_HOLE = 48
"""Over places where nothing continues it, it grows by so many."""

_SWEEPS = 48
"""How often the end of two faces is moved, a cell at a time."""

_LEAST_ALONG = float(np.cos(np.radians(SHARPEST_DEG)))

compiled = njit(cache=True, nogil=True, error_model="numpy")

_ALL_AROUND = np.ones((3, 3), np.uint8)


Ground = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""What faces grow on: x and y of the viewing rays, (H, W); inverse depths that a cell may have, (K, H, W), the first of
them sure, NaN for none; and how far the projector coordinate moves with each, px mm."""


@dataclass(frozen=True)
class Grown:
    """Faces as far as they have grown; the arrays are changed in place.

    Parameters
    ----------
    label
        (H, W) face of every cell, 0 for none.
    w
        (H, W) its inverse depth there.
    normal
        (H, W, 3) unit normal where the face began, nearest to the cell.
    """

    label: NDArray[np.int32]
    w: NDArray[np.float64]
    normal: NDArray[np.float64]


def grow(grown: Grown, ground: Ground, sharp: NDArray[np.bool_], tolerance_px: float) -> None:
    """Let faces grow over what continues them.

    Parameters
    ----------
    grown
        **Changed.**
    ground
        What cells offer.
    sharp
        (H, W) bool, cells at creases and steps: no face grows over those, or it would bend.
    tolerance_px
        What continues a face misses it by no more than this.
    """
    may = np.isfinite(ground[2]).any(axis=0) & ~sharp
    for _ in range(_LAYERS):
        if not _layer(grown, ground, may, tolerance_px, False):
            break


def fill(grown: Grown, ground: Ground, wanted: NDArray[np.bool_], tolerance_px: float) -> None:
    """Continue faces as planes to what is left of ``wanted``, (H, W) bool: creases and holes. Arguments as `grow`."""
    filled = np.zeros(wanted.shape, bool)
    for _ in range(_HOLE):
        before = grown.label > 0
        if not _layer(grown, ground, wanted, tolerance_px, True):
            break
        filled |= (grown.label > 0) & ~before
    for _ in range(_SWEEPS):
        if not _step(grown, ground, filled & _beside_another(grown.label), tolerance_px, True):
            break


def _layer(grown: Grown, ground: Ground, may: NDArray[np.bool_], tolerance_px: float, planes: bool) -> bool:
    """Let all faces grow by a cell; whether any did."""
    label = grown.label
    front = may & (label == 0) & (cv2.dilate((label > 0).astype(np.uint8), _ALL_AROUND) > 0)
    return _step(grown, ground, front, tolerance_px, planes)


def _step(grown: Grown, ground: Ground, front: NDArray[np.bool_], tolerance_px: float, planes: bool) -> bool:
    """Decide of all cells of a front at once to which face they belong; whether any label changed."""
    cells = np.flatnonzero(front)
    if not cells.size:
        return False
    chosen, value, normal = np.zeros(cells.size, np.int32), np.zeros(cells.size), np.zeros((cells.size, 3))
    before = grown.label, grown.w, grown.normal, *ground
    over_pixels(lambda a, b: _decide(*before, cells, tolerance_px, planes, chosen, value, normal, a, b), cells.size)
    found = (chosen > 0) & (chosen != grown.label.ravel()[cells])
    grown.label.ravel()[cells[found]], grown.w.ravel()[cells[found]] = chosen[found], value[found]
    grown.normal.reshape(-1, 3)[cells[found]] = normal[found]
    return bool(found.any())


def _beside_another(label: NDArray[np.int32]) -> NDArray[np.bool_]:
    known = np.where(label > 0, label, np.iinfo(np.int32).max).astype(np.float32)
    lowest = cv2.erode(known, _ALL_AROUND)
    highest = cv2.dilate(label.astype(np.float32), _ALL_AROUND)
    return np.asarray(lowest != highest)


def borders(
    label: NDArray[np.int32],
    w: NDArray[np.float64],
    ground: Ground,
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """How faces meet: pairs (P, 2) of labels at P cells between two, and (P, 2) angle in degrees and step in px."""
    x, y, _, scales = ground
    usual = float(np.nanmedian(scales[0]))
    pairs, places = [], []
    for axis in (0, 1):
        first = label[(slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))]
        second = label[(slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))]
        there = np.nonzero((first > 0) & (second > 0) & (first != second))
        pairs.append(np.stack([first[there], second[there]], axis=1))
        places.append(there[0] * label.shape[1] + there[1])
    pair, place = np.concatenate(pairs).astype(np.int32), np.concatenate(places)
    how = np.full((len(place), 2), np.nan)
    over_pixels(lambda a, b: _meet(label, w, x, y, usual, place, pair, how, a, b), len(place))
    return pair, how


@compiled
def _plane(label, w, x, y, row, column, face, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Plane of a face around a cell: w there, and its slopes; False where too few cells say."""
    top, bottom = max(row - _REACH, 0), min(row + _REACH + 1, label.shape[0])
    left, right = max(column - _REACH, 0), min(column + _REACH + 1, label.shape[1])
    n, sx, sy, sv, level = 0.0, 0.0, 0.0, 0.0, 0.0
    xx, xy, yy, vx, vy = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if label[i, j] == face and not (i == row and j == column):
                if n == 0:
                    level = w[i, j]
                dx, dy, v = x[i, j] - x[row, column], y[i, j] - y[row, column], w[i, j] - level
                n += 1
                sx += dx
                sy += dy
                sv += v
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
                vx += v * dx
                vy += v * dy
    if n < _FEWEST:
        return False
    mx, my, mv = sx / n, sy / n, sv / n
    cxx, cxy, cyy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    # A little of a cell's own width on the slopes, for cells on one line.
    ridge = 1e-3 * (cxx + cyy)
    cxx += ridge
    cyy += ridge
    cvx, cvy = vx / n - mv * mx, vy / n - mv * my
    det = cxx * cyy - cxy * cxy
    if not det > 0:
        return False
    out[1], out[2] = (cyy * cvx - cxy * cvy) / det, (cxx * cvy - cxy * cvx) / det
    out[0] = level + mv - out[1] * mx - out[2] * my
    return True


@compiled
def _turned(plane, x, y, began):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Whether a plane faces elsewhere than the face did where it began: it would go around a crease."""
    third = plane[0] - plane[1] * x - plane[2] * y
    along = plane[1] * began[0] + plane[2] * began[1] + third * began[2]
    return along < _LEAST_ALONG * np.sqrt(plane[1] ** 2 + plane[2] ** 2 + third**2)


@compiled
def _decide(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    label, w, began, x, y, offered, scale, cells, tolerance_px, planes, chosen, value, normal, start, stop
):
    """Face of the cells numbered start..stop, its inverse depth there, and the normal where it began.

    The face that what is offered misses least; its place is what is offered, or on the face continued as a plane. Where
    nothing is sure, that plane need not be met: of two faces that may be seen the nearer is, for those that light each
    other form a hollow.
    """
    height, width = label.shape
    faces, plane = np.zeros(9, np.int32), np.zeros(3)
    for i in range(start, stop):
        row, column = cells[i] // width, cells[i] % width
        count, best = 0, -np.inf
        blind = planes and not np.isfinite(offered[0, row, column])
        for r in range(max(row - 1, 0), min(row + 2, height)):
            for c in range(max(column - 1, 0), min(column + 2, width)):
                face = label[r, c]
                new = face > 0
                for k in range(count):
                    new &= faces[k] != face
                if not new:
                    continue
                faces[count] = face
                count += 1
                if not _plane(label, w, x, y, row, column, face, plane) or plane[0] <= 0:
                    continue
                if blind:
                    if plane[0] > best:
                        best, chosen[i], value[i] = plane[0], face, plane[0]
                        normal[i] = began[r, c]
                    continue
                if not planes and _turned(plane, x[row, column], y[row, column], began[r, c]):
                    continue
                for k in range(1 if planes else offered.shape[0]):
                    off = abs(offered[k, row, column] - plane[0]) * scale[k, row, column]
                    if off <= tolerance_px and -off > best:
                        best, chosen[i] = -off, face
                        value[i] = plane[0] if planes else offered[k, row, column]
                        normal[i] = began[r, c]


@compiled
def _meet(label, w, x, y, scale, place, pair, how, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Angle and step between the planes of two faces where they meet."""
    width = label.shape[1]
    one, two = np.zeros(3), np.zeros(3)
    for i in range(start, stop):
        row, column = place[i] // width, place[i] % width
        if not _plane(label, w, x, y, row, column, pair[i, 0], one):
            continue
        if not _plane(label, w, x, y, row, column, pair[i, 1], two):
            continue
        here_x, here_y = x[row, column], y[row, column]
        for plane in (one, two):
            # From w at the cell to the normal of the plane n · ray = w.
            plane[0] -= plane[1] * here_x + plane[2] * here_y
        dot = one[0] * two[0] + one[1] * two[1] + one[2] * two[2]
        lengths = np.sqrt((one**2).sum() * (two**2).sum())
        how[i, 0] = np.degrees(np.arccos(min(max(dot / lengths, -1.0), 1.0)))
        off = (one[0] - two[0]) + (one[1] - two[1]) * here_x + (one[2] - two[2]) * here_y
        how[i, 1] = abs(off) * scale


def compile_all() -> None:
    """Compile the kernels, so that no scan waits for them."""
    label = np.zeros((12, 24), np.int32)
    label[:, :8], label[:, 16:] = 1, 2
    x, y = (a.astype(np.float64) / 100 for a in np.meshgrid(np.arange(24), np.arange(12)))
    w, wanted = np.full(label.shape, 0.01), np.ones(label.shape, bool)
    offered, scale = np.full((2, 12, 24), 0.01), np.full((2, 12, 24), 1e4)
    offered[0, :, 8:16] = np.nan
    ground = x, y, offered, scale
    grown = Grown(label, w, np.tile([0.0, 0.0, 1.0], (12, 24, 1)))
    grow(grown, ground, np.zeros_like(wanted), 1.0)
    fill(grown, ground, wanted, 1.0)
    borders(label, w, ground)
