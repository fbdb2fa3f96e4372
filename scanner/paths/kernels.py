"""The compiled inner loops of the separation on one axis; `scanner.paths.twin` says the same in plain NumPy.

A coordinate is carried as the phase v = 2πf_c u (rad) and a frequency as ξ_t = f_t/f_c - 1; the phasors are divided by
the trend m_t, which leaves the weights g_t = m_t². Amplitudes enter linearly and are eliminated in every fit (variable
projection, Golub & Pereyra 1973), which leaves 2 x 2 systems in closed form.

Numba's cache of `separate_block` does not see the files of what it calls: `make` compiles it anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.folding import COLUMNS, fold, sums, turned_sum, turned_sums
from scanner.paths.pencil import poles
from scanner.paths.rotation import angle_of, compiled, rotation

Floats = NDArray[np.float32]
Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]
Workspace = tuple[Phasors, Phasors, Reals, Reals, Reals, Reals, Reals, Reals, Reals]

CANDIDATES = 3
"""Fits that are kept of a pixel, the best one first."""
FIELDS = 7
"""Of a fit: score, v₁, v₂, a₁, a₂ and, per σ_z², the variances of a·v and of a."""

_ORDER_CHI2 = 60.0
"""Fringe orders within this χ² of the float solution are tried."""
_ORDER_REACH = 8.0
"""Fringes to either side of the float solution at most."""
_ORDER_BEND = 0.2
"""Fringes by which the region widens per fringe from the float solution, because the valley of the likelihood bends."""
_SLACK_CHI2 = 2.0
"""χ² by which a pair must promise to fit worse than those kept to be left out untried."""
_ORDER_PAIRS = 100.0
"""Area of the region at most: one hopeless pixel must not cost the time of a hundred."""
_REFINED = 3
"""Pairs of orders that are refined to convergence."""
_CLOSEST_RAD = math.pi / 2
"""Nearer than a quarter fringe, two paths are as good as one."""
_CONVERGED_CHI2 = 1e-2
"""A step that lowers χ² by less ends a refinement: it moves no coordinate by more than 1/10 of its σ."""
_REGULAR = 1e-9
"""Floor of a determinant relative to its diagonal."""
_STEPS = 30
"""Levenberg-Marquardt steps at most; two or three are usual."""


@compiled  # pragma: no cover
def _float_fit(y: Phasors, g: Reals, xi: Reals, v1: float, v2: float) -> Any:
    """Least squares of y_t = ρ₁ e^{iξ_t v₁} + ρ₂ e^{iξ_t v₂} with complex ρ, for weights g.

    Returns ρ₁, ρ₂, the explained power, the information matrix of (v₁, v₂) (elements 11, 12, 22) and the gradient of
    half the power.
    """
    dx = xi[1] - xi[0]
    e1, turn1, e2, turn2 = rotation(xi[0] * v1), rotation(dx * v1), rotation(xi[0] * v2), rotation(dx * v2)
    c1 = c2 = f1 = f2 = m0 = m1 = m2 = 0j
    s0 = s2 = 0.0
    for t in range(y.size):
        q1 = g[t] * (e1.conjugate() * y[t])
        q2 = g[t] * (e2.conjugate() * y[t])
        p0 = g[t] * (e1.conjugate() * e2)
        p1 = xi[t] * p0
        c1 += q1
        c2 += q2
        f1 += xi[t] * q1
        f2 += xi[t] * q2
        m0 += p0
        m1 += p1
        m2 += xi[t] * p1
        s0 += g[t]
        s2 += g[t] * xi[t] ** 2
        e1 *= turn1
        e2 *= turn2
    inverse = 1 / max(s0 * s0 - (m0.real**2 + m0.imag**2), _REGULAR * s0 * s0)
    r1 = inverse * (s0 * c1 - m0 * c2)
    r2 = inverse * (s0 * c2 - m0.conjugate() * c1)
    power = (c1.conjugate() * r1 + c2.conjugate() * r2).real
    # Schur complement of the amplitudes; Σ g ξ = 0 because ξ is taken about the weighted mean.
    own = s2 - inverse * s0 * (m1.real**2 + m1.imag**2)
    mutual = m2 + inverse * m0.conjugate() * m1 * m1
    i11 = own * (r1.real**2 + r1.imag**2)
    i12 = (r1.conjugate() * r2 * mutual).real
    i22 = own * (r2.real**2 + r2.imag**2)
    d1 = (r1.conjugate() * (f1 - m1 * r2)).imag
    d2 = (r2.conjugate() * (f2 - m1.conjugate() * r1)).imag
    return r1, r2, power, i11, i12, i22, d1, d2


@compiled  # pragma: no cover
def _residues(folded: Reals, v1: float, v2: float) -> Any:
    """ρ₁ and ρ₂ of `_float_fit` alone."""
    last = folded.shape[0] - 1
    # ξ of the middle frequency is not zero where the weights are skew.
    xi, s0 = folded[last, 3] - 1, folded[last, 1]
    c1, c2, m0 = turned_sums(folded, v1, v2)
    inverse = 1 / max(s0 * s0 - (m0.real**2 + m0.imag**2), _REGULAR * s0 * s0)
    # The turns at the middle frequency, which c and m₀ are taken over, are those of ρ.
    r1, r2 = inverse * (s0 * c1 - m0 * c2), inverse * (s0 * c2 - m0.conjugate() * c1)
    return rotation(-xi * v1) * r1, rotation(-xi * v2) * r2


@compiled  # pragma: no cover
def _fixed_fit(folded: Reals, v1: float, v2: float) -> Any:
    """Least squares of y_t = a₁ e^{i(1+ξ_t)v₁} + a₂ e^{i(1+ξ_t)v₂} with real a, for weights g.

    Returns a₁, a₂, the explained power (-1 unless both amplitudes are positive), the diagonal and the off-diagonal
    element of the information matrix of (a₁v₁, a₂v₂), the gradient of half the power to these, and the two elements for
    (a₁, a₂).
    """
    last = folded.shape[0] - 1
    s0, s2 = folded[last, 1], folded[last, 2]
    c1, c2, f1, f2, m0, m1, m2 = sums(folded, v1, v2)
    inverse = 1 / max(s0 * s0 - m0 * m0, _REGULAR * s0 * s0)
    a1 = inverse * (s0 * c1 - m0 * c2)
    a2 = inverse * (s0 * c2 - m0 * c1)
    power = c1 * a1 + c2 * a2 if a1 > 0 and a2 > 0 else -1.0
    share = m1 * m1 / max(s2 * s2 - m2 * m2, _REGULAR * s2 * s2)
    return (
        a1, a2, power, s2 - inverse * s0 * m1 * m1, m2 - inverse * m0 * m1 * m1, f1 - a2 * m1, f2 + a1 * m1,
        s0 - share * s2, m0 - share * m2,
    )  # fmt: skip


@compiled  # pragma: no cover
def _refine_float(y: Phasors, g: Reals, xi: Reals, v1: float, v2: float, limit: float) -> Any:
    """Gauss-Newton on `_float_fit`, at most ``limit`` rad a step; returns v₁, v₂, ρ₁, ρ₂, power and information."""
    r1 = r2 = 0j
    power = i11 = i12 = i22 = 0.0
    t1, t2 = v1, v2
    for _ in range(7):
        q1, q2, gained, j11, j12, j22, d1, d2 = _float_fit(y, g, xi, t1, t2)
        if gained < power:
            # Too far, as happens where the paths are close: once more, nearer to the last place.
            t1, t2 = v1 + 0.3 * (t1 - v1), v2 + 0.3 * (t2 - v2)
            continue
        v1, v2, r1, r2, power, i11, i12, i22 = t1, t2, q1, q2, gained, j11, j12, j22
        inverse = 1 / max(i11 * i22 - i12 * i12, _REGULAR * i11 * i22)
        step1, step2 = inverse * (i22 * d1 - i12 * d2), inverse * (i11 * d2 - i12 * d1)
        size = max(abs(step1), abs(step2))
        shorten = min(1.0, limit / size)
        t1, t2 = v1 + shorten * step1, v2 + shorten * step2
        if size < 0.05 * limit:
            break
    return v1, v2, r1, r2, power, i11, i12, i22


@compiled  # pragma: no cover
def _refine_fixed(folded: Reals, v1: float, v2: float, tolerance: float) -> Any:
    """Levenberg-Marquardt on `_fixed_fit`.

    Returns whether a step gained less than ``tolerance``, v₁, v₂, a₁, a₂, the power and the information there.
    """
    a1 = a2 = own = mutual = d1 = d2 = own_a = mutual_a = damping = 0.0
    power, converged = -1.0, False
    t1, t2 = v1, v2
    for _ in range(_STEPS):
        b1, b2, gained, n_own, n_mutual, e1, e2, n_own_a, n_mutual_a = _fixed_fit(folded, t1, t2)
        if gained >= power:
            converged = gained - power < tolerance
            v1, v2, a1, a2, power, d1, d2 = t1, t2, b1, b2, gained, e1, e2
            own, mutual, own_a, mutual_a = n_own, n_mutual, n_own_a, n_mutual_a
            damping *= 0.1
        else:
            converged = power - gained < tolerance
            damping = max(10 * damping, 0.03)
        if converged or power < 0:
            break
        damped = own * (1 + damping)
        inverse = 1 / max(damped * damped - mutual * mutual, _REGULAR * own * own)
        step1, step2 = inverse * (damped * d1 - mutual * d2) / a1, inverse * (damped * d2 - mutual * d1) / a2
        shorten = 1 / max(1.0, abs(step1), abs(step2))
        t1, t2 = v1 + shorten * step1, v2 + shorten * step2
    return converged, v1, v2, a1, a2, power, own, mutual, own_a, mutual_a


@compiled  # pragma: no cover
def _strongest(folded: Reals, low: float, high: float, step: float) -> Any:
    """Of v = low, low + step, … < high the one where the data hold most of one path, and its complex amplitude."""
    last = folded.shape[0] - 1
    place, residue, most = low, 0j, -1.0
    for k in range(int((high - low) / step) + 1):
        c = turned_sum(folded, low + k * step)
        power = c.real**2 + c.imag**2
        if power > most:
            place, residue, most = low + k * step, c, power
    return place, 1 / folded[last, 1] * (rotation((1 - folded[last, 3]) * place) * residue)


@compiled  # pragma: no cover
def _nearest(v: float, r: complex) -> float:
    """The coordinate nearest to v whose phase is that of the residue r."""
    off = angle_of(r) - v
    return v + off - 2 * math.pi * math.floor(off * (0.5 / math.pi) + 0.5)


@compiled  # pragma: no cover
def _try_orders(
    folded: Reals, count: int, total: float, variance: float, solution: Any, turn: float, low: float, high: float,
    seeds: Reals, kept: Reals,
) -> None:  # fmt: skip
    """Fix the fringe orders of a float solution and improve the list ``kept`` (CANDIDATES, FIELDS)."""
    v1, v2, r1, r2, power, i11, i12, i22 = solution
    cycle = 2 * math.pi
    phase1, phase2 = angle_of(r1), angle_of(r2)
    n1, n2 = (v1 - phase1) / cycle, (v2 - phase2) / cycle
    # Where even the float solution misfits, the noise is not what limits it.
    scale = variance * max(1.0, (total - power) / (variance * (2 * count - 6)))
    determinant = max(i11 * i22 - i12 * i12, _REGULAR * i11 * i22)
    reach = min(_ORDER_CHI2 * scale / cycle**2, _ORDER_PAIRS / math.pi * math.sqrt(determinant))
    for j in range(_REFINED):
        seeds[j, 0] = math.inf
    # Of each interval at least the nearest order is tried; from the middle outwards, so that a good fit is found early.
    wide = max(0.5, min(math.sqrt(reach * i22 / determinant), _ORDER_REACH))
    low1, high1 = math.ceil(n1 - wide), math.floor(n1 + wide)
    middle1 = min(max(round(n1), low1), high1)
    floor, enough = total - power, math.inf
    for j1 in range(2 * max(middle1 - low1, high1 - middle1) + 1):
        k1 = middle1 + (-(j1 // 2) if j1 % 2 == 0 else (j1 + 1) // 2)
        if k1 < low1 or k1 > high1:
            continue
        centre = n2 - i12 / i22 * (k1 - n1)
        loss = (k1 - n1) ** 2 * determinant / i22
        rest = max(reach - loss, 0.0)
        narrow = max(0.5, min(math.sqrt(rest / i22), _ORDER_REACH)) + _ORDER_BEND * abs(k1 - n1)
        low2, high2 = math.ceil(centre - narrow), math.floor(centre + narrow)
        middle2 = min(max(round(centre), low2), high2)
        for j2 in range(2 * max(middle2 - low2, high2 - middle2) + 1):
            k2 = middle2 + (-(j2 // 2) if j2 % 2 == 0 else (j2 + 1) // 2)
            if k2 < low2 or k2 > high2:
                continue
            # Real amplitudes fit worse than complex ones: what these lose already is the least that is lost.
            bend = max(abs(k2 - centre) - _ORDER_BEND * abs(k1 - n1), 0.0)
            if floor + cycle**2 * (loss + bend**2 * i22) > enough:
                continue
            t1, t2 = phase1 + cycle * k1, phase2 + cycle * k2
            if abs(t1 - t2) < _CLOSEST_RAD:
                continue
            r1, r2 = _residues(folded, t1, t2)
            t1, t2 = _nearest(t1, r1), _nearest(t2, r2)
            a1, a2, gained, own, mutual, d1, d2, _, _ = _fixed_fit(folded, t1, t2)
            if gained < 0:
                continue
            # What one Gauss-Newton step, of at most one radian, promises to gain.
            inverse = 1 / max(own * own - mutual * mutual, _REGULAR * own * own)
            step1, step2 = inverse * (own * d1 - mutual * d2), inverse * (own * d2 - mutual * d1)
            shorten = 1 / max(1.0, abs(step1) / a1, abs(step2) / a2)
            cost = total - gained - shorten * (step1 * d1 + step2 * d2)
            place = _REFINED
            while place > 0 and cost < seeds[place - 1, 0]:
                place -= 1
            if place < _REFINED:
                for j in range(_REFINED - 1, place, -1):
                    for k in range(3):
                        seeds[j, k] = seeds[j - 1, k]
                seeds[place, 0] = cost
                seeds[place, 1] = t1 + shorten * step1 / a1
                seeds[place, 2] = t2 + shorten * step2 / a2
                enough = max(seeds[_REFINED - 1, 0], floor) + _SLACK_CHI2 * scale
    for j in range(_REFINED):
        if not seeds[j, 0] < math.inf:
            break
        converged, t1, t2, a1, a2, power, own, mutual, own_a, mutual_a = _refine_fixed(
            folded, seeds[j, 1], seeds[j, 2], _CONVERGED_CHI2 * variance
        )
        if turn > 0:
            t1 -= turn * math.floor((t1 - low) / turn)
            t2 -= turn * math.floor((t2 - low) / turn)
        if not (converged and power > 0 and low <= t1 < high and low <= t2 < high):
            continue
        if a1 < a2:
            t1, t2, a1, a2 = t2, t1, a2, a1
        # A scale-free prior, 1/(a₁ + a₂): of two fits equally good, the one with less light.
        score = total - power + 2 * variance * math.log(a1 + a2)
        # Diagonal elements of the inverse information matrices.
        var_v = own / max(own * own - mutual * mutual, _REGULAR * own * own)
        var_a = own_a / max(own_a * own_a - mutual_a * mutual_a, _REGULAR * own_a * own_a)
        _keep(kept, score, t1, t2, a1, a2, var_v, var_a)


@compiled  # pragma: no cover
def _keep(
    kept: Reals, score: float, v1: float, v2: float, a1: float, a2: float, var_v: float, var_a: float
) -> None:  # fmt: skip
    """Put a fit into the ascending list ``kept``, once."""
    count = kept.shape[0]
    place = count
    for k in range(count):
        if abs(v1 - kept[k, 1]) < 0.5 and abs(v2 - kept[k, 2]) < 0.5:
            if score >= kept[k, 0]:
                return
            # The same fit, a little better: its old place is the one that is overwritten.
            count = k + 1
            break
    while place > 0 and not score >= kept[place - 1, 0]:
        place -= 1
    if place >= count:
        return
    for k in range(count - 1, place, -1):
        for j in range(kept.shape[1]):
            kept[k, j] = kept[k - 1, j]
    kept[place, 0], kept[place, 1], kept[place, 2], kept[place, 3] = score, v1, v2, a1
    kept[place, 4], kept[place, 5], kept[place, 6] = a2, var_v, var_a


def workspace(count: int) -> Workspace:
    """Arrays that `separate_block` works in, of ``count`` frequencies; one set a thread."""
    m = count // 2 + 1
    return (
        np.empty(count, np.complex128),
        np.empty(count, np.complex128),
        np.empty((count // 2 + 2, COLUMNS)),
        np.empty((count // 2 + 2, COLUMNS)),
        np.empty((m, m)),
        np.empty((m, m)),
        np.empty((4, m)),
        np.empty((_REFINED, 3)),
        np.empty((CANDIDATES, FIELDS)),
    )


@compiled  # pragma: no cover
def separate_block(
    z: NDArray[np.complex64], sigma: Reals, gain: Reals, g: Reals, xi: Reals, unitary: Phasors, k1: Reals, k2: Reals,
    carrier: float, step_rad: float, turn: float, low: float, high: float, found: Floats, start: int, stop: int,
    work: Workspace,
) -> None:  # fmt: skip
    """Candidates of the pixels start..stop, written into ``found`` (CANDIDATES, 9, P) as `scanner.paths.separation`.

    ``work`` is `workspace`.
    """
    y, left, folded, folded_left, covariance, square, basis, seeds, kept = work
    count = z.shape[0]
    dof = 2 * count - 4
    # 1/Δf and the width of a path in the spectrum of the comb, 1/(TΔf), as phases of the carrier.
    period = 2 * math.pi / step_rad
    resolution = period / count
    middle = 0.5 * (low + high)
    for p in range(start, stop):
        variance = sigma[p] ** 2
        for t in range(count):
            y[t] = (1 / gain[t]) * z[t, p]
        fold(y, gain, 1.0, 1 + xi[0], xi[1] - xi[0], folded)
        total = folded[count // 2 + 1, 0]
        if not (0 < total < math.inf and 0 < variance < math.inf):
            continue
        for k in range(CANDIDATES):
            kept[k, 0], kept[k, 1], kept[k, 2], kept[k, 3], kept[k, 4] = math.inf, math.nan, math.nan, 1.0, 1.0
        pole1, pole2 = poles(y, unitary, k1, k2, covariance, square, basis)
        # Of the places that a pole may stand for, the one nearest to the middle of the picture.
        v1 = middle + period * ((pole1 / (2 * math.pi) - middle / period + 0.5) % 1 - 0.5)
        v2 = middle + period * ((pole2 / (2 * math.pi) - middle / period + 0.5) % 1 - 0.5)
        if not abs(v1 - v2) > 0.1 * resolution:
            # The poles have run together: take the likeliest of some distances about them.
            centre, most = (v1 if math.isnan(v2) else 0.5 * (v1 + v2)), -1.0
            for k in range(1, 5):
                apart = 0.06 * k * resolution
                power = _float_fit(y, g, xi, centre - apart, centre + apart)[2]
                if power > most:
                    v1, v2, most = centre - apart, centre + apart, power
        for attempt in range(2):
            if attempt == 1:
                v1, r = _strongest(folded, low, high, resolution / 8)
                for t in range(count):
                    left[t] = y[t] - r * rotation(xi[t] * v1)
                fold(left, gain, 1.0, 1 + xi[0], xi[1] - xi[0], folded_left)
                v2, _ = _strongest(folded_left, low, high, resolution / 8)
            solution = _refine_float(y, g, xi, v1, v2, 0.1 * resolution)
            _try_orders(folded, count, total, variance, solution, turn, low, high, seeds, kept)
            chi2 = kept[0, 0] / variance - 2 * math.log(kept[0, 3] + kept[0, 4])
            if chi2 < dof + 5 * math.sqrt(2 * dof):
                break
        for j in range(CANDIDATES):
            if not kept[j, 0] < math.inf:
                break
            for k in range(2):
                found[j, k, p] = kept[j, 1 + k] / carrier
                found[j, 2 + k, p] = kept[j, 3 + k]
                found[j, 4 + k, p] = sigma[p] * math.sqrt(kept[j, 5]) / (kept[j, 3 + k] * carrier)
            found[j, 6, p] = sigma[p] * math.sqrt(kept[j, 6])
            found[j, 7, p] = max(kept[j, 0] / variance - 2 * math.log(kept[j, 3] + kept[j, 4]), 0.0)
            found[j, 8, p] = (kept[j, 0] - kept[0, 0]) / variance
