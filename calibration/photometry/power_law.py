"""The power law light = grey^γ: its fit to measured light, and its harmonics in a fringe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]

_NEAR, _FAR = 0.1, 10.0


@dataclass(frozen=True)
class GammaEstimate:
    """An exponent γ, and how surely it is known.

    Parameters
    ----------
    gamma
        The exponent.
    sigma
        Its standard deviation.
    method
        How it was found, in words.
    """

    gamma: float
    sigma: float
    method: str


def fit_gamma(grey: Array, light: Array, sigma: Array | None = None) -> tuple[float, float]:
    """Fit light = a + b·grey^γ with a, b and γ free.

    The offset takes up black light, room light and what the camera's lens spreads; a phase does not feel it either.

    Parameters
    ----------
    grey
        (K,) levels as fractions of full scale, 0..1.
    light
        (K,) what was measured, any unit.
    sigma
        (K,) standard deviation of ``light``; None where it is the same for all and not known.

    Returns
    -------
    gamma, sigma
        The exponent and its standard deviation, from ``sigma`` or, where larger, from the residuals: a response that
        is no power law has an uncertain exponent.

    Raises
    ------
    ValueError
        Fewer than five points, or light that does not rise.
    """
    if grey.size < 5:
        raise ValueError(f"{grey.size} levels: offset, gain and exponent need at least 5")
    weight = np.ones(light.shape) if sigma is None else 1 / sigma
    rise = float(light[np.argmax(grey)] - light[np.argmin(grey)])
    if rise <= 0:
        raise ValueError("the light does not rise with the grey level")

    def residual(p: Array) -> Array:
        return np.asarray((p[0] + p[1] * grey ** p[2] - light) * weight)

    start = np.array([float(light.min()), rise, 1.5])
    found = least_squares(
        residual,
        start,
        bounds=([-np.inf, 0, _NEAR], [np.inf, np.inf, _FAR]),
        x_scale=[rise, rise, 1.0],
        xtol=1e-12,
        ftol=1e-12,
    )
    dof = max(light.size - 3, 1)
    jacobian = np.asarray(found.jac, np.float64)
    scatter = 2 * found.cost / dof
    covariance = np.linalg.inv(jacobian.T @ jacobian) * (scatter if sigma is None else max(scatter, 1.0))
    return float(found.x[2]), float(np.sqrt(covariance[2, 2]))


def power_harmonics(gamma: float, count: int) -> Array:
    """Amplitudes of a full fringe through a power law, over that of the fundamental.

    Parameters
    ----------
    gamma
        Exponent of ((1 + cos θ)/2)^γ.
    count
        How many harmonics.

    Returns
    -------
    (count,) b_k/b_1, k = 1..count.

    Notes
    -----
    b_k = 2/π ∫₀^π cos^{2γ}(θ/2) cos kθ dθ ∝ 1/(Γ(γ+1+k)·Γ(γ+1−k)) (Gradshteyn & Ryzhik 3.631.9), so that
    b_k/b_{k−1} = (γ − k + 1)/(γ + k), and b_2/b_1 = (γ − 1)/(γ + 2).
    """
    k = np.arange(2, count + 1)
    return np.concatenate(([1.0], np.cumprod((gamma - k + 1) / (gamma + k))))


def gamma_of_ratio(ratio: float) -> float:
    """Exponent for which a full fringe has b_2/b_1 = ``ratio``: γ = (1 + 2r)/(1 − r), the inverse of the above."""
    return (1 + 2 * ratio) / (1 - ratio)
