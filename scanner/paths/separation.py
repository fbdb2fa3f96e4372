"""Two-path separation: which two light paths does a pixel see, from the first round alone (method.md §6).

Where a bounce mixes with the direct light, a pixel's phasors at T equidistant frequencies are

    z_t = m_t (a₁ e^{i2πf_t u₁} + a₂ e^{i2πf_t u₂}) + noise,   a₁, a₂ > 0,

with the common modulation trend m_t. The likelihood has one sharp peak for every pair of fringe orders, and the search
runs as carrier-phase ambiguities are resolved in satellite navigation:

1. *Float solution*: amplitudes free to be complex. A forward-backward matrix pencil in real arithmetic (unitary ESPRIT,
   Haardt & Nossek, IEEE Trans. Signal Process. 43, 1995) gives the poles, thus u₁ and u₂ modulo 1/Δf; Gauss-Newton
   brings them to the maximum of the likelihood.
2. *Fringe orders*: with real amplitudes the phase of each residue at the centre frequency f_c gives u_k modulo 1/f_c.
   All pairs of orders that the Fisher information of the float solution leaves open are tried.
3. *Fixed solution*: Levenberg-Marquardt from the best of them; the lowest cost wins.

A pixel that no pair fits gets a second start: the one-path maximum and the strongest path in what that leaves over.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanner.paths.comb import prepare
from scanner.paths.kernels import CANDIDATES, Floats, separate_block, workspace

_BLOCK = 2048
"""Pixels that a thread works on at a time."""

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


@dataclass(frozen=True)
class TwoPaths:
    """Two light paths per pixel on one axis; path 0 has the larger amplitude. NaN where no pair of paths was found.

    Parameters
    ----------
    u
        (2, P) projector coordinates, px.
    amplitude
        (2, P) modulation of each path, DN.
    sigma_u
        (2, P) predicted standard deviation of ``u``, px: inverse Fisher matrix, given the fringe orders.
    sigma_amplitude
        (P,) predicted standard deviation of either amplitude, DN.
    chi2
        (P,) χ² of the two-path fit; far above ``dof`` there is a third path.
    margin
        (P,) growth of χ² to the next best pair of fringe orders; infinite where no other came into question. Below
        about 10 the orders are in doubt, and with them ``u`` by whole fringes.
    converged
        (P,) bool, the fit ended in a maximum of the likelihood within the projector's extent.
    dof
        Degrees of freedom of ``chi2``, 2T - 4.
    """

    u: Floats
    amplitude: Floats
    sigma_u: Floats
    sigma_amplitude: Floats
    chi2: Floats
    margin: Floats
    converged: NDArray[np.bool_]
    dof: int


def separate_two_paths(
    z: ArrayLike, frequency: ArrayLike, sigma_z: ArrayLike, extent: float, gain: ArrayLike | None = None
) -> TwoPaths:
    """Separate the two light paths of every pixel on one axis.

    Parameters
    ----------
    z
        (T, P) complex phasors of the pixels in question, DN.
    frequency
        (T,) f_t, 1/px; T ≥ 5, equidistant in any order.
    sigma_z
        (P,) standard deviation of the real and of the imaginary part of a phasor, DN.
    extent
        Projector pixels along the axis; coordinates lie in [-1/2, extent - 1/2).
    gain
        (T,) common modulation trend m_t > 0; None for 1.

    Raises
    ------
    SeparationPlanError
        Fewer than five frequencies, not equidistant, or Δf so wide that 1/Δf is below ``extent``.
    ValueError
        Shapes that do not belong together, or a gain that is not positive.

    Notes
    -----
    method.md §6. Every pixel is fitted; whether it needs two paths is for the one-path χ² to say.
    """
    found = separate_candidates(z, frequency, sigma_z, extent, gain)
    best = found[0]
    best[8] = np.where(np.isnan(found[1, 8]) & np.isfinite(best[8]), np.inf, found[1, 8])
    return two_paths(best, len(np.asarray(frequency)))


def separate_candidates(
    z: ArrayLike, frequency: ArrayLike, sigma_z: ArrayLike, extent: float, gain: ArrayLike | None = None
) -> Floats:
    """Fits of two paths to every pixel that came into question, arguments as `separate_two_paths`.

    Returns
    -------
    NDArray
        (CANDIDATES, 9, P), the best first, NaN where there are fewer: u₁, u₂ (px), a₁ ≥ a₂ (DN), σ_u₁, σ_u₂ (px), σ_a
        (DN), χ², and the growth over the best of χ² + 2 ln(a₁ + a₂).
    """
    phasors, sigma, comb = prepare(z, frequency, sigma_z, extent, gain)
    pixels = phasors.shape[1]
    found = np.full((CANDIDATES, 9, pixels), np.nan, np.float32)

    def separate(start: int) -> None:
        separate_block(
            phasors, sigma, comb.gain, comb.weight, comb.xi, *comb.pencil, comb.carrier, comb.step_rad, comb.turn,
            comb.low, comb.high, found, start, min(start + _BLOCK, pixels), workspace(len(comb.gain)),
        )  # fmt: skip

    with ThreadPoolExecutor(CORES) as pool:
        list(pool.map(separate, range(0, pixels, _BLOCK)))
    return found


def two_paths(found: Floats, count: int) -> TwoPaths:
    """Rows (9, P) u₁, u₂, a₁, a₂, σ_u₁, σ_u₂, σ_a, χ², margin as `TwoPaths` of ``count`` frequencies."""
    return TwoPaths(
        u=found[0:2],
        amplitude=found[2:4],
        sigma_u=found[4:6],
        sigma_amplitude=found[6],
        chi2=found[7],
        margin=found[8],
        converged=np.isfinite(found[0]),
        dof=2 * count - 4,
    )
