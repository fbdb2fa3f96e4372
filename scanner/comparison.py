"""Several methods on one scene, judged in the bounce region the way the paper does: by the error after a plane fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.result import ScanResult

_TUKEY = 4.685
"""Tuning constant of Tukey's biweight, in units of σ: 95 % efficiency on Gaussian errors."""


@dataclass(frozen=True)
class Row:
    """One method in the region.

    Parameters
    ----------
    method
        Its name.
    frames
        Frames it took.
    coverage
        Share of the region's pixels with a point.
    std_mm
        Standard deviation of all its points from the robust plane, mm.
    median_mm
        Median distance from the plane, mm.
    outliers
        Share of its points more than 1 mm off the plane.
    seconds
        Capture and decoding, s of the machine.
    """

    method: str
    frames: int
    coverage: float
    std_mm: float
    median_mm: float
    outliers: float
    seconds: float


def fit_plane(points: NDArray[np.floating[Any]], iterations: int = 30) -> tuple[NDArray[np.float64], float]:
    """Robust plane n·X = d through (P, 3) points: (n, d), n a unit vector; Tukey's biweight on the distances.

    Raises
    ------
    ValueError
        Fewer than three points.
    """
    if len(points) < 3:
        raise ValueError(f"{len(points)} points do not make a plane")
    centre = np.median(points, axis=0)
    off = np.asarray(points, np.float64) - centre
    weights = np.ones(len(off))
    for i in range(iterations):
        middle = np.average(off, axis=0, weights=weights)
        _, _, axes = np.linalg.svd((off - middle) * np.sqrt(weights)[:, None], full_matrices=False)
        normal = axes[2]
        distance = (off - middle) @ normal
        scale = 1.4826 * np.median(np.abs(distance)) + 1e-12
        updated = np.clip(1 - (distance / (_TUKEY * scale)) ** 2, 0, None) ** 2
        if i and np.allclose(updated, weights, atol=1e-4):
            break
        weights = updated
    return normal, float(normal @ (centre + middle))


def largest_region(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected part of a mask."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def compare(results: Mapping[str, ScanResult], region: NDArray[np.bool_]) -> tuple[list[Row], dict[str, Any]]:
    """Judge each result in ``region`` (H, W) against the robust plane through its own points.

    Returns
    -------
    rows
        One a method.
    maps
        Signed distance (H, W) from the plane by method, mm; NaN outside the region and where there is no point.
    """
    rows, maps = [], {}
    for name, result in results.items():
        points = result.maps.points
        distance = np.full(region.shape, np.nan, np.float32)
        frames = sum(v for k, v in result.summary["frames"].items() if k != "repeated")
        seconds = sum(result.summary["timings_s"].values())
        known = np.asarray(region if points is None else region & np.isfinite(points[..., 2]))
        if points is None or known.sum() < 3:
            nan = float("nan")
            rows.append(Row(name, frames, 0.0, nan, nan, nan, seconds))
        else:
            normal, d = fit_plane(points[known])
            off = points[known] @ normal - d
            distance[known] = off
            rows.append(
                Row(
                    name,
                    frames,
                    float(known.sum() / region.sum()),
                    float(off.std()),
                    float(np.median(np.abs(off))),
                    float((np.abs(off) > 1).mean()),
                    seconds,
                )
            )
        maps[name] = distance
    return rows, maps


def picture(maps: Mapping[str, NDArray[np.float32]], rows: Sequence[Row], path: Path, simulated: bool) -> None:
    """Distance from the plane, one map a method on one scale, as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    known = np.asarray(np.isfinite(np.stack(list(maps.values()))).any(axis=0))
    ys, xs = np.nonzero(known)
    window = (slice(ys.min(), ys.max() + 1), slice(xs.min(), xs.max() + 1)) if ys.size else (slice(None), slice(None))
    limit = max(4 * min((r.median_mm for r in rows if np.isfinite(r.median_mm)), default=0.1), 0.01)
    shape = known[window].shape
    width = 3.2
    figure = Figure(figsize=(width * len(maps) + 1.0, width * shape[0] / shape[1] + 1.1), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(maps), squeeze=False)[0]
    for ax, (name, values), row in zip(axes, maps.items(), rows, strict=True):
        image = ax.imshow(values[window], cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        ax.set_facecolor("0.85")
        ax.set_xticks([])
        ax.set_yticks([])
        ax.set_title(f"{name.upper()}   std {row.std_mm:.3g} mm\n{100 * row.coverage:.1f} % covered", fontsize=10)
    figure.colorbar(image, ax=list(axes), label="distance from the plane, mm", shrink=0.9, extend="both")
    stamp = "SIMULATED DATA · " if simulated else ""
    figure.suptitle(f"{stamp}bounce region after a plane fit; grey: no point", fontsize=9, color="0.3")
    figure.savefig(path, dpi=130)


def to_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """JSON-ready rows."""
    return [asdict(row) for row in rows]
