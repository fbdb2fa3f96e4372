"""The compiled inner loops of the joint separation of both axes; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; its fits are the hypotheses. The other axis is *across*.
All kernels live in this one file because Numba's cache looks at a kernel's own file only.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

FIELDS = 17
"""Of a hypothesis: u₁, u₂, a₁, a₂ along the line and across it, the σ of all eight, χ²."""
ROWS = 2 * FIELDS + 1
"""Of a pixel's result: the best hypothesis, its rival, and half the difference of their scores."""

_FIRST_STEPS = 3
"""Levenberg-Marquardt steps after which hopeless hypotheses are given up."""
_HOPELESS_CHI2 = 60.0
"""Excess over the best hypothesis from which one is hopeless."""
_STEPS = 12
"""Further steps at most; two or three are usual."""
_CONVERGED_CHI2 = 1e-3
"""A step that lowers χ² by less ends a refinement: it moves no coordinate by more than 1/30 of its σ."""
_ORDERS = 2
"""Fringe orders tried to either side of what the pole of the rest says."""
_VISIBLE_SIGMAS = 5.0
"""A direct path that is weaker than this is none."""
_SAME_PX = 0.5
"""Direct places nearer than this are one place, whatever the bounce is."""
_NEAR_LINE_PX, _NEAR_LINE_SIGMAS = 3.0, 6.0
"""How far from the line a fit of the axis across may lie and still be tried."""
_APART_PX = 80.0
"""Distances of the paths along the line up to which they are sought with amplitudes from across it, px."""
_PAIRS = 4
"""Of these, so many are kept."""
_TINY = 1e-300

_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


@_compiled  # pragma: no cover
def _turn(angle: float) -> complex:
    return complex(math.cos(angle), math.sin(angle))


@_compiled  # pragma: no cover
def _axis_normal(
    y: Phasors, g: Reals, omega0: float, step: float, theta: Reals, first: int, normal: Reals, slope: Reals
) -> float:
    """Add the data of one axis to the normal equations; returns its χ².

    ``theta[first:first + 4]`` are u₁, u₂, a₁, a₂; ``y`` (T,) the phasors over trend and noise, ``g`` (T,) the weights.
    """
    u1, u2, a1, a2 = theta[first], theta[first + 1], theta[first + 2], theta[first + 3]
    e1, turn1 = _turn(omega0 * u1), _turn(step * u1)
    e2, turn2 = _turn(omega0 * u2), _turn(step * u2)
    chi2 = 0.0
    n00 = n01 = n03 = n11 = n12 = n22 = n23 = 0.0
    s0 = s1 = s2 = s3 = 0.0
    for t in range(y.size):
        w, omega = g[t], omega0 + t * step
        off = y[t] - a1 * e1 - a2 * e2
        chi2 += w * (off.real * off.real + off.imag * off.imag)
        # In turned coordinates: what is along a path changes its amplitude, what is across its place.
        q1, q2, p = e1.conjugate() * off, e2.conjugate() * off, e1.conjugate() * e2
        wo = w * omega
        s0 += wo * q1.imag
        s1 += wo * q2.imag
        s2 += w * q1.real
        s3 += w * q2.real
        n00 += wo * omega
        n01 += wo * omega * p.real
        n03 += wo * p.imag
        n22 += w
        n23 += w * p.real
        e1 *= turn1
        e2 *= turn2
    n11, n12 = n00, -n03
    i, j, k, m = first, first + 1, first + 2, first + 3
    normal[i, i] += a1 * a1 * n00
    normal[j, i] += a1 * a2 * n01
    normal[j, j] += a2 * a2 * n11
    # Re(conj(i ω a₁ e₁) e₂) = ω a₁ Im(conj(e₁) e₂), and the other way round.
    normal[m, i] += a1 * n03
    normal[k, j] += a2 * n12
    normal[k, k] += n22
    normal[m, k] += n23
    normal[m, m] += n22
    slope[i] += a1 * s0
    slope[j] += a2 * s1
    slope[k] += s2
    slope[m] += s3
    return chi2


