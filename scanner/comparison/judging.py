"""Figures of a method in a window, of one scan and over several seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from drivers import SceneTruth
from scanner.comparison.detection import bounces, judge_detection
from scanner.comparison.fitting import residuals
from scanner.comparison.windows import Window
from scanner.result import Maps, ScanResult

_HALF_FRINGE_PX = 8.0
"""Half of the finest fringes' usual period: a coordinate farther off is on a wrong fringe."""

_CLOSE_PX = 0.1
_FAR_APART_PX = 60.0
"""Two paths so far apart on the projector are well separable by their fringes (method.md §6)."""

_OUTLIER_MM = 1.0
_CONFIDENCE = 0.95

FIGURES = {
    "coverage": "share of the window's pixels with a point; where the truth is known, of those with direct light",
    "std_mm": "standard deviation of all its points from the robust surface through them",
    "std_ratio": "that standard deviation over the reference's, which sees no bounces, seed by seed",
    "median_mm": "median distance from that surface",
    "outliers": "share of its points more than 1 mm off that surface",
    "rmse_mm": "root mean square distance of all its points from the true ones",
    "wrong_fringes": "share of its coordinates more than 8 px, half a fringe, from the true ones",
    "close": "share of the window's coordinates with a bounce from 60 px or farther that are within 0.1 px of the "
    "true ones; missing ones are not",
    "precision": "share of the detected pixels of the whole picture that see a bounce",
    "recall": "share of the pixels of the whole picture that see a bounce which are detected",
    "auc": "area under the ROC curve of the method's statistic, whole picture",
    "frames": "frames taken",
    "seconds": "capture and decoding on this machine, s",
}
"""What is measured, in words."""


@dataclass(frozen=True)
class Trial:
    """The figures of one scan in one window, by the names of `FIGURES`; NaN or left out where there is none.

    Parameters
    ----------
    method, window
        Name of the row, which is the method's or the reference's, and of the window.
    values
        The figures.
    number
        Of the scan, from 0; scans of one number have the same seed.
    """

    method: str
    window: str
    values: Mapping[str, float]
    number: int = 0


@dataclass(frozen=True)
class Row:
    """One method in one window, over the seeds.

    Parameters
    ----------
    method, window
        Their names.
    seeds
        How many scans.
    mean
        Mean of each figure over the scans that have it.
    half_width
        Of its 95 % confidence interval, by Student's t; NaN with fewer than two.
    """

    method: str
    window: str
    seeds: int
    mean: Mapping[str, float]
    half_width: Mapping[str, float]

    def to_json(self) -> dict[str, Any]:
        """JSON-ready: the means by name, and the intervals' half widths."""
        return {
            "method": self.method,
            "window": self.window,
            "seeds": self.seeds,
            **self.mean,
            "half_width_95": dict(self.half_width),
        }


def distances(result: ScanResult, window: Window) -> NDArray[np.float32]:
    """(H, W) signed distance from the surface through the window's own points, mm; NaN elsewhere."""
    found = np.full(window.mask.shape, np.nan, np.float32)
    points = result.maps.points
    if points is not None:
        known = window.mask & np.isfinite(points[..., 2])
        found[known] = residuals(points[known], window.fit)
    return found


