"""γ where the projector's coordinate is known by other means, such as a Gray code: two ways that share nothing but it.

Three steps leave no harmonics to look at. But where the phase is known, the grey values themselves trace the response,
and the error of the three-step phase tells the harmonics.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from calibration.photometry.power_law import GammaEstimate, fit_gamma, power_harmonics
from calibration.photometry.ramp import PhotometryError
from calibration.photometry.tiles import scattered
from calibration.photometry.waveform import phase_error_curve

Array = NDArray[np.float64]

_TILES = 16
_LEVELS = 64
_HARMONICS = 48
_GAMMAS = (0.3, 6.0)


def gamma_of_intensity(grey: Array, light: Array) -> GammaEstimate:
    """Exponent from what pixels see of known grey levels: light = a + b·grey^γ.

    Parameters
    ----------
    grey
        (M,) grey level that was sent to each pixel, 0..1, in picture order.
    light
        (M,) what the camera saw, over the pixel's own rise from black to white.

    Returns
    -------
    The exponent. Its σ comes from the scatter over the picture and from how far the response is no power law.
    """
    edges = np.linspace(0, 1, _LEVELS + 1)
    of = np.clip(np.searchsorted(edges, grey, side="right") - 1, 0, _LEVELS - 1)

    def fit(pixels: NDArray[np.intp]) -> Array:
        # Means by level first: where fringes are flat, at black and white, there are more pixels than between.
        count = np.bincount(of[pixels], minlength=_LEVELS)
        sums = [np.bincount(of[pixels], weights=v[pixels], minlength=_LEVELS) for v in (grey, light)]
        seen = count > 0
        return np.array(fit_gamma(sums[0][seen] / count[seen], sums[1][seen] / count[seen]))

    value, covariance = scattered(fit, grey.size, _TILES)
    return GammaEstimate(float(value[0]), float(np.hypot(value[1], np.sqrt(covariance[0, 0]))), "grey values")


def gamma_of_phase_error(phase: Array, error: Array, steps: int = 3) -> GammaEstimate:
    """Exponent whose harmonics make the error of the N-step phase of a full fringe.

    Parameters
    ----------
    phase
        (M,) the fringe's true phase, rad, in picture order, all phases among them.
    error
        (M,) measured minus true phase, rad.
    steps
        N, 3 or 4: more steps err too little.

    Returns
    -------
    The exponent that the light of the fringe ((1 + cos θ)/2)^Γ went through as a whole: a fringe that was sent as its
    1/p-th power and projected with γ has Γ = γ/p.

    Raises
    ------
    PhotometryError
        No exponent from 0.3 to 6 makes such an error.

    Notes
    -----
    The error is nearly −b₂/b₁·sin 3θ for three steps; its sine part at Nθ is compared with that of the full series
    (cf. Hoang et al., Opt. Lett. 35, 1992 (2010), where two pre-applied exponents are extrapolated linearly).
    """

    def expected(gamma: float) -> float:
        theta, curve = phase_error_curve(np.concatenate(([0.0], power_harmonics(gamma, _HARMONICS))), steps)
        return float(2 * np.mean(curve * np.sin(steps * theta)))

    design = np.column_stack([np.ones(phase.size), np.cos(steps * phase), np.sin(steps * phase)])

    def amplitude(pixels: NDArray[np.intp]) -> Array:
        x = design[pixels]
        return np.asarray(np.linalg.solve(x.T @ x, x.T @ error[pixels])[2:])

    value, covariance = scattered(amplitude, phase.size, _TILES)
    low, high = (expected(g) - value[0] for g in _GAMMAS)
    if low * high > 0:
        raise PhotometryError(
            f"a {steps}-step phase error of {value[0]:.3f} rad: no projector's gamma makes that",
            "Check the order of the frames and the sign of the phase.",
        )
    gamma = float(brentq(lambda g: expected(g) - value[0], *_GAMMAS, xtol=1e-6))
    slope = (expected(gamma + 0.01) - expected(gamma - 0.01)) / 0.02
    return GammaEstimate(gamma, float(np.sqrt(covariance[0, 0]) / abs(slope)), f"error of the {steps}-step phase")
