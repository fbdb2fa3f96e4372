"""Coordinates without the ripples of the windows over them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.kernels import over_rows, sin_cos_turns
from scanner.phasors import AxisPhasors
from scanner.pooling.windows import Windows
from scanner.ripples.fitting import FASTEST, FINENESS, GROUPS, MOST_WAVES, fit_windows
from scanner.ripples.surface import STRIDE, TERMS, WINDOW, compiled, terms
from scanner.unwrapping import Coordinates

_FEWEST_FREQUENCIES = 5
"""Fewer do not tell how far away a second path is."""

_PASSES = 2
"""What crosses several windows is found again in what the first pass leaves."""

_LEFT = 0.4
"""Part of a ripple that usually stays, where the second path runs less evenly than the wave."""


def remove_ripples(
    phasors: AxisPhasors,
    coordinates: Coordinates,
    sigma_z: NDArray[np.float32],
    gain: NDArray[np.float64],
    good: NDArray[np.bool_],
    asked: NDArray[np.bool_],
    extent: int,
) -> tuple[Coordinates, NDArray[np.float32]]:
    """Take off weak bounces that only the neighbourhood shows.

    Parameters
    ----------
    phasors
        Of one axis. **Changed**: the waves are subtracted from the ``asked`` pixels.
    coordinates, sigma_z, gain
        Of these phasors, as for `scanner.unwrapping.unwrap`.
    good
        (H, W) bool, pixels whose fringes are whole and sound: they show the ripples.
    asked
        (H, W) bool, the good ones among these are corrected.
    extent
        Projector pixels along the axis.

    Returns
    -------
    tuple
        The coordinates, σ grown by the part of the ripple that may have stayed and χ² that of what is left; and
        (H, W) the amplitude of what was taken off in units of the direct light's, 0 where nothing was.
    """
    ripple = np.zeros(good.shape, np.float32)
    frequency = phasors.frequency.astype(np.float64)
    if len(frequency) < _FEWEST_FREQUENCIES or not (good & asked).any():
        return coordinates, ripple
    gaps = np.diff(np.sort(frequency))
    reach = min(float(extent), 0.5 / float(gaps[gaps > 0].min(initial=np.inf)))
    binning = _binning(coordinates.u, good)
    asked = asked & good
    now = replace(
        coordinates, u=coordinates.u.copy(), amplitude=coordinates.amplitude.copy(), chi2=coordinates.chi2.copy()
    )
    for _ in range(_PASSES):
        cells = _cells(phasors.z, now, sigma_z, good, asked, binning)
        windows = Windows.over(cells[-1].shape, WINDOW, STRIDE)
        found = _found(cells, frequency, np.asarray(gain, np.float64), reach, windows)
        if not (found[0] > 1).any():
            break
        places = windows.rows, windows.columns, windows.row_range, windows.column_range
        what = phasors.z, sigma_z, asked, frequency, gain, binning, *places, *found
        _everywhere(what, (now.u, now.amplitude, now.chi2, ripple))
        near = np.ones((2 * STRIDE * binning + 1,) * 2, np.uint8)
        asked = asked & (cv2.dilate((ripple > 0).astype(np.uint8), near) > 0)
    stayed = np.float32(_LEFT) * shift_of(ripple, frequency)
    return replace(now, sigma=np.hypot(now.sigma, stayed)), ripple


def shift_of(ripple: NDArray[np.float32], frequency: NDArray[np.float64]) -> NDArray[np.float32]:
    """Root mean square shift (px) of coordinates by bounces of these amplitudes: α/(2πf) at most, 1/√2 of it mostly."""
    return np.asarray(ripple / np.float32(2 * np.pi * np.sqrt(2) * frequency.mean()), np.float32)


def _binning(u: NDArray[np.float32], good: NDArray[np.bool_]) -> int:
    """Camera pixels across that see about one projector pixel."""
    steps = [np.abs(np.diff(u, axis=k)) for k in (0, 1)]
    both = [good[1:] & good[:-1], good[:, 1:] & good[:, :-1]]
    usual = max(float(np.median(s[b])) if b.any() else 0.0 for s, b in zip(steps, both, strict=True))
    return max(1, round(1 / usual)) if usual > 1 / 16 else 1


Cells = tuple[
    NDArray[np.complex64],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.bool_],
    NDArray[np.bool_],
]
"""Phasors, coordinate, amplitude, noise, good and asked of the cells."""


def _cells(
    z: NDArray[np.complex64],
    now: Coordinates,
    sigma_z: NDArray[np.float32],
    good: NDArray[np.bool_],
    asked: NDArray[np.bool_],
    binning: int,
) -> Cells:
    """Means over blocks of pixels, so that a window spans as many fringes whatever the camera resolves."""
    if binning == 1:
        return z, now.u, now.amplitude, sigma_z, good, asked
    shape = tuple(n // binning for n in good.shape)
    planes = [now.u, now.amplitude, sigma_z**2]
    means: list[NDArray[np.float32]] = [np.empty(shape, np.float32) for _ in planes]
    z_mean: NDArray[np.complex64] = np.empty((len(z), *shape), np.complex64)
    whole: NDArray[np.bool_] = np.empty(shape, bool)
    wanted: NDArray[np.bool_] = np.zeros(shape, bool)

    def rows(start: int, stop: int) -> None:
        _block_means(z, *planes, good, asked, binning, z_mean, *means, whole, wanted, start, stop)  # type: ignore[call-arg]

    over_rows(rows, shape[0])
    noise = np.asarray(np.sqrt(means[2]) / np.float32(binning), np.float32)
    return z_mean, means[0], means[1], noise, whole, wanted


@compiled
def _block_means(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    z,
    u,
    amplitude,
    variance,
    good,
    asked,
    side,
    z_mean,
    u_mean,
    amplitude_mean,
    variance_mean,
    whole,
    wanted,
    start,
    stop,
):
    """Means of the blocks in rows start..stop of blocks; a block with a pixel that is not good is not whole."""
    share = np.float32(1 / side**2)
    for i in range(start, stop):
        for j in range(whole.shape[1]):
            all_good = True
            first, second, third = np.float32(0), np.float32(0), np.float32(0)
            for y in range(i * side, (i + 1) * side):
                for x in range(j * side, (j + 1) * side):
                    all_good &= good[y, x]
                    wanted[i, j] |= asked[y, x]
                    first += u[y, x]
                    second += amplitude[y, x]
                    third += variance[y, x]
            whole[i, j] = all_good
            u_mean[i, j], amplitude_mean[i, j], variance_mean[i, j] = first * share, second * share, third * share
            for t in range(z.shape[0]):
                total = np.complex64(0)
                if all_good:
                    for y in range(i * side, (i + 1) * side):
                        for x in range(j * side, (j + 1) * side):
                            total += z[t, y, x]
                z_mean[t, i, j] = total * share


def _found(
    cells: Cells, frequency: NDArray[np.float64], gain: NDArray[np.float64], reach: float, windows: Windows
) -> tuple[NDArray[np.int8], NDArray[np.float64], NDArray[np.complex64], NDArray[np.float64]]:
    """Of every window: waves + 1, or 0 where it tells nothing; the waves' turns per cell; amplitudes; surface."""
    shape, count = windows.shape, len(frequency)
    middle = np.arange(WINDOW) - 0.5 * (WINDOW - 1)
    line = np.cos(np.pi * middle / (WINDOW + 1)) ** 2
    taper = np.outer(line, line).astype(np.float32)
    tried = np.arange(-FASTEST, FASTEST + 1) / FINENESS
    table = np.exp(-2j * np.pi * tried[:, None] * middle).astype(np.complex64)
    groups = np.arange(count) * GROUPS // count
    known = np.zeros(shape, np.int8)
    turns = np.zeros((*shape, MOST_WAVES, 2))
    vectors = np.zeros((*shape, MOST_WAVES, count), np.complex64)
    surface = np.zeros((*shape, TERMS))
    fixed: tuple[Any, ...] = *cells, frequency, gain, taper, table, groups, reach, windows.rows, windows.columns
    results = known, turns, vectors, surface
    over_rows(lambda a, b: fit_windows(*fixed, *results, a, b), shape[0])  # type: ignore[call-arg]
    return results


