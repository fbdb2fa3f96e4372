"""What the one-path fits leave of the phasors, in units of the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from scanner.kernels import over_pixels, sin_cos_turns
from scanner.phasors import AxisPhasors
from scanner.unwrapping import Coordinates

_OUTLIER_RATE = 1e-4
"""A residual larger than noise makes so rarely keeps its direction and loses the rest: depth edges and dust must not
speak for a window."""

_LEAST_RATIO = 0.001
"""Waves weaker than this part of the direct light are put down to the patterns: 8-bit rounding is 0.2 % of a fringe's
amplitude, of which twelve steps leave half. A bounce so weak moves a coordinate by 0.001/2π of a period."""

_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"})


@dataclass(frozen=True)
class Residuals:
    """What the one-path fits of one axis leave.

    Parameters
    ----------
    e
        (T, H, W) turned back by the fitted phase, in units of the noise: real and imaginary parts of variance 1 under
        noise alone, on 2T - 2 degrees of freedom. Unusable pixels are 0.
    systematic
        (H, W) power per pixel, in the same units, that the frames may have in one wave without any bounce.
    frequency
        (T,) 1/px; the waves of the frequencies have spatial frequencies in proportion.
    """

    e: NDArray[np.complex64]
    systematic: NDArray[np.float32]
    frequency: NDArray[np.float64]


def one_path_residuals(
    phasors: AxisPhasors,
    coordinates: Coordinates,
    sigma_z: NDArray[np.float32],
    gain: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> Residuals:
    """Residuals of the one-path fits ``coordinates`` of ``phasors``; the arguments are those of `unwrap`.

    Notes
    -----
    Two errors follow the fringes and therefore the surface, like a bounce: those of the patterns, in proportion to the
    light, and the rounding of the frames where no noise dithers it. Noise of σ DN leaves exp(-2π²σ²) of the latter
    (Widrow and Kollár, *Quantization Noise*, §19).
    """
    count = len(phasors.frequency)
    result = np.empty(phasors.z.shape, np.complex64)
    most = np.float32(chi2_distribution.isf(_OUTLIER_RATE, 2 * count - 2))
    planes = (coordinates.u, coordinates.amplitude, sigma_z, usable)
    u, amplitude, sigma, asked = (np.ascontiguousarray(a).reshape(-1) for a in planes)
    f, g = phasors.frequency.astype(np.float32), gain.astype(np.float32)
    z, out = phasors.z.reshape(count, -1), result.reshape(count, -1)
    over_pixels(lambda a, b: _residuals(z, f, g, u, amplitude, sigma, asked, most, out, a, b), z.shape[1])
    variance = sigma_z**2 / np.float32(phasors.noise_gain)
    undithered = np.exp(-4 * np.pi**2 * np.maximum(variance - np.float32(1 / 12), 0))
    systematic = count * (_LEAST_RATIO * coordinates.amplitude / sigma_z) ** 2
    systematic += (2 * count - 2) * undithered / (12 * variance)
    return Residuals(result, np.where(usable, systematic, 0).astype(np.float32), phasors.frequency)


@_compiled
def _residuals(z, frequency, gain, u, amplitude, sigma, usable, most, out, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = frequency.size
    for j in range(start, stop):
        if not usable[j]:
            for t in range(count):
                out[t, j] = 0
            continue
        total = np.float32(0.0)
        for t in range(count):
            s, c = sin_cos_turns(frequency[t] * u[j])
            re = (z[t, j].real * c + z[t, j].imag * s - gain[t] * amplitude[j]) / sigma[j]
            im = (z[t, j].imag * c - z[t, j].real * s) / sigma[j]
            out[t, j] = complex(re, im)
            total += re * re + im * im
        if total > most:
            shrink = np.sqrt(most / total)
            for t in range(count):
                out[t, j] *= shrink
