"""How the contrast of fringes falls with their frequency: the MTF of projector and camera together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.photometry.ramp import PhotometryError
from calibration.photometry.tiles import scattered
from drivers import NoiseModel
from scanner.patterns import Axis, Plan, phase_steps
from scanner.phasors import RoundPhasors

Array = NDArray[np.float64]

MTF_PERIODS_PX = (64.0, 32.0, 16.0, 12.0, 8.0, 6.0, 4.0)
"""Periods, px, of the fringes that the MTF is measured with: f from 1/64 to 1/4 1/px."""

_TILES = 24
_CLEAR = 10.0
_STRONG = 0.25
_FEWEST = 500
_PIXELS = 100_000
_ITERATIONS = 6


@dataclass(frozen=True, eq=False)
class Mtf:
    """Contrast of a fringe over that of an infinitely coarse one, of projector and camera together.

    M(f) = sinc(f)·exp(−2π²s²f² − q f⁴): sinc for the projector's square pixels, s² (px²) the variance of everything
    else that blurs, in projector px, and q its departure from a Gaussian, as of the camera's own square pixels.

    Parameters
    ----------
    spot
        (2,) s² and q. s² may come out slightly negative where the optics are perfect.
    covariance
        (2, 2) theirs.
    frequency, contrast, sigma
        (T,) the frequencies measured (1/px), the contrast measured there and its standard deviation.
    """

    spot: Array
    covariance: Array
    frequency: Array
    contrast: Array
    sigma: Array

    @property
    def spot_px(self) -> float:
        """Standard deviation of the spot beyond a pixel's own, projector px."""
        return float(np.sqrt(max(self.spot[0], 0.0)))

    @property
    def spot_sigma_px(self) -> float:
        """Standard deviation of `spot_px`."""
        sigma2 = math.sqrt(float(self.covariance[0, 0]))
        return sigma2 / (2 * max(self.spot_px, math.sqrt(sigma2)))

    def at(self, frequency: ArrayLike) -> Array:
        """Contrast of the model at frequencies in 1/px, of any shape.

        Detection divides modulations by it, and harmonics are weakened by it. Beyond the highest frequency measured,
        where the model is not held by anything, ln M goes on with the slope it has there.
        """
        f = np.abs(np.asarray(frequency, np.float64))
        last = np.float64(self.frequency.max())
        inside = np.minimum(f, last)
        slope = float(-4 * last * (np.pi**2 * self.spot[0] + last**2 * self.spot[1]))
        beyond = np.exp(min(slope, 0.0) * (f - inside))
        return np.asarray(np.abs(np.sinc(f)) * np.exp(_falls(inside) @ self.spot) * beyond)

    def sigma_at(self, frequency: ArrayLike) -> Array:
        """Standard deviation of `at`."""
        falls = _falls(np.asarray(frequency, np.float64))
        return np.asarray(self.at(frequency) * np.sqrt(np.einsum("...i,ij,...j", falls, self.covariance, falls)))

    def fall(self, coarse: float, fine: float) -> tuple[float, float]:
        """Contrast at ``fine`` over that at ``coarse`` (1/px), and its standard deviation with that of the model."""
        ratio = float(self.at(fine) / self.at(coarse))
        difference = _falls(np.float64(fine)) - _falls(np.float64(coarse))
        return ratio, float(np.hypot(ratio * np.sqrt(difference @ self.covariance @ difference), self.misfit))

    @property
    def misfit(self) -> float:
        """Largest difference of measurement and model."""
        return float(np.abs(self.contrast - self.at(self.frequency)).max())

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; the inverse of `from_json`."""
        return {name: np.asarray(getattr(self, name)).tolist() for name in _FIELDS}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """MTF of a document that `to_json` wrote."""
        return cls(**{name: np.asarray(document[name], np.float64) for name in _FIELDS})


_FIELDS = ("spot", "covariance", "frequency", "contrast", "sigma")


def _falls(f: Array | np.float64) -> Array:
    """(..., 2) derivatives of ln M by s² and q."""
    return np.stack([-2 * np.pi**2 * np.square(f), -(np.square(f) ** 2)], axis=-1)


def mtf_plan(
    size: tuple[int, int],
    axis: Axis = "x",
    periods_px: Sequence[float] = MTF_PERIODS_PX,
    steps: int = 6,
    response: tuple[float, ...] | None = None,
) -> Plan:
    """Fringes of many frequencies to measure the MTF with; ``response`` as `scanner.patterns.Plan` has it."""
    sequences = tuple(phase_steps(axis, 1 / p, steps) for p in periods_px)
    return Plan(size, sequences) if response is None else Plan(size, sequences, response=response)


def measure_mtf(phasors: RoundPhasors, noise: NoiseModel, axis: Axis = "x") -> Mtf:
    """MTF from the modulations of one axis of a round, pooled over the picture.

    B_t = b_p·M(f_t) is fitted with a brightness b_p for every pixel and one M for all, by least squares (Gauss-Newton,
    the b_p eliminated; Golub & Pereyra, SIAM J. Numer. Anal. 10, 413 (1973)). Pixels that see a bounce beside their
    direct light would vary by themselves: measure on a plain board.

    Parameters
    ----------
    phasors
        Of all sequences of a plan such as `mtf_plan`'s.
    noise
        Of a frame.
    axis
        Which.

    Raises
    ------
    PhotometryError
        Hardly a pixel has clear fringes at all frequencies, or there are fewer than four of those.
    """
    stack = phasors.axis(axis)
    if stack is None or stack.frequency.size < 4:
        raise PhotometryError(
            f"fewer than four frequencies along {axis}: an MTF cannot be told", "Project fringes of several periods."
        )
    modulation = np.abs(stack.z).reshape(stack.frequency.size, -1)
    sigma_z = stack.sigma_z(noise, phasors.mean).reshape(-1)
    strong = modulation[np.argmin(stack.frequency)]
    # |z| of pure noise is no modulation: its mean exceeds B by σ²/2B, below 0.5 % from 10 σ on.
    clear = (modulation > _CLEAR * sigma_z).all(axis=0) & ~phasors.saturated.reshape(-1)
    clear &= strong > _STRONG * np.quantile(strong, 0.99)
    chosen = np.flatnonzero(clear)
    if chosen.size < _FEWEST:
        raise PhotometryError(
            f"{chosen.size} pixels show every fringe of the MTF plan clearly",
            "Focus projector and camera on a plain white board that fills the picture, and lengthen the exposure.",
        )
    chosen = chosen[:: max(1, chosen.size // _PIXELS)]
    b = modulation[:, chosen].astype(np.float64)
    return mtf_of_modulation(stack.frequency, np.sqrt(np.maximum(b**2 - sigma_z[chosen] ** 2, 0)), _TILES)


def mtf_of_modulation(frequency: Array, modulation: Array, tiles: int = _TILES) -> Mtf:
    """MTF from modulations of pixels that see one path each.

    Parameters
    ----------
    frequency
        (T,) 1/px, at least four.
    modulation
        (T, P) above 0, any unit, the noise's own share removed, pixels in picture order.
    tiles
        Parts of the picture, whose scatter makes the standard deviations.
    """
    pixel_box = np.sinc(frequency)
    falls = _falls(frequency)
    design = np.column_stack([np.ones(frequency.size), falls])

    def fit(pixels: NDArray[np.intp]) -> Array:
        b = modulation[:, pixels]
        spot = np.linalg.lstsq(design, np.log(b.mean(axis=1) / pixel_box), rcond=None)[0][1:]
        for _ in range(_ITERATIONS):
            m = pixel_box * np.exp(falls @ spot)
            brightness = m @ b / (m @ m)
            pooled = b @ brightness / (brightness @ brightness)
            # The pixels' own brightness is projected out, and with it the bias that its noise would make.
            jacobian = m[:, None] * falls
            jacobian -= np.outer(m, m @ jacobian) / (m @ m)
            spot = spot + np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ (pooled - m))
        return np.concatenate((spot, pooled))

    value, covariance = scattered(fit, modulation.shape[1], tiles)
    return Mtf(value[:2], covariance[:2, :2], frequency.astype(np.float64), value[2:], np.sqrt(np.diag(covariance)[2:]))
