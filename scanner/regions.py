"""Which projector pixels round two lights (method.md §5).

*sound*: where the detected pixels' direct light can come from, and nothing else. *literal*: the paper's Eq. 21, which
darkens only what undetected camera pixels map to and so leaves lit every emitter that the camera does not see.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CELL_PX = 8
"""Side of the cells in which it is counted who lights whom, projector px."""

HARM = 0.02
"""A surface that lights more than this share of another's pixels must not be lit together with it."""

LEAST_SURFACE = 12
"""Fewer pixels than this are strays of the separation, not a surface."""

_CONTINUOUS_PX = 3.0
"""On one surface the step to the next camera pixel exceeds twice the usual one by no more than this, projector px."""

_REACH_PITCHES = 2.5
"""The lit set is grown by so many camera pixels at least: one sees half its own width and three σ of the blur."""

_RARE = 0.25
"""A place throws at least this share of the bounces that come from where most do, or none."""

_DENSITY = 3
"""A projector pixel is believed when at least this many coordinates fall on it and its 8 neighbours."""


def sound_mask(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    size: tuple[int, int],
    margin_px: float,
    emitters: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    pitch_px: float = 1.0,
) -> NDArray[np.bool_]:
    """Light the direct coordinates of the detected pixels, grown by a margin, except where the bounces come from.

    Parameters
    ----------
    x, y
        (P,) direct projector coordinates of the detected pixels, px; NaN where not known. With ``y`` all NaN whole
        columns are lit (one axis, no rig), with ``x`` all NaN whole rows.
    size
        Projector (width, height), px.
    margin_px
        How far the lit set is grown, so that fringes are not cut where they are measured.
    emitters
        (x, y) of the second paths: the margin does not grow onto them.
    pitch_px
        Usual distance of the coordinates of neighbouring camera pixels, projector px.

    Returns
    -------
    NDArray
        (height, width) bool.
    """
    gap = max(1, int(np.ceil(pitch_px)))
    core = _close(_believed(_splat(x, y, size), gap), gap)
    # A camera pixel sees beyond its own place: a coarse camera needs more than the margin.
    reach = int(np.ceil(max(margin_px, _REACH_PITCHES * pitch_px)))
    grown = cv2.dilate(core.astype(np.uint8), _disc(reach)) > 0 if reach else core
    if emitters is not None:
        source = _close(_believed(_splat(*emitters, size), gap), gap)
        grown &= core | ~source
    return np.asarray(grown)


def emitter_mask(
    x: NDArray[np.float32], y: NDArray[np.float32], size: tuple[int, int], reach_px: float, pitch_px: float = 1.0
) -> NDArray[np.bool_]:
    """Where most bounces come from.

    Parameters
    ----------
    x, y
        (P,) coordinates of the bounces, px.
    size
        Projector (width, height), px.
    reach_px
        By how much the emitters are grown, px.
    pitch_px
        As `sound_mask`.

    Returns
    -------
    NDArray
        (height, width) bool. Places with few bounces for their kind are none: there the fringe order of a bounce is
        wrong more often than a bounce.
    """
    gap = max(1, int(np.ceil(pitch_px)))
    counts = _splat(x, y, size)
    side = 2 * gap + 1
    near = cv2.blur(counts.astype(np.float32), (side, side))
    usual = float(np.median(np.repeat(near.ravel(), counts.ravel()))) if counts.any() else 0.0
    source = _close(_believed(counts, gap) & (near >= _RARE * usual), gap)
    return np.asarray(cv2.dilate(source.astype(np.uint8), _disc(int(np.ceil(reach_px)))) > 0)


def between_paths(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    bounce_x: NDArray[np.float32],
    bounce_y: NDArray[np.float32],
    size: tuple[int, int],
    reach_px: float,
    share: float = 1.0,
) -> NDArray[np.bool_]:
    """Projector pixels between a direct place and the emitter of its bounce, where these are near to each other.

    Towards a fold both paths meet, and before they do they are too close for round one to see that there are two.

    Parameters
    ----------
    x, y, bounce_x, bounce_y
        (P,) direct coordinates and those of the bounces, px.
    size
        Projector (width, height), px.
    reach_px
        Paths farther apart than this tell nothing.
    share
        How much of the way counts, from the direct place on; to the fold it is a half.

    Returns
    -------
    NDArray
        (height, width) bool.
    """
    return _close(_believed(_splat(*_along(x, y, bounce_x, bounce_y, reach_px, (0, share)), size), 1), 1)