def _everywhere(what: tuple[Any, ...], results: tuple[NDArray[Any], ...]) -> None:
    """Run `_remove` over the picture, on all cores."""
    over_rows(lambda a, b: _remove(*what, *results, a, b), results[0].shape[0])  # type: ignore[call-arg]


@compiled
def _remove(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    z,
    sigma,
    asked,
    frequency,
    gain,
    binning,
    rows,
    columns,
    row_range,
    column_range,
    known,
    turns,
    vectors,
    surface,
    u,
    amplitude,
    chi2,
    ripple,
    start,
    stop,
):
    """Subtract the waves from the phasors of the asked pixels in rows start..stop, and fit one path to the rest."""
    count = frequency.size
    middle = frequency.mean()
    here = np.empty(TERMS)
    wave, back = np.empty(count, np.complex128), np.empty(count, np.complex128)
    gg, ffgg = 0.0, 0.0
    for t in range(count):
        gg += gain[t] ** 2
        ffgg += (frequency[t] * gain[t]) ** 2
    half = 0.5 * (WINDOW - 1)
    for y in range(start, stop):
        down = min(y // binning, row_range.shape[0] - 1)
        for x in range(u.shape[1]):
            if not asked[y, x]:
                continue
            across = min(x // binning, column_range.shape[0] - 1)
            total, strength, touched = 0.0, 0.0, False
            wave[:] = 0
            for i in range(row_range[down, 0], row_range[down, 1]):
                dy = (y - 0.5 * (binning - 1)) / binning - rows[i]
                for j in range(column_range[across, 0], column_range[across, 1]):
                    if known[i, j] == 0:
                        continue
                    dx = (x - 0.5 * (binning - 1)) / binning - columns[j]
                    terms(dy, dx, here)
                    # Towards its ends a window counts less and less.
                    share = (np.cos(1.5 * here[2]) * np.cos(1.5 * here[1])) ** 2 + 1e-4
                    total += share
                    if known[i, j] == 1:
                        continue
                    touched = True
                    place = 0.0
                    for a in range(TERMS):
                        place += surface[i, j, a] * here[a]
                    for w in range(known[i, j] - 1):
                        along = turns[i, j, w, 0] * (dy - half) + turns[i, j, w, 1] * (dx - half)
                        for t in range(count):
                            s, c = sin_cos_turns(np.float32(frequency[t] * (along / middle + place)))
                            wave[t] += share * vectors[i, j, w, t] * complex(c, s)
            if not touched:
                continue
            for t in range(count):
                wave[t] /= total
                z[t, y, x] -= wave[t]
                strength += wave[t].real ** 2 + wave[t].imag ** 2
            place, level = float(u[y, x]), 0.0
            for turn in range(3):
                slope, level = 0.0, 0.0
                for t in range(count):
                    s, c = sin_cos_turns(np.float32(frequency[t] * place))
                    back[t] = z[t, y, x] * complex(c, -s)
                    slope += frequency[t] * gain[t] * back[t].imag
                    level += gain[t] * back[t].real
                level /= gg
                if turn < 2 and level > 0:
                    place += slope / (2 * np.pi * level * ffgg)
            misfit = 0.0
            for t in range(count):
                misfit += (back[t].real - gain[t] * level) ** 2 + back[t].imag ** 2
            u[y, x], amplitude[y, x] = place, level
            chi2[y, x] = misfit / sigma[y, x] ** 2
            ripple[y, x] = np.hypot(ripple[y, x], np.sqrt(strength / count) / max(level, 1e-6))


def compile_all() -> None:
    """Compile the kernels, so that no scan waits for them."""
    side = WINDOW + STRIDE
    u = np.broadcast_to(np.arange(side, dtype=np.float32) + 100, (side, side)).copy()
    frequency = np.array([(80 + t) / 1280 for t in range(9)])
    second = 0.3 * np.exp(2j * np.pi * frequency[:, None, None] * (u + 100 + 2 * (u - 100)))
    z = (np.exp(2j * np.pi * frequency[:, None, None] * u) + second).astype(np.complex64)
    noise, whole = np.full(u.shape, 0.01, np.float32), np.ones(u.shape, bool)
    coordinates = Coordinates("x", u, noise, np.ones_like(u), np.ones_like(u), 16, u)
    remove_ripples(AxisPhasors("x", frequency, z, 1.0), coordinates, noise, np.ones(9), whole, whole, 1280)
