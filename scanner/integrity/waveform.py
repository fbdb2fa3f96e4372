"""How much of what a frame shows can be the waveform of a fringe, and how much must be an error.

Whatever the projector's response is and however many paths of light reach a pixel, its grey value is a Fourier series
in the phase step: A + Σ c_k cos(k δ_n + φ_k). Of N > 2K + 1 frames, what no series up to order K explains is noise, the
harmonics beyond K, and errors of single frames. The first is measured; the second follow from c₂, which falls to c₃ and
c₄ by known ratios for any plausible response; what is left is an error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.sampling import Grid, Noise, noise_of
from scanner.integrity.significance import UNCERTAIN_NOISE, beyond

TOLERANCE = 0.6
"""Errors that change a coordinate by less than half of its noise, rms, are let pass: an error e of one frame of N
changes a phase by (2/N) (e/B) sin φ, the noise by √(2/N) σ/B, and e = 0.6 σ √(N/2) makes the ratio 0.4."""

STEADY = 0.005
"""No lamp is steadier than this: errors below it, as a share of B for each of N/2 frames, are no reason for alarm."""

HARMFUL = 0.25
"""Mean square of a phase error, in units of that of its noise, that is worth another take: half the noise, rms."""

ROUNDING_DN = 0.29
"""Standard deviation of a rounded grey value."""

LAMP = 0.003
"""The light may have become so much brighter or darker between two sequences."""

FEWEST = 60
"""Pixels with fringes below which nothing can be said."""

_CLEAR = 6.0
_LITTLE = 0.5
"""Less light than this share of what was taken for lit, and it was darkness that told the noise."""

_MORE_NOISE = 1.25
_LEAST_VISIBLE = 0.05
_LINEAR = 0.03
_DRIFT = 0.002
_WELL_CONDITIONED = 100.0

_NEXT_HARMONIC = {2: (1.4, 0.07), 3: (0.5, 0.03), 4: (0.25, 0.015)}
"""Of the first harmonic beyond K: its greatest share of c₂ and of A. A power law I ~ L^γ, γ = 0.8..2.2, has half that:
c₂/c₁ = (γ - 1)/(γ + 2), c_{k+1}/c_k = (γ - k)/(γ + k + 1). The other half is for pixels that see two paths."""

_ALIAS = {3: 0.035, 4: 0.013, 5: 0.008, 6: 0.005, 7: 0.004}
"""Greatest plausible Nth harmonic of the waveform, as a share of B: the mean of N steps holds it."""


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
    noise
        Of one grey value, as it is to be judged by.
    own_noise
        What this sequence alone says of it.
    harmonics
        (K - 1, U) phasors of the harmonics 2..K at the usable pixels, DN; empty where they are not free.
    errors
        (N, U) what each frame would have to be wrong by, alone, at the usable pixels, DN; empty for three steps.
    visible
        (N,) share of the energy of a frame's error that no waveform explains.
    """

    mean: NDArray[np.float32]
    z: NDArray[np.complex64]
    usable: NDArray[np.bool_]
    clear_dn: float
    noise: Noise
    own_noise: Noise
    harmonics: NDArray[np.complex64]
    errors: NDArray[np.float32]
    visible: NDArray[np.float64]

    @property
    def sigma_dn(self) -> float:
        """Noise of one grey value, DN."""
        return self.noise.sigma_dn

    @property
    def share(self) -> float:
        """Share of the pixels that are usable."""
        return float(self.usable.mean())

    def distortion(self) -> NDArray[np.complex64]:
        """(K - 1,) c₂..c_K as shares of c₁, of what goes with the phase as a projector's response makes it."""
        b = np.maximum(np.abs(self.z[self.usable]), 1e-6)
        turn = self.z[self.usable].conj() / b
        along = [(h * turn ** (k + 2) * b).sum() for k, h in enumerate(self.harmonics)]
        return np.asarray(np.array(along) / np.square(b).sum(), np.complex64)

    def linear(self) -> bool | None:
        """Whether the projector responds linearly, as the second harmonic has it; None where noise leaves it open."""
        if not self.harmonics.size:
            return None
        noise = 4 * self.sigma_dn**2 / len(self.visible)
        power = float(np.square(np.abs(self.harmonics[0])).mean())
        limit = (_LINEAR * float(np.abs(self.z[self.usable]).mean())) ** 2
        if power - (1 - UNCERTAIN_NOISE) * noise < limit:
            return True
        return False if power - (1 + UNCERTAIN_NOISE) * noise > limit else None


