"""Evidence for weak bounces, pooled over neighbours (method.md §4).

What a one-path fit leaves of a pixel's phasors, turned back by the phase of the fitted path, is noise or the second
path: ``e_t = a₂ e^{i2πf_t Δu}`` less what the fit took. From pixel to pixel Δu changes, and with it the phase of e, but
on a smooth surface it changes evenly: inside a small window the residuals are the samples of a plane wave with one
unknown vector over t,

    e_t(p) ≈ s_t e^{i k·p} + noise,   k = 2πf ∇Δu, nearly the same for all frequencies.

The Fourier transform of a window collects such a wave in one bin (the generalised likelihood ratio test for a signal
linear in its unknown amplitudes: Kay, *Fundamentals of Statistical Signal Processing II: Detection Theory*, §7.6): of M
pixels, M times the power of one against the same noise. Adding χ² of the pixels, which forgets the phases, gains √M.

Where a window's strongest bin is beyond noise, its wave predicts every pixel. A pixel's evidence is the log-likelihood
ratio of that prediction (made without the pixel itself, so that clean pixels gain nothing by chance) against noise. It
belongs to the single pixel and keeps borders sharp; `scanner.labelling` joins it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import ncx2

from scanner.kernels import over_pixels, over_rows, sin_cos_turns
from scanner.labelling import label
from scanner.phasors import AxisPhasors
from scanner.unwrapping import Coordinates

WINDOW = 16
"""Side of a window, px: the phase of a bounce must run evenly over so many pixels."""

_STRIDE = 8
"""From window to window, px: every pixel lies in four, and one of them is seldom cut by a border."""

_LEAST_SHARE = 0.25
"""A window with fewer usable pixels is not asked."""

_OUTLIER_RATE = 1e-4
"""A residual larger than noise makes so rarely keeps its direction and loses the rest: depth edges and dust must not
speak for a window."""

_QUARTILE_WINDOWS = 200
"""So many windows at least tell which waves all clean surfaces have in common."""

_LEAST_RATIO = 0.001
"""Waves weaker than this part of the direct light are put down to the patterns: 8-bit rounding is 0.2 % of a fringe's
amplitude, of which twelve steps leave half. A bounce so weak moves a coordinate by 0.001/2π of a period."""

_FEWEST = 12
"""A wave is known from so many pixels at least."""

_BINS = WINDOW * WINDOW
_FRACTIONS = np.array([-0.5, -0.25, 0.0, 0.25, 0.5], np.float32)
"""Of a bin: between two bins of the transform half the power would be lost."""

_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"})


@dataclass(frozen=True)
class Pooled:
    """What pixels and their neighbours say about a bounce, arrays (H, W).

    Parameters
    ----------
    p_value
        How often noise alone looks at least like this, by the pixel's own χ² or by the strongest of its windows.
    detected
        bool, pixels with a ``p_value`` below the false-alarm rate.
    evidence
        float32, log-likelihood ratio of a bounce in this very pixel, nats; 0 where the pixel is not usable.
    """

    p_value: NDArray[np.float32]
    detected: NDArray[np.bool_]
    evidence: NDArray[np.float32]


@dataclass(frozen=True)
class Residuals:
    """What the one-path fits of one axis leave.

    Parameters
    ----------
    e
        (T, H, W) turned back by the fitted phase, in units of the noise: real and imaginary parts of variance 1 under
        noise alone, on 2T - 2 degrees of freedom. Unusable pixels are 0.
    systematic
        (H, W) power per pixel, in the same units, that the frames may have in one wave without any bounce.
    frequency
        (T,) 1/px; the waves of the frequencies have spatial frequencies in proportion.
    """

    e: NDArray[np.complex64]
    systematic: NDArray[np.float32]
    frequency: NDArray[np.float64]


@dataclass(frozen=True)
class _Windows:
    """Where the windows begin, and of every row and column the first and the last window that covers it."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    row_range: NDArray[np.intp]
    column_range: NDArray[np.intp]

    @classmethod
    def over(cls, shape: tuple[int, ...]) -> _Windows:
        rows, columns = (
            np.unique(np.append(np.arange(0, n - WINDOW + 1, _STRIDE), n - WINDOW)) if n >= WINDOW else np.arange(0)
            for n in shape
        )
        return cls(rows, columns, _covering(rows, shape[0]), _covering(columns, shape[1]))

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.rows), len(self.columns)

    def sums(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """(n, m) sum of (H, W) values over every window."""
        result = np.zeros(self.shape, np.float32)
        for i, y in enumerate(self.rows):
            total = np.concatenate(([0.0], np.cumsum(values[y : y + WINDOW].sum(axis=0, dtype=np.float64))))
            result[i] = total[self.columns + WINDOW] - total[self.columns]
        return result


@dataclass(frozen=True)
class Spectra:
    """Power of the residuals in every window at every spatial frequency.

    Parameters
    ----------
    windows
        Where they lie.
    asked
        (n, m) bool, windows with enough usable pixels.
    power
        (n, m, bins) by axis, summed over t, per usable pixel: χ² with ``dof`` degrees of freedom under noise.
    systematic
        (n, m) by axis, what a bin may hold without a bounce.
    dof
        By axis.
    """

    windows: _Windows
    asked: NDArray[np.bool_]
    power: tuple[NDArray[np.float32], ...]
    systematic: tuple[NDArray[np.float32], ...]
    dof: tuple[int, ...]

    @classmethod
    def of(cls, residuals: Sequence[Residuals], usable: NDArray[np.bool_]) -> Spectra:
        """Transform the residuals of each axis; ``usable`` (H, W)."""
        windows = _Windows.over(usable.shape)
        count = windows.sums(usable)
        each = np.maximum(count, np.float32(1))[..., None]
        power = tuple(np.asarray(_spectra(r.e, windows) / each, np.float32) for r in residuals)
        systematic = tuple(windows.sums(r.systematic) for r in residuals)
        return cls(
            windows, count >= _LEAST_SHARE * _BINS, power, systematic, tuple(2 * len(r.e) - 2 for r in residuals)
        )

    def p_values(self, excess_noise: np.float32) -> tuple[NDArray[np.float64], list[NDArray[np.intp]]]:
        """P-value (n, m) of the windows' strongest bins, the axes joined by Fisher's method; and those bins by axis."""
        surprise, peaks = np.zeros(self.windows.shape), []
        for raw, systematic, dof in zip(self.power, self.systematic, self.dof, strict=True):
            power = raw / excess_noise
            power /= _common_waves(power[self.asked], dof)
            peak = power.argmax(axis=-1)
            strongest = np.take_along_axis(power, peak[..., None], axis=-1)[..., 0]
            strongest = np.maximum(strongest - systematic / excess_noise, 0)
            one = chi2_distribution.sf(strongest, dof)
            surprise -= 2 * np.log(np.maximum(-np.expm1(_BINS * np.log1p(-np.minimum(one, 1 - 1e-12))), 1e-300))
            peaks.append(peak)
        return np.where(self.asked, chi2_distribution.sf(surprise, 2 * len(self.power)), 1.0), peaks


def one_path_residuals(
    phasors: AxisPhasors,
    coordinates: Coordinates,
    sigma_z: NDArray[np.float32],
    gain: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> Residuals:
    """Residuals of the one-path fits ``coordinates`` of ``phasors``; the arguments are those of `unwrap`.

    Notes
    -----
    Two errors follow the fringes and therefore the surface, like a bounce: those of the patterns, in proportion to the
    light, and the rounding of the frames where no noise dithers it. Noise of σ DN leaves exp(-2π²σ²) of the latter
    (Widrow and Kollár, *Quantization Noise*, §19).
    """
    count = len(phasors.frequency)
    result = np.empty(phasors.z.shape, np.complex64)
    most = np.float32(chi2_distribution.isf(_OUTLIER_RATE, 2 * count - 2))
    planes = (coordinates.u, coordinates.amplitude, sigma_z, usable)
    u, amplitude, sigma, asked = (np.ascontiguousarray(a).reshape(-1) for a in planes)
    f, g = phasors.frequency.astype(np.float32), gain.astype(np.float32)
    z, out = phasors.z.reshape(count, -1), result.reshape(count, -1)
    over_pixels(lambda a, b: _residuals(z, f, g, u, amplitude, sigma, asked, most, out, a, b), z.shape[1])
    variance = sigma_z**2 / np.float32(phasors.noise_gain)
    undithered = np.exp(-4 * np.pi**2 * np.maximum(variance - np.float32(1 / 12), 0))
    systematic = count * (_LEAST_RATIO * coordinates.amplitude / sigma_z) ** 2
    systematic += (2 * count - 2) * undithered / (12 * variance)
    return Residuals(result, np.where(usable, systematic, 0).astype(np.float32), phasors.frequency)


def pool(
    residuals: Sequence[Residuals],
    statistic: NDArray[np.float32],
    dof: int,
    usable: NDArray[np.bool_],
    false_alarm_rate: float,
    excess_noise: float = 1.0,
    spectra: Spectra | None = None,
) -> Pooled:
    """Pool the residuals of all axes.

    Parameters
    ----------
    residuals
        Of each axis, from `one_path_residuals`.
    statistic, dof
        (H, W) χ² of the one-path fits of all axes together, and its degrees of freedom under noise.
    usable
        (H, W) pixels to ask.
    false_alarm_rate
        Share of clean pixels that may be ``detected``. One half of it goes to the pixels' own χ², an eighth to each of
        the four windows that cover a pixel.
    excess_noise
        Variance of clean pixels over what the noise model says.
    spectra
        `Spectra.of` the residuals, where they are asked again with another noise.
    """
    if spectra is None:
        spectra = Spectra.of(residuals, usable)
    windows = spectra.windows
    excess = np.float32(excess_noise)
    own = chi2_distribution.sf(statistic / excess, dof).astype(np.float32)
    in_windows, peaks = spectra.p_values(excess)
    best = np.ones(statistic.shape, np.float32)
    for i, y in enumerate(windows.rows):
        for j, x in enumerate(windows.columns):
            part = best[y : y + WINDOW, x : x + WINDOW]
            np.minimum(part, in_windows[i, j], out=part)
    p_value = np.where(usable, np.minimum(np.minimum(2 * own, 8 * best), 1), 1).astype(np.float32)
    asked = in_windows <= false_alarm_rate / 8
    alone = single_pixel_evidence(statistic / excess, dof, false_alarm_rate)
    weights = usable.astype(np.float32)
    evidence = _evidence(residuals, windows, asked, peaks, weights, alone, excess)
    # Where a border cuts a window, the wave comes out too weak: known from the pixels that speak for it, it is right.
    members = weights * (evidence > 0)
    evidence = _evidence(residuals, windows, asked, peaks, members, alone, excess)
    evidence[~usable] = 0
    return Pooled(p_value, p_value <= false_alarm_rate, evidence)


def single_pixel_evidence(statistic: NDArray[np.float32], dof: int, false_alarm_rate: float) -> NDArray[np.float32]:
    """(H, W) log-likelihood ratio of a pixel's own χ²: noncentral against central, nats.

    The noncentrality is the one that the false-alarm rate lets detect every other time: weaker bounces cannot be told
    by a single pixel, stronger ones exceed any doubt with it as well.
    """
    threshold = float(chi2_distribution.isf(false_alarm_rate, dof))
    grid = np.linspace(0.05, 8 * threshold, 4000)
    ratio = ncx2.logpdf(grid, dof, max(threshold - dof, dof**0.5)) - chi2_distribution.logpdf(grid, dof)
    known = np.isfinite(ratio)
    return np.asarray(np.interp(statistic, grid[known], ratio[known]), np.float32)


def _spectra(e: NDArray[np.complex64], windows: _Windows) -> NDArray[np.float32]:
    """(n, m, bins) power of every spatial frequency in every window, summed over t."""
    power = np.empty((*windows.shape, _BINS), np.float32)
    if not power.size:
        return power

    def bands(start: int, stop: int) -> None:
        for i in range(start, stop):
            y = windows.rows[i]
            views = np.lib.stride_tricks.sliding_window_view(e[:, y : y + WINDOW], WINDOW, axis=2)
            total = np.zeros((WINDOW, len(windows.columns), WINDOW), np.float32)
            for view in views:
                spectrum = fft.fftn(view[:, windows.columns], axes=(0, 2))
                total += spectrum.real**2 + spectrum.imag**2
            power[i] = total.transpose(1, 0, 2).reshape(-1, _BINS)

    over_rows(bands, len(windows.rows))
    return power


def _common_waves(power: NDArray[np.float32], dof: int) -> NDArray[np.float32]:
    """(bins,) by how much clean surfaces exceed noise at each spatial frequency: the lower quartile over the windows.

    What projector and camera add everywhere (a trend of the modulation, rounding of the pictures) shows as the same few
    waves on every surface, and is no bounce.
    """
    if len(power) < _QUARTILE_WINDOWS:
        return np.ones(_BINS, np.float32)
    sample = power[:: max(1, len(power) // 4000)]
    expected = float(chi2_distribution.ppf(0.25, dof))
    error = np.sqrt(0.25 * 0.75 / len(sample)) / float(chi2_distribution.pdf(expected, dof))
    quartile = np.quantile(sample, 0.25, axis=0)
    return np.where(quartile > expected + 4 * error, quartile / expected, 1).astype(np.float32)


def _evidence(
    residuals: Sequence[Residuals],
    windows: _Windows,
    asked: NDArray[np.bool_],
    peaks: Sequence[NDArray[np.intp]],
    weights: NDArray[np.float32],
    alone: NDArray[np.float32],
    excess_noise: np.float32,
) -> NDArray[np.float32]:
    """Evidence of every pixel: of the waves of its windows, or of its own χ² where that says more."""
    pooled = np.zeros(weights.shape, np.float32)
    reached = np.zeros(weights.shape, bool)
    for found, peak in zip(residuals, peaks, strict=True):
        e, count = found.e, len(found.e)
        ratio = (found.frequency / found.frequency.mean()).astype(np.float32)
        waves = np.zeros((*windows.shape, count), np.complex64)
        place = np.zeros((*windows.shape, 2), np.float32)
        members = np.zeros(windows.shape, np.float32)
        arrays = windows.rows, windows.columns, asked, peak
        over_rows(lambda a, b: _fit_waves(e, ratio, weights, *arrays, waves, place, members, a, b), windows.shape[0])  # noqa: B023
        over_rows(
            lambda a, b: _predict(
                e,  # noqa: B023
                ratio,  # noqa: B023
                weights,
                windows.rows,
                windows.columns,
                windows.row_range,
                windows.column_range,
                waves,  # noqa: B023
                place,  # noqa: B023
                members,  # noqa: B023
                pooled,
                reached,
                a,
                b,
            ),
            len(weights),
        )
    return np.where(reached, np.maximum(pooled / excess_noise, alone), alone)


def compile_all() -> None:
    """Compile the kernels of pooling and labelling, so that no scan waits for them."""
    side = 2 * WINDOW
    z = np.ones((3, side, side), np.complex64)
    plane, usable = np.ones((side, side), np.float32), np.ones((side, side), bool)
    phasors = AxisPhasors("x", np.array([1 / 16, 1 / 17, 1 / 18]), z, 1.0)
    coordinates = Coordinates("x", plane, plane, plane, plane, 4, plane)
    residuals = one_path_residuals(phasors, coordinates, plane, np.ones(3), usable)
    label(pool([residuals], plane, 4, usable, 0.4).evidence, iterations=1)


def _covering(starts: NDArray[np.intp], length: int) -> NDArray[np.intp]:
    """(length, 2) first and last + 1 of the windows that cover a row or column."""
    places = np.arange(length)
    return np.stack(
        [np.searchsorted(starts, places - WINDOW, side="right"), np.searchsorted(starts, places, side="right")], axis=1
    )


@_compiled
def _residuals(z, frequency, gain, u, amplitude, sigma, usable, most, out, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = frequency.size
    for j in range(start, stop):
        if not usable[j]:
            for t in range(count):
                out[t, j] = 0
            continue
        total = np.float32(0.0)
        for t in range(count):
            s, c = sin_cos_turns(frequency[t] * u[j])
            re = (z[t, j].real * c + z[t, j].imag * s - gain[t] * amplitude[j]) / sigma[j]
            im = (z[t, j].imag * c - z[t, j].real * s) / sigma[j]
            out[t, j] = complex(re, im)
            total += re * re + im * im
        if total > most:
            shrink = np.sqrt(most / total)
            for t in range(count):
                out[t, j] *= shrink


@_compiled
def _fit_waves(e, ratio, weights, rows, columns, asked, peak, waves, place, members, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Spatial frequency (turns per px, down and across) and vector over t of the wave of every asked window."""
    count = e.shape[0]
    fractions = _FRACTIONS.size
    lines = np.empty((fractions, count, WINDOW), np.complex64)
    for i in range(start, stop):
        for j in range(columns.size):
            if not asked[i, j]:
                continue
            y0, x0 = rows[i], columns[j]
            total = np.float32(0.0)
            for y in range(WINDOW):
                for x in range(WINDOW):
                    total += weights[y0 + y, x0 + x]
            if total < _FEWEST:
                continue
            ky, kx = peak[i, j] // WINDOW, peak[i, j] % WINDOW
            # The smallest of the spatial frequencies that the pixels cannot tell apart.
            ky = ky - WINDOW if ky > WINDOW // 2 else ky
            kx = kx - WINDOW if kx > WINDOW // 2 else kx
            for a in range(fractions):
                turns = (np.float32(kx) + _FRACTIONS[a]) / np.float32(WINDOW)
                for t in range(count):
                    for y in range(WINDOW):
                        lines[a, t, y] = 0
                for t in range(count):
                    for x in range(WINDOW):
                        s, c = sin_cos_turns(turns * ratio[t] * np.float32(x))
                        back = np.complex64(complex(c, -s))
                        for y in range(WINDOW):
                            lines[a, t, y] += weights[y0 + y, x0 + x] * e[t, y0 + y, x0 + x] * back
            best = np.float32(-1.0)
            for b in range(fractions):
                turns = (np.float32(ky) + _FRACTIONS[b]) / np.float32(WINDOW)
                for a in range(fractions):
                    power = np.float32(0.0)
                    for t in range(count):
                        re, im = np.float32(0.0), np.float32(0.0)
                        for y in range(WINDOW):
                            s, c = sin_cos_turns(turns * ratio[t] * np.float32(y))
                            value = lines[a, t, y]
                            re += value.real * c + value.imag * s
                            im += value.imag * c - value.real * s
                        power += re * re + im * im
                    if power > best:
                        best = power
                        place[i, j, 0] = turns
                        place[i, j, 1] = (np.float32(kx) + _FRACTIONS[a]) / np.float32(WINDOW)
                        for t in range(count):
                            re, im = np.float32(0.0), np.float32(0.0)
                            for y in range(WINDOW):
                                s, c = sin_cos_turns(turns * ratio[t] * np.float32(y))
                                value = lines[a, t, y]
                                re += value.real * c + value.imag * s
                                im += value.imag * c - value.real * s
                            waves[i, j, t] = complex(re, im)
            members[i, j] = total


@_compiled
def _predict(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    e, ratio, weights, rows, columns, row_range, column_range, waves, place, members, evidence, reached, start, stop
):
    """Add the evidence of one axis: Re<prediction, pixel> - |prediction|²/2, by the strongest wave over the pixel."""
    count = e.shape[0]
    for y in range(start, stop):
        for x in range(e.shape[2]):
            strongest, at_i, at_j = np.float32(0.0), -1, -1
            for i in range(row_range[y, 0], row_range[y, 1]):
                for j in range(column_range[x, 0], column_range[x, 1]):
                    if members[i, j] > 0:
                        power = np.float32(0.0)
                        for t in range(count):
                            power += waves[i, j, t].real ** 2 + waves[i, j, t].imag ** 2
                        power /= members[i, j]
                        if power > strongest:
                            strongest, at_i, at_j = power, i, j
            if at_i < 0:
                continue
            turns = place[at_i, at_j, 0] * np.float32(y - rows[at_i]) + place[at_i, at_j, 1] * np.float32(
                x - columns[at_j]
            )
            own = weights[y, x]
            others = max(members[at_i, at_j] - own, np.float32(1.0))
            product, length = np.float32(0.0), np.float32(0.0)
            for t in range(count):
                s, c = sin_cos_turns(turns * ratio[t])
                re = e[t, y, x].real * c + e[t, y, x].imag * s
                im = e[t, y, x].imag * c - e[t, y, x].real * s
                mean_re = (waves[at_i, at_j, t].real - own * re) / others
                mean_im = (waves[at_i, at_j, t].imag - own * im) / others
                product += mean_re * re + mean_im * im
                length += mean_re * mean_re + mean_im * mean_im
            evidence[y, x] += product - np.float32(0.5) * length
            reached[y, x] = True
