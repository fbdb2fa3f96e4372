"""The ripples of every window: spatial frequency, amplitude over the frequencies, and where they come from."""

from __future__ import annotations

import numpy as np

from scanner.kernels import sin_cos_turns
from scanner.ripples.surface import TERMS, WINDOW, compiled, fit_surface, terms, values_of

MOST_WAVES = 3
"""Second paths that one window can tell apart."""

FINENESS = 2 * WINDOW
"""Spatial frequencies are tried in steps of one turn in so many cells."""

FASTEST = 12
"""Highest of them, in steps: four cells for one turn. Faster ones the camera's pixels smear."""

_SLOWEST = 1.75
"""Lowest of them, in steps: slower ones the surface itself takes up."""

GROUPS = 3
"""Neighbouring frequencies of the plan are added up before the search, to so many sums."""

_LEAST_POWER = 45.0
"""χ² with two degrees of freedom for each of three sums: noise alone exceeds it in one window of 30 000."""

_LEAST_LEAD = 25.0
"""χ² with one degree of freedom by which a second place must explain the wave better than the surface itself."""

_NEAREST_PX = 10.0
"""Second places nearer than this are not told from what the surface itself does: creases, borders, relief."""

_CLEAREST_SHARE = 0.7
"""Least part of the wave that one second place explains."""

_LEAST_RATIO = 0.0015
"""Weaker waves are put down to the patterns: 8-bit rounding is 0.2 % of a fringe, of which twelve steps leave half."""

_FEWEST = 0.5
"""Share of a window's cells that must be there."""

_ROUGH_PX = 0.5
"""A surface that departs from the smooth one by more than this, in the middle, is none."""

_STRAY_PX = 1.0
"""Cells farther off than this, and than four times the usual, do not count."""

_SETTLING = 2
"""Rounds in which surface and waves are fitted in turns."""


@compiled
def _carriers(turns, ratio, lines):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """e^{2πi k r_t (j - middle)} along one side of the window, (T, WINDOW)."""
    half = np.float32(0.5 * (WINDOW - 1))
    for t in range(ratio.size):
        for j in range(WINDOW):
            s, c = sin_cos_turns(np.float32(turns * ratio[t] * (j - half)))
            lines[t, j] = complex(c, s)