def fit(
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    steps_rad: NDArray[np.float64],
    reference: Reference | None = None,
    former_noise_dn: float = np.inf,
    round_noise: Noise | None = None,
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
    former_noise_dn
        Noise of a grey value in the sequences before: an error that passes for noise must not hide itself.
    round_noise
        Noise that the sequences before showed in the same light: a few pixels alone tell it badly.
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

    most = _MORE_NOISE * former_noise_dn

    def told(lit: NDArray[np.bool_]) -> Noise:
        if orders > 1 or (len(rest) and reference is None):
            return noise_of(rest, valid, lit, ROUNDING_DN)
        if reference is not None:
            against = (mean - reference.mean)[None]
            found = noise_of(against, valid & reference.known, lit, 0.0)
            scale = reference.noise_gain(count)
        else:
            # Three steps leave no residual. But the texture of an object changes mean and modulation alike.
            contrast = float(np.median(modulation[lit] / np.maximum(mean[lit], 1))) if lit.any() else 0.0
            found = noise_of((modulation - np.float32(contrast) * mean)[None], valid, lit, 0.0)
            scale = float(np.sqrt((2 + contrast**2) / count))
        return replace(found, sigma_dn=max(found.sigma_dn / scale, ROUNDING_DN))

    lit = valid & (modulation > 0.25 * np.quantile(modulation, 0.9))
    own = told(lit)
    own = replace(own, sigma_dn=min(own.sigma_dn, most))
    gain = _CLEAR * float(np.linalg.norm(solve[1]))
    usable = valid & (modulation > gain * own.sigma_dn)
    if 0 < np.count_nonzero(usable) < _LITTLE * np.count_nonzero(lit):
        # Nearly all was dark, and darkness has less noise than light.
        bright = usable & (modulation > 0.25 * np.quantile(modulation[usable], 0.9))
        former = former_noise_dn if np.isfinite(former_noise_dn) else 0.0
        again = told(bright)
        own = replace(again, sigma_dn=max(own.sigma_dn, min(again.sigma_dn, most), former))
    noise = own
    if round_noise is not None:
        joined = own.joined(round_noise)
        # Harmonics may pass for noise, and some frequencies show more of them.
        noise = replace(joined, sigma_dn=max(own.sigma_dn, joined.sigma_dn))
    clear = gain * noise.sigma_dn
    usable = valid & (modulation > clear)
    visible = np.square(unexplained, dtype=np.float64).sum(axis=1)
    errors = np.empty((count, 0), np.float32)
    if len(rest) and usable.any():
        errors = (unexplained / np.maximum(visible, 1e-9)[:, None].astype(np.float32)) @ rest[:, usable]
    harmonics = np.empty((0, int(usable.sum())), np.complex64)
    if orders > 1 and usable.any():
        rows = np.concatenate([solve[2 : 1 + orders], solve[2 + orders :]])
        both = rows @ values[:, usable]
        harmonics = both[: orders - 1] + np.complex64(1j) * both[orders - 1 :]
    return Waveform(mean, z, usable, clear, noise, own, harmonics, errors, visible)


def series(steps_rad: NDArray[np.float64], orders: int) -> NDArray[np.float64]:
    """(N, 1 + 2K) columns 1, cos kδ and -sin kδ for k = 1..K, of N steps δ."""
    angle = steps_rad[:, None] * np.arange(1, orders + 1)
    return np.concatenate([np.ones((len(steps_rad), 1)), np.cos(angle), -np.sin(angle)], axis=1)


def next_harmonic(waveform: Waveform) -> float:
    """Greatest plausible amplitude of the first harmonic that is not free, as a share of A."""
    share, most = _NEXT_HARMONIC[free_harmonics(len(waveform.visible))]
    return min(share * float(np.abs(waveform.distortion()[0])), most)


def excess(waveform: Waveform, cells: Grid) -> NDArray[np.float64]:
    """(N, tiles + 1) how far each frame's error is beyond what noise and harmonics make: above 1 is an alarm."""
    visible = np.maximum(waveform.visible, 1e-9)[:, None]
    energy, single, brightness, pixels = _energies(np.square(waveform.errors), waveform, cells)
    found = beyond(
        energy=energy,
        noise=waveform.sigma_dn**2 / visible,
        let_pass=single + next_harmonic(waveform) ** 2 / 2 * brightness / visible**2,
        pixels=pixels,
        freedom=waveform.noise.freedom,
    )
    found[waveform.visible < _LEAST_VISIBLE] = 0
    return found


def harmonic_excess(waveform: Waveform, cells: Grid) -> NDArray[np.float64]:
    """(1, tiles + 1) how far the free harmonics are beyond what noise makes of them: above 1 is an alarm.

    Of a linear projector they are errors as well, of several frames at once, as where the picture lags for a while.
    """
    count, shares = len(waveform.visible), waveform.distortion()
    b = np.maximum(np.abs(waveform.z[waveform.usable]), 1e-6)
    turn = waveform.z[waveform.usable] / b
    free = [h - c * turn ** (k + 2) * b for k, (h, c) in enumerate(zip(waveform.harmonics, shares, strict=True))]
    energy, single, brightness, pixels = _energies(np.square(np.abs(free)).sum(axis=0)[None], waveform, cells)
    parts = 2 * len(free) * 2 / count
    return beyond(
        energy=energy,
        noise=parts * waveform.sigma_dn**2,
        let_pass=parts / count * single + float(np.square(3 * np.abs(shares)).sum()) * brightness,
        pixels=pixels,
        freedom=waveform.noise.freedom,
    )


def _energies(
    squares: NDArray[np.float32], waveform: Waveform, cells: Grid
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Over the tiles: mean (K, U) ``squares``, the harmless error of one frame, the mean square of A, the pixels."""
    b = np.abs(waveform.z[waveform.usable])
    level = np.maximum(waveform.mean[waveform.usable], b)
    moments = cells.sums(np.concatenate([squares, [b**2, level**2]]), waveform.usable)
    pixels = np.maximum(_counted(cells, waveform.usable), 1)
    moments /= pixels
    single = len(waveform.visible) / 2 * ((TOLERANCE * waveform.sigma_dn) ** 2 + STEADY**2 * moments[-2])
    return moments[:-2], single, moments[-1], pixels


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
    alias = _alias(z, off, count)
    # In a part of the picture, bounces make more of it than over all.
    allowed = np.full(cells.tiles + 1, 3 * max(alias, (0.25 if count == 3 else 0.1) * _ALIAS[count]))
    allowed[-1] = 2.2 * max(alias, 0.1 * _ALIAS[count])
    moments = cells.sums(np.stack([off**2, b**2, np.maximum(mean, b) ** 2]), there)
    pixels = np.maximum(_counted(cells, there), 1)
    single = count / 2 * ((TOLERANCE * waveform.sigma_dn) ** 2 + STEADY**2 * moments[1] / pixels) / count**2
    steady = (_DRIFT**2 + allowed**2 / 2) * moments[2] / pixels
    noise = (waveform.sigma_dn * reference.noise_gain(count)) ** 2
    return beyond(moments[0] / pixels, noise, single + steady, pixels, waveform.noise.freedom)


def _alias(z: NDArray[np.complex64], off: NDArray[np.float32], count: int) -> float:
    """Amplitude of what goes with the Nth multiple of the phase in (U,) ``off``, as a share of B, if plausible."""
    b = np.abs(z)
    turn = z / np.maximum(b, 1e-6)
    # What goes with the phase itself is an error; it is fitted as well, lest a part of it should pass for a harmonic.
    shapes = np.stack([b] + [b * part for k in (1, count) for part in ((turn**k).real, (turn**k).imag)], axis=1)
    return min(float(np.hypot(*np.linalg.lstsq(shapes, off, rcond=1e-3)[0][3:])), _ALIAS[count])


def _counted(cells: Grid, usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    found = np.bincount(cells.tile[usable], minlength=cells.tiles).astype(np.float64)
    return np.append(found, found.sum())
