"""How well a method detects bounces, where the bench can tell the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from drivers import SceneTruth
from scanner.result import Maps

_CLEAN = 0.1
"""A pixel whose bounce is weaker than this share of the least that counts is clean; what lies between is not judged."""


@dataclass(frozen=True)
class DetectionFigures:
    """Of one method; NaN where it detects nothing or the truth is not known.

    Parameters
    ----------
    precision
        Share of the detected pixels that see a bounce.
    recall
        Share of the pixels with a bounce that are detected.
    auc
        Probability that the method's statistic is larger for a pixel with a bounce than for a clean one.
    """

    precision: float = float("nan")
    recall: float = float("nan")
    auc: float = float("nan")


def bounces(truth: SceneTruth, least_alpha: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(H, W) pixels that see a bounce of at least ``least_alpha`` beside their direct light, and clean ones.

    Pixels without direct light, or that mix two surfaces, are neither.
    """
    judged = np.isfinite(truth.x_p) & ~truth.edge
    alpha = np.nan_to_num(truth.alpha, nan=0.0)
    return judged & (alpha >= least_alpha), judged & (alpha < _CLEAN * least_alpha)


def judge_detection(maps: Maps, truth: SceneTruth | None, least_alpha: float) -> DetectionFigures:
    """Judge ``maps.interreflection`` and ``maps.score`` against the truth."""
    if truth is None or maps.score is None:
        return DetectionFigures()
    bounce, clean = bounces(truth, least_alpha)
    hits, alarms = int((maps.interreflection & bounce).sum()), int((maps.interreflection & clean).sum())
    return DetectionFigures(
        precision=hits / (hits + alarms) if hits + alarms else float("nan"),
        recall=hits / int(bounce.sum()) if bounce.any() else float("nan"),
        auc=_auc(maps.score[bounce], maps.score[clean]),
    )


def _auc(bounce: NDArray[np.float32], clean: NDArray[np.float32]) -> float:
    """Area under the ROC curve by ranks (Mann and Whitney); a pixel without a statistic ranks lowest."""
    if not bounce.size or not clean.size:
        return float("nan")
    ranks = rankdata(np.nan_to_num(np.concatenate([bounce, clean]), nan=-np.inf))
    n, m = bounce.size, clean.size
    return float((ranks[:n].sum() - n * (n + 1) / 2) / (n * m))
