"""Phasors → absolute projector coordinates with their standard deviation, by maximum likelihood (method.md §3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner import kernels
from scanner.patterns import Axis
from scanner.phasors import AxisPhasors


@dataclass(frozen=True)
class Coordinates:
    """One-path coordinates of one axis, all arrays (H, W) float32.

    Parameters
    ----------
    u
        Projector coordinate, px, within -1/2 .. extent - 1/2.
    sigma
        Predicted standard deviation, px.
    amplitude
        Fringe modulation B, DN.
    chi2
        Misfit of the one-path model, ``dof`` degrees of freedom.
    lead
        Log-likelihood ratio of the best fringe order against the second best.
    """

    axis: Axis
    u: NDArray[np.float32]
    sigma: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    chi2: NDArray[np.float32]
    dof: int
    lead: NDArray[np.float32]


def modulation_trend(phasors: AxisPhasors, sigma_z: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T,) modulation of each frequency relative to the mean: the MTF of projector and camera, as the frames show it.

    The median over the pixels with clear fringes: bounces raise and lower single pixels, the optics all of them.
    """
    stride = max(1, int(np.sqrt(sigma_z.size / 100_000)))
    modulus = np.abs(phasors.z[:, ::stride, ::stride]).reshape(len(phasors.frequency), -1)
    clear = modulus.min(axis=0) > 8 * sigma_z[::stride, ::stride].reshape(-1)
    if clear.sum() < 100:
        return np.ones(len(phasors.frequency))
    modulus = modulus[:, clear]
    trend = np.ones(len(phasors.frequency))
    steady = np.ones(modulus.shape[1], bool)
    # A bounce moves the modulation up and down with frequency: the second pass asks the steadier half of the pixels.
    for _ in range(2):
        shape = modulus[:, steady] / modulus[:, steady].mean(axis=0)
        trend = np.median(shape, axis=1).astype(np.float64)
        flat = modulus / trend[:, None]
        spread = flat.std(axis=0) / flat.mean(axis=0)
        steady = spread <= np.quantile(spread, 0.5)
    return np.asarray(trend / trend.mean())


def modulation(phasors: AxisPhasors, sigma_z: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) fringe modulation B, DN: root mean square of |z_t|, each frequency weighted by the information it carries.

    The information on the coordinate grows with f². A bounce raises |z_t| at some frequencies and lowers it at others;
    unlike the amplitude of a one-path fit, this mean does not vanish with it.
    """
    weights = np.square(phasors.frequency) / np.square(phasors.frequency).sum()
    power = np.zeros(sigma_z.shape, np.float32)
    for z, weight in zip(phasors.z, weights, strict=True):
        power += np.float32(weight) * (z.real**2 + z.imag**2)
    power -= 2 * sigma_z**2
    return np.sqrt(np.maximum(power, 0))


def unwrap(
    phasors: AxisPhasors, sigma_z: NDArray[np.float32], extent: int, gain: NDArray[np.float64] | None = None
) -> Coordinates:
    """Maximum-likelihood coordinate of every pixel.

    Parameters
    ----------
    phasors
        Of one axis, any frequencies that are unambiguous together over ``extent``.
    sigma_z
        (H, W) noise of the phasors, DN.
    extent
        Projector pixels along the axis; the picture reaches from -1/2 to extent - 1/2, so that column 0 under noise
        stays column 0.
    gain
        (T,) `modulation_trend`; None takes all frequencies alike.
    """
    count = len(phasors.frequency)
    results = kernels.unwrap(
        phasors.z.reshape(count, -1),
        phasors.frequency,
        np.ones(count) if gain is None else gain,
        np.ascontiguousarray(sigma_z, np.float32).reshape(-1),
        -0.5,
        extent - 0.5,
    )
    u, sigma, amplitude, chi2, lead = (r.reshape(sigma_z.shape) for r in results)
    return Coordinates(phasors.axis, u, sigma, amplitude, chi2, 2 * count - 2, lead)
