"""The response of projector and camera together, from a ramp of uniform pictures."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression
from scipy.stats import norm

from calibration.observations import Finding
from calibration.photometry.power_law import fit_gamma
from calibration.photometry.ramp import PhotometryError, Ramp
from calibration.photometry.tiles import scattered
from scanner.response import LEVELS, ProjectorResponse

Array = NDArray[np.float64]

_TILES = 24
_FEWEST_LEVELS = 8
_MOST_CLIPPED = 0.05
_FLICKER = 0.01
_BENT = 0.01
_DEAD = 0.002
_DEAD_LEVELS = 12


@dataclass(frozen=True, eq=False)
class RampResult:
    """What a ramp says of a projector.

    Parameters
    ----------
    response
        The measured curve with its γ.
    levels, light, sigma
        (K,) the levels that were projected, the light that was measured (black 0, white 1) and its standard deviation.
    findings
        What is wrong, if anything; empty for a good measurement.
    """

    response: ProjectorResponse
    levels: NDArray[np.int64]
    light: Array
    sigma: Array
    findings: tuple[Finding, ...]

    @property
    def good(self) -> bool:
        """Whether the response may be used."""
        return not any(f.refuses for f in self.findings)


def response_of_ramp(ramp: Ramp) -> RampResult:
    """Response of the projector as the camera sees it.

    The light of a level is the mean rise above black of all pixels over that of white. Its standard deviation comes
    from the scatter over the parts of the picture and, where larger, from that of pictures shown more than once; both
    hold noise and everything else that is not common to all pixels and times.

    Between the levels a monotone cubic (Fritsch & Carlson, SIAM J. Numer. Anal. 17, 238 (1980)) runs through
    light^(1/γ), which is straight for a power law.

    Raises
    ------
    PhotometryError
        Too few levels to tell a curve.
    """
    levels = np.unique(ramp.levels)
    if levels.size < _FEWEST_LEVELS:
        raise PhotometryError(
            f"the ramp has {levels.size} grey levels, a response needs at least {_FEWEST_LEVELS}",
            "Project 17 or 33 levels from 0 to 255.",
        )
    light, covariance = scattered(lambda p: _light(ramp, levels, p), ramp.values.shape[1], _TILES)
    flicker = _flicker(ramp)
    clamped = _clamped(ramp, light)
    own = np.sqrt(np.diag(covariance) + (flicker * light) ** 2 + clamped**2)
    sigma = np.hypot(own, clamped[0] * (1 - light))
    # The ends are 0 and 1 by definition, not without noise; a fit must not be held by them alone. What is wrong with
    # black itself goes into the fit's offset.
    weight = np.maximum(own, float(np.median(own)) + 1e-5)
    grey = levels / (LEVELS - 1)
    gamma, gamma_sigma = fit_gamma(grey, light, weight)
    monotone = np.asarray(isotonic_regression(light, weights=1 / weight**2).x)
    findings = _findings(ramp, levels, light, sigma, monotone, flicker)
    if monotone[-1] <= monotone[0]:
        raise PhotometryError(
            "the light does not rise from black to white", "Check that the projector shows this computer's picture."
        )
    # The ends are black and white, whatever their neighbours' noise would make of them.
    monotone = np.clip((monotone - monotone[0]) / (monotone[-1] - monotone[0]), 0, 1)
    every = np.arange(LEVELS)
    straight = PchipInterpolator(levels, monotone ** (1 / gamma))(every)
    curve = np.maximum.accumulate(np.clip(straight, 0, 1) ** gamma)
    response = ProjectorResponse(
        light=curve,
        sigma=np.interp(every, levels, sigma),
        gamma=gamma,
        gamma_sigma=gamma_sigma,
        source=f"ramp of {levels.size} levels",
        measured=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    return RampResult(response, levels, light, sigma, tuple(findings))


def camera_linearity(
    short: NDArray[np.floating], long: NDArray[np.floating], ratio: float, black: NDArray[np.floating]
) -> tuple[float, Finding | None]:
    """Whether the camera's grey value is proportional to light, from two exposures of one unmoved scene.

    Parameters
    ----------
    short, long
        (H, W) frames, none of their pixels saturated, better the means of several.
    ratio
        Exposure time of ``long`` over that of ``short``, 2 or so.
    black
        (H, W) frame without light, or the grey value of the dark, broadcast.

    Returns
    -------
    deviation, finding
        The largest departure of long/short from ``ratio`` over the range of grey values, relative; and what to do about
        it, or None where it is below 1 %.
    """
    s = (np.asarray(short, np.float64) - black).reshape(-1)
    l_ = (np.asarray(long, np.float64) - black).reshape(-1)
    edges = np.quantile(l_, np.linspace(0.1, 1, 10))
    bins = np.searchsorted(edges, l_)
    # Chosen by the long exposure, whose relative noise is the smaller; sums in place of ratios do not feel the rest.
    gains = np.array([l_[bins == b].sum() / max(s[bins == b].sum(), 1e-9) for b in range(1, 10) if (bins == b).any()])
    deviation = float(np.abs(gains / ratio - 1).max())
    if deviation <= _BENT:
        return deviation, None
    return deviation, _not_linear(f"{ratio:g} × the exposure makes up to {100 * deviation:.1f} % more or less light")


def _light(ramp: Ramp, levels: NDArray[np.int64], pixels: NDArray[np.intp]) -> Array:
    """(K,) mean rise above black over that of white."""
    means = np.array([ramp.values[ramp.levels == level][:, pixels].mean(dtype=np.float64) for level in levels])
    return np.asarray((means - means[0]) / (means[-1] - means[0]))


def _flicker(ramp: Ramp) -> float:
    """Standard deviation of the light from picture to picture, relative, from white shown more than once."""
    whites = ramp.values[ramp.levels == LEVELS - 1].mean(axis=1, dtype=np.float64)
    black = float(ramp.values[ramp.levels == 0].mean(dtype=np.float64))
    return float(whites.std(ddof=1) / (whites.mean() - black)) if whites.size > 1 else 0.0


def _clamped(ramp: Ramp, light: Array) -> Array:
    """(K,) by how much each level is too bright, relative to white, because the camera cuts its noise off at zero."""
    whites, black = ramp.values[ramp.levels == LEVELS - 1], ramp.values[ramp.levels == 0].mean(axis=0)
    if len(whites) < 2:
        return np.zeros(light.size)
    # Of a clipped Gaussian: σ·(φ(t) − t·(1 − Φ(t))), t the distance to zero in σ; white has the most noise.
    noise = max(float(np.sqrt(np.var(np.diff(whites, axis=0)) / 2)), 1e-6)
    rise = float((whites.mean(axis=0) - black).mean())
    t = (float(black.mean()) + rise * light) / noise
    return np.asarray(noise * (norm.pdf(t) - t * norm.sf(t)) / rise)


def _findings(
    ramp: Ramp, levels: NDArray[np.int64], light: Array, sigma: Array, monotone: Array, flicker: float
) -> list[Finding]:
    found = []
    if ramp.clipped_share > _MOST_CLIPPED:
        found.append(
            Finding(
                "ramp_saturated",
                False,
                f"white saturates {100 * ramp.clipped_share:.0f} % of the lit pixels; the response is from the others",
                "Shorten the exposure or close the aperture, so that the whole board counts.",
            )
        )
    falls = (monotone - light) / (sigma + 1e-5)
    worst = int(np.argmax(np.abs(falls)))
    if abs(falls[worst]) > 5 and abs(monotone[worst] - light[worst]) > 0.003:
        found.append(
            Finding(
                "ramp_not_monotone",
                True,
                f"light falls about grey level {levels[worst]} by {2 * abs(monotone[worst] - light[worst]):.3f} of full"
                " scale: a brighter picture gives less light",
                "Switch off dynamic contrast, automatic iris and eco modes; the exposure must be a multiple of the"
                " projector's period.",
            )
        )
    if flicker > _FLICKER:
        found.append(
            Finding(
                "ramp_flicker",
                True,
                f"white varies by {100 * flicker:.1f} % from picture to picture",
                "Make the exposure a whole multiple of the projector's period, let the lamp warm up, and keep other"
                " light away.",
            )
        )
    return found + _ends(levels, light) + _bent(ramp, levels)


def _ends(levels: NDArray[np.int64], light: Array) -> list[Finding]:
    """Grey levels at the ends that make no difference."""
    dark = levels[light < _DEAD].max()
    bright = levels[light > 1 - _DEAD].min()
    if dark >= _DEAD_LEVELS and bright <= LEVELS - 1 - _DEAD_LEVELS:
        return [
            Finding(
                "limited_range",
                False,
                f"grey levels up to {dark} are black and those from {bright} on white: the picture is sent in video"
                " range",
                "Set graphics card and projector to full range (RGB 0-255, PC), then measure again.",
            )
        ]
    if bright <= LEVELS - 1 - _DEAD_LEVELS:
        return [
            Finding(
                "white_clipped",
                False,
                f"grey levels from {bright} on give the same light",
                "Lower the projector's contrast setting, or switch its picture mode, until white steps are told apart.",
            )
        ]
    return []


def _bent(ramp: Ramp, levels: NDArray[np.int64]) -> list[Finding]:
    """A camera that is not linear: bright pixels and dim ones then disagree about the projector's light.

    One that follows a power law escapes: it bends all pixels alike. `camera_linearity` sees that as well.
    """
    rise = ramp.values[ramp.levels == LEVELS - 1].mean(axis=0) - ramp.values[ramp.levels == 0].mean(axis=0)
    low, high = np.quantile(rise, [0.25, 0.75])
    if high < 1.15 * low:
        return []
    dim, bright = (_light(ramp, levels, np.flatnonzero(part)) for part in (rise <= low, rise >= high))
    off = float(np.abs(dim - bright).max())
    if off <= _BENT:
        return []
    return [
        _not_linear(f"dim and bright pixels disagree about the light of a level by {100 * off:.1f} % of full scale")
    ]


def _not_linear(what: str) -> Finding:
    return Finding(
        "camera_not_linear",
        False,
        what + ": the camera's grey value is not proportional to light",
        "Set the camera's gamma to 1, its contrast curve, sharpening and automatic gain off, then measure again.",
    )
