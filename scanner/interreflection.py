"""Where do bounces arrive? Detection with thresholds that follow the noise (method.md §4).

Three detectors are offered. *variation* is the paper's: the standard deviation of the modulation over the frequencies.
*misfit* is χ² of the one-path fit to the complex phasors; it uses the phase too and sees several times weaker bounces.
*pooled* asks the neighbours as well (`scanner.pooling`) and joins the evidence of single pixels (`scanner.labelling`);
it sees bounces far below the noise of a pixel. All are compared with their distribution under noise alone, so that the
operator chooses a false-alarm rate and never a grey level. Depth edges, which mix two surfaces in one pixel, look the
same to each and are told apart by the surfaces beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from scanner.labelling import BOUNDARY_PRICE, label
from scanner.phasors import AxisPhasors
from scanner.pooling import Residuals, Spectra, pool
from scanner.unwrapping import Coordinates

_SMALLEST_REGION = 12
"""Fewer connected pixels than this are no region: nothing that a second round could light."""

MOST_EVIDENCE = 3 * BOUNDARY_PRICE
"""A single pixel never says more than its own boundary costs: no region stands on one pixel."""

FEWEST = 100
"""Fewer pixels tell nothing of the noise."""

_MOST_UNEVEN = 1.5
"""The better quarter of clean pixels fits worse than the best fiftieth by less than this; more is bounces."""

_QUIET = 0.02
"""Share of the pixels that see no bounce in any scene."""

_PENUMBRA_PX = 15
"""Window whose mean statistic tells bounces below the threshold of a pixel, camera px."""

_PENUMBRA_EXCESS, _PENUMBRA_SIGMAS, _PENUMBRA_LEAST = 0.1, 5.0, 30
"""By how much it exceeds what the quietest pixels show: relative, and in its own noise; and of how many pixels."""

_EDGE_REACH = 3
"""How far from a depth edge, px, the optics mix both surfaces."""

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)


@dataclass(frozen=True)
class Detection:
    """What the first round says about bounces, arrays (H, W).

    Parameters
    ----------
    region
        bool, pixels that see a bounce.
    depth_edge
        bool, pixels that mix two surfaces.
    suspicious
        bool, single pixels outside both whose fringes fit one path so badly that they cannot be kept.
    statistic
        The test statistic over its expectation under noise: 1 means noise alone.
    threshold
        Value of ``statistic`` that the chosen share of clean pixels exceeds.
    excess_noise
        Variance of clean pixels over what the noise model says; the threshold is scaled with it.
    penumbra
        bool, pixels outside all of these that only together with their neighbours show a bounce: its rim, where it is
        too weak to be detected and still moves a coordinate by more than its noise.
    """

    region: NDArray[np.bool_]
    depth_edge: NDArray[np.bool_]
    suspicious: NDArray[np.bool_]
    statistic: NDArray[np.float32]
    threshold: float
    excess_noise: float
    penumbra: NDArray[np.bool_]


def modulation_variation(phasors: AxisPhasors, gain: NDArray[np.float64]) -> NDArray[np.float32]:
    """(H, W) standard deviation over the frequencies of |z_t|, DN (the paper's B_v), the optics' own trend removed."""
    count = len(phasors.frequency)
    total = np.zeros(phasors.z.shape[1:], np.float32)
    squares = np.zeros_like(total)
    first = np.abs(phasors.z[0]) / np.float32(gain[0])
    for t in range(1, count):
        # Deviations from the first frequency keep the squares small enough for single precision.
        off = np.abs(phasors.z[t]) / np.float32(gain[t]) - first
        total += off
        squares += off * off
    variance = (squares - total * total / np.float32(count)) / np.float32(count)
    return np.sqrt(np.maximum(variance, 0))


def misfit_statistic(coordinates: Sequence[Coordinates]) -> tuple[NDArray[np.float32], int]:
    """χ² of the one-path fits of all axes together, and its degrees of freedom."""
    total = coordinates[0].chi2.copy()
    for other in coordinates[1:]:
        total += other.chi2
    return total, sum(c.dof for c in coordinates)


def variation_statistic(
    variations: Sequence[NDArray[np.float32]], sigma_z: Sequence[NDArray[np.float32]], frequencies: Sequence[int]
) -> tuple[NDArray[np.float32], int]:
    """T·B_v²/σ_z² of all axes together: χ² with T - 1 degrees of freedom each, as long as B is well above the noise."""
    total = np.zeros_like(variations[0])
    for variation, sigma, count in zip(variations, sigma_z, frequencies, strict=True):
        total += np.float32(count) * (variation / sigma) ** 2
    return total, sum(count - 1 for count in frequencies)


def detect(
    statistic: NDArray[np.float32],
    dof: int,
    coordinates: Sequence[Coordinates],
    usable: NDArray[np.bool_],
    false_alarm_rate: float,
) -> Detection:
    """Separate clean pixels, bounces and depth edges.

    Parameters
    ----------
    statistic, dof
        (H, W) statistic that noise alone makes χ² with ``dof`` degrees of freedom.
    coordinates
        One-path coordinates of the axes, to tell depth edges.
    usable
        (H, W) pixels with enough modulation and without saturation.
    false_alarm_rate
        Share of clean pixels that exceed the threshold before their neighbours are asked.

    Notes
    -----
    A pixel belongs to the region when it exceeds the threshold and at least two neighbours are suspect, or when it is
    itself suspect (exceeds the 5 % point) and most neighbours exceed the threshold: weak bounces are joined up, single
    false alarms dropped, and a clean pixel beside a strong bounce stays clean.
    """
    excess = excess_noise(statistic, dof, usable)
    threshold = float(chi2_distribution.isf(false_alarm_rate, dof)) * excess
    suspect_from = float(chi2_distribution.isf(0.05, dof)) * excess
    strong = usable & (statistic > threshold)
    suspect = usable & (statistic > suspect_from)
    found = strong & (_count_neighbours(suspect) >= 2)
    for _ in range(2):
        found = (strong & (_count_neighbours(found) >= 1)) | found
        found |= suspect & (_count_neighbours(found) >= 5)
    return _sorted_out(found, statistic, dof, coordinates, usable, threshold, excess)


def detect_pooled(
    residuals: Sequence[Residuals],
    statistic: NDArray[np.float32],
    dof: int,
    coordinates: Sequence[Coordinates],
    usable: NDArray[np.bool_],
    false_alarm_rate: float,
) -> Detection:
    """Separate clean pixels, bounces and depth edges by evidence that is pooled over neighbours.

    Parameters
    ----------
    residuals
        Of each axis, from `scanner.pooling.one_path_residuals`.
    statistic, dof, coordinates, usable, false_alarm_rate
        As for `detect`; the statistic is χ² of the one-path fits.

    Notes
    -----
    The region minimises evidence against boundary length (`scanner.labelling`): it is found where windows or single
    pixels exceed the threshold, and what they raise by chance is too weak for the boundary it would need. Clean pixels
    are therefore taken for a bounce less often than ``false_alarm_rate``.

    The noise is measured twice: the lower quartile of all pixels lies too high where bounces cover some of them, that
    of the pixels outside the region that was found with it does not.
    """
    spectra = Spectra.of(residuals, usable)
    excess = excess_noise(statistic, dof, usable)
    found, start = np.zeros(usable.shape, bool), None
    for _ in range(2):
        pooled = pool(residuals, statistic, dof, usable, false_alarm_rate, excess, spectra)
        evidence = np.clip(pooled.evidence, -MOST_EVIDENCE, MOST_EVIDENCE)
        start = label(evidence, start=start)
        found = usable & (start > 0.5)
        before, excess = excess, excess_noise(statistic, dof, usable & ~found)
        if excess > 0.99 * before:
            break
    threshold = float(chi2_distribution.isf(false_alarm_rate, dof)) * excess
    return _sorted_out(found, statistic, dof, coordinates, usable, threshold, excess)


def _sorted_out(
    found: NDArray[np.bool_],
    statistic: NDArray[np.float32],
    dof: int,
    coordinates: Sequence[Coordinates],
    usable: NDArray[np.bool_],
    threshold: float,
    excess: float,
) -> Detection:
    """Take depth edges, pinholes and specks out of the pixels found."""
    edge = _depth_edges(found, usable, coordinates)
    region = _without_small(_fill_pinholes(found & ~edge, usable), _SMALLEST_REGION)
    certain = float(chi2_distribution.isf(1e-6, dof)) * excess
    suspicious = usable & (statistic > certain) & ~region & ~edge
    return Detection(
        region=region,
        depth_edge=edge & ~region,
        suspicious=suspicious,
        statistic=statistic / np.float32(dof),
        threshold=threshold / dof,
        excess_noise=excess,
        penumbra=_penumbra(statistic, dof, usable, usable & ~found & ~region & ~edge & ~suspicious),
    )


def _penumbra(
    statistic: NDArray[np.float32], dof: int, usable: NDArray[np.bool_], asked: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Those of the ``asked`` pixels whose mean statistic over the asked ones around exceeds what quiet ones show."""
    window = (_PENUMBRA_PX, _PENUMBRA_PX)
    near, total = (
        cv2.boxFilter(plane, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for plane in (asked.astype(np.float32), np.where(asked, statistic, np.float32(0)))
    )
    quiet = max(1.0, _relative_quantile(statistic, dof, usable, _QUIET))
    near = np.maximum(near, 1)
    limit = quiet * (1 + _PENUMBRA_EXCESS + _PENUMBRA_SIGMAS * np.sqrt(2 / (dof * near)))
    return np.asarray(asked & (near >= _PENUMBRA_LEAST) & (total > dof * near * limit))


def excess_noise(statistic: NDArray[np.float32], dof: int, usable: NDArray[np.bool_]) -> float:
    """Variance of clean pixels in units of what the noise model says, 1 at least.

    The lower quartile of the statistic tells it until bounces cover three quarters of the picture; from there on the
    quietest pixels do.
    """
    quiet = _relative_quantile(statistic, dof, usable, _QUIET)
    return max(1.0, min(excess_misfit(statistic, dof, usable), _MOST_UNEVEN * quiet))


def excess_misfit(statistic: NDArray[np.float32], dof: int, usable: NDArray[np.bool_]) -> float:
    """Lower quartile of a χ² statistic over the usable pixels, in units of where noise alone would put it.

    The lower quartile stays with the clean pixels even where bounces cover most of the picture.
    """
    return _relative_quantile(statistic, dof, usable, 0.25)


def _relative_quantile(statistic: NDArray[np.float32], dof: int, usable: NDArray[np.bool_], share: float) -> float:
    values = statistic[usable]
    if values.size < FEWEST:
        return 1.0
    quantile = np.quantile(values[:: max(1, values.size // 200_000)], share)
    return float(quantile) / float(chi2_distribution.ppf(share, dof))


def _count_neighbours(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.asarray(cv2.filter2D(mask.astype(np.uint8), -1, _NEIGHBOURS, borderType=cv2.BORDER_CONSTANT), np.uint8)


def _fill_pinholes(mask: NDArray[np.bool_], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Join pixels that the region surrounds: where the second path happens to leave no trace in the fringes."""
    closed = cv2.morphologyEx(
        mask.astype(np.uint8), cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    )
    return mask | ((closed > 0) & usable & (_count_neighbours(mask) >= 5))


def _without_small(mask: NDArray[np.bool_], smallest: int) -> NDArray[np.bool_]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= smallest
    keep[0] = False
    return np.asarray(keep[labels])


def _depth_edges(
    found: NDArray[np.bool_], usable: NDArray[np.bool_], coordinates: Sequence[Coordinates]
) -> NDArray[np.bool_]:
    """Return the found pixels between two clean surfaces that do not continue each other.

    On a line through the pixel, both clean sides are extrapolated to it by their own slope; across a bounce on one
    smooth surface they meet, at a depth edge they miss each other by more than the noise and the curvature explain.
    """
    clean = usable & ~found
    height, width = found.shape
    rows, columns = np.nonzero(found)
    edge = np.zeros(rows.size, bool)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        near, far = [], []
        for sense in (1, -1):
            # The nearest clean pixel within reach on this side, and the one behind it for the slope.
            inner = np.full(rows.size, -1)
            for k in range(_EDGE_REACH, 0, -1):
                y, x = rows + sense * k * dy, columns + sense * k * dx
                y2, x2 = y + sense * dy, x + sense * dx
                inside = (y2 >= 0) & (y2 < height) & (x2 >= 0) & (x2 < width)
                inside &= (y >= 0) & (y < height) & (x >= 0) & (x < width)
                ok = np.zeros(rows.size, bool)
                ok[inside] = clean[y[inside], x[inside]] & clean[y2[inside], x2[inside]]
                inner[ok] = k
            near.append(inner)
            far.append(inner > 0)
        both = np.flatnonzero(far[0] & far[1])
        for c in coordinates:
            met = []
            for sense, inner in zip((1, -1), near, strict=True):
                away = inner[both]
                y, x = rows[both] + sense * away * dy, columns[both] + sense * away * dx
                close, behind = c.u[y, x], c.u[y + sense * dy, x + sense * dx]
                met.append((close + away * (close - behind), np.abs(close - behind), c.sigma[y, x]))
            gap = np.abs(met[0][0] - met[1][0])
            allowed = 0.5 + 0.5 * np.maximum(met[0][1], met[1][1]) + 8 * _EDGE_REACH * (met[0][2] + met[1][2])
            edge[both] |= gap > allowed
    result = np.zeros_like(found)
    result[rows, columns] = edge
    return result
