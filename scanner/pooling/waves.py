"""The wave of a window, and what it predicts for its pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.kernels import over_rows, sin_cos_turns
from scanner.pooling.residuals import Residuals
from scanner.pooling.windows import WINDOW, Windows

_FEWEST = 12
"""A wave is known from so many pixels at least."""

_FRACTIONS = np.array([-0.5, -0.25, 0.0, 0.25, 0.5], np.float32)
"""Of a bin: between two bins of the transform half the power would be lost."""

_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"})


def wave_evidence(
    residuals: Sequence[Residuals],
    windows: Windows,
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
