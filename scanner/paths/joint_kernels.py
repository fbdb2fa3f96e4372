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

_HOPELESS_CHI2 = 25.0
"""Excess over the best hypothesis from which one is hopeless."""
_STEPS = 14
"""Levenberg-Marquardt steps at most; two or three are usual."""
_CONVERGED_CHI2 = 1e-2
"""A step that lowers χ² by less ends a refinement: it moves no coordinate by more than 1/10 of its σ."""
_VISIBLE_SIGMAS = 5.0
"""A direct path that is weaker than this is none."""
_SAME_PX = 0.5
"""Direct places nearer than this are one place, whatever the bounce is."""
_SAME_FIT_PX = 0.25
"""A hypothesis whose first step leads this near to a fit that is known, in all places, leads to that fit."""
_TINY = 1e-300


@compiled  # pragma: no cover
def _load(
    z: NDArray[np.complex64], gain: Reals, sigma: float, p: int, omega0: float, step: float, y: Phasors, w: Reals
) -> None:  # fmt: skip
    """Phasors of a pixel over the trend, and the sums' weights: ``w[k]`` are g ωᵏ, and ``w[3]`` starts with Σ g|y|²."""
    power = 0.0
    for t in range(z.shape[0]):
        omega = omega0 + t * step
        y[t] = (1 / gain[t]) * z[t, p]
        w[0, t] = (gain[t] / sigma) ** 2
        w[1, t] = w[0, t] * omega
        w[2, t] = w[1, t] * omega
        power += w[0, t] * (y[t].real * y[t].real + y[t].imag * y[t].imag)
    w[3, 0] = power


@compiled  # pragma: no cover
def _axis_normal(
    y: Phasors, w: Reals, omega0: float, step: float, theta: Reals, first: int, normal: Reals, slope: Reals
) -> float:
    """Write the data of one axis into the normal equations; returns its χ².

    ``theta[first:first + 4]`` are u₁, u₂, a₁, a₂; ``y`` (T,) and ``w`` (4, T) as `_load` leaves them.
    """
    u1, u2, a1, a2 = theta[first], theta[first + 1], theta[first + 2], theta[first + 3]
    e1, turn1 = rotation(-omega0 * u1), rotation(-step * u1)
    e2, turn2 = rotation(-omega0 * u2), rotation(-step * u2)
    c1 = c2 = f1 = f2 = m0 = m1 = m2 = s0 = s2 = 0.0
    for t in range(y.size):
        # In turned coordinates: what is along a path changes its amplitude, what is across its place.
        q1, q2, p = e1 * y[t], e2 * y[t], e1 * e2.conjugate()
        w0, w1, w2 = w[0, t], w[1, t], w[2, t]
        c1 += w0 * q1.real
        c2 += w0 * q2.real
        f1 += w1 * q1.imag
        f2 += w1 * q2.imag
        m0 += w0 * p.real
        m1 += w1 * p.imag
        m2 += w2 * p.real
        s0 += w0
        s2 += w2
        e1 *= turn1
        e2 *= turn2
    i, j, k, m = first, first + 1, first + 2, first + 3
    normal[i, i] = a1 * a1 * s2
    normal[j, i] = a1 * a2 * m2
    normal[j, j] = a2 * a2 * s2
    # Re(conj(i ω a₁ e₁) e₂) = ω a₁ Im(conj(e₁) e₂), and the other way round; a path's own is zero.
    normal[k, i], normal[m, i] = 0.0, a1 * m1
    normal[k, j], normal[m, j] = -a2 * m1, 0.0
    normal[k, k], normal[m, k], normal[m, m] = s0, m0, s0
    slope[i] = a1 * (f1 - a2 * m1)
    slope[j] = a2 * (f2 + a1 * m1)
    slope[k] = c1 - a1 * s0 - a2 * m0
    slope[m] = c2 - a2 * s0 - a1 * m0
    return float(w[3, 0] - a1 * (c1 + slope[k]) - a2 * (c2 + slope[m]))


@compiled  # pragma: no cover
def _normal_equations(
    ya: Phasors, wa: Reals, yb: Phasors, wb: Reals, comb: Reals, prior: Reals, theta: Reals, normal: Reals, slope: Reals
) -> float:  # fmt: skip
    """χ² of both axes and the priors, its Gauss-Newton matrix (lower half) and the negative half gradient.

    ``comb`` holds 2πf₀ and 2πΔf of the axis along and of the axis across. ``prior`` holds where the epipolar line is
    left, the place across there, the line's slope, its σ; ln κ; σ of the two log ratios of amplitudes.
    """
    for a in range(4, 8):
        for b in range(4):
            normal[a, b] = 0.0
    chi2 = _axis_normal(ya, wa, comb[0], comb[1], theta, 0, normal, slope)
    chi2 += _axis_normal(yb, wb, comb[2], comb[3], theta, 4, normal, slope)
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
def _forward(factor: Reals, right: Reals, first: int, out: Reals) -> None:
    """Solve with the lower triangle for a right side that is zero before ``first``."""
    for a in range(first, 8):
        s = right[a]
        for b in range(first, a):
            s -= factor[a, b] * out[b]
        out[a] = s * factor[a, a]


@compiled  # pragma: no cover
def _backward(factor: Reals, right: Reals, out: Reals) -> None:
    """Solve with the upper triangle, the transpose of the lower."""
    for k in range(8):
        a = 7 - k
        s = right[a]
        for b in range(a + 1, 8):
            s -= factor[b, a] * out[b]
        out[a] = s * factor[a, a]