def beyond_the_middle(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    bounce_x: NDArray[np.float32],
    bounce_y: NDArray[np.float32],
    reach_px: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places (x, y) on the other side of a fold: nearer to the emitter of a bounce than to its own place.

    Parameters as `between_paths`, whose second half this is.
    """
    return _along(x, y, bounce_x, bounce_y, reach_px, (0.5, 1))


def _along(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    bounce_x: NDArray[np.float32],
    bounce_y: NDArray[np.float32],
    reach_px: float,
    part: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points a pixel apart on a part of the way from direct places to emitters, where these are near to each other."""
    near = np.hypot(bounce_x - x, bounce_y - y) <= reach_px
    way = np.linspace(*part, int(np.ceil((part[1] - part[0]) * reach_px)) + 1, dtype=np.float32)[:, None]
    first, second = ((u[near] + way * (v[near] - u[near])).ravel() for u, v in ((x, bounce_x), (y, bounce_y)))
    return first, second


def pitch(x: NDArray[np.float32], y: NDArray[np.float32]) -> float:
    """Usual distance (px) of the coordinates (H, W) that neighbouring camera pixels see; 1 where it cannot be told."""
    steps = [np.abs(np.diff(u, axis=axis)) for u in (x, y) for axis in (0, 1)]
    usual = [float(np.median(known)) for s in steps if (known := s[np.isfinite(s)]).size]
    return max(usual, default=1.0)


def lit_together(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    bounce_x: NDArray[np.float32],
    bounce_y: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Choose surfaces of the region that can be lit at once because none of them lights another.

    A mirror in view shows the camera the board again, where the projector lights it through the mirror: both
    places are detected, and each is the other's emitter. The largest surface goes first; whatever would light one that
    is chosen already, or be lit by it, stays dark.

    Parameters
    ----------
    x, y
        (H, W) direct projector coordinates of the detected pixels, px, NaN elsewhere.
    bounce_x, bounce_y
        (H, W) where their bounces come from.

    Returns
    -------
    NDArray
        (H, W) bool, pixels of the chosen surfaces.
    """
    count, labels, stats = surfaces(x, y)
    by_size = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")
    chosen = np.zeros(count, bool)
    lit: set[int] = set()
    emitting: dict[int, float] = {}
    for label in by_size[stats[by_size, cv2.CC_STAT_AREA] >= LEAST_SURFACE]:
        left, top, width, height, area = stats[label]
        window = (slice(top, top + height), slice(left, left + width))
        mine = labels[window] == label
        places = set(np.unique(_cells(x[window][mine], y[window][mine])).tolist())
        sources, counts = np.unique(_cells(bounce_x[window][mine], bounce_y[window][mine]), return_counts=True)
        harmed = sum(n for cell, n in zip(sources.tolist(), counts.tolist(), strict=True) if cell in lit)
        harming = sum(emitting.get(cell, 0.0) for cell in places)
        if harmed > HARM * area or harming > HARM:
            continue
        chosen[label] = True
        lit |= places
        for cell, n in zip(sources.tolist(), counts.tolist(), strict=True):
            emitting[cell] = emitting.get(cell, 0.0) + n / area
    return np.asarray(chosen[labels])


def on_surface(x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) pixels whose coordinates (H, W) continue those of enough neighbours; the others are strays."""
    _, labels, stats = surfaces(x, y)
    enough = stats[:, cv2.CC_STAT_AREA] >= LEAST_SURFACE
    enough[0] = False
    return np.asarray(enough[labels])


def surfaces(x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[int, NDArray[np.int32], NDArray[np.int32]]:
    """Connected surfaces: their number, (H, W) labels, and OpenCV's statistics; 0 is none."""
    limit = _CONTINUOUS_PX + 2 * pitch(x, y)
    broken = ~(np.isfinite(x) & np.isfinite(y))
    for axis in (0, 1):
        step = np.abs(np.diff(x, axis=axis)) + np.abs(np.diff(y, axis=axis))
        jump = step > limit
        broken[(slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))] |= jump
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~broken).astype(np.uint8), connectivity=4)
    return count, np.asarray(labels, np.int32), np.asarray(stats, np.int32)


def _cells(x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.int64]:
    """Number of the cell that each coordinate lies in, -1 for NaN."""
    cells = np.full(x.shape, -1, np.int64)
    known = np.isfinite(x) & np.isfinite(y)
    row, column = (np.floor(u[known] / CELL_PX).astype(np.int64) for u in (y, x))
    cells[known] = row * 100_000 + column
    return cells