@_compiled  # pragma: no cover
def _normal_equations(
    za: Phasors, ga: Reals, zb: Phasors, gb: Reals, comb: Reals, prior: Reals, theta: Reals, normal: Reals, slope: Reals
) -> float:  # fmt: skip
    """χ² of both axes and the priors, its Gauss-Newton matrix (lower half) and the negative half gradient.

    ``comb`` holds 2πf₀ and 2πΔf of the axis along and of the axis across. ``prior`` holds where the epipolar line is
    left, the place across there, the line's slope, its σ; ln κ; σ of the two log ratios of amplitudes.
    """
    for a in range(8):
        slope[a] = 0.0
        for b in range(a + 1):
            normal[a, b] = 0.0
    chi2 = _axis_normal(za, ga, comb[0], comb[1], theta, 0, normal, slope)
    chi2 += _axis_normal(zb, gb, comb[2], comb[3], theta, 4, normal, slope)
    weight = 1 / (prior[3] * prior[3])
    off = theta[4] - prior[1] - prior[2] * (theta[0] - prior[0])
    chi2 += weight * off * off
    normal[0, 0] += weight * prior[2] * prior[2]
    normal[4, 0] -= weight * prior[2]
    normal[4, 4] += weight
    slope[0] += weight * prior[2] * off
    slope[4] -= weight * off
    for k in range(2):
        a, b = theta[2 + k], theta[6 + k]
        weight = 1 / (prior[5 + k] * prior[5 + k])
        off = math.log(b / a) - prior[4]
        chi2 += weight * off * off
        normal[2 + k, 2 + k] += weight / (a * a)
        normal[6 + k, 2 + k] -= weight / (a * b)
        normal[6 + k, 6 + k] += weight / (b * b)
        slope[2 + k] += weight * off / a
        slope[6 + k] -= weight * off / b
    return float(chi2)


@_compiled  # pragma: no cover
def _factorise(normal: Reals, damping: float, factor: Reals) -> bool:
    """Cholesky factor of the matrix with its diagonal raised; False where it is not positive."""
    for a in range(8):
        for b in range(a + 1):
            s = normal[a, b]
            if a == b:
                s *= 1 + damping
            for c in range(b):
                s -= factor[a, c] * factor[b, c]
            if a == b:
                if not s > 1e-12 * normal[a, a]:
                    return False
                factor[a, a] = math.sqrt(s)
            else:
                factor[a, b] = s / factor[b, b]
    return True


@_compiled  # pragma: no cover
def _solve(factor: Reals, right: Reals, out: Reals) -> None:
    for a in range(8):
        s = right[a]
        for b in range(a):
            s -= factor[a, b] * out[b]
        out[a] = s / factor[a, a]
    for k in range(8):
        a = 7 - k
        s = out[a]
        for b in range(a + 1, 8):
            s -= factor[b, a] * out[b]
        out[a] = s / factor[a, a]


@_compiled  # pragma: no cover
def _improve(
    za: Phasors, ga: Reals, zb: Phasors, gb: Reals, comb: Reals, prior: Reals, theta: Reals, steps: int,
    work: Any,
) -> Any:  # fmt: skip
    """Levenberg-Marquardt from ``theta``, in place; returns χ² and whether the last step gained next to nothing."""
    normal, slope, factor, step, trial, normal2, slope2 = work
    damping, converged = 0.0, False
    chi2 = _normal_equations(za, ga, zb, gb, comb, prior, theta, normal, slope)
    for _ in range(steps):
        if not _factorise(normal, damping, factor):
            damping = max(10 * damping, 1e-3)
            continue
        _solve(factor, slope, step)
        shorten = 1.0
        for k in (0, 1, 4, 5):
            # A radian at most, so that no fringe order is left.
            shorten = min(shorten, 1 / max(1e-9, abs(step[k]) * comb[0 if k < 4 else 2]))
        for k in (2, 3, 6, 7):
            if step[k] < 0:
                shorten = min(shorten, -0.7 * theta[k] / step[k])
        for k in range(8):
            trial[k] = theta[k] + shorten * step[k]
        gained = _normal_equations(za, ga, zb, gb, comb, prior, trial, normal2, slope2)
        if gained <= chi2:
            converged = chi2 - gained < _CONVERGED_CHI2
            chi2 = gained
            for a in range(8):
                theta[a], slope[a] = trial[a], slope2[a]
                for b in range(a + 1):
                    normal[a, b] = normal2[a, b]
            damping *= 0.1
        else:
            converged = gained - chi2 < _CONVERGED_CHI2
            damping = max(10 * damping, 0.03)
        if converged:
            break
    return chi2, converged