def judge(
    name: str,
    result: ScanResult,
    windows: Sequence[Window],
    truth: SceneTruth | None,
    least_alpha: float,
    number: int = 0,
) -> list[Trial]:
    """Figures of one scan in every window.

    Parameters
    ----------
    name
        Of the method.
    truth
        What is really there, or None: then only what needs no truth is judged.
    least_alpha
        Bounces of this share of the direct light and more count as such.
    number
        Of the scan, from 0.
    """
    detection = judge_detection(result.maps, truth, least_alpha)
    frames = sum(v for k, v in result.summary["frames"].items() if k != "repeated")
    seconds = sum(v for k, v in result.summary["timings_s"].items() if k != "open bench")
    trials = []
    for window in windows:
        off = distances(result, window)
        off = off[np.isfinite(off)]
        maps, points = result.maps, result.maps.points
        target = window.mask if truth is None else window.mask & np.isfinite(truth.x_p)
        there = np.zeros_like(target) if points is None else target & np.isfinite(points[..., 2])
        values = {
            "coverage": _share(there.sum(), target.sum()),
            "std_mm": float(off.std()) if off.size else math.nan,
            "median_mm": float(np.median(np.abs(off))) if off.size else math.nan,
            "outliers": float((np.abs(off) > _OUTLIER_MM).mean()) if off.size else math.nan,
            "rmse_mm": math.nan,
            "wrong_fringes": math.nan,
            "precision": detection.precision,
            "recall": detection.recall,
            "auc": detection.auc,
            "frames": float(frames),
            "seconds": float(seconds),
        }
        if truth is not None and there.any():
            assert points is not None
            error = np.linalg.norm(points[there] - truth.points[there], axis=1)
            values["rmse_mm"] = float(np.sqrt(np.mean(error**2)))
            wrong = np.zeros(there.shape, bool)
            for u, true in ((maps.x_p, truth.x_p), (maps.y_p, truth.y_p)):
                if u is not None:
                    wrong |= np.abs(u - true) > _HALF_FRINGE_PX
            values["wrong_fringes"] = float(wrong[there].mean())
        if truth is not None:
            values["close"] = _close(maps, truth, target, least_alpha)
        trials.append(Trial(name, window.name, values, number))
    return trials


def _close(maps: Maps, truth: SceneTruth, target: NDArray[np.bool_], least_alpha: float) -> float:
    """Share of the coordinates of pixels whose two paths are far apart along that axis which are right."""
    bounce, _ = bounces(truth, least_alpha)
    near, many = 0, 0
    for u, true, bounced in ((maps.x_p, truth.x_p, truth.bounce_x), (maps.y_p, truth.y_p, truth.bounce_y)):
        if u is not None:
            with np.errstate(invalid="ignore"):
                asked = target & bounce & (np.abs(bounced - true) >= _FAR_APART_PX)
                near += int((np.abs(u - true)[asked] <= _CLOSE_PX).sum())
            many += int(asked.sum())
    return _share(near, many)


def beside_reference(trials: Sequence[Trial], reference: str) -> list[Trial]:
    """The trials with ``std_ratio``: the std over that of the ``reference`` row in the same window and scan number."""
    found = {(t.window, t.number): t.values["std_mm"] for t in trials if t.method == reference}
    beside = []
    for t in trials:
        std = found.get((t.window, t.number), math.nan)
        ratio = t.values["std_mm"] / std if std > 0 else math.nan
        beside.append(replace(t, values={**t.values, "std_ratio": ratio}))
    return beside


def rows_of(trials: Sequence[Trial]) -> list[Row]:
    """One row for each window and method, in the order in which they first appear, window by window."""
    windows = list(dict.fromkeys(t.window for t in trials))
    methods = list(dict.fromkeys(t.method for t in trials))
    rows = []
    for window in windows:
        for method in methods:
            mine = [t.values for t in trials if (t.window, t.method) == (window, method)]
            if mine:
                spread = {k: _mean_and_half_width([v.get(k, math.nan) for v in mine]) for k in FIGURES}
                mean, half = ({k: v[i] for k, v in spread.items()} for i in (0, 1))
                rows.append(Row(method, window, len(mine), mean, half))
    return rows


def _mean_and_half_width(values: Sequence[float]) -> tuple[float, float]:
    known = np.array([v for v in values if math.isfinite(v)])
    if not known.size:
        return math.nan, math.nan
    if known.size < 2:
        return float(known.mean()), math.nan
    half = float(student.ppf(0.5 + _CONFIDENCE / 2, known.size - 1) * known.std(ddof=1) / math.sqrt(known.size))
    return float(known.mean()), half


def _share(part: Any, whole: Any) -> float:
    return float(part) / float(whole) if whole else math.nan
