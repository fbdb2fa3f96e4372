"""One hypothesis of two paths on both axes: its sum of squares, and Levenberg-Marquardt; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; the other is *across*.

Numba's cache of `joint_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.rotation import compiled, rotation

Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

_CONVERGED_CHI2 = 1e-2
"""A step that lowers χ² by less ends a refinement: it moves no coordinate by more than 1/10 of its σ."""


@compiled  # pragma: no cover
def load(
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

    ``theta[first:first + 4]`` are u₁, u₂, a₁, a₂; ``y`` (T,) and ``w`` (4, T) as `load` leaves them.
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
def normal_equations(
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
def factorise(normal: Reals, damping: float, known: Reals, factor: Reals) -> bool:
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
def forward(factor: Reals, right: Reals, first: int, out: Reals) -> None:
    """Solve with the lower triangle for a right side that is zero before ``first``."""
    for a in range(first, 8):
        s = right[a]
        for b in range(first, a):
            s -= factor[a, b] * out[b]
        out[a] = s * factor[a, a]


@compiled  # pragma: no cover
def backward(factor: Reals, right: Reals, out: Reals) -> None:
    """Solve with the upper triangle, the transpose of the lower."""
    for k in range(8):
        a = 7 - k
        s = right[a]
        for b in range(a + 1, 8):
            s -= factor[b, a] * out[b]
        out[a] = s * factor[a, a]


@compiled  # pragma: no cover
def variance(factor: Reals, of: Reals, first: int, work: Reals) -> float:
    """Variance of a linear combination ``of`` (8,) of the parameters that is zero before ``first``."""
    forward(factor, of, first, work)
    total = 0.0
    for k in range(first, 8):
        total += work[k] * work[k]
    return total


@compiled  # pragma: no cover
def improve(
    ya: Phasors, wa: Reals, yb: Phasors, wb: Reals, comb: Reals, prior: Reals, theta: Reals, chi2: float, steps: int,
    normal: Reals, slope: Reals, factor: Reals, step: Reals, trial: Reals, normal2: Reals, slope2: Reals,
    nothing: Reals,
) -> Any:  # fmt: skip
    """Levenberg-Marquardt from ``theta``, whose χ² and normal equations are given; all are brought up to date.

    Returns χ² and whether the last step gained next to nothing.
    """
    damping, converged = 0.0, False
    for _ in range(steps):
        if not factorise(normal, damping, nothing, factor):
            damping = max(10 * damping, 1e-3)
            continue
        forward(factor, slope, 0, trial)
        backward(factor, trial, step)
        shorten = 1.0
        for k in (0, 1, 4, 5):
            # A radian at most, so that no fringe order is left.
            shorten = min(shorten, 1 / max(1e-9, abs(step[k]) * comb[0 if k < 4 else 2]))
        for k in (2, 3, 6, 7):
            if step[k] < 0:
                shorten = min(shorten, -0.7 * theta[k] / step[k])
        for k in range(8):
            trial[k] = theta[k] + shorten * step[k]
        gained = normal_equations(ya, wa, yb, wb, comb, prior, trial, normal2, slope2)
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
def set_line(out: Reals, common: Reals, along: float, across: float, slope: float) -> None:
    """Prior of a hypothesis: ``common`` with the epipolar line about (along, across)."""
    for j in range(7):
        out[j] = common[j]
    out[0], out[1], out[2] = along, across, slope
    out[3] = common[3] * math.sqrt(1 + slope * slope)
