"""Detection at the limit: how weak a bounce, under how much noise, at which distance of the two paths.

The study of Optics Express 27(20) 28293, Figs. 22 and 23, with three detectors at one false-alarm rate: the paper's
standard deviation of the modulation, χ² of the one-path fit, and χ² pooled over neighbours. Every figure comes with the
95 % interval over independent seeds.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.stats import rankdata
from scipy.stats import t as student

from scanner.patterns import Axis
from scanner.studies.ideal import DETECTORS, IdealScene, Judgement, curved_scene, disc_scene, observe, tiled_scene

ALPHAS = (0.05, 0.4, 0.6)
SIGMAS_DN = (0.0, 10.0, 20.0)
NEAR_PX = 20.0
"""Nearer than this on the projector, two paths look like one: those pixels are not counted."""

PAPER_FREQUENCIES = tuple((80 + t) / 1280 for t in range(9))
PAPER_STEPS = 12


@dataclass(frozen=True)
class Interval:
    """Mean over seeds and its 95 % interval (Student)."""

    mean: float
    low: float
    high: float
    seeds: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Interval:
        """Of independent values, one a seed; NaN of less than two values leaves the interval open."""
        known = np.asarray([v for v in values if np.isfinite(v)])
        if known.size < 2:
            return cls(float(known.mean()) if known.size else float("nan"), float("nan"), float("nan"), known.size)
        half = float(student.ppf(0.975, known.size - 1) * known.std(ddof=1) / np.sqrt(known.size))
        return cls(float(known.mean()), float(known.mean() - half), float(known.mean() + half), known.size)


@dataclass(frozen=True)
class Score:
    """One detected region beside the truth.

    Parameters
    ----------
    iou
        Intersection over union, the pixels with |Δu| < 20 px not counted.
    false_alarms
        Share of the pixels without a bounce that were taken for one.
    border_mean_px, border_95_px
        Distance of the true border's pixels from the found border: mean, and what 95 % of them keep; NaN where
        nothing was found. What is missing inside a region, or found far outside, is told by the other figures.
    auc
        Area under the ROC of the detector's score.
    best_iou
        Intersection over union of the score at the threshold that suits this very scene best.
    """

    iou: float
    false_alarms: float
    border_mean_px: float
    border_95_px: float
    auc: float
    best_iou: float


def score(scene: IdealScene, judged: Judgement, near_px: float = NEAR_PX) -> Score:
    """Compare a judgement with the truth."""
    truth = scene.region
    counted = ~(truth & (scene.distance < near_px))
    wanted, found = truth & counted, judged.region & counted
    distances = _border_distances(truth, judged.region, counted)
    known = distances.size > 0
    return Score(
        iou=float((wanted & found).sum() / max((wanted | found).sum(), 1)),
        false_alarms=float((judged.region & ~truth).sum() / max((~truth).sum(), 1)),
        border_mean_px=float(distances.mean()) if known else float("nan"),
        border_95_px=float(np.quantile(distances, 0.95)) if known else float("nan"),
        auc=area_under_roc(judged.score[wanted], judged.score[~truth]),
        best_iou=_best_iou(judged.score[wanted], judged.score[~truth]),
    )


def area_under_roc(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Probability that a positive scores above a negative (Mann-Whitney), ties counted half; NaN where none is."""
    if not positive.size or not negative.size:
        return float("nan")
    ranks = rankdata(np.concatenate([positive.ravel(), negative.ravel()]))
    above = ranks[: positive.size].sum() - positive.size * (positive.size + 1) / 2
    return float(above / (positive.size * negative.size))


