"""How much of what a frame shows can be the waveform of a fringe, and how much must be an error.

Whatever the projector's response is and however many paths of light reach a pixel, its grey value is a Fourier series
in the phase step: A + Σ c_k cos(k δ_n + φ_k). Of N > 2K + 1 frames, what no series up to order K explains is noise, the
harmonics beyond K, and errors of single frames. The first is measured; the second follow from c₂, which falls to c₃ and
c₄ by known ratios for any plausible response; what is left is an error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.sampling import Grid, noise_of

TOLERANCE = 0.7
"""Errors that change a coordinate by half of its noise, rms, are the largest that are let pass: an error e of one frame
of N changes a phase by (2/N) (e/B) sin φ, the noise by √(2/N) σ/B, and e = 0.7 σ √(N/2) makes the ratio 1/2."""

STEADY = 0.005
"""No lamp is steadier than this: errors below it, as a share of B for each of N/2 frames, are no reason for alarm."""

ROUNDING_DN = 0.29
"""Standard deviation of a rounded grey value."""

LAMP = 0.01
"""The light may have become so much brighter or darker between two sequences."""

FEWEST = 60
"""Pixels with fringes below which nothing can be said."""

_CLEAR = 6.0
_FEWEST_OF_TILE = 40
_SIGNIFICANT = 10.0
_UNCERTAIN_NOISE = 0.3
_LEAST_VISIBLE = 0.05
_WELL_CONDITIONED = 100.0

_NEXT_HARMONIC = {2: (0.7, 0.05), 3: (0.3, 0.02), 4: (0.15, 0.01)}
"""Of the first harmonic beyond K: its greatest share of c₂ and of A. A power law I ~ L^γ, γ = 0.8..2.2, has half that:
c₂/c₁ = (γ - 1)/(γ + 2), c_{k+1}/c_k = (γ - k)/(γ + k + 1). The other half is for pixels that see two paths."""


def free_harmonics(count: int) -> int:
    """K: the orders of the waveform that ``count`` steps leave free; 1 where they are too few to tell errors by."""
    return min(4, max(2, (count - max(2, -(-count // 3)) - 1) // 2)) if count >= 6 else 1


@dataclass(frozen=True)
class Reference:
    """The mean A of the steps as other pictures of the same scene have it.

    Parameters
    ----------
    mean
        (P,) DN; 0 where not known.
    known
        (P,) where it is.
    variance
        Its noise variance in units of that of one grey value.
    """

    mean: NDArray[np.float32]
    known: NDArray[np.bool_]
    variance: float

    def noise_gain(self, count: int) -> float:
        """Standard deviation, in units of one grey value's, of the mean of ``count`` steps against this one."""
        return float(np.sqrt(1 / count + self.variance))


@dataclass(frozen=True)
class Waveform:
    """What the planned steps make of the sampled pixels.

    Parameters
    ----------
    mean
        (P,) A, DN.
    z
        (P,) phasor of the fringe, DN.
    usable
        (P,) pixels with fringes that stand out of the noise, none of them saturated.
    clear_dn
        Modulation from which a pixel is usable, DN.
    sigma_dn
        Noise of one grey value, DN.
    second
        Share of the second harmonic in the modulation, rms over the pixels; 0 where it was not measured.
    errors
        (N, U) what each frame would have to be wrong by, alone, at the usable pixels, DN; empty for three steps.
    visible
        (N,) share of the energy of a frame's error that no waveform explains.
    """

    mean: NDArray[np.float32]
    z: NDArray[np.complex64]
    usable: NDArray[np.bool_]
    clear_dn: float
    sigma_dn: float
    second: float
    errors: NDArray[np.float32]
    visible: NDArray[np.float64]

    @property
    def share(self) -> float:
        """Share of the pixels that are usable."""
        return float(self.usable.mean())


def fit(
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    steps_rad: NDArray[np.float64],
    reference: Reference | None = None,
) -> Waveform:
    """Least squares of the waveform with the given steps.

    Parameters
    ----------
    values
        (N, P) grey values of the sampled pixels.
    valid
        (P,) pixels without a saturated frame.
    steps_rad
        (N,) planned steps.
    reference
        The mean as other sequences have it; with few steps the noise is measured against it.
    """
    count = len(steps_rad)
    orders = free_harmonics(count)
    model = series(steps_rad, orders)
    basis, _ = np.linalg.qr(model, mode="complete")
    unexplained = basis[:, np.linalg.matrix_rank(model) :].astype(np.float32)
    solve = np.linalg.pinv(model).astype(np.float32)
    mean, re, im = solve[[0, 1, 1 + orders]] @ values
    z = re + np.complex64(1j) * im
    modulation = np.abs(z)
    rest = unexplained.T @ values
    lit = valid & (modulation > 0.25 * np.quantile(modulation, 0.9))
    if orders > 1 or (len(rest) and reference is None):
        sigma = noise_of(rest, valid, lit, ROUNDING_DN)
    elif reference is not None:
        against = (mean - reference.mean)[None]
        sigma = noise_of(against, valid & reference.known, lit, 0.0) / reference.noise_gain(count)
        sigma = max(sigma, ROUNDING_DN)
    else:
        # Three steps leave no residual. What changes from pixel to pixel within a frame is texture as well as noise.
        sigma = noise_of(values, valid, lit, ROUNDING_DN)
    clear = _CLEAR * sigma * float(np.linalg.norm(solve[1]))
    usable = valid & (modulation > clear)
    visible = np.square(unexplained, dtype=np.float64).sum(axis=1)
    errors = np.empty((count, 0), np.float32)
    second = 0.0
    if len(rest) and usable.any():
        errors = (unexplained / np.maximum(visible, 1e-9)[:, None].astype(np.float32)) @ rest[:, usable]
    if orders > 1 and usable.any():
        harmonic = solve[[2, 2 + orders]] @ values[:, usable]
        floor = 2 * sigma**2 * float(np.square(solve[2]).sum())
        power = float(np.square(modulation[usable]).mean())
        second = float(np.sqrt(max(float(np.square(harmonic).sum(axis=0).mean()) - floor, 0.0) / power))
    return Waveform(mean, z, usable, clear, sigma, second, errors, visible)


