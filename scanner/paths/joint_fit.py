"""One hypothesis of two paths on both axes: its sum of squares, and Levenberg-Marquardt; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; the other is *across*.

No two parameters of the four of P = (u₂, a₂ along; u₁, a₁ across) have a common term in the Gauss-Newton matrix, nor
have those of Q = (u₁, a₁ along; u₂, a₂ across): place and amplitude of one path are orthogonal, the line couples u₁
with u₁ and the ratios a_k with a_k. It is thus two diagonals and a 4 x 4 matrix B, and its Schur complement is 4 x 4.
A *system* (8, 4) holds: the diagonals of P and of Q; B by rows of P; the negative half gradients of P and of Q.

Numba's cache of `joint_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.folding import sums
from scanner.paths.rotation import compiled

Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

_CONVERGED_CHI2 = 1e-2
"""A step that lowers χ² by less ends a refinement: it moves no coordinate by more than 1/10 of its σ."""
_DAMPED = 0.01
"""Damping from which a step says nothing of how much a whole one would gain."""
_REGULAR = 1e-9
"""Least damping, for the sake of rounding."""
_TINY = 1e-12
"""Pivots that are smaller relative to the diagonal are none."""


@compiled  # pragma: no cover
def normal_equations(along: Reals, across: Reals, prior: Reals, theta: Reals, system: Reals) -> float:
    """Write the normal equations at ``theta`` (8,), u₁, u₂, a₁, a₂ along and across, into ``system``; returns χ².

    ``along`` and ``across`` are what `scanner.paths.folding.fold` leaves. ``prior`` holds where the epipolar line is
    left, the place across there, the line's slope, its σ; ln κ; σ of the two log ratios of amplitudes.
    """
    p, q, b, gp, gq = system[0], system[1], system[2:6], system[6], system[7]
    last, a1, a2 = along.shape[0] - 1, theta[2], theta[3]
    c1, c2, f1, f2, m0, m1, m2 = sums(along, theta[0], theta[1])
    power, s0, s2 = along[last, 0], along[last, 1], along[last, 2]
    p[0], p[1], q[0], q[1] = a2 * a2 * s2, s0, a1 * a1 * s2, s0
    # Re(conj(i ω a₁ e₁) e₂) = ω a₁ Im(conj(e₁) e₂), and the other way round.
    b[0, 0], b[0, 1], b[1, 0], b[1, 1] = a1 * a2 * m2, -a2 * m1, a1 * m1, m0
    gp[0], gq[0] = a2 * (f2 + a1 * m1), a1 * (f1 - a2 * m1)
    gp[1], gq[1] = c2 - a2 * s0 - a1 * m0, c1 - a1 * s0 - a2 * m0
    chi2 = power - a1 * (c1 + gq[1]) - a2 * (c2 + gp[1])
    last, b1, b2 = across.shape[0] - 1, theta[6], theta[7]
    c1, c2, f1, f2, m0, m1, m2 = sums(across, theta[4], theta[5])
    power, s0, s2 = across[last, 0], across[last, 1], across[last, 2]
    p[2], p[3], q[2], q[3] = b1 * b1 * s2, s0, b2 * b2 * s2, s0
    b[2, 2], b[2, 3], b[3, 2], b[3, 3] = b1 * b2 * m2, b1 * m1, -b2 * m1, m0
    gp[2], gq[2] = b1 * (f1 - b2 * m1), b2 * (f2 + b1 * m1)
    gp[3], gq[3] = c1 - b1 * s0 - b2 * m0, c2 - b2 * s0 - b1 * m0
    chi2 += power - b1 * (c1 + gp[3]) - b2 * (c2 + gq[3])
    weight, slope = 1 / (prior[3] * prior[3]), prior[2]
    off = theta[4] - prior[1] - slope * (theta[0] - prior[0])
    chi2 += weight * off * off
    q[0] += weight * slope * slope
    p[2] += weight
    b[2, 0] = -weight * slope
    gq[0] += weight * slope * off
    gp[2] -= weight * off
    per_a, per_b = 1 / a1, 1 / b1
    weight, off = 1 / (prior[5] * prior[5]), math.log(b1 * per_a) - prior[4]
    chi2 += weight * off * off
    q[1] += weight * per_a * per_a
    p[3] += weight * per_b * per_b
    b[3, 1] = -weight * per_a * per_b
    gq[1] += weight * off * per_a
    gp[3] -= weight * off * per_b
    per_a, per_b = 1 / a2, 1 / b2
    weight, off = 1 / (prior[6] * prior[6]), math.log(b2 * per_a) - prior[4]
    chi2 += weight * off * off
    p[1] += weight * per_a * per_a
    q[3] += weight * per_b * per_b
    b[1, 3] = -weight * per_a * per_b
    gp[1] += weight * off * per_a
    gq[3] -= weight * off * per_b
    return float(chi2)


@compiled  # pragma: no cover
def _schur(system: Reals, damping: float, place_a: float, place_b: float) -> Any:
    """Triangular factors of what is left for Q, with the diagonal raised and information added to the places.

    Returns 1/P (4), the strict lower triangle (6) and the reciprocal pivots (4) of the factors L D Lᵀ; the last is
    negative where the matrix is not positive.
    """
    p, q, b = system[0], system[1], system[2:6]
    more = 1 + damping
    r0, r1 = 1 / (p[0] * more + place_a), 1 / (p[1] * more)
    r2, r3 = 1 / (p[2] * more + place_b), 1 / (p[3] * more)
    b00, b01, b10, b11, b13 = b[0, 0], b[0, 1], b[1, 0], b[1, 1], b[1, 3]
    b20, b22, b23, b31, b32, b33 = b[2, 0], b[2, 2], b[2, 3], b[3, 1], b[3, 2], b[3, 3]
    d0 = q[0] * more + place_a - r0 * b00 * b00 - r1 * b10 * b10 - r2 * b20 * b20
    v1, v2, v3 = -r0 * b00 * b01 - r1 * b10 * b11, -r2 * b20 * b22, -r1 * b10 * b13 - r2 * b20 * b23
    i0 = 1 / d0
    l1, l2, l3 = i0 * v1, i0 * v2, i0 * v3
    d1 = q[1] * more - r0 * b01 * b01 - r1 * b11 * b11 - r3 * b31 * b31 - l1 * v1
    w2, w3 = -r3 * b31 * b32 - l1 * v2, -r1 * b11 * b13 - r3 * b31 * b33 - l1 * v3
    i1 = 1 / d1
    m2, m3 = i1 * w2, i1 * w3
    d2 = q[2] * more + place_b - r2 * b22 * b22 - r3 * b32 * b32 - l2 * v2 - m2 * w2
    x3 = -r2 * b22 * b23 - r3 * b32 * b33 - l2 * v3 - m2 * w3
    i2 = 1 / d2
    n3 = i2 * x3
    d3 = q[3] * more - r1 * b13 * b13 - r2 * b23 * b23 - r3 * b33 * b33 - l3 * v3 - m3 * w3 - n3 * x3
    i3 = 1 / d3
    if not (d0 > _TINY * q[0] and d1 > _TINY * q[1] and d2 > _TINY * q[2] and d3 > _TINY * q[3]):
        i3 = -1.0
    return r0, r1, r2, r3, l1, l2, l3, m2, m3, n3, i0, i1, i2, i3


@compiled  # pragma: no cover
def solve(system: Reals, damping: float, step: Reals) -> float:
    """Step (8,) that the normal equations say, and by how much it lowers χ²; negative where they have no solution."""
    r0, r1, r2, r3, l1, l2, l3, m2, m3, n3, i0, i1, i2, i3 = _schur(system, damping + _REGULAR, 0.0, 0.0)
    if i3 < 0:
        return -1.0
    b, g, h = system[2:6], system[6], system[7]
    g0, g1, g2, g3 = r0 * g[0], r1 * g[1], r2 * g[2], r3 * g[3]
    x0 = h[0] - b[0, 0] * g0 - b[1, 0] * g1 - b[2, 0] * g2
    x1 = h[1] - b[0, 1] * g0 - b[1, 1] * g1 - b[3, 1] * g3 - l1 * x0
    x2 = h[2] - b[2, 2] * g2 - b[3, 2] * g3 - l2 * x0 - m2 * x1
    x3 = h[3] - b[1, 3] * g1 - b[2, 3] * g2 - b[3, 3] * g3 - l3 * x0 - m3 * x1 - n3 * x2
    y0, y1, y2, y3 = i0 * x0, i1 * x1, i2 * x2, i3 * x3
    gain = g0 * g[0] + g1 * g[1] + g2 * g[2] + g3 * g[3] + x0 * y0 + x1 * y1 + x2 * y2 + x3 * y3
    y2 -= n3 * y3
    y1 -= m2 * y2 + m3 * y3
    y0 -= l1 * y1 + l2 * y2 + l3 * y3
    step[0], step[2], step[5], step[7] = y0, y1, y2, y3
    step[1] = g0 - r0 * (b[0, 0] * y0 + b[0, 1] * y1)
    step[3] = g1 - r1 * (b[1, 0] * y0 + b[1, 1] * y1 + b[1, 3] * y3)
    step[4] = g2 - r2 * (b[2, 0] * y0 + b[2, 2] * y2 + b[2, 3] * y3)
    step[6] = g3 - r3 * (b[3, 1] * y1 + b[3, 2] * y2 + b[3, 3] * y3)
    return float(gain)


@compiled  # pragma: no cover
def covariance(system: Reals, place_a: float, place_b: float, variances: Reals) -> Any:
    """Variances (8,) of the parameters; returns the determinant of the covariance, and that of a₁ and a₂ along.

    ``place_a`` and ``place_b`` are information that all places have along and across. The determinant is negative
    where there are no variances.
    """
    r0, r1, r2, r3, l1, l2, l3, m2, m3, n3, i0, i1, i2, i3 = _schur(system, _REGULAR, place_a, place_b)
    if i3 < 0:
        return -1.0, 0.0
    b = system[2:6]
    # The inverse K of L, then that of the Schur complement, Kᵀ D⁻¹ K.
    k20, k31 = m2 * l1 - l2, n3 * m2 - m3
    k30 = m3 * l1 - l3 - n3 * k20
    s33, s23, s13, s03 = i3, -n3 * i3, k31 * i3, k30 * i3
    s22, s12, s02 = i2 - n3 * s23, k31 * s23 - m2 * i2, k30 * s23 + k20 * i2
    s11 = i1 + m2 * m2 * i2 + k31 * s13
    s01 = k30 * s13 - k20 * m2 * i2 - l1 * i1
    s00 = i0 + l1 * l1 * i1 + k20 * k20 * i2 + k30 * s03
    variances[0], variances[2], variances[5], variances[7] = s00, s11, s22, s33
    e, f = b[0, 0], b[0, 1]
    variances[1] = r0 + r0 * r0 * (e * (e * s00 + 2 * f * s01) + f * f * s11)
    e, f, h = b[1, 0], b[1, 1], b[1, 3]
    variances[3] = r1 + r1 * r1 * (e * (e * s00 + 2 * (f * s01 + h * s03)) + f * (f * s11 + 2 * h * s13) + h * h * s33)
    mutual = -r1 * (e * s01 + f * s11 + h * s13)
    e, f, h = b[2, 0], b[2, 2], b[2, 3]
    variances[4] = r2 + r2 * r2 * (e * (e * s00 + 2 * (f * s02 + h * s03)) + f * (f * s22 + 2 * h * s23) + h * h * s33)
    e, f, h = b[3, 1], b[3, 2], b[3, 3]
    variances[6] = r3 + r3 * r3 * (e * (e * s11 + 2 * (f * s12 + h * s13)) + f * (f * s22 + 2 * h * s23) + h * h * s33)
    return r0 * r1 * r2 * r3 * i0 * i1 * i2 * i3, mutual


@compiled  # pragma: no cover
def improve(
    along: Reals, across: Reals, prior: Reals, theta: Reals, chi2: float, gain: float, step: Reals, system: Reals,
    trial: Reals, spare: Reals, steps: int,
) -> float:  # fmt: skip
    """Levenberg-Marquardt from ``theta``, whose χ², system, step and promised gain are given; returns χ².

    ``theta`` and ``system`` are brought up to date; ``trial`` (8,) and ``spare`` (8, 4) are workspace.
    """
    damping, converged = 0.0, False
    omega_a, omega_b = along[along.shape[0] - 1, 3], across[across.shape[0] - 1, 3]
    for _ in range(steps):
        if gain < 0:
            damping = max(10 * damping, 1e-3)
            gain = solve(system, damping, step)
            continue
        shorten = 1.0
        for k in (0, 1, 4, 5):
            # A radian at most, so that no fringe order is left.
            shorten = min(shorten, 1 / max(1e-9, abs(step[k]) * (omega_a if k < 4 else omega_b)))
        for k in (2, 3, 6, 7):
            if step[k] < 0:
                shorten = min(shorten, -0.7 * theta[k] / step[k])
        for k in range(8):
            trial[k] = theta[k] + shorten * step[k]
        if gain < _CONVERGED_CHI2 and damping < _DAMPED and shorten == 1:
            # So near to the minimum the square is exact.
            for k in range(8):
                theta[k] = trial[k]
            return chi2 - gain
        reached = normal_equations(along, across, prior, trial, spare)
        if reached <= chi2:
            converged = chi2 - reached < _CONVERGED_CHI2
            chi2 = reached
            for k in range(8):
                theta[k] = trial[k]
                for m in range(4):
                    system[k, m] = spare[k, m]
            damping *= 0.1
        else:
            converged = reached - chi2 < _CONVERGED_CHI2
            damping = max(10 * damping, 0.03)
        if converged:
            break
        gain = solve(system, damping, step)
    return chi2


@compiled  # pragma: no cover
def set_line(out: Reals, common: Reals, along: float, across: float, slope: float) -> None:
    """Prior of a hypothesis: ``common`` with the epipolar line about (along, across)."""
    for j in range(7):
        out[j] = common[j]
    out[0], out[1], out[2] = along, across, slope
    out[3] = common[3] * math.sqrt(1 + slope * slope)
