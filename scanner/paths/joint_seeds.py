"""Where the joint separation starts: hypotheses of both paths on both axes; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; the other is *across*. A fit of two paths along, with the
place across that the line gives to its direct one, is a hypothesis; so is a fit across whose direct path lies near the
line, with two paths of its amplitudes along. Which distance these have is sought on the moduli alone, which do not
depend on where the pair is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.folding import COLUMNS, fold, sums
from scanner.paths.joint_place import ORDERS, lone_path, order_turns, wave_of
from scanner.paths.rotation import compiled, rotation

Floats = NDArray[np.float32]
Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]
Numbers = NDArray[np.intp]
SeedWorkspace = tuple[
    Phasors, Phasors, Phasors, Reals, Reals, Reals, Reals, Reals, Reals, Phasors, Phasors
]  # fmt: skip

PAIRS = 4
"""Pairs of places along the line that are kept of those with the amplitudes of one fit across."""
_NEAR_LINE_PX, _NEAR_LINE_SIGMAS = 3.0, 6.0
"""How far from the line a fit of the axis across may lie and still be tried."""
_APART_PX = 80.0
"""Distances of the paths along the line up to which they are sought with amplitudes from across it, px."""
_HOPELESS_CHI2 = 35.0
"""χ² above the best from which a distance or a fit across is hopeless."""
_DISTANCE_STEPS = 2
"""Gauss-Newton steps of a distance: it is refined again."""
_SAME_PX = 2.0
"""Starts this near to each other in all places lead to one and the same fit."""


def seed_workspace(count_a: int, count_b: int, comb: Reals) -> SeedWorkspace:
    """Arrays that `seed_block` works in, of so many frequencies along and across; one set a thread."""
    return (
        np.empty(count_a, np.complex128),
        np.empty(count_b, np.complex128),
        np.empty(max(count_a, count_b), np.complex128),
        np.empty((2, count_a)),
        np.empty(count_a),
        np.empty(count_b),
        np.empty((PAIRS, 4)),
        np.empty((PAIRS, 3)),
        np.empty((count_a // 2 + 2, COLUMNS)),
        order_turns(count_a, comb[0], comb[1]),
        order_turns(count_b, comb[2], comb[3]),
    )


@compiled  # pragma: no cover
def _rest(
    zb: Phasors, gb: Reals, comb: Reals, turns: Phasors, u1: float, a1: float, low: float, high: float, left: Phasors
) -> Any:  # fmt: skip
    """Place and amplitude of the one path in what the path (u₁, a₁) leaves of an axis; amplitude 0 where none is."""
    left = left[: zb.size]
    wave_of(u1, comb[2], comb[3], left)
    lag, total = 0j, gb[0]
    left[0] = zb[0] - a1 * left[0]
    for t in range(1, zb.size):
        left[t] = zb[t] - a1 * left[t]
        total += gb[t]
        lag += gb[t] * (left[t] * left[t - 1].conjugate())
    place, most = lone_path(left, gb, lag, comb[2], comb[3], turns, ORDERS, low, high)
    return place, max(most, 0.0) / total


@compiled  # pragma: no cover
def _pair_at(
    ya: Phasors, ga: Reals, folded: Reals, comb: Reals, turns: Phasors, a1: float, a2: float, apart: float, low: float,
    high: float, left: Phasors,
) -> Any:  # fmt: skip
    """Places of two paths of known amplitudes that are about ``apart`` from each other, and their χ²."""
    left = left[: ya.size]
    wave_of(apart, comb[0], comb[1], left)
    lag = 0j
    left[0] = ya[0] * (a1 + a2 * left[0]).conjugate()
    for t in range(1, ya.size):
        left[t] = ya[t] * (a1 + a2 * left[t]).conjugate()
        lag += ga[t] * (left[t] * left[t - 1].conjugate())
    u1, _ = lone_path(left, ga, lag, comb[0], comb[1], turns, 1, low, high)
    u2, last = u1 + apart, folded.shape[0] - 1
    power, s0, s2 = folded[last, 0], folded[last, 1], folded[last, 2]
    c1, c2, f1, f2, m0, m1, m2 = sums(folded, u1, u2)
    chi2 = power + (a1 * a1 + a2 * a2) * s0 + 2 * (a1 * a2 * m0 - a1 * c1 - a2 * c2)
    n11, n12, n22 = a1 * a1 * s2, a1 * a2 * m2, a2 * a2 * s2
    s1, s2 = a1 * (f1 - a2 * m1), a2 * (f2 + a1 * m1)
    # One Gauss-Newton step, half a radian at most, and what it promises.
    inverse = 1 / (n11 * n22 * (1 + 1e-3) - n12 * n12)
    d1, d2 = inverse * (n22 * s1 - n12 * s2), inverse * (n11 * s2 - n12 * s1)
    shorten = 1 / max(1.0, 2 * comb[0] * max(abs(d1), abs(d2)))
    gain = shorten * (2 - shorten) * (s1 * d1 + s2 * d2)
    return u1 + shorten * d1, u2 + shorten * d2, chi2 - gain


@compiled  # pragma: no cover
def _distance(power: Reals, weight: Reals, comb: Reals, a1: float, a2: float, sigma_a2: float, apart: float) -> Any:
    """Distance near ``apart`` and second amplitude near a₂ that the squared moduli say, and their χ².

    The squares are a₁² + a₂² + 2a₁a₂ cos ω_t d. ``sigma_a2`` is the relative standard deviation of the a₂ given;
    ``weight`` (T,) one over the variance of ``power``.
    """
    omega0, step = comb[0], comb[1]
    chi2, prior = math.inf, 1 / (sigma_a2 * a2) ** 2
    d, b = apart, a2
    for _ in range(_DISTANCE_STEPS):
        e, turn = rotation(omega0 * d), rotation(step * d)
        off, omega = a2 - b, omega0
        chi2, n11, n12, n22, s1, s2 = prior * off * off, 0.0, 0.0, prior, 0.0, prior * off
        constant, mixed = a1 * a1 + b * b, 2 * a1 * b
        for t in range(power.size):
            w, off = weight[t], power[t] - constant - mixed * e.real
            by_d, by_b = -mixed * omega * e.imag, 2 * (b + a1 * e.real)
            chi2 += w * off * off
            n11 += w * by_d * by_d
            n12 += w * by_d * by_b
            n22 += w * by_b * by_b
            s1 += w * by_d * off
            s2 += w * by_b * off
            e *= turn
            omega += step
        # Where the moduli are extreme they say little of the distance: half a radian at most.
        n11 += 1e-3 * n22 * (a1 * omega0) ** 2
        inverse = 1 / (n11 * n22 - n12 * n12)
        step_d, step_b = inverse * (n22 * s1 - n12 * s2), inverse * (n11 * s2 - n12 * s1)
        chi2 -= s1 * step_d + s2 * step_b
        d += max(-0.5 / omega0, min(step_d, 0.5 / omega0))
        b = max(0.5 * b, min(b + step_b, 2 * b))
    return d, b, chi2


@compiled  # pragma: no cover
def _pairs(
    ya: Phasors, ga: Reals, folded: Reals, comb: Reals, turns: Phasors, a1: float, bounce: float, sigma_bounce: float,
    low: float, high: float, left: Phasors, moduli: Reals, distances: Reals, found: Reals,
) -> None:  # fmt: skip
    """Places u₁, u₂ along the line for two paths of amplitudes a₁ and about ``bounce``.

    ``found`` (PAIRS, 4) gets the likeliest: χ², u₁, u₂, a₂. ``left`` (T,), ``moduli`` (2, T), ``distances`` (PAIRS, 3)
    are workspace.
    """
    middle = ya.size // 2
    fringe = 2 * math.pi / (comb[0] + middle * comb[1])
    power, weight = moduli[0], moduli[1]
    for t in range(ya.size):
        square = ya[t].real * ya[t].real + ya[t].imag * ya[t].imag
        power[t], weight[t] = square - 2 / ga[t], 0.25 * ga[t] / (square + 1 / ga[t])
    for j in range(PAIRS):
        found[j, 0], distances[j, 0] = math.inf, math.inf
    # The modulation in the middle of the comb leaves the distance open by whole fringes, and its sense.
    cosine = max(-0.95, min((power[middle] - a1 * a1 - bounce * bounce) / (2 * a1 * bounce), 0.95))
    offset = fringe * math.acos(cosine) / (2 * math.pi)
    for number in range(2 * int(_APART_PX / fringe) + 1):
        apart = (number + 1) // 2 * fringe + (-offset if number % 2 else offset)
        d, a2, chi2 = _distance(power, weight, comb, a1, bounce, sigma_bounce, apart)
        place = PAIRS
        while place > 0 and chi2 < distances[place - 1, 0]:
            place -= 1
        if place < PAIRS and chi2 < distances[0, 0] + _HOPELESS_CHI2:
            for j in range(PAIRS - 1, place, -1):
                for m in range(3):
                    distances[j, m] = distances[j - 1, m]
            distances[place, 0], distances[place, 1], distances[place, 2] = chi2, d, a2
    for number in range(2 * PAIRS):
        least, a2 = distances[number // 2, 0], distances[number // 2, 2]
        if not least < min(distances[0, 0], found[0, 0]) + _HOPELESS_CHI2:
            break
        apart = -distances[number // 2, 1] if number % 2 else distances[number // 2, 1]
        u1, u2, chi2 = _pair_at(ya, ga, folded, comb, turns, a1, a2, apart, low, high, left)
        if not (low <= u1 < high and low <= u2 < high):
            continue
        place = PAIRS - 1
        for j in range(PAIRS):
            # Neighbours of a pair that is kept already lead to the same place.
            if found[j, 0] < math.inf and abs(u1 - found[j, 1]) < 1 and abs(u2 - found[j, 2]) < 1:
                place = j
                break
        if not chi2 < found[place, 0]:
            continue
        while place > 0 and chi2 < found[place - 1, 0]:
            for m in range(4):
                found[place, m] = found[place - 1, m]
            place -= 1
        found[place, 0], found[place, 1], found[place, 2], found[place, 3] = chi2, u1, u2, a2


@compiled  # pragma: no cover
def _known(thetas: Reals, count: int) -> bool:
    """Whether the hypothesis ``thetas[count]`` is one of those before it."""
    for h in range(count):
        away = 0.0
        for k in (0, 1, 4, 5):
            away = max(away, abs(thetas[h, k] - thetas[count, k]))
        if away < _SAME_PX:
            return True
    return False


@compiled  # pragma: no cover
def seed_block(
    za: NDArray[np.complex64], zb: NDArray[np.complex64], sigma_a: Reals, sigma_b: Reals, gain_a: Reals, gain_b: Reals,
    comb: Reals, low_a: float, high_a: float, low_b: float, high_b: float, numbers: Numbers, fits: Floats,
    other: Reals, slopes: Reals, fits_across: Floats, prior: Reals, start: int, work: SeedWorkspace, seeds: Reals,
    lines: Reals, bounds: Reals,
) -> None:  # fmt: skip
    """Hypotheses of the pixels ``numbers`` (n,), of which ``fits_across`` holds those from ``start`` on.

    ``seeds`` (n, most, 8) get u₁, u₂, a₁, a₂ along and across, path 1 direct; ``lines`` (n, most, 3) a place along, the
    place across that the line gives to it, and the line's slope; ``bounds`` (n, most) what χ² will hardly fall below,
    infinite where there is no more hypothesis.
    """
    count_a, count_b, kinds, kinds_across = za.shape[0], zb.shape[0], fits.shape[0], fits_across.shape[0]
    ya, yb, left, moduli, ga, gb, pairs, distances, folded, turns_a, turns_b = work
    kappa = math.exp(prior[4])
    for n in range(numbers.size):
        p, q = numbers[n], start + n
        for t in range(count_a):
            ya[t], ga[t] = (1 / gain_a[t]) * za[t, p], (gain_a[t] / sigma_a[p]) ** 2
        for t in range(count_b):
            yb[t], gb[t] = (1 / gain_b[t]) * zb[t, p], (gain_b[t] / sigma_b[p]) ** 2
        tried = 0
        for h in range(bounds.shape[1]):
            bounds[n, h] = math.inf
        for k in range(kinds):
            for i in range(2):
                place = other[2 * k + i, p]
                if not (low_b - 1 <= place < high_b + 1):
                    continue
                theta = seeds[n, tried]
                theta[0], theta[1] = fits[k, i, p], fits[k, 1 - i, p]
                theta[2], theta[3] = fits[k, 2 + i, p], fits[k, 3 - i, p]
                theta[4], theta[6] = place, kappa * theta[2]
                theta[5], rest = _rest(yb, gb, comb, turns_b, place, theta[6], low_b, high_b, left)
                theta[7] = max(rest, 0.1 * kappa * theta[3])
                lines[n, tried, 0], lines[n, tried, 1], lines[n, tried, 2] = theta[0], place, slopes[2 * k + i, p]
                # Both axes together cannot fit better than this one alone.
                bounds[n, tried] = fits[k, 7, p]
                tried += 1
        if kinds_across > 0:
            fold(ya, gain_a, sigma_a[p], comb[0], comb[1], folded)
        for k in range(kinds_across):
            for i in range(2):
                b1, b2 = fits_across[k, 2 + i, q], fits_across[k, 3 - i, q]
                allowed = _NEAR_LINE_PX + _NEAR_LINE_SIGMAS * (prior[3] + fits_across[k, 4 + i, q])
                if not (fits_across[k, 7, q] < fits_across[0, 7, q] + _HOPELESS_CHI2 and b1 > 0):
                    continue
                off = math.inf
                for m in range(other.shape[0]):
                    if math.isfinite(other[m, p]):
                        off = min(off, abs(fits_across[k, i, q] - other[m, p]) - _APART_PX * abs(slopes[m, p]))
                if not off < allowed:
                    continue
                _pairs(
                    ya, ga, folded, comb, turns_a, b1 / kappa, b2 / kappa, prior[6], low_a, high_a, left, moduli,
                    distances, pairs,
                )  # fmt: skip
                for j in range(PAIRS):
                    # The line through the place nearest to where it is known.
                    nearest, apart = -1, math.inf
                    for m in range(other.shape[0]):
                        off = abs(fits[m // 2, m % 2, p] - pairs[j, 1])
                        if math.isfinite(other[m, p]) and off < apart:
                            nearest, apart = m, off
                    if not pairs[j, 0] < pairs[0, 0] + _HOPELESS_CHI2 or nearest < 0:
                        continue
                    there, s = fits[nearest // 2, nearest % 2, p], slopes[nearest, p]
                    place = other[nearest, p] + s * (pairs[j, 1] - there)
                    if not abs(fits_across[k, i, q] - place) < allowed * math.sqrt(1 + s * s):
                        continue
                    theta = seeds[n, tried]
                    theta[0], theta[1], theta[2], theta[3] = pairs[j, 1], pairs[j, 2], b1 / kappa, pairs[j, 3]
                    theta[4], theta[5], theta[6], theta[7] = fits_across[k, i, q], fits_across[k, 1 - i, q], b1, b2
                    if _known(seeds[n], tried):
                        continue
                    lines[n, tried, 0], lines[n, tried, 1], lines[n, tried, 2] = theta[0], place, s
                    bounds[n, tried] = fits_across[k, 7, q]
                    tried += 1
