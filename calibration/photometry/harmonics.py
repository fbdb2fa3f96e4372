"""The harmonics of projected fringes, from N-step frames, and the γ they tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from calibration.photometry.mtf import Mtf
from calibration.photometry.power_law import GammaEstimate, gamma_of_ratio
from calibration.photometry.ramp import PhotometryError
from calibration.photometry.tiles import scattered
from calibration.photometry.waveform import fringe_harmonics
from drivers import Pixels
from scanner.patterns import FringeSequence
from scanner.response import ProjectorResponse

Array = NDArray[np.float64]

_TILES = 24
_STRONG = 0.25
_FEWEST = 500
_PIXELS = 200_000
_GAMMAS = (0.25, 6.0)


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Harmonics of the light over the fundamental, pooled over the picture.

    Parameters
    ----------
    frequency
        Of the fringe, 1/px.
    steps
        N.
    ratio
        (K,) b_k/b_1 for k = 1..⌈N/2⌉ − 1, signed, in phase with the fundamental.
    sigma
        (K,) standard deviation, from the scatter over the picture.
    modulation
        Mean amplitude of the fundamental, DN.
    """

    frequency: float
    steps: int
    ratio: Array
    sigma: Array
    modulation: float


def measure_harmonics(frames: Pixels, fringes: FringeSequence, saturated_dn: int) -> Harmonics:
    """Harmonics of a fringe sequence with N ≥ 5 equal steps of one frequency.

    Each harmonic F_k = 2/N Σ I_n e^{−ik φ_n} is turned by the pixel's own fundamental phase, F_k·(F_1*/|F_1|)^k: what
    the response makes is real there and common to all pixels, while noise and the harmonic N − k that N steps fold onto
    k have a phase that differs from pixel to pixel and average out.

    Parameters
    ----------
    frames
        (N, H, W) grey values.
    fringes
        What was projected.
    saturated_dn
        Grey value of a saturated pixel; such pixels are left out, for clipping makes harmonics of its own.

    Raises
    ------
    PhotometryError
        Hardly a pixel shows unsaturated fringes.
    ValueError
        Fewer than five steps, unequal steps, or several frequencies.
    """
    steps = fringes.steps_rad
    n = len(steps)
    if fringes.frequency is None or n < 5 or len(frames) != n:
        raise ValueError(f"{fringes.label} with {n} steps: harmonics need at least 5 steps of one frequency")
    if not np.allclose(np.exp(1j * np.diff(steps)), np.exp(2j * np.pi / n)):
        raise ValueError(f"{fringes.label}: harmonics need N equal steps of 2π/N")
    flat = frames.reshape(n, -1)
    chosen = np.flatnonzero((flat < saturated_dn).all(axis=0))
    values = flat[:, chosen[:: max(1, chosen.size // _PIXELS)]].astype(np.float64)
    orders = np.arange(1, (n + 1) // 2)
    spectrum = 2 / n * np.exp(-1j * orders[:, None] * steps) @ values
    strength = np.abs(spectrum[0])
    lit = strength > _STRONG * np.quantile(strength, 0.99) if strength.size else strength > 0
    if np.count_nonzero(lit) < _FEWEST:
        raise PhotometryError(
            f"{np.count_nonzero(lit)} pixels show unsaturated fringes ({fringes.label})",
            "Put a plain white board into the picture and shorten the exposure.",
        )
    spectrum, strength = spectrum[:, lit], strength[lit]
    turned = (spectrum * (spectrum[0].conj() / strength) ** orders[:, None]).real

    def pooled(pixels: NDArray[np.intp]) -> Array:
        # Least squares of turned = ratio·|F_1|.
        weight = strength[pixels]
        return np.asarray(turned[:, pixels] @ weight / (weight @ weight))

    ratio, covariance = scattered(pooled, strength.size, _TILES)
    return Harmonics(fringes.frequency, n, ratio, np.sqrt(np.diag(covariance)), float(strength.mean()))


def gamma_of_harmonics(
    harmonics: Harmonics, *, mean: float = 0.5, amplitude: float = 0.5, mtf: Mtf | None = None
) -> GammaEstimate:
    """Exponent of the power law that makes the second harmonic.

    Parameters
    ----------
    harmonics
        Of a fringe that was projected without correction.
    mean, amplitude
        A and B of the fringe as fractions of full scale.
    mtf
        Of projector and camera together: the optics weaken the second harmonic more than the fundamental. None where
        the fringe is so coarse that both pass.

    Notes
    -----
    A full fringe has b_2/b_1 = (γ − 1)/(γ + 2) (`calibration.photometry.power_law.power_harmonics`); of weaker ones the
    ratio is inverted numerically. σ holds the scatter over the picture and that of the MTF.

    Raises
    ------
    PhotometryError
        No γ from 0.25 to 6 makes such harmonics.
    """
    measured, sigma = float(harmonics.ratio[1]), float(harmonics.sigma[1])
    if mtf is not None:
        f = harmonics.frequency
        fall, fall_sigma = mtf.fall(f, 2 * f)
        measured, sigma = measured / fall, float(np.hypot(sigma, measured / fall * fall_sigma)) / fall

    def ratio(gamma: float) -> float:
        light = ProjectorResponse.power(gamma).light
        b = fringe_harmonics(light, mean=mean, amplitude=amplitude, count=2)
        return float(b[2] / b[1])

    low, high = ratio(_GAMMAS[0]), ratio(_GAMMAS[1])
    if not low < measured < high:
        raise PhotometryError(
            f"the second harmonic is {measured:.3f} of the fundamental: no projector's gamma makes that",
            "Check that nothing saturates, that the frames are in order, and that the scene does not move.",
        )
    if mean == amplitude == 0.5:
        gamma = gamma_of_ratio(measured)
        slope = 3 / (gamma + 2) ** 2
    else:
        gamma = float(brentq(lambda g: ratio(g) - measured, *_GAMMAS, xtol=1e-6))
        slope = (ratio(gamma * 1.01) - ratio(gamma / 1.01)) / (gamma * (1.01 - 1 / 1.01))
    return GammaEstimate(gamma, sigma / slope, f"second harmonic of {harmonics.steps} steps")