def roc(positive: NDArray[Any], negative: NDArray[Any], rates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of positives above the thresholds that the share ``rates`` of the negatives exceeds."""
    thresholds = np.quantile(negative, 1 - rates)
    return np.asarray((positive[None] > thresholds[:, None]).mean(axis=1))


def _best_iou(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    thresholds = np.quantile(np.concatenate([positive, negative]), np.linspace(0, 1, 400))
    hits = positive.size - np.searchsorted(np.sort(positive), thresholds)
    false = negative.size - np.searchsorted(np.sort(negative), thresholds)
    return float((hits / (positive.size + false)).max())


def _border_distances(
    truth: NDArray[np.bool_], found: NDArray[np.bool_], counted: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Distance of every border pixel of the truth, as far as it is counted, from the nearest border pixel found."""
    true_border = truth & counted & ~binary_erosion(truth, border_value=1)
    found_border = found & ~binary_erosion(found, border_value=1)
    if not true_border.any() or not found_border.any():
        return np.empty(0)
    return np.asarray(distance_transform_edt(~found_border)[true_border])


def pairs_study(
    seeds: Sequence[int],
    axes: Sequence[Axis] = ("x",),
    shape: tuple[int, int] = (384, 512),
    false_alarm_rate: float = 0.01,
    frequencies: Sequence[float] = PAPER_FREQUENCIES,
    steps: int = PAPER_STEPS,
    pairs: Sequence[tuple[float, float]] = tuple(itertools.product(ALPHAS, SIGMAS_DN)),
    report: Callable[[str], None] = lambda text: None,
) -> tuple[list[dict[str, Any]], dict[tuple[float, float], tuple[IdealScene, dict[str, Judgement]]]]:
    """Measure the nine pairs of attenuation and noise.

    Returns
    -------
    rows
        One for each pair and detector: its `Score`, each figure an `Interval` over the seeds.
    examples
        Scene and judgements of the first seed by pair, for figures.
    """
    rows: list[dict[str, Any]] = []
    examples: dict[tuple[float, float], tuple[IdealScene, dict[str, Judgement]]] = {}
    for number, (alpha, sigma) in enumerate(pairs, 1):
        report(f"pair {number} of {len(pairs)}: α = {alpha:g}, σ = {sigma:g} DN")
        scores: dict[str, list[Score]] = {d: [] for d in DETECTORS}
        for seed in seeds:
            rng = np.random.default_rng([seed, round(1000 * alpha), round(sigma)])
            scene = curved_scene(shape, alpha, rng, axes)
            seen = observe(scene, dict.fromkeys(axes, frequencies), steps, sigma, rng)
            judged = {d: seen.judge(d, false_alarm_rate) for d in DETECTORS}
            for detector, judgement in judged.items():
                scores[detector].append(score(scene, judgement))
            examples.setdefault((alpha, sigma), (scene, judged))
        rows += [{"alpha": alpha, "sigma_dn": sigma, "detector": d, **_intervals(s)} for d, s in scores.items()]
    return rows, examples


def distance_study(
    deltas_px: Sequence[float],
    seeds: Sequence[int],
    alpha: float,
    sigma_dn: float,
    axes: Sequence[Axis] = ("x",),
    shape: tuple[int, int] = (128, 128),
    radius_px: float = 40,
    false_alarm_rate: float = 0.01,
    report: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """One Δu at a time, blind values included: a disc whose bounce has this Δu everywhere."""
    rows = []
    for number, delta in enumerate(deltas_px, 1):
        report(f"distance {number} of {len(deltas_px)}: Δu = {delta:g} px at α = {alpha:g}, σ = {sigma_dn:g} DN")
        scores: dict[str, list[Score]] = {d: [] for d in DETECTORS}
        for seed in seeds:
            rng = np.random.default_rng([seed, round(10 * delta), round(1000 * alpha), round(sigma_dn)])
            scene = disc_scene(shape, alpha, delta, radius_px, axes)
            seen = observe(scene, dict.fromkeys(axes, PAPER_FREQUENCIES), PAPER_STEPS, sigma_dn, rng)
            for detector in DETECTORS:
                scores[detector].append(score(scene, seen.judge(detector, false_alarm_rate), near_px=0.0))
        rows += [
            {"delta_px": delta, "alpha": alpha, "sigma_dn": sigma_dn, "detector": d, **_intervals(s)}
            for d, s in scores.items()
        ]
    return rows


def clean_study(
    rates: Sequence[float],
    seeds: Sequence[int],
    axes: Sequence[Axis] = ("x",),
    sigma_dn: float = 10.0,
    shape: tuple[int, int] = (384, 512),
    report: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Pictures without any bounce: the share of pixels beyond the threshold, and the share taken for a region."""
    beyond: dict[tuple[str, float], list[float]] = {}
    region: dict[tuple[str, float], list[float]] = {}
    for number, seed in enumerate(seeds, 1):
        report(f"clean picture {number} of {len(seeds)}")
        rng = np.random.default_rng([seed, 77])
        scene = curved_scene(shape, 0.0, rng, axes)
        seen = observe(scene, dict.fromkeys(axes, PAPER_FREQUENCIES), PAPER_STEPS, sigma_dn, rng)
        for detector, rate in itertools.product(DETECTORS, rates):
            judged = seen.judge(detector, rate)
            key = detector, rate
            beyond.setdefault(key, []).append(float(judged.beyond.mean()))
            region.setdefault(key, []).append(float(judged.region.mean()))
    return [
        {
            "detector": d,
            "false_alarm_rate": r,
            "beyond": asdict(Interval.of(beyond[d, r])),
            "region": asdict(Interval.of(region[d, r])),
        }
        for d, r in beyond
    ]


def plan_study(
    plans: Mapping[str, tuple[Mapping[Axis, Sequence[float]], int]],
    seeds: Sequence[int],
    pairs: Sequence[tuple[tuple[float, float], float]],
    delta_px: tuple[float, float] = (16, 600),
    tiles: int = 6,
    side_px: int = 40,
    false_alarm_rate: float = 0.01,
    report: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Plans on bounces of random α, Δu, direction and slope: detection AUC, and coordinate error of clean pixels.

    Parameters
    ----------
    plans
        Frequencies by axis (1/px) and steps, by name.
    pairs
        (range of α, σ in DN).
    """
    rows = []
    for (alpha, sigma), (name, (frequencies, steps)) in itertools.product(pairs, plans.items()):
        report(f"{name}, α = {alpha[0]:g}..{alpha[1]:g}, σ = {sigma:g} DN")
        areas: dict[str, list[float]] = {d: [] for d in DETECTORS}
        errors: list[float] = []
        for seed in seeds:
            # The same bounces for every plan.
            scene = tiled_scene(tiles, side_px, alpha, delta_px, np.random.default_rng([seed, 5]), tuple(frequencies))
            seen = observe(scene, frequencies, steps, sigma, np.random.default_rng([seed, steps, len(name)]))
            for detector in DETECTORS:
                judged = seen.judge(detector, false_alarm_rate)
                areas[detector].append(area_under_roc(judged.score[scene.region], judged.score[~scene.region]))
            off = np.concatenate([(c.u - scene.direct[c.axis])[~scene.region] for c in seen.coordinates])
            errors.append(float(np.sqrt(np.mean(np.clip(off, -1, 1) ** 2))))
        rows.append(
            {
                "plan": name,
                "frames": steps * sum(len(f) for f in frequencies.values()),
                "alpha": list(alpha),
                "sigma_dn": sigma,
                "auc": {d: asdict(Interval.of(v)) for d, v in areas.items()},
                "rms_px": asdict(Interval.of(errors)),
            }
        )
    return rows


def _intervals(scores: Sequence[Score]) -> dict[str, Any]:
    values = [asdict(s) for s in scores]
    return {key: asdict(Interval.of([v[key] for v in values])) for key in values[0]}