@compiled
def _amplitudes(e, down, across, count, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(T,) of the wave with these carriers, and their total power."""
    power = 0.0
    for t in range(e.shape[0]):
        total = complex(0.0, 0.0)
        for y in range(WINDOW):
            line = complex(0.0, 0.0)
            for x in range(WINDOW):
                line += e[t, y * WINDOW + x] * np.conj(across[t, x])
            total += line * np.conj(down[t, y])
        out[t] = total / count
        power += out[t].real ** 2 + out[t].imag ** 2
    return power


@compiled
def _strongest(e, weights, taper, table, groups):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Spatial frequency (turns per cell, down and across) of the strongest wave, and Σ|·|² there."""
    count = e.shape[0]
    side = 2 * FASTEST + 1
    sums = np.zeros((GROUPS, WINDOW, WINDOW), np.complex64)
    for t in range(count):
        g = groups[t]
        for y in range(WINDOW):
            for x in range(WINDOW):
                sums[g, y, x] += e[t, y * WINDOW + x] * taper[y, x]
    power = np.zeros((side, side), np.float32)
    line = np.empty((WINDOW, side), np.complex64)
    for g in range(GROUPS):
        for y in range(WINDOW):
            for k in range(side):
                total = np.complex64(0)
                for x in range(WINDOW):
                    total += sums[g, y, x] * table[k, x]
                line[y, k] = total
        for m in range(side):
            for k in range(side):
                total = np.complex64(0)
                for y in range(WINDOW):
                    total += line[y, k] * table[m, y]
                power[m, k] += total.real**2 + total.imag**2
    best, at_y, at_x = np.float32(-1.0), 0, 0
    for m in range(side):
        for k in range(side):
            ky, kx = m - FASTEST, k - FASTEST
            if ky * ky + kx * kx >= _SLOWEST * _SLOWEST and power[m, k] > best:
                best, at_y, at_x = power[m, k], ky, kx
    return best, at_y / FINENESS, at_x / FINENESS


@compiled
def _place(v, frequency, gain, middle, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Distance Δu (px) of the place that explains the wave best; what it explains, and what Δu = 0 does."""
    norm = 0.0
    for t in range(v.size):
        norm += gain[t] * gain[t]
    best, at, none = -1.0, 0.0, 0.0
    steps = int(reach / 2)
    for n in range(-steps, steps + 1):
        total = complex(0.0, 0.0)
        for t in range(v.size):
            s, c = sin_cos_turns(np.float32((frequency[t] - middle) * 2 * n))
            total += gain[t] * v[t] * complex(c, -s)
        power = (total.real**2 + total.imag**2) / norm
        if n == 0:
            none = power
        if power > best:
            best, at = power, 2.0 * n
    return at, best, none


@compiled
def _smooth(u, good, each, weights, coefficients, values, off):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Fit the surface without strays; sets the weights, returns by how much it is usually missed, px."""
    for n in range(u.size):
        weights[n] = 1.0 if good[n] else 0.0
    usual = 0.0
    for _ in range(3):
        fit_surface(u, weights, each, coefficients)
        values_of(coefficients, each, values)
        m = 0
        for n in range(u.size):
            if good[n]:
                off[m] = abs(u[n] - values[n])
                m += 1
        usual = 1.4826 * np.median(off[:m])
        for n in range(u.size):
            weights[n] = 1.0 if good[n] and abs(u[n] - values[n]) < max(4 * usual, _STRAY_PX) else 0.0
    fit_surface(u, weights, each, coefficients)
    values_of(coefficients, each, values)
    return usual


@compiled
def _rest(z, frequency, gain, place, level, weights, found, v, down, across, rest):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """What surface and waves leave of the phasors, turned back by the surface."""
    for t in range(frequency.size):
        for n in range(place.size):
            if weights[n] == 0:
                rest[t, n] = 0
                continue
            s, c = sin_cos_turns(np.float32(frequency[t] * place[n]))
            left = z[t, n] * complex(c, -s) - gain[t] * level[n]
            for w in range(found):
                left -= v[w, t] * down[w, t, n // WINDOW] * across[w, t, n % WINDOW]
            rest[t, n] = left


@compiled
def _settle(frequency, gain, each, weights, total, found, v, down, across, rest, du, off, cu, cb, change, level):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Fit the waves anew to what is left, then the surface to what these leave: one round of backfitting."""
    trial = np.empty(frequency.size, np.complex128)
    for w in range(found):
        _amplitudes(rest, down[w], across[w], total, trial)
        for t in range(frequency.size):
            v[w, t] += trial[t]
            for n in range(weights.size):
                if weights[n] > 0:
                    rest[t, n] -= trial[t] * down[w, t, n // WINDOW] * across[w, t, n % WINDOW]
    gg = (gain**2).sum()
    ffgg = ((frequency * gain) ** 2).sum()
    for n in range(weights.size):
        du[n], off[n] = 0.0, 0.0
        if weights[n] > 0:
            slope, more = 0.0, 0.0
            for t in range(frequency.size):
                slope += frequency[t] * gain[t] * rest[t, n].imag
                more += gain[t] * rest[t, n].real
            du[n] = slope / (2 * np.pi * level[n] * ffgg)
            off[n] = more / gg
    fit_surface(du, weights, each, change)
    for a in range(TERMS):
        cu[a] += change[a]
    fit_surface(off, weights, each, change)
    for a in range(TERMS):
        cb[a] += change[a]


@compiled
def _sharpened(rest, ratio, total, ky, kx, down, across, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Spatial frequency between the steps, with the ratio of the plan's frequencies; its carriers and amplitudes."""
    trial = np.empty(ratio.size, np.complex128)
    best, step = -1.0, 0.5 / FINENESS
    for _ in range(2):
        middle_y, middle_x = ky, kx
        for a in range(-1, 2):
            _carriers(middle_y + a * step, ratio, down)
            for b in range(-1, 2):
                _carriers(middle_x + b * step, ratio, across)
                strength = _amplitudes(rest, down, across, total, trial)
                if strength > best:
                    best, ky, kx = strength, middle_y + a * step, middle_x + b * step
                    out[:] = trial
        step /= 2
    _carriers(ky, ratio, down)
    _carriers(kx, ratio, across)
    return best, ky, kx


@compiled
def fit_windows(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    z,
    u,
    amplitude,
    sigma,
    good,
    asked,
    frequency,
    gain,
    taper,
    table,
    groups,
    reach,
    rows,
    columns,
    known,
    turns,
    vectors,
    surface,
    start,
    stop,
):
    """Surface and waves of the windows in rows start..stop of windows, as `scanner.ripples.removal` lays them out."""
    count, size = frequency.size, WINDOW * WINDOW
    middle = frequency.mean()
    ratio = (frequency / middle).astype(np.float32)
    gg = (gain**2).sum()
    each = np.empty((size, TERMS))
    for n in range(size):
        terms(np.float32(n // WINDOW), np.float32(n % WINDOW), each[n])
    weights, place, level = np.empty(size), np.empty(size), np.empty(size)
    uu, aa, off, du = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    cu, cb, change = np.empty(TERMS), np.empty(TERMS), np.empty(TERMS)
    here, there = np.empty(size, np.bool_), np.empty((count, size), np.complex64)
    rest = np.empty((count, size), np.complex64)
    down = np.empty((MOST_WAVES, count, WINDOW), np.complex64)
    across = np.empty((MOST_WAVES, count, WINDOW), np.complex64)
    v = np.empty((MOST_WAVES, count), np.complex128)
    for i in range(start, stop):
        for j in range(columns.size):
            total, wanted, noise = 0, False, 0.0
            for n in range(size):
                y, x = rows[i] + n // WINDOW, columns[j] + n % WINDOW
                here[n] = good[y, x]
                uu[n] = u[y, x] if here[n] else 0.0
                aa[n] = amplitude[y, x] if here[n] else 0.0
                if here[n]:
                    total += 1
                    noise += sigma[y, x] ** 2
                    wanted |= asked[y, x]
            if not wanted or total < _FEWEST * size:
                continue
            noise /= total
            usual = _smooth(uu, here, each, weights, cu, place, off)
            total = int(weights.sum())
            if usual > _ROUGH_PX or total < _FEWEST * size:
                continue
            fit_surface(aa, weights, each, cb)
            values_of(cb, each, level)
            tapered = 0.0
            for n in range(size):
                tapered += weights[n] * taper[n // WINDOW, n % WINDOW] ** 2
                for t in range(count):
                    there[t, n] = z[t, rows[i] + n // WINDOW, columns[j] + n % WINDOW]
            found = 0
            while True:
                for _ in range(_SETTLING if found else 1):
                    _rest(there, frequency, gain, place, level, weights, found, v, down, across, rest)
                    _settle(
                        frequency,
                        gain,
                        each,
                        weights,
                        total,
                        found,
                        v,
                        down,
                        across,
                        rest,
                        du,
                        off,
                        cu,
                        cb,
                        change,
                        level,
                    )
                    values_of(cu, each, place)
                    values_of(cb, each, level)
                if found == MOST_WAVES:
                    break
                _rest(there, frequency, gain, place, level, weights, found, v, down, across, rest)
                power, ky, kx = _strongest(rest, weights, taper, table, groups)
                if power < _LEAST_POWER * noise * tapered * count / GROUPS:
                    break
                power, ky, kx = _sharpened(rest, ratio, total, ky, kx, down[found], across[found], v[found])
                at, explained, none = _place(v[found], frequency, gain, middle, reach)
                if abs(at) < _NEAREST_PX or (explained - none) * total < _LEAST_LEAD * noise:
                    break
                if explained < _CLEAREST_SHARE * power or explained < gg * (_LEAST_RATIO * cb[0]) ** 2:
                    break
                turns[i, j, found, 0], turns[i, j, found, 1] = ky, kx
                found += 1
            known[i, j] = 1 + found
            surface[i, j] = cu
            vectors[i, j, :found] = v[:found]