def series(steps_rad: NDArray[np.float64], orders: int) -> NDArray[np.float64]:
    """(N, 1 + 2K) columns 1, cos kδ and -sin kδ for k = 1..K, of N steps δ."""
    angle = steps_rad[:, None] * np.arange(1, orders + 1)
    return np.concatenate([np.ones((len(steps_rad), 1)), np.cos(angle), -np.sin(angle)], axis=1)


def excess(waveform: Waveform, cells: Grid) -> NDArray[np.float64]:
    """(N, tiles + 1) how far each frame's error is beyond what noise and harmonics make: above 1 is an alarm."""
    count = len(waveform.visible)
    b = np.abs(waveform.z[waveform.usable])
    level = np.maximum(waveform.mean[waveform.usable], b)
    share, most = _NEXT_HARMONIC[free_harmonics(count)]
    visible = np.maximum(waveform.visible, 1e-9)[:, None]
    moments = cells.sums(np.concatenate([np.square(waveform.errors), [b**2, level**2]]), waveform.usable)
    pixels = np.maximum(_counted(cells, waveform.usable), 1)
    harmonic = min(share * waveform.second, most) ** 2 / 2 * moments[-1] / pixels / visible**2
    found = beyond(
        energy=moments[:count] / pixels,
        noise=waveform.sigma_dn**2 / visible,
        let_pass=count / 2 * ((TOLERANCE * waveform.sigma_dn) ** 2 + STEADY**2 * moments[-2] / pixels) + harmonic,
        pixels=pixels,
    )
    found[waveform.visible < _LEAST_VISIBLE] = 0
    return found


def of_own_fringe(waveform: Waveform) -> NDArray[np.float64]:
    """(N,) error of each frame that goes with the phase of its own fringe, rms in units of B; 0 where phases are few.

    With four or five steps the second harmonic of the waveform is as large as an error. But over all phases they can be
    told apart: what a wrong frame lacks is its own fringe, once per period, the harmonics come twice and three times.
    """
    b = np.abs(waveform.z[waveform.usable])
    turn = waveform.z[waveform.usable] / np.maximum(b, 1e-6)
    shapes = np.stack([b] + [b * part for k in (1, 2, 3) for part in ((turn**k).real, (turn**k).imag)], axis=1)
    products = shapes.T @ shapes
    if np.linalg.cond(products) > _WELL_CONDITIONED:
        return np.zeros(len(waveform.visible))
    offset, along, across = np.linalg.solve(products, shapes.T @ waveform.errors.T)[:3]
    return np.asarray(np.sqrt(offset**2 + (along**2 + across**2) / 2), np.float64)


def other_mean(waveform: Waveform, reference: Reference, count: int, cells: Grid) -> NDArray[np.float64]:
    """(tiles + 1) how far the mean of the steps is from the reference, beyond what one may be wrong by; above 1: alarm.

    The error of one frame of N changes the mean by its Nth; so does the Nth harmonic of the waveform, whose phase tells
    it from an error.
    """
    there = waveform.usable & reference.known
    if np.count_nonzero(there) < FEWEST:
        return np.zeros(cells.tiles + 1)
    mean, former, z = waveform.mean[there], reference.mean[there], waveform.z[there]
    change = float(np.median(mean / np.maximum(former, 1)))
    off = mean - former * np.float32(np.clip(change, 1 - LAMP, 1 + LAMP))
    b = np.abs(z)
    turned = (z / np.maximum(b, 1e-6)) ** count * b
    shapes = np.stack([turned.real, turned.imag], axis=1)
    harmonic = float(np.hypot(*np.linalg.lstsq(shapes, off, rcond=1e-3)[0]))
    moments = cells.sums(np.stack([off**2, b**2, np.maximum(mean, b) ** 2]), there)
    pixels = np.maximum(_counted(cells, there), 1)
    single = count / 2 * ((TOLERANCE * waveform.sigma_dn) ** 2 + STEADY**2 * moments[1] / pixels) / count**2
    steady = (STEADY**2 + (3 * harmonic) ** 2 / 2) * moments[2] / pixels
    noise = (waveform.sigma_dn * reference.noise_gain(count)) ** 2
    return beyond(moments[0] / pixels, noise, single + steady, pixels)


def beyond(
    energy: NDArray[np.float64],
    noise: NDArray[np.float64] | float,
    let_pass: NDArray[np.float64],
    pixels: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(…, tiles + 1) mean square of an error over what may pass, unless it is not significant; above 1 is an alarm.

    Parameters
    ----------
    energy
        Mean square as measured, DN².
    noise
        What noise adds to it, DN².
    let_pass
        Mean square that does no harm, DN².
    pixels
        (tiles + 1,) over how many pixels it was taken.
    """
    harmful = (energy - noise) / (1.5 * let_pass + _UNCERTAIN_NOISE * noise)
    significant = (energy / noise - 1) * np.sqrt(pixels / 2) / _SIGNIFICANT
    found = np.minimum(harmful, significant)
    found[..., pixels < _FEWEST_OF_TILE] = 0
    return np.asarray(found)


def _counted(cells: Grid, usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    found = np.bincount(cells.tile[usable], minlength=cells.tiles).astype(np.float64)
    return np.append(found, found.sum())
