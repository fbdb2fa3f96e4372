"""The compiled inner loops of decoding, each with a plain NumPy twin that the tests compare it with.

Kernels release the GIL and work on a range of pixels; `over_pixels` spreads them over the cores. Run as a program
(``python -m scanner.kernels``) this module compiles them all into Numba's cache, so that no scan waits for it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drivers import Pixels

CHUNK = 512
"""Pixels whose working set stays in the first-level cache."""

# NaN and infinity keep their meaning; sums may be reordered, which is what vectorises them.
_FAST = {"reassoc", "contract", "arcp", "nsz"}

_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
_POOL = ThreadPoolExecutor(_CORES, thread_name_prefix="pixels")


def over_pixels(kernel: Callable[[int, int], object], count: int) -> None:
    """Call ``kernel(start, stop)`` for blocks that cover ``range(count)``, on all cores; raises what a block raised."""
    block = max(64 * CHUNK, -(-count // (4 * _CORES)))
    block += -block % CHUNK
    list(_POOL.map(lambda start: kernel(start, min(start + block, count)), range(0, count, block)))


def over_rows(kernel: Callable[[int, int], object], count: int) -> None:
    """Call ``kernel(start, stop)`` for bands that cover ``range(count)``, on all cores; raises what a band raised."""
    band = max(1, -(-count // (2 * _CORES)))
    list(_POOL.map(lambda start: kernel(start, min(start + band, count)), range(0, count, band)))


@njit(inline="always")
def sin_cos_turns(turns):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """sin(2πx) and cos(2πx) for |x| below some thousand turns, to 2e-7; polynomials, so that loops vectorise."""
    x = turns - np.float32(np.floor(turns + np.float32(0.5)))  # -1/2 .. 1/2
    # Fold to a quarter turn: sin(2πx) = sin(2π(±1/2 - x)), and the cosine changes sign.
    far = abs(x) > np.float32(0.25)
    y = np.copysign(np.float32(0.5), x) - x if far else x
    sign = np.float32(-1.0) if far else np.float32(1.0)
    y2 = y * y
    s = y * (
        np.float32(6.2831853)
        + y2
        * (
            np.float32(-41.341702)
            + y2
            * (
                np.float32(81.605249)
                + y2 * (np.float32(-76.705859) + y2 * (np.float32(42.058694) + y2 * np.float32(-15.094643)))
            )
        )
    )
    c = np.float32(1.0) + y2 * (
        np.float32(-19.739209)
        + y2
        * (
            np.float32(64.939394)
            + y2
            * (
                np.float32(-85.456817)
                + y2 * (np.float32(60.244641) + y2 * (np.float32(-26.426257) + y2 * np.float32(7.903536)))
            )
        )
    )
    return s, sign * c


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _demodulate(frames, solve, model, saturated_dn, z, mean, residual, saturated, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Least squares of I_n = A + Re(z e^{iφ_n}) for pixels start..stop; see `demodulate_twin`."""
    steps = frames.shape[0]
    a = np.empty(CHUNK, np.float32)
    c = np.empty(CHUNK, np.float32)
    s = np.empty(CHUNK, np.float32)
    r = np.empty(CHUNK, np.float32)
    top = np.empty(CHUNK, np.float32)
    for first in range(start, stop, CHUNK):
        m = min(CHUNK, stop - first)
        a[:] = 0
        c[:] = 0
        s[:] = 0
        r[:] = 0
        top[:] = 0
        for n in range(steps):
            # A view from zero: an index with an offset may be negative for all the compiler knows, and hinders it.
            row = frames[n, first : first + m]
            wa, wc, ws = solve[0, n], solve[1, n], solve[2, n]
            for j in range(m):
                value = np.float32(row[j])
                a[j] += wa * value
                c[j] += wc * value
                s[j] += ws * value
                top[j] = value if value > top[j] else top[j]
        for n in range(steps):
            row = frames[n, first : first + m]
            mc, ms = model[1, n], model[2, n]
            for j in range(m):
                off = np.float32(row[j]) - a[j] - mc * c[j] - ms * s[j]
                r[j] += off * off
        z_here, mean_here = z[first : first + m], mean[first : first + m]
        residual_here, saturated_here = residual[first : first + m], saturated[first : first + m]
        for j in range(m):
            z_here[j] = np.complex64(complex(c[j], s[j]))
            mean_here[j] += a[j]
            residual_here[j] += r[j]
            saturated_here[j] |= top[j] >= saturated_dn


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _unwrap(z, reference, frequency, gain, sigma_z, table, low, high, u, sigma_u, amplitude, chi2, lead, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Maximum-likelihood coordinate for pixels start..stop; see `unwrap_twin`."""
    count = frequency.size
    orders = table.shape[0]
    period = np.float32(1.0) / frequency[reference]
    two_pi = np.float32(2 * np.pi)
    gain_energy = np.float32(0.0)
    information = np.float32(0.0)
    for t in range(count):
        gain_energy += gain[t] * gain[t]
        information += gain[t] * gain[t] * frequency[t] * frequency[t]
    yr = np.empty((count, CHUNK), np.float32)
    yi = np.empty((count, CHUNK), np.float32)
    u0, score, slope, curve, best, second, order, shift, step = np.empty((9, CHUNK), np.float32)
    for first in range(start, stop, CHUNK):
        m = min(CHUNK, stop - first)
        finest = z[reference, first : first + m]
        for j in range(m):
            turn = np.float32(np.arctan2(finest[j].imag, finest[j].real)) / two_pi
            u0[j] = (turn if turn >= 0 else turn + np.float32(1.0)) * period
        curve[:] = np.float32(1e-30)
        # Turn every phasor back by the phase it would have at u0: what is left differs by the fringe order only.
        for t in range(count):
            here, re, im, f = z[t, first : first + m], yr[t], yi[t], frequency[t]
            for j in range(m):
                s, c = sin_cos_turns(f * u0[j])
                zr, zi = here[j].real, here[j].imag
                re[j] = zr * c + zi * s
                im[j] = zi * c - zr * s
                curve[j] += np.float32(2.0) * f * f * np.sqrt(zr * zr + zi * zi)
        for j in range(m):
            curve[j] = np.float32(1.0) / curve[j]
        best[:] = -np.inf
        second[:] = -np.inf
        order[:] = 0
        for k in range(orders):
            score[:] = 0
            slope[:] = 0
            # Few arrays per loop: with more, the compiler gives up proving that they do not overlap.
            for t in range(count):
                x, y, c, s, f = yr[t], yi[t], table[k, t, 0], table[k, t, 1], frequency[t]
                fc, fs = f * c, f * s
                for j in range(m):
                    score[j] += x[j] * c + y[j] * s
                    slope[j] += y[j] * fc - x[j] * fs
            offset = np.float32(k - 1) * period
            number = np.float32(k)
            for j in range(m):
                place = u0[j] + offset
                # The height of the likelihood's parabola beside the candidate: one phase alone places it too roughly.
                peak = score[j] + slope[j] * slope[j] * curve[j]
                score[j] = peak if (place >= low and place < high) else np.float32(-np.inf)
            for j in range(m):
                value, leader = score[j], best[j]
                rival = min(value, leader)
                second[j] = max(second[j], rival)
                order[j] = number if value > leader else order[j]
                best[j] = max(value, leader)
        slope[:] = 0
        curve[:] = 0
        shift[:] = 0
        for t in range(count):
            re, im, turns, f = yr[t], yi[t], table[:, t], frequency[t]
            for j in range(m):
                row = np.uint32(order[j])
                c, s = turns[row, 0], turns[row, 1]
                x, y = re[j] * c + im[j] * s, im[j] * c - re[j] * s
                re[j] = x
                im[j] = y
                slope[j] += f * y
                curve[j] += f * f * x
        # Two Newton steps on the likelihood; the angles are small, so a short series turns the phasors exactly enough.
        limit = np.float32(0.1) * period
        for _ in range(2):
            for j in range(m):
                raw = slope[j] / (two_pi * curve[j]) if curve[j] > 0 else np.float32(0.0)
                step[j] = min(max(raw, -limit), limit)
                shift[j] += step[j]
            slope[:] = 0
            curve[:] = 0
            for t in range(count):
                re, im, f = yr[t], yi[t], frequency[t]
                for j in range(m):
                    angle = two_pi * f * step[j]
                    a2 = angle * angle
                    c = np.float32(1.0) - a2 * (np.float32(0.5) - a2 * np.float32(1 / 24))
                    s = angle * (np.float32(1.0) - a2 * (np.float32(1 / 6) - a2 * np.float32(1 / 120)))
                    x, y = re[j] * c + im[j] * s, im[j] * c - re[j] * s
                    re[j] = x
                    im[j] = y
                    slope[j] += f * y
                    curve[j] += f * f * x
        strength, misfit = score, step
        strength[:] = 0
        misfit[:] = 0
        for t in range(count):
            re, g = yr[t], gain[t] / gain_energy
            for j in range(m):
                strength[j] += g * re[j]
        for j in range(m):
            strength[j] = max(strength[j], np.float32(0.0))
        for t in range(count):
            re, im, g = yr[t], yi[t], gain[t]
            for j in range(m):
                off = re[j] - strength[j] * g
                misfit[j] += off * off + im[j] * im[j]
        noise = sigma_z[first : first + m]
        u_here, sigma_here, amplitude_here = (
            u[first : first + m],
            sigma_u[first : first + m],
            amplitude[first : first + m],
        )
        chi2_here, lead_here = chi2[first : first + m], lead[first : first + m]
        spread = np.float32(1.0) / (two_pi * np.sqrt(information))
        for j in range(m):
            variance = noise[j] * noise[j]
            u_here[j] = u0[j] + (order[j] - np.float32(1.0)) * period + shift[j]
            amplitude_here[j] = strength[j]
            sigma_here[j] = spread * noise[j] / strength[j] if strength[j] > 0 else np.float32(np.inf)
            chi2_here[j] = misfit[j] / variance
            rival = max(second[j], np.float32(0.0))
            gap = best[j] * best[j] - rival * rival
            lead_here[j] = gap / (np.float32(2 * count) * variance) if best[j] > 0 else np.float32(0.0)


def demodulation_matrices(steps_rad: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least-squares solution and model matrices of I_n = A + Re(z e^{iφ_n}), each (3, N) in the order A, Re z, Im z.

    Raises
    ------
    ValueError
        The steps do not determine mean, modulation and phase.
    """
    model = np.stack([np.ones_like(steps_rad), np.cos(steps_rad), -np.sin(steps_rad)])
    if steps_rad.size < 3 or np.linalg.cond(model) > 1e3:
        raise ValueError(f"the steps {np.degrees(steps_rad).round(1)}° do not determine mean, modulation and phase")
    return np.linalg.pinv(model.T).astype(np.float32), model.astype(np.float32)


def demodulate(
    frames: Pixels,
    steps_rad: NDArray[np.float64],
    saturated_dn: int,
    z: NDArray[np.complex64],
    mean: NDArray[np.float32],
    residual: NDArray[np.float32],
    saturated: NDArray[np.bool_],
) -> None:
    """Phasors of one sequence of P pixels, written in place.

    Parameters
    ----------
    frames
        (N, P) uint8 or uint16, C-contiguous.
    steps_rad
        (N,) phase steps, rad.
    saturated_dn
        Grey value from which a pixel is saturated.
    z
        (P,) set to B e^{i2πfu}.
    mean, residual
        (P,) increased by A and by the sum of squared residuals (DN²; N - 3 degrees of freedom).
    saturated
        (P,) set where a frame is saturated.
    """
    solve, model = demodulation_matrices(steps_rad)
    over_pixels(
        lambda a, b: _demodulate(frames, solve, model, np.float32(saturated_dn), z, mean, residual, saturated, a, b),
        frames.shape[1],
    )


def demodulate_twin(
    frames: Pixels, steps_rad: NDArray[np.float64], saturated_dn: int
) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Plain NumPy twin of `demodulate`: z, mean, residual, saturated."""
    model = np.stack([np.ones_like(steps_rad), np.cos(steps_rad), -np.sin(steps_rad)], axis=1)
    values = frames.astype(np.float64)
    found = np.linalg.lstsq(model, values, rcond=None)[0]
    residual = ((values - model @ found) ** 2).sum(axis=0)
    saturated = np.asarray((frames >= saturated_dn).any(axis=0))
    return np.asarray(found[1] + 1j * found[2]), found[0], np.asarray(residual), saturated


def order_table(frequency: NDArray[np.float64], low: float, high: float) -> NDArray[np.float32]:
    """Phasors (orders, T, 2) by which fringe order k - 1 of the highest frequency turns every frequency."""
    period = 1 / frequency.max()
    orders = np.arange(-1, int(np.ceil((high - low) / period)) + 1)
    angle = 2 * np.pi * np.outer(orders * period, frequency)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


def unwrap(
    z: NDArray[np.complex64],
    frequency: NDArray[np.float64],
    gain: NDArray[np.float64],
    sigma_z: NDArray[np.float32],
    low: float,
    high: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """One-path maximum-likelihood coordinate: argmax_u Re Σ_t z_t e^{-i2πf_t u} over low ≤ u < high.

    Every fringe order of the highest frequency is tried, then two Newton steps end at the maximum.

    Parameters
    ----------
    z
        (T, P) phasors.
    frequency
        (T,) 1/px.
    gain
        (T,) modulation of each frequency relative to the others (projector and camera MTF).
    sigma_z
        (P,) standard deviation of Re z and of Im z, DN.
    low, high
        Range of u, px.

    Returns
    -------
    u, sigma_u
        (P,) px.
    amplitude
        (P,) DN.
    chi2
        (P,) misfit with 2T - 2 degrees of freedom.
    lead
        (P,) log-likelihood ratio of the best against the second-best fringe order.
    """
    pixels = z.shape[1]
    results = tuple(np.empty(pixels, np.float32) for _ in range(5))
    u, sigma_u, amplitude, chi2, lead = results
    table = order_table(frequency, low, high)
    reference = int(frequency.argmax())
    f32, g32 = frequency.astype(np.float32), gain.astype(np.float32)
    over_pixels(
        lambda a, b: _unwrap(
            z,
            reference,
            f32,
            g32,
            sigma_z,
            table,
            np.float32(low),
            np.float32(high),
            u,
            sigma_u,
            amplitude,
            chi2,
            lead,
            a,
            b,
        ),
        pixels,
    )
    return u, sigma_u, amplitude, chi2, lead


def unwrap_twin(
    z: NDArray[np.complex128],
    frequency: NDArray[np.float64],
    gain: NDArray[np.float64],
    sigma_z: NDArray[np.float64],
    low: float,
    high: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Plain NumPy twin of `unwrap` in double precision."""
    reference = int(frequency.argmax())
    period = 1 / frequency[reference]
    u0 = np.angle(z[reference]) % (2 * np.pi) / (2 * np.pi) * period
    orders = np.arange(-1, int(np.ceil((high - low) / period)) + 1)
    candidates = u0 + orders[:, None] * period
    c = z[:, None] * np.exp(-2j * np.pi * frequency[:, None, None] * candidates)
    f = frequency[:, None, None]
    score = c.real.sum(0) + (f * c.imag).sum(0) ** 2 / (2 * f**2 * np.abs(c)).sum(0)
    score = np.where((candidates >= low) & (candidates < high), score, -np.inf)
    ranked = np.sort(score, axis=0)
    best, second = ranked[-1], np.maximum(ranked[-2], 0)
    u = np.take_along_axis(candidates, score.argmax(axis=0)[None], axis=0)[0]
    f = frequency[:, None]
    for _ in range(2):
        c = z * np.exp(-2j * np.pi * f * u)
        u = u + np.clip((f * c.imag).sum(0) / (2 * np.pi * (f**2 * c.real).sum(0)), -0.1 * period, 0.1 * period)
    c = z * np.exp(-2j * np.pi * f * u)
    g = gain[:, None]
    amplitude = np.maximum((g * c.real).sum(0) / (g**2).sum(), 0)
    chi2 = ((c.real - amplitude * g) ** 2 + c.imag**2).sum(0) / sigma_z**2
    sigma_u = sigma_z / (2 * np.pi * amplitude * np.sqrt((g**2 * f**2).sum()))
    return u, sigma_u, amplitude, chi2, (best**2 - second**2) / (2 * len(frequency) * sigma_z**2)


def compile_all() -> float:
    """Compile every kernel of the package, for 8- and 16-bit frames, into the cache; returns the seconds it took."""
    began = time.perf_counter()
    from scanner import cloud, faces, paths, pooling, ripples, strays, triangulation

    few = np.ones((9, 4), np.complex64)
    paths.separate_two_paths(few, np.array([(80 + t) / 1280 for t in range(9)]), np.ones(4, np.float32), 1280)
    paths.compile_all()
    triangulation.compile_all()
    cloud.grid_normals(np.ones((1, 1, 3), np.float32), np.ones((1, 1), np.float32))
    steps = 2 * np.pi * np.arange(4) / 4
    z = np.zeros((3, 8), np.complex64)
    for dtype in (np.uint8, np.uint16):
        frames = np.zeros((4, 8), dtype)
        demodulate(frames, steps, 255, z[0], np.zeros(8, np.float32), np.zeros(8, np.float32), np.zeros(8, bool))
    unwrap(z, np.array([1 / 16, 1 / 17, 1 / 18]), np.ones(3), np.ones(8, np.float32), -0.5, 63.5)
    pooling.compile_all()
    ripples.compile_all()
    faces.compile_all()
    strays.strays(np.ones((3, 3), np.float32), None)
    return time.perf_counter() - began


if __name__ == "__main__":
    print(f"compiled the kernels in {compile_all():.1f} s")
