"""What a projector's response does to a fringe: its harmonics, and the phase error that N steps make of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.photometry.mtf import Mtf
from scanner.response import LEVELS, quantisation_sigma

Array = NDArray[np.float64]

_SAMPLES = 4096
_HARMONICS = 64


@dataclass(frozen=True)
class PhaseError:
    """What harmonics and rounded levels do to the phase of an N-step fringe.

    Parameters
    ----------
    rms_rad, peak_rad
        Of the periodic error, that is of the harmonics that N steps cannot tell from the fundamental.
    rms_px, peak_px
        The same as projector px.
    rounding_rad, rounding_px
        Standard deviation of the noise that rounding to 256 levels makes, before the optics average it.
    second_harmonic
        Amplitude of the second harmonic over that of the fundamental.
    """

    rms_rad: float
    peak_rad: float
    rms_px: float
    peak_px: float
    rounding_rad: float
    rounding_px: float
    second_harmonic: float


def fringe_harmonics(
    light: Array, *, correction: Array | None = None, mean: float = 0.5, amplitude: float = 0.5, count: int = _HARMONICS
) -> Array:
    """Amplitudes of the harmonics of a projected fringe A + B cos θ.

    Parameters
    ----------
    light
        (256,) the light that the projector really makes of every grey level.
    correction
        (256,) the response that the pictures are corrected for; None for pictures without correction.
    mean, amplitude
        A and B as fractions of full scale.
    count
        The highest harmonic.

    Returns
    -------
    (count + 1,) light of the mean and of cos θ … cos(count·θ), signed; the rounding of levels left out.
    """
    theta = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    wanted = mean + amplitude * np.cos(theta)
    scale = np.arange(LEVELS) / (LEVELS - 1)
    grey = wanted if correction is None else np.interp(wanted, correction, scale)
    # Straight lines between levels, an error of (1/255)²/8 of the curvature.
    spectrum = np.fft.rfft(np.interp(grey, scale, light)).real / _SAMPLES
    return np.concatenate((spectrum[:1], 2 * spectrum[1 : count + 1]))


def phase_error_curve(harmonics: Array, steps: int, samples: int = 720) -> tuple[Array, Array]:
    """Error of the N-step phase along one period.

    Parameters
    ----------
    harmonics
        (K + 1,) amplitudes of mean, fundamental and harmonics, signed.
    steps
        N equal phase steps.
    samples
        How finely the period is looked at.

    Returns
    -------
    theta, error
        (samples,) rad each.

    Notes
    -----
    The N-step transform passes harmonic k where k ≡ ±1 (mod N) (Hoang et al., Opt. Lett. 35, 1992 (2010)); three steps
    let the second and fourth through, twelve only the eleventh and thirteenth.
    """
    theta = 2 * np.pi * np.arange(samples) / samples
    k = np.arange(harmonics.size)
    forward, backward = k[k % steps == 1], k[(k % steps == steps - 1) & (k > 0)]
    z = harmonics[forward] @ np.exp(1j * forward[:, None] * theta)
    z = z + harmonics[backward] @ np.exp(-1j * backward[:, None] * theta)
    return theta, np.angle(z * np.exp(-1j * theta))


def predict_phase_error(
    light: Array,
    frequency: float,
    steps: int,
    *,
    correction: Array | None = None,
    mean: float = 0.5,
    amplitude: float = 0.5,
    mtf: Mtf | None = None,
) -> PhaseError:
    """Phase error of an N-step fringe, as it is projected with or without correction.

    Parameters
    ----------
    light
        (256,) the light that the projector really makes of every grey level.
    frequency
        Of the fringe, 1/px.
    steps
        N.
    correction, mean, amplitude
        As `fringe_harmonics`.
    mtf
        Of projector and camera together, which weakens harmonics more than the fundamental; None for perfect optics.
    """
    harmonics = fringe_harmonics(light, correction=correction, mean=mean, amplitude=amplitude)
    if mtf is not None:
        harmonics = harmonics * mtf.at(frequency * np.arange(harmonics.size))
    _, error = phase_error_curve(harmonics, steps)
    curve = np.arange(LEVELS) / (LEVELS - 1) if correction is None else correction
    rounding = float(np.sqrt(2 / steps)) * quantisation_sigma(curve, mean, amplitude) / amplitude
    px = 1 / (2 * np.pi * frequency)
    rms, peak = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    return PhaseError(
        rms_rad=rms,
        peak_rad=peak,
        rms_px=rms * px,
        peak_px=peak * px,
        rounding_rad=rounding,
        rounding_px=rounding * px,
        second_harmonic=float(harmonics[2] / harmonics[1]),
    )
