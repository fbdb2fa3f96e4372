"""Power of the residuals in every window at every spatial frequency, against noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import chi2 as chi2_distribution

from scanner.kernels import over_rows
from scanner.pooling.residuals import Residuals
from scanner.pooling.windows import WINDOW, Windows

_LEAST_SHARE = 0.25
"""A window with fewer usable pixels is not asked."""

_QUARTILE_WINDOWS = 200
"""So many windows at least tell which waves all clean surfaces have in common."""

_BINS = WINDOW * WINDOW


@dataclass(frozen=True)
class Spectra:
    """Power of the residuals in every window at every spatial frequency.

    Parameters
    ----------
    windows
        Where they lie.
    asked
        (n, m) bool, windows with enough usable pixels.
    power
        (n, m, bins) by axis, summed over t, per usable pixel: χ² with ``dof`` degrees of freedom under noise.
    systematic
        (n, m) by axis, what a bin may hold without a bounce.
    dof
        By axis.
    """

    windows: Windows
    asked: NDArray[np.bool_]
    power: tuple[NDArray[np.float32], ...]
    systematic: tuple[NDArray[np.float32], ...]
    dof: tuple[int, ...]

    @classmethod
    def of(cls, residuals: Sequence[Residuals], usable: NDArray[np.bool_]) -> Spectra:
        """Transform the residuals of each axis; ``usable`` (H, W)."""
        windows = Windows.over(usable.shape)
        count = windows.sums(usable)
        each = np.maximum(count, np.float32(1))[..., None]
        power = tuple(np.asarray(_spectra(r.e, windows) / each, np.float32) for r in residuals)
        systematic = tuple(windows.sums(r.systematic) for r in residuals)
        return cls(
            windows, count >= _LEAST_SHARE * _BINS, power, systematic, tuple(2 * len(r.e) - 2 for r in residuals)
        )

    def p_values(self, excess_noise: np.float32) -> tuple[NDArray[np.float64], list[NDArray[np.intp]]]:
        """P-value (n, m) of the windows' strongest bins, the axes joined by Fisher's method; and those bins by axis."""
        surprise, peaks = np.zeros(self.windows.shape), []
        for raw, systematic, dof in zip(self.power, self.systematic, self.dof, strict=True):
            power = raw / excess_noise
            power /= _common_waves(power[self.asked], dof)
            peak = power.argmax(axis=-1)
            strongest = np.take_along_axis(power, peak[..., None], axis=-1)[..., 0]
            strongest = np.maximum(strongest - systematic / excess_noise, 0)
            one = chi2_distribution.sf(strongest, dof)
            surprise -= 2 * np.log(np.maximum(-np.expm1(_BINS * np.log1p(-np.minimum(one, 1 - 1e-12))), 1e-300))
            peaks.append(peak)
        return np.where(self.asked, chi2_distribution.sf(surprise, 2 * len(self.power)), 1.0), peaks


def _spectra(e: NDArray[np.complex64], windows: Windows) -> NDArray[np.float32]:
    """(n, m, bins) power of every spatial frequency in every window, summed over t."""
    power = np.empty((*windows.shape, _BINS), np.float32)
    if not power.size:
        return power

    def bands(start: int, stop: int) -> None:
        for i in range(start, stop):
            y = windows.rows[i]
            views = np.lib.stride_tricks.sliding_window_view(e[:, y : y + WINDOW], WINDOW, axis=2)
            total = np.zeros((WINDOW, len(windows.columns), WINDOW), np.float32)
            for view in views:
                spectrum = fft.fftn(view[:, windows.columns], axes=(0, 2))
                total += spectrum.real**2 + spectrum.imag**2
            power[i] = total.transpose(1, 0, 2).reshape(-1, _BINS)

    over_rows(bands, len(windows.rows))
    return power


def _common_waves(power: NDArray[np.float32], dof: int) -> NDArray[np.float32]:
    """(bins,) by how much clean surfaces exceed noise at each spatial frequency: the lower quartile over the windows.

    What projector and camera add everywhere (a trend of the modulation, rounding of the pictures) shows as the same few
    waves on every surface, and is no bounce.
    """
    if len(power) < _QUARTILE_WINDOWS:
        return np.ones(_BINS, np.float32)
    sample = power[:: max(1, len(power) // 4000)]
    expected = float(chi2_distribution.ppf(0.25, dof))
    error = np.sqrt(0.25 * 0.75 / len(sample)) / float(chi2_distribution.pdf(expected, dof))
    quartile = np.quantile(sample, 0.25, axis=0)
    return np.where(quartile > expected + 4 * error, quartile / expected, 1).astype(np.float32)