@compiled  # pragma: no cover
def _variance(factor: Reals, of: Reals, first: int, work: Reals) -> float:
    """Variance of a linear combination ``of`` (8,) of the parameters that is zero before ``first``."""
    _forward(factor, of, first, work)
    total = 0.0
    for k in range(first, 8):
        total += work[k] * work[k]
    return total


@compiled  # pragma: no cover
def _leads_to_known(thetas: Reals, step: Reals, scores: Reals, h: int, count: int) -> bool:
    """Whether the first step of the hypothesis ``h`` ends at one of those that have a score already."""
    for other in range(count):
        away = 0.0 if scores[other] < math.inf else math.inf
        for k in (0, 1, 4, 5):
            away = max(away, abs(thetas[other, k] - thetas[h, k] - step[k]))
        if away < _SAME_FIT_PX:
            return True
    return False


@compiled  # pragma: no cover
def _improve(
    ya: Phasors, wa: Reals, yb: Phasors, wb: Reals, comb: Reals, prior: Reals, theta: Reals, chi2: float, steps: int,
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
        _forward(factor, slope, 0, trial)
        _backward(factor, trial, step)
        shorten = 1.0
        for k in (0, 1, 4, 5):
            # A radian at most, so that no fringe order is left.
            shorten = min(shorten, 1 / max(1e-9, abs(step[k]) * comb[0 if k < 4 else 2]))
        for k in (2, 3, 6, 7):
            if step[k] < 0:
                shorten = min(shorten, -0.7 * theta[k] / step[k])
        for k in range(8):
            trial[k] = theta[k] + shorten * step[k]
        gained = _normal_equations(ya, wa, yb, wb, comb, prior, trial, normal2, slope2)
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
    wa, wb = np.empty((4, count_a)), np.empty((4, count_b))
    thetas, priors, gradients = np.empty((most, 8)), np.empty((most, 7)), np.empty((most, 8))
    chi2s, scores, promised, steps = np.empty(most), np.empty(most), np.empty(most), np.empty((most, 8))
    normals, factor, normal2 = np.zeros((most, 8, 8)), np.zeros((8, 8)), np.zeros((8, 8))
    step, trial, slope2, unit = np.empty(8), np.empty(8), np.empty(8), np.empty(8)
    nothing, anywhere = np.zeros(8), np.zeros(8)
    for k in (0, 1, 4, 5):
        # No place is less known than anywhere in the picture.
        anywhere[k] = 12 / (high_a - low_a if k < 4 else high_b - low_b) ** 2
    work = (factor, step, trial, normal2, slope2, nothing)
    for n in range(bounds.shape[0]):
        p = start + n
        _load(za, gain_a, sigma_a[p], p, comb[0], comb[1], ya, wa)
        _load(zb, gain_b, sigma_b[p], p, comb[2], comb[3], yb, wb)
        tried, least = 0, math.inf
        for h in range(most):
            if not bounds[n, h] < math.inf:
                break
            if bounds[n, h] > least + _HOPELESS_CHI2:
                continue
            theta = thetas[tried]
            for k in range(8):
                theta[k] = seeds[n, h, k]
            _set_line(priors[tried], prior, lines[n, h, 0], lines[n, h, 1], lines[n, h, 2])
            chi2s[tried] = _normal_equations(
                ya, wa, yb, wb, comb, priors[tried], theta, normals[tried], gradients[tried]
            )  # fmt: skip
            if not _factorise(normals[tried], 1e-9, nothing, factor):
                continue
            _forward(factor, gradients[tried], 0, step)
            promised[tried] = chi2s[tried]
            for k in range(8):
                promised[tried] -= step[k] * step[k]
            if not promised[tried] < least + _HOPELESS_CHI2:
                continue
            _backward(factor, step, steps[tried])
            least = min(least, promised[tried])
            scores[tried] = math.inf
            tried += 1
        # The most promising first: what it reaches shows which of the others are hopeless, and which lead to it.
        best, least = -1, math.inf
        for _ in range(tried):
            h = promised[:tried].argmin()
            if not promised[h] < least + _HOPELESS_CHI2:
                break
            promised[h] = math.inf
            theta = thetas[h]
            if _leads_to_known(thetas, steps[h], scores, h, tried):
                continue
            chi2s[h], _ = _improve(
                ya, wa, yb, wb, comb, priors[h], theta, chi2s[h], _STEPS, normals[h], gradients[h], work
            )  # fmt: skip
            least = min(least, chi2s[h])
            if not chi2s[h] < least + _HOPELESS_CHI2:
                continue
            if not (low_a <= theta[0] < high_a and low_b <= theta[4] < high_b):
                continue
            if not _factorise(normals[h], 0.0, anywhere, factor):
                continue
            # Evidence by Laplace's method, with a scale-free prior on the amplitudes.
            score = chi2s[h] + 2 * math.log(theta[2] + theta[3])
            reciprocal = 1.0
            for k in range(8):
                reciprocal *= factor[k, k]
                unit[k] = 1.0 if k == 2 else 0.0
            score -= 2 * math.log(reciprocal)
            if not theta[2] > _VISIBLE_SIGMAS * math.sqrt(_variance(factor, unit, 2, step)):
                continue
            unit[3] = -1.0
            lead = (theta[2] - theta[3]) / math.sqrt(max(_variance(factor, unit, 2, step), _TINY))
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
                out[row + 8 + k, p] = math.sqrt(_variance(factor, unit, k, step))
            out[row + 16, p] = chi2s[h]
