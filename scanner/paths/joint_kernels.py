"""Refinement of the hypotheses of both axes together, and the choice between them; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; the other is *across*. All kernels of a compiled function
live in one file because Numba's cache looks at that file only.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.rotation import compiled, rotation

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
_VISIBLE_SIGMAS = 5.0
"""A direct path that is weaker than this is none."""
_SAME_PX = 0.5
"""Direct places nearer than this are one place, whatever the bounce is."""
_TINY = 1e-300


@compiled  # pragma: no cover
def _axis_normal(
    y: Phasors, g: Reals, omega0: float, step: float, theta: Reals, first: int, normal: Reals, slope: Reals
) -> float:
    """Add the data of one axis to the normal equations; returns its χ².

    ``theta[first:first + 4]`` are u₁, u₂, a₁, a₂; ``y`` (T,) the phasors over trend and noise, ``g`` (T,) the weights.
    """
    u1, u2, a1, a2 = theta[first], theta[first + 1], theta[first + 2], theta[first + 3]
    e1, turn1 = rotation(omega0 * u1), rotation(step * u1)
    e2, turn2 = rotation(omega0 * u2), rotation(step * u2)
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


@compiled  # pragma: no cover
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


@compiled  # pragma: no cover
def _factorise(normal: Reals, damping: float, known: Reals, factor: Reals) -> bool:
    """Cholesky factor of the matrix with its diagonal raised; False where it is not positive.

    ``known`` (8,) is added to the diagonal. The factor's diagonal holds its reciprocals.
    """
    for a in range(8):
        for b in range(a):
            s = normal[a, b]
            for c in range(b):
                s -= factor[a, c] * factor[b, c]
            factor[a, b] = s * factor[b, b]
        s = normal[a, a] * (1 + damping) + known[a]
        for c in range(a):
            s -= factor[a, c] * factor[a, c]
        if not s > 1e-12 * normal[a, a]:
            return False
        factor[a, a] = 1 / math.sqrt(s)
    return True


@compiled  # pragma: no cover
def _solve(factor: Reals, right: Reals, out: Reals) -> None:
    for a in range(8):
        s = right[a]
        for b in range(a):
            s -= factor[a, b] * out[b]
        out[a] = s * factor[a, a]
    for k in range(8):
        a = 7 - k
        s = out[a]
        for b in range(a + 1, 8):
            s -= factor[b, a] * out[b]
        out[a] = s * factor[a, a]


@compiled  # pragma: no cover
def _improve(
    za: Phasors, ga: Reals, zb: Phasors, gb: Reals, comb: Reals, prior: Reals, theta: Reals, chi2: float, steps: int,
    normal: Reals, slope: Reals, work: Any,
) -> Any:  # fmt: skip
    """Levenberg-Marquardt from ``theta``, whose χ² and normal equations are given; all are brought up to date.

    Returns χ² and whether the last step gained next to nothing.
    """
    factor, step, trial, normal2, slope2, nothing = work
    damping, converged = 0.0, False
    for _ in range(steps):
        if not _factorise(normal, damping, nothing, factor):
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


@compiled  # pragma: no cover
def _set_line(out: Reals, common: Reals, along: float, across: float, slope: float) -> None:
    """Prior of a hypothesis: ``common`` with the epipolar line about (along, across)."""
    for j in range(7):
        out[j] = common[j]
    out[0], out[1], out[2] = along, across, slope
    out[3] = common[3] * math.sqrt(1 + slope * slope)


@compiled  # pragma: no cover
def joint_block(
    za: NDArray[np.complex64], zb: NDArray[np.complex64], sigma_a: Reals, sigma_b: Reals, gain_a: Reals, gain_b: Reals,
    comb: Reals, low_a: float, high_a: float, low_b: float, high_b: float, seeds: Reals, lines: Reals, bounds: Reals,
    prior: Reals, larger_is_direct: float, out: Floats, start: int,
) -> None:  # fmt: skip
    """The likeliest direct path of the pixels from ``start`` on, and its rival, as rows of ``out``.

    ``seeds``, ``lines``, ``bounds`` as `scanner.paths.joint_seeds.seed_block` leaves them.
    """
    count_a, count_b, most = za.shape[0], zb.shape[0], bounds.shape[1]
    ya, yb = np.empty(count_a, np.complex128), np.empty(count_b, np.complex128)
    ga, gb = np.empty(count_a), np.empty(count_b)
    thetas, priors, gradients = np.empty((most, 8)), np.empty((most, 7)), np.empty((most, 8))
    chi2s, scores, done = np.empty(most), np.empty(most), np.zeros(most, np.bool_)
    normals, factor, normal2 = np.zeros((most, 8, 8)), np.zeros((8, 8)), np.zeros((8, 8))
    step, trial, slope2, unit = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    nothing, anywhere = np.zeros(8), np.zeros(8)
    for k in (0, 1, 4, 5):
        # No place is less known than anywhere in the picture.
        anywhere[k] = 12 / (high_a - low_a if k < 4 else high_b - low_b) ** 2
    work = (factor, step, trial, normal2, slope2, nothing)
    for n in range(bounds.shape[0]):
        p = start + n
        for t in range(count_a):
            ya[t], ga[t] = (1 / gain_a[t]) * za[t, p], (gain_a[t] / sigma_a[p]) ** 2
        for t in range(count_b):
            yb[t], gb[t] = (1 / gain_b[t]) * zb[t, p], (gain_b[t] / sigma_b[p]) ** 2
        tried, least = 0, math.inf
        for h in range(most):
            if not bounds[n, h] < math.inf:
                break
            if bounds[n, h] > least + _HOPELESS_CHI2:
                continue
            theta, normal, gradient = thetas[tried], normals[tried], gradients[tried]
            for k in range(8):
                theta[k] = seeds[n, h, k]
            _set_line(priors[tried], prior, lines[n, h, 0], lines[n, h, 1], lines[n, h, 2])
            chi2 = _normal_equations(ya, ga, yb, gb, comb, priors[tried], theta, normal, gradient)
            chi2s[tried], done[tried] = _improve(
                ya, ga, yb, gb, comb, priors[tried], theta, chi2, _FIRST_STEPS, normal, gradient, work
            )  # fmt: skip
            if chi2s[tried] < math.inf:
                least = min(least, chi2s[tried])
                tried += 1
        best = -1
        for h in range(tried):
            scores[h] = math.inf
            if not chi2s[h] <= least + _HOPELESS_CHI2:
                continue
            theta = thetas[h]
            if not done[h]:
                chi2s[h], _ = _improve(
                    ya, ga, yb, gb, comb, priors[h], theta, chi2s[h], _STEPS, normals[h], gradients[h], work
                )  # fmt: skip
                least = min(least, chi2s[h])
            if not (low_a <= theta[0] < high_a and low_b <= theta[4] < high_b):
                continue
            if not _factorise(normals[h], 0.0, anywhere, factor):
                continue
            # Evidence by Laplace's method, with a scale-free prior on the amplitudes.
            score = chi2s[h] + 2 * math.log(theta[2] + theta[3])
            for k in range(8):
                score -= 2 * math.log(factor[k, k])
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
            _factorise(normals[h], 1e-9, nothing, factor)
            for k in range(8):
                out[row + k, p] = thetas[h, k]
                for j in range(8):
                    unit[j] = 1.0 if j == k else 0.0
                _solve(factor, unit, step)
                out[row + 8 + k, p] = math.sqrt(max(step[k], 0.0))
            out[row + 16, p] = chi2s[h]
