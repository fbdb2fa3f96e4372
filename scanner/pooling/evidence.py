"""Windows and single pixels joined into one p-value and one evidence for every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import ncx2

from scanner.labelling import label
from scanner.phasors import AxisPhasors
from scanner.pooling.residuals import Residuals, one_path_residuals
from scanner.pooling.spectra import Spectra
from scanner.pooling.waves import wave_evidence
from scanner.pooling.windows import WINDOW
from scanner.unwrapping import Coordinates


@dataclass(frozen=True)
class Pooled:
    """What pixels and their neighbours say about a bounce, arrays (H, W).

    Parameters
    ----------
    p_value
        How often noise alone looks at least like this, by the pixel's own χ² or by the strongest of its windows.
    detected
        bool, pixels with a ``p_value`` below the false-alarm rate.
    evidence
        float32, log-likelihood ratio of a bounce in this very pixel, nats; 0 where the pixel is not usable.
    """

    p_value: NDArray[np.float32]
    detected: NDArray[np.bool_]
    evidence: NDArray[np.float32]


def pool(
    residuals: Sequence[Residuals],
    statistic: NDArray[np.float32],
    dof: int,
    usable: NDArray[np.bool_],
    false_alarm_rate: float,
    excess_noise: float = 1.0,
    spectra: Spectra | None = None,
) -> Pooled:
    """Pool the residuals of all axes.

    Parameters
    ----------
    residuals
        Of each axis, from `one_path_residuals`.
    statistic, dof
        (H, W) χ² of the one-path fits of all axes together, and its degrees of freedom under noise.
    usable
        (H, W) pixels to ask.
    false_alarm_rate
        Share of clean pixels that may be ``detected``. One half of it goes to the pixels' own χ², an eighth to each of
        the four windows that cover a pixel.
    excess_noise
        Variance of clean pixels over what the noise model says.
    spectra
        `Spectra.of` the residuals, where they are asked again with another noise.
    """
    if spectra is None:
        spectra = Spectra.of(residuals, usable)
    windows = spectra.windows
    excess = np.float32(excess_noise)
    own = chi2_distribution.sf(statistic / excess, dof).astype(np.float32)
    in_windows, peaks = spectra.p_values(excess)
    best = np.ones(statistic.shape, np.float32)
    for i, y in enumerate(windows.rows):
        for j, x in enumerate(windows.columns):
            part = best[y : y + WINDOW, x : x + WINDOW]
            np.minimum(part, in_windows[i, j], out=part)
    p_value = np.where(usable, np.minimum(np.minimum(2 * own, 8 * best), 1), 1).astype(np.float32)
    asked = in_windows <= false_alarm_rate / 8
    alone = single_pixel_evidence(statistic / excess, dof, false_alarm_rate)
    weights = usable.astype(np.float32)
    evidence = wave_evidence(residuals, windows, asked, peaks, weights, alone, excess)
    # Where a border cuts a window, the wave comes out too weak: known from the pixels that speak for it, it is right.
    members = weights * (evidence > 0)
    evidence = wave_evidence(residuals, windows, asked, peaks, members, alone, excess)
    evidence[~usable] = 0
    return Pooled(p_value, p_value <= false_alarm_rate, evidence)


def single_pixel_evidence(statistic: NDArray[np.float32], dof: int, false_alarm_rate: float) -> NDArray[np.float32]:
    """(H, W) log-likelihood ratio of a pixel's own χ²: noncentral against central, nats.

    The noncentrality is the one that the false-alarm rate lets detect every other time: weaker bounces cannot be told
    by a single pixel, stronger ones exceed any doubt with it as well.
    """
    threshold = float(chi2_distribution.isf(false_alarm_rate, dof))
    grid = np.linspace(0.05, 8 * threshold, 4000)
    ratio = ncx2.logpdf(grid, dof, max(threshold - dof, dof**0.5)) - chi2_distribution.logpdf(grid, dof)
    known = np.isfinite(ratio)
    return np.asarray(np.interp(statistic, grid[known], ratio[known]), np.float32)


def compile_all() -> None:
    """Compile the kernels of pooling and labelling, so that no scan waits for them."""
    side = 2 * WINDOW
    z = np.ones((3, side, side), np.complex64)
    plane, usable = np.ones((side, side), np.float32), np.ones((side, side), bool)
    phasors = AxisPhasors("x", np.array([1 / 16, 1 / 17, 1 / 18]), z, 1.0)
    coordinates = Coordinates("x", plane, plane, plane, plane, 4, plane)
    residuals = one_path_residuals(phasors, coordinates, plane, np.ones(3), usable)
    label(pool([residuals], plane, 4, usable, 0.4).evidence, iterations=1)