def continued(
    u: NDArray[np.float32], known: NDArray[np.bool_], wanted: NDArray[np.bool_], reach_px: float = 12.0
) -> NDArray[np.float32]:
    """Continue a coordinate from where it is known to ``wanted`` pixels nearby, by a local plane.

    Parameters
    ----------
    u, known
        (H, W) coordinate, px, and where it counts.
    wanted
        (H, W) pixels to be given one.
    reach_px
        Standard deviation of the Gaussian window in which the plane is fitted, camera px; three of them is the limit.

    Returns
    -------
    NDArray
        (P,) coordinates of the wanted pixels in row order, NaN where nothing is known within reach.
    """
    rows, columns = np.nonzero(wanted)
    weight = known.astype(np.float32)
    middle = float(u[known].mean()) if known.any() else 0.0
    value = np.where(known, u - np.float32(middle), np.float32(0))
    y, x = (g.astype(np.float32) / np.float32(reach_px) for g in np.mgrid[: u.shape[0], : u.shape[1]])

    def moment(plane: NDArray[np.float32]) -> NDArray[np.float64]:
        blurred = cv2.GaussianBlur(plane, (0, 0), reach_px, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred, np.float64)[rows, columns]

    w, wx, wy = moment(weight), moment(weight * x), moment(weight * y)
    wxx, wxy, wyy = moment(weight * x * x), moment(weight * x * y), moment(weight * y * y)
    wu, wux, wuy = moment(value), moment(value * x), moment(value * y)
    # Normal equations about the pixel itself, a little ridge on the slopes for pixels with neighbours on one line.
    px, py = x[rows, columns].astype(np.float64), y[rows, columns].astype(np.float64)
    a = np.empty((rows.size, 3, 3))
    a[:, 0, 0] = w
    a[:, 0, 1] = a[:, 1, 0] = wx - px * w
    a[:, 0, 2] = a[:, 2, 0] = wy - py * w
    a[:, 1, 1] = wxx - 2 * px * wx + px * px * w + 1e-4 * w
    a[:, 2, 2] = wyy - 2 * py * wy + py * py * w + 1e-4 * w
    a[:, 1, 2] = a[:, 2, 1] = wxy - px * wy - py * wx + px * py * w
    b = np.stack([wu, wux - px * wu, wuy - py * wu], axis=1)
    near = w > 1e-3
    found = np.full(rows.size, np.nan, np.float32)
    found[near] = np.linalg.solve(a[near], b[near, :, None])[:, 0, 0] + middle
    return found


def literal_mask(x: NDArray[np.float32], y: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Light everything but the pixels that undetected camera pixels map to (the paper's Eq. 21).

    Parameters
    ----------
    x, y
        (P,) coordinates of the undetected pixels, px.

    Notes
    -----
    Gaps of up to two projector pixels between neighbouring camera pixels are closed: the paper's camera samples the
    projector several times over and has none.
    """
    return ~_close(_splat(x, y, size) > 0, 1)


def inside(
    mask: NDArray[np.bool_], x: NDArray[np.float32], y: NDArray[np.float32], clearance_px: int
) -> NDArray[np.bool_]:
    """Whether projector coordinates lie in ``mask``, at least ``clearance_px`` from where it ends; False for NaN."""
    core = cv2.erode(mask.astype(np.uint8), _disc(clearance_px), borderType=cv2.BORDER_CONSTANT, borderValue=1) > 0
    height, width = mask.shape
    known = np.isfinite(x) & np.isfinite(y)
    column = np.clip(np.rint(np.where(known, x, 0)), 0, width - 1).astype(np.intp)
    row = np.clip(np.rint(np.where(known, y, 0)), 0, height - 1).astype(np.intp)
    return np.asarray(known & core[row, column])


def _splat(x: NDArray[np.float32], y: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.int32]:
    """(height, width) number of coordinates that round to each projector pixel."""
    width, height = size
    if np.isnan(y).all():
        column = np.rint(x[np.isfinite(x)]).astype(np.intp)
        counts = np.bincount(column[(column >= 0) & (column < width)], minlength=width)
        return np.broadcast_to(counts.astype(np.int32), (height, width))
    if np.isnan(x).all():
        return _splat(y, x, (height, width)).T
    known = np.isfinite(x) & np.isfinite(y)
    column, row = np.rint(x[known]).astype(np.intp), np.rint(y[known]).astype(np.intp)
    ok = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    counts = np.bincount(row[ok] * width + column[ok], minlength=width * height)
    return counts.reshape(height, width).astype(np.int32)


def _believed(counts: NDArray[np.int32], gap: int) -> NDArray[np.bool_]:
    """Pixels that enough coordinates fall on or beside: a single wrong one must not light an emitter."""
    side = 2 * gap + 1
    near = cv2.boxFilter(counts.astype(np.float32), -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return (counts > 0) & (near >= _DENSITY)


def _close(mask: NDArray[np.bool_], gap: int) -> NDArray[np.bool_]:
    # A border of its own: closing must not lose what touches the picture's edge.
    reach = gap + 1
    edge = 2 * reach
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(reach))[edge:-edge, edge:-edge] > 0)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
