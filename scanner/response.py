"""How much light a projector makes of a grey level, and the grey level that makes a wanted light.

Fringes are planned in light (`scanner.patterns`). A projector whose light follows grey^γ turns them into fringes with
harmonics; with its measured response, each picture asks for the grey level whose light is nearest the wanted one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import OperatorError

PROJECTOR_RESPONSE = "projector_response"
"""Name of the response among the notes of a rig."""

LEVELS = 256
"""Grey levels of a picture."""

Array = NDArray[np.float64]


class ResponseError(OperatorError):
    """A projector response that cannot be used."""


def checked_light(light: ArrayLike) -> Array:
    """Light of every grey level, (256,) float64, after it was found to be one.

    Raises
    ------
    ValueError
        Not 256 finite values from 0 to 1 that nowhere fall and rise at all.
    """
    values = np.asarray(light, np.float64)
    if values.shape != (LEVELS,) or not np.isfinite(values).all():
        raise ValueError(f"a response of shape {values.shape}: it must be {LEVELS} finite values, one per grey level")
    if values[0] < -1e-9 or values[-1] > 1 + 1e-9 or (np.diff(values) < 0).any() or values[-1] <= values[0]:
        raise ValueError(
            f"a response from {values[0]:g} to {values[-1]:g}: light must rise with the grey level, within 0 and 1"
        )
    return values


def nearest_levels(light: ArrayLike, wanted: ArrayLike) -> NDArray[np.uint8]:
    """Grey levels whose light is nearest the wanted one; of levels with equal light, the lowest.

    Parameters
    ----------
    light
        (256,) light of every grey level, nowhere falling.
    wanted
        (...) light, in the same unit.

    Returns
    -------
    (...) uint8
    """
    curve = np.asarray(light, np.float64)
    return np.searchsorted((curve[1:] + curve[:-1]) / 2, np.asarray(wanted, np.float64)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class ProjectorResponse:
    """The measured response of a projector, as the camera sees it.

    Parameters
    ----------
    light
        (256,) light of every grey level over that of full scale, the light of black removed: 0 at level 0, 1 at 255.
    sigma
        (256,) standard deviation of ``light``.
    gamma, gamma_sigma
        Exponent of the power law that comes nearest, and its standard deviation. Says how far from linear the projector
        is; what corrects a picture is ``light``.
    source
        What it was measured from, in words.
    measured
        When, ISO 8601.

    Raises
    ------
    ValueError
        ``light`` is no response, see `checked_light`, or ``sigma`` is not as long.
    """

    light: Array
    sigma: Array
    gamma: float
    gamma_sigma: float
    source: str = ""
    measured: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "light", checked_light(self.light))
        object.__setattr__(self, "sigma", np.asarray(self.sigma, np.float64))
        if self.sigma.shape != (LEVELS,) or not (self.sigma >= 0).all():
            raise ValueError(f"the σ of a response must be {LEVELS} values of 0 or more")

    @classmethod
    def power(cls, gamma: float) -> Self:
        """The exact response light = (grey/255)^gamma."""
        light = (np.arange(LEVELS) / (LEVELS - 1)) ** gamma
        return cls(light, np.zeros(LEVELS), gamma, 0.0, source="power law")

    @property
    def values(self) -> tuple[float, ...]:
        """``light`` as a `scanner.patterns.Plan` carries it."""
        return tuple(float(v) for v in np.round(self.light, 7))

    @property
    def lut(self) -> NDArray[np.uint8]:
        """(256,) grey level to send for each wanted light 0/255 … 255/255."""
        return nearest_levels(self.light, np.arange(LEVELS) / (LEVELS - 1))

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; the inverse of `from_json`."""
        return {
            "light": list(self.values),
            "sigma": [float(v) for v in np.round(self.sigma, 7)],
            "gamma": self.gamma,
            "gamma_sigma": self.gamma_sigma,
            "source": self.source,
            "measured": self.measured,
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Response of a document that `to_json` wrote.

        Raises
        ------
        ResponseError
            The document is none of those.
        """
        try:
            return cls(**document)
        except (TypeError, ValueError) as error:
            raise ResponseError(
                f"the projector response of the rig cannot be used: {error}",
                "Measure it again with `calibrate`, or set scan.correct_response: false to take the projector as"
                " linear.",
            ) from None


def response_of(metadata: Mapping[str, Any]) -> ProjectorResponse | None:
    """The projector response among the notes of a rig; None where none was measured.

    Raises
    ------
    ResponseError
        There is one, and it cannot be used.
    """
    document = metadata.get(PROJECTOR_RESPONSE)
    return None if document is None else ProjectorResponse.from_json(document)


def corrected_for(light: Sequence[float] | None, metadata: Mapping[str, Any]) -> str:
    """What patterns were made for, in words.

    Parameters
    ----------
    light
        The response that the plan was corrected for, or None.
    metadata
        Notes of the rig, where the measurement stands.
    """
    if light is None:
        return "response taken as linear"
    document = metadata.get(PROJECTOR_RESPONSE)
    if document is None:
        return "corrected for a measured response"
    known = ProjectorResponse.from_json(document)
    return f"corrected for the measured response, γ = {known.gamma:.3f} ± {known.gamma_sigma:.3f}"


def quantisation_sigma(light: Sequence[float] | Array, mean: float = 0.5, amplitude: float = 0.5) -> float:
    """RMS error of a fringe's light for want of levels in between, as a fraction of full scale.

    Parameters
    ----------
    light
        (256,) light of every grey level.
    mean, amplitude
        A and B of the fringe as fractions of full scale.

    Notes
    -----
    Rounding to the nearest of levels that lie s apart errs by s/√12. A linear projector has s = 1/255 everywhere and
    errs by 0.0011. With light = grey^γ, s = γ·light^(1−1/γ)/255: for γ > 1 the bright levels are the coarse ones, for
    γ < 1 the dark ones. γ = 2.2 gives 0.0017 over a full fringe: in place of harmonics of 29 % (`calibration`), a noise
    fixed to the projector's pixels of √(2/N)·σ/B = 0.0014 rad with twelve steps, 0.004 px at a period of 16 px.
    """
    turns = 2 * np.pi * (np.arange(4096) + 0.5) / 4096
    wanted = mean + amplitude * np.cos(turns)
    curve = np.asarray(light, np.float64)
    return float(np.sqrt(np.mean((curve[nearest_levels(curve, wanted)] - wanted) ** 2)))