@_compiled  # pragma: no cover
def _rest(zb: Phasors, gb: Reals, comb: Reals, u1: float, a1: float, low: float, high: float, left: Phasors) -> Any:
    """Place and amplitude of the one path in what the path (u₁, a₁) leaves of an axis; amplitude 0 where none is."""
    omega0, step = comb[2], comb[3]
    e, turn = _turn(omega0 * u1), _turn(step * u1)
    lag, total = 0j, 0.0
    for t in range(zb.size):
        left[t] = zb[t] - a1 * e
        total += gb[t]
        if t > 0:
            lag += gb[t] * (left[t] * left[t - 1].conjugate())
        e *= turn
    period = 2 * math.pi / step
    coarse = math.atan2(lag.imag, lag.real) / step
    coarse -= period * math.floor((coarse - 0.5 * (low + high)) / period + 0.5)
    centre = omega0 + 0.5 * (zb.size - 1) * step
    e, turn, c = _turn(-omega0 * coarse), _turn(-step * coarse), 0j
    for t in range(zb.size):
        c += gb[t] * (e * left[t])
        e *= turn
    fine = coarse + math.atan2(c.imag, c.real) / centre
    place, most = fine, 0.0
    for k in range(-_ORDERS, _ORDERS + 1):
        u = fine + k * 2 * math.pi / centre
        if not (low <= u < high):
            continue
        e, turn, s = _turn(-omega0 * u), _turn(-step * u), 0.0
        for t in range(zb.size):
            s += gb[t] * (e * left[t]).real
            e *= turn
        if s > most:
            place, most = u, s
    return place, most / total


@_compiled  # pragma: no cover
def _pair_at(
    ya: Phasors, ga: Reals, comb: Reals, a1: float, a2: float, apart: float, low: float, high: float, left: Phasors
) -> Any:  # fmt: skip
    """Places of two paths of known amplitudes that are about ``apart`` from each other, and their χ²."""
    omega0, step = comb[0], comb[1]
    centre, period = omega0 + 0.5 * (ya.size - 1) * step, 2 * math.pi / step
    e, turn, lag = _turn(omega0 * apart), _turn(step * apart), 0j
    for t in range(ya.size):
        left[t] = ya[t] * (a1 + a2 * e).conjugate()
        if t > 0:
            lag += ga[t] * (left[t] * left[t - 1].conjugate())
        e *= turn
    coarse = math.atan2(lag.imag, lag.real) / step
    coarse -= period * math.floor((coarse - 0.5 * (low + high)) / period + 0.5)
    e, turn, c = _turn(-omega0 * coarse), _turn(-step * coarse), 0j
    for t in range(ya.size):
        c += ga[t] * (e * left[t])
        e *= turn
    fine = coarse + math.atan2(c.imag, c.real) / centre
    u1, most = fine, -math.inf
    for k in range(-1, 2):
        u = fine + k * 2 * math.pi / centre
        e, turn, s = _turn(-omega0 * u), _turn(-step * u), 0.0
        for t in range(ya.size):
            s += ga[t] * (e * left[t]).real
            e *= turn
        if s > most and low <= u < high:
            u1, most = u, s
    u2 = u1 + apart
    v1, v2, chi2 = u1, u2, math.inf
    for _ in range(3):
        # Gauss-Newton, half a radian at most; the last turn only takes χ².
        u1, u2 = v1, v2
        e1, turn1, e2, turn2 = _turn(omega0 * u1), _turn(step * u1), _turn(omega0 * u2), _turn(step * u2)
        chi2 = n11 = n12 = n22 = s1 = s2 = 0.0
        for t in range(ya.size):
            off, w, omega = ya[t] - a1 * e1 - a2 * e2, ga[t], omega0 + t * step
            chi2 += w * (off.real * off.real + off.imag * off.imag)
            w *= omega
            s1 += w * a1 * (e1.conjugate() * off).imag
            s2 += w * a2 * (e2.conjugate() * off).imag
            w *= omega
            n11 += w * a1 * a1
            n22 += w * a2 * a2
            n12 += w * a1 * a2 * (e1.conjugate() * e2).real
            e1 *= turn1
            e2 *= turn2
        inverse = 1 / (n11 * n22 * (1 + 1e-3) - n12 * n12)
        d1, d2 = inverse * (n22 * s1 - n12 * s2), inverse * (n11 * s2 - n12 * s1)
        shorten = 1 / max(1.0, 2 * omega0 * max(abs(d1), abs(d2)))
        v1, v2 = u1 + shorten * d1, u2 + shorten * d2
    return u1, u2, chi2


