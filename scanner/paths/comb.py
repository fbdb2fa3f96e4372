"""The equidistant frequencies of a plan, as the kernels of the separation want them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import OperatorError
from scanner.paths.kernels import Phasors, Reals
from scanner.paths.pencil import unitary_esprit


class SeparationPlanError(OperatorError):
    """The frequencies of a plan do not let two paths be separated."""


@dataclass(frozen=True)
class Comb:
    """The equidistant frequencies in the kernels' terms.

    ``gain`` (T,) m_t; ``weight`` (T,) m_t²; ``xi`` (T,) ξ_t about the weighted mean frequency; ``carrier`` 2πf_c,
    rad/px; ``step_rad`` Δf/f_c, so that v·step_rad is the angle of a pole; ``turn`` the v after which all fringes
    coincide again, 0 where that is not 1/Δf; ``low`` and ``high`` the range of v; ``pencil`` the matrices of
    `unitary_esprit`.
    """

    gain: Reals
    weight: Reals
    xi: Reals
    carrier: float
    step_rad: float
    turn: float
    low: float
    high: float
    pencil: tuple[Phasors, Reals, Reals]

    @property
    def start_and_step(self) -> tuple[float, float]:
        """2πf₀ and 2πΔf, rad/px."""
        return self.carrier * (1 + float(self.xi[0])), self.carrier * self.step_rad


def prepare(
    z: ArrayLike, frequency: ArrayLike, sigma_z: ArrayLike, extent: float, gain: ArrayLike | None
) -> tuple[NDArray[np.complex64], Reals, Comb]:
    """Check the arguments of `separate_two_paths` and bring the frequencies into ascending order."""
    phasors = np.ascontiguousarray(z, np.complex64)
    f = np.asarray(frequency, np.float64)
    sigma = np.ascontiguousarray(sigma_z, np.float64)
    trend = np.ones(f.shape) if gain is None else np.asarray(gain, np.float64)
    if phasors.ndim != 2 or f.shape != phasors.shape[:1] or trend.shape != f.shape or sigma.shape != phasors.shape[1:]:
        raise ValueError(f"z {phasors.shape}, frequency {f.shape}, gain {trend.shape}, sigma_z {sigma.shape}")
    if not np.all(trend > 0):
        raise ValueError(f"gain {trend}: must be positive")
    if f.size < 5:
        raise SeparationPlanError(
            f"Two-path separation: the plan has {f.size} frequencies on the axis, 5 are the least",
            "Use a plan of more frequencies, such as the nine of the method mfs.",
        )
    order = np.argsort(f)
    f, trend, phasors = f[order], trend[order], np.ascontiguousarray(phasors[order])
    spacing = (f[-1] - f[0]) / (f.size - 1)
    even = f[0] + spacing * np.arange(f.size)
    if spacing <= 0 or 2 * np.pi * extent * np.abs(f - even).max() > 0.01:
        periods = ", ".join(f"{1 / v:.6g}" for v in f)
        raise SeparationPlanError(
            f"Two-path separation: the frequencies of the periods {periods} px are not equidistant",
            "Choose frequencies f0 + t·Δf with t = 0, 1, 2, …, such as (80 + t)/1280 per px.",
        )
    if spacing * extent > 1 + 1e-9:
        raise SeparationPlanError(
            f"Two-path separation: a frequency spacing of 1/{1 / spacing:.6g} per px repeats within {extent:g} px",
            f"Choose a frequency spacing of 1/{extent:g} per px or less.",
        )
    centre = float(trend**2 @ even / (trend @ trend))
    carrier = 2 * math.pi * centre
    coincide = abs(even[0] / spacing - round(even[0] / spacing)) < 1e-6
    return (
        phasors,
        sigma,
        Comb(
            gain=trend,
            weight=trend**2,
            xi=even / centre - 1,
            carrier=carrier,
            step_rad=spacing / centre,
            turn=carrier / spacing if coincide else 0.0,
            low=-0.5 * carrier,
            high=(extent - 0.5) * carrier,
            pencil=unitary_esprit(f.size // 2 + 1),
        ),
    )
