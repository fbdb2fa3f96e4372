"""What the report needs of the measured surface: local planes, and the points packed for the 3-D view."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.result import Maps

Array = NDArray[Any]

MAX_POINTS = 130_000
"""Points of the 3-D view at most: 12 bytes each, 16 in the page."""
_RECORD = np.dtype(
    [("position", "<i2", 3), ("grey", "u1"), ("sigma", "u1"), ("region", "u1"), ("normal", "i1", 3)], align=False
)


_PLANE_PIXELS = 3_000_000  # of a larger camera every second, third … pixel of rows and columns is judged


@dataclass(frozen=True)
class LocalPlanes:
    """Planes through the neighbourhoods of every ``stride``-th pixel of rows and columns, a grid (H', W').

    Parameters
    ----------
    residual
        (H', W') float32, mm: distance of the point from its plane, less the mean of its neighbours' distances,
        positive towards the camera; NaN where there is no point or too few neighbours agree on a plane.
    normals
        (H', W', 3) float32 unit normals towards the camera, NaN as above.
    window
        Side of a neighbourhood in pixels of the grid.
    """

    residual: NDArray[np.float32]
    normals: NDArray[np.float32]
    window: int
    stride: int = 1


def median(values: Array) -> float:
    """Median of the finite values, NaN without any."""
    good = values[np.isfinite(values)]
    return float(np.median(good)) if good.size else math.nan


def planes_of_scan(points: Array) -> LocalPlanes:
    """Local planes on a grid and in windows that suit the camera: about a sixtieth of its width."""
    height, width = points.shape[:2]
    stride = math.ceil(math.sqrt(height * width / _PLANE_PIXELS))
    thinned = points[::stride, ::stride]
    return replace(local_planes(thinned, max(7, 2 * round(thinned.shape[1] / 128) + 1)), stride=stride)


def local_planes(points: Array, window: int) -> LocalPlanes:
    """Robust plane fit in a square window around every pixel.

    On a plane n·X = 1 the inverse depth is linear in the normalised image coordinates, 1/z = n·(x/z, y/z, 1), whatever
    the lens; so n comes from box means. Points farther off than three times the spread of their neighbourhood are left
    out and the fit is repeated, twice. The mean residual of a window is the surface's curvature there and is taken off.

    Parameters
    ----------
    points
        (H, W, 3) mm in the camera frame, NaN where there is none.
    window
        Side of the window, px, odd.
    """
    z = points[..., 2].astype(np.float64)
    valid = np.isfinite(points).all(axis=2) & (z > 0)
    q = np.zeros(z.shape)
    np.divide(1.0, z, out=q, where=valid)
    x, y = (np.where(valid, points[..., i] * q, 0.0) for i in (0, 1))

    def mean(values: Array) -> Array:
        return np.asarray(cv2.boxFilter(values, -1, (window, window), borderType=cv2.BORDER_CONSTANT))

    kept = valid.copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(3):
            w = kept.astype(np.float64)
            n = mean(w)
            mx, my, mq = (mean(w * v) / n for v in (x, y, q))
            xx, xy, yy = mean(w * x * x) / n - mx**2, mean(w * x * y) / n - mx * my, mean(w * y * y) / n - my**2
            xq, yq = mean(w * x * q) / n - mx * mq, mean(w * y * q) / n - my * mq
            determinant = xx * yy - xy**2
            a, b = (yy * xq - xy * yq) / determinant, (xx * yq - xy * xq) / determinant
            c = mq - a * mx - b * my
            length = np.sqrt(a**2 + b**2 + c**2)
            residual = (1 - z * (a * x + b * y + c)) / length
            # A third of a window must agree on its plane, and must not lie on one line.
            known = valid & (n > 1 / 3) & (determinant > 1e-3 * (xx + yy) ** 2)
            distance = np.where(known, np.abs(residual), 0)
            spread = 1.25 * mean(kept * distance) / n
            kept = known & (distance <= 3 * spread)
        residual -= mean(np.where(kept, residual, 0)) / mean(kept.astype(np.float64))
        normals = -np.stack([a, b, c], axis=-1) / length[..., None]
    residual[~known] = np.nan
    normals[~known] = np.nan
    return LocalPlanes(residual.astype(np.float32), normals.astype(np.float32), window)


def pack_points(maps: Maps, planes: LocalPlanes) -> tuple[dict[str, Any], str]:
    """Points for the 3-D view, thinned on the pixel grid and quantised.

    Parameters
    ----------
    maps
        With ``points``.
    planes
        Their normals; the view shows a subset of those pixels.

    Returns
    -------
    A JSON-ready description (``count``, ``shown_of``, ``step_mm``, ``centre``, ``extent_mm``, ``spacing_mm``,
    ``sigma_mm``, ``depth_mm``) and base64 of the records: int16 position in steps from the centre, grey, σ
    (logarithmic over ``sigma_mm``), region, int8 normal.

    Notes
    -----
    Points beyond three times the central 99 % of the cloud are left out: one stray point must not shrink the object.
    """
    assert maps.points is not None
    total = int(np.isfinite(maps.points[..., 2]).sum())
    excess = total / (0.99 * MAX_POINTS) / planes.stride**2
    down = max(1, round(math.sqrt(excess)))
    thin = np.s_[::down, :: max(1, math.ceil(excess / down))]
    grid = np.s_[:: planes.stride, :: planes.stride]
    points = maps.points[grid][thin]
    shown = np.asarray(np.isfinite(points).all(axis=2))
    if not shown.any():
        return {"count": 0, "shown_of": total}, ""
    low, high = np.percentile(points[shown], (0.5, 99.5), axis=0)
    centre, reach = (low + high) / 2, 1.5 * float(max((high - low).max(), 1e-3))
    shown &= (np.abs(np.where(shown[..., None], points, np.inf) - centre) <= reach).all(axis=2)
    keep = np.flatnonzero(shown)[:MAX_POINTS]  # thinned to 99 %, so the cut is for combed maps only

    def at(values: Array) -> Array:
        thinned: Array = values[grid][thin]
        return thinned.reshape(-1, *values.shape[2:])[keep]

    cloud = at(maps.points)
    records = np.zeros(len(keep), _RECORD)
    quantum = reach / 32767
    records["position"] = np.rint((cloud - centre) / quantum)
    grey = at(maps.brightness) + at(maps.modulation)
    white = max(float(np.percentile(grey, 99)), 1e-6)
    records["grey"] = np.clip(255 * grey / white, 0, 255)
    sigma_range = None
    if maps.sigma_point is not None:
        sigma = at(maps.sigma_point)
        good = np.isfinite(sigma) & (sigma > 0)
        if good.any():
            sigma_range = [float(v) for v in np.percentile(sigma[good], (2, 98))]
            sigma_range[1] = max(sigma_range[1], 1.001 * sigma_range[0])
            with np.errstate(all="ignore"):
                level = 254 * np.log(sigma / sigma_range[0]) / math.log(sigma_range[1] / sigma_range[0])
            records["sigma"] = np.clip(np.where(good, level, 254), 0, 254)
    normal = planes.normals[thin].reshape(-1, 3)[keep]
    facing = -cloud / np.linalg.norm(cloud, axis=1, keepdims=True)  # where no plane is known: seen face on
    records["normal"] = np.rint(127 * np.where(np.isfinite(normal), normal, facing))
    records["region"] = at(maps.interreflection)
    gaps = [median(np.linalg.norm(np.diff(points, axis=axis), axis=2)) for axis in (0, 1)]
    spacing = max((g for g in gaps if math.isfinite(g)), default=2 * reach / math.sqrt(len(keep)))
    description = {
        "count": len(keep),
        "shown_of": total,
        "step_mm": quantum,
        "centre": [float(v) for v in centre],
        "extent_mm": [float(v) for v in high - low],
        "spacing_mm": spacing,
        "sigma_mm": sigma_range,
        "depth_mm": [float(low[2]), float(high[2])],
    }
    return description, base64.b64encode(records.tobytes()).decode()