@_compiled  # pragma: no cover
def _pairs(
    ya: Phasors, ga: Reals, comb: Reals, a1: float, bounce: float, sigma_bounce: float, low: float, high: float,
    left: Phasors, found: Reals,
) -> None:  # fmt: skip
    """Places u₁, u₂ along the line for two paths of amplitudes a₁ and about ``bounce``.

    ``found`` (_PAIRS, 4) gets the likeliest: χ², u₁, u₂, a₂.
    """
    middle = ya.size // 2
    fringe = 2 * math.pi / (comb[0] + middle * comb[1])
    # The modulation in the middle of the comb leaves the distance open by whole fringes, and its sense.
    strength = ya[middle].real * ya[middle].real + ya[middle].imag * ya[middle].imag
    reach = int(_APART_PX / fringe)
    for j in range(_PAIRS):
        found[j, 0] = math.inf
    # A bounce may be blurred more along the line than across it, or less.
    for kind in range(3):
        if kind > 0 and found[0, 0] < 4 * ya.size:
            break
        a2 = bounce * math.exp((0, -1, 1)[kind] * sigma_bounce)
        cosine = max(-1.0, min((strength - a1 * a1 - a2 * a2) / (2 * a1 * a2), 1.0))
        offset = fringe * math.acos(cosine) / (2 * math.pi)
        for number in range(4 * reach + 2):
            apart = (number // 2 - reach) * fringe + (offset if number % 2 else -offset)
            u1, u2, chi2 = _pair_at(ya, ga, comb, a1, a2, apart, low, high, left)
            if not (low <= u1 < high and low <= u2 < high):
                continue
            place = _PAIRS - 1
            for j in range(_PAIRS):
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


@_compiled  # pragma: no cover
def _set_line(out: Reals, common: Reals, along: float, across: float, slope: float) -> None:
    """Prior of a hypothesis: ``common`` with the epipolar line about (along, across)."""
    for j in range(7):
        out[j] = common[j]
    out[0], out[1], out[2] = along, across, slope
    out[3] = common[3] * math.sqrt(1 + slope * slope)


@_compiled  # pragma: no cover
def joint_block(
    za: NDArray[np.complex64], zb: NDArray[np.complex64], sigma_a: Reals, sigma_b: Reals, gain_a: Reals, gain_b: Reals,
    comb: Reals, low_a: float, high_a: float, low_b: float, high_b: float, fits: Floats, other: Reals, slopes: Reals,
    fits_across: Floats, prior: Reals, larger_is_direct: float, out: Floats, start: int, stop: int,
) -> None:  # fmt: skip
    """The likeliest direct path of the pixels start..stop and its rival; rows of ``out`` as `scanner.paths.joint`."""
    count_a, count_b, kinds, kinds_across = za.shape[0], zb.shape[0], fits.shape[0], fits_across.shape[0]
    most = 2 * kinds + 2 * kinds_across * _PAIRS
    ya, yb = np.empty(count_a, np.complex128), np.empty(count_b, np.complex128)
    left = np.empty(max(count_a, count_b), np.complex128)
    ga, gb = np.empty(count_a), np.empty(count_b)
    thetas, priors, pairs = np.empty((most, 8)), np.empty((most, 7)), np.empty((_PAIRS, 4))
    chi2s, scores = np.empty(most), np.empty(most)
    normal, factor, normal2 = np.zeros((8, 8)), np.zeros((8, 8)), np.zeros((8, 8))
    slope, step, trial, slope2, unit = np.empty(8), np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    work = (normal, slope, factor, step, trial, normal2, slope2)
    kappa = math.exp(prior[4])
    for p in range(start, stop):
        for t in range(count_a):
            ya[t], ga[t] = (1 / gain_a[t]) * za[t, p], (gain_a[t] / sigma_a[p]) ** 2
        for t in range(count_b):
            yb[t], gb[t] = (1 / gain_b[t]) * zb[t, p], (gain_b[t] / sigma_b[p]) ** 2
        tried, least = 0, math.inf
        for k in range(kinds):
            for i in range(2):
                place = other[2 * k + i, p]
                # Both axes together cannot fit better than this one alone.
                hopeless = fits[k, 7, p] > least + _HOPELESS_CHI2
                if hopeless or not (low_b - 1 <= place < high_b + 1):
                    continue
                theta = thetas[tried]
                theta[0], theta[1] = fits[k, i, p], fits[k, 1 - i, p]
                theta[2], theta[3] = fits[k, 2 + i, p], fits[k, 3 - i, p]
                theta[4], theta[6] = place, kappa * theta[2]
                theta[5], rest = _rest(yb, gb, comb, place, theta[6], low_b, high_b, left)
                theta[7] = max(rest, 0.1 * kappa * theta[3])
                _set_line(priors[tried], prior, theta[0], place, slopes[2 * k + i, p])
                chi2s[tried], _ = _improve(ya, ga, yb, gb, comb, priors[tried], theta, _FIRST_STEPS, work)
                if chi2s[tried] < math.inf:
                    least = min(least, chi2s[tried])
                    tried += 1
        for k in range(kinds_across):
            for i in range(2):
                b1, b2 = fits_across[k, 2 + i, p], fits_across[k, 3 - i, p]
                allowed = _NEAR_LINE_PX + _NEAR_LINE_SIGMAS * (prior[3] + fits_across[k, 4 + i, p])
                if not (fits_across[k, 7, p] < least + _HOPELESS_CHI2 and b1 > 0):
                    continue
                off = math.inf
                for m in range(other.shape[0]):
                    if math.isfinite(other[m, p]):
                        off = min(off, abs(fits_across[k, i, p] - other[m, p]) - _APART_PX * abs(slopes[m, p]))
                if not off < allowed:
                    continue
                _pairs(ya, ga, comb, b1 / kappa, b2 / kappa, prior[6], low_a, high_a, left, pairs)
                for j in range(_PAIRS):
                    # The line through the place nearest to where it is known.
                    nearest, apart = -1, math.inf
                    for m in range(other.shape[0]):
                        off = abs(fits[m // 2, m % 2, p] - pairs[j, 1])
                        if math.isfinite(other[m, p]) and off < apart:
                            nearest, apart = m, off
                    if not pairs[j, 0] < math.inf or nearest < 0:
                        continue
                    there, s = fits[nearest // 2, nearest % 2, p], slopes[nearest, p]
                    place = other[nearest, p] + s * (pairs[j, 1] - there)
                    if not abs(fits_across[k, i, p] - place) < allowed * math.sqrt(1 + s * s):
                        continue
                    theta = thetas[tried]
                    theta[0], theta[1], theta[2], theta[3] = pairs[j, 1], pairs[j, 2], b1 / kappa, pairs[j, 3]
                    theta[4], theta[5], theta[6], theta[7] = fits_across[k, i, p], fits_across[k, 1 - i, p], b1, b2
                    _set_line(priors[tried], prior, theta[0], place, s)
                    chi2s[tried], _ = _improve(ya, ga, yb, gb, comb, priors[tried], theta, _FIRST_STEPS, work)
                    if chi2s[tried] < math.inf:
                        least = min(least, chi2s[tried])
                        tried += 1
        best = -1
        for h in range(tried):
            scores[h] = math.inf
            if not chi2s[h] <= least + _HOPELESS_CHI2:
                continue
            theta = thetas[h]
            chi2s[h], _ = _improve(ya, ga, yb, gb, comb, priors[h], theta, _STEPS, work)
            least = min(least, chi2s[h])
            if not (low_a <= theta[0] < high_a and low_b <= theta[4] < high_b):
                continue
            # No place is less known than anywhere in the picture.
            for k in (0, 1, 4, 5):
                normal[k, k] += 12 / (high_a - low_a if k < 4 else high_b - low_b) ** 2
            if not _factorise(normal, 0.0, factor):
                continue
            # Evidence by Laplace's method, with a scale-free prior on the amplitudes.
            score = chi2s[h] + 2 * math.log(theta[2] + theta[3])
            for k in range(8):
                score += 2 * math.log(factor[k, k])
                unit[k] = 1.0 if k == 2 else 0.0
            _solve(factor, unit, step)
            if not theta[2] > _VISIBLE_SIGMAS * math.sqrt(step[2]):
                continue
            unit[3] = -1.0
            _solve(factor, unit, step)
            lead = (theta[2] - theta[3]) / math.sqrt(max(step[2] - step[3], _TINY))
            sure = 0.5 * math.erfc(-lead / math.sqrt(2.0))
            scores[h] = score - 2 * math.log(larger_is_direct * sure + (1 - larger_is_direct) * (1 - sure))
            if best < 0 or scores[h] < scores[best]:
                best = h
        if best < 0:
            continue
        rival = -1
        for h in range(tried):
            away = max(abs(thetas[h, 0] - thetas[best, 0]), abs(thetas[h, 4] - thetas[best, 4]))
            if scores[h] < math.inf and away > _SAME_PX and (rival < 0 or scores[h] < scores[rival]):
                rival = h
        out[2 * FIELDS, p] = 0.5 * (scores[rival] - scores[best]) if rival >= 0 else math.inf
        for h, row in ((best, 0), (rival, FIELDS)):
            if h < 0:
                continue
            _normal_equations(ya, ga, yb, gb, comb, priors[h], thetas[h], normal, slope)
            _factorise(normal, 1e-9, factor)
            for k in range(8):
                out[row + k, p] = thetas[h, k]
                for j in range(8):
                    unit[j] = 1.0 if j == k else 0.0
                _solve(factor, unit, step)
                out[row + 8 + k, p] = math.sqrt(max(step[k], 0.0))
            out[row + 16, p] = chi2s[h]
