"""Two-path separation: which two light paths does a pixel see, from the first round alone (method.md §6).

Where a bounce mixes with the direct light, a pixel's phasors at T equidistant frequencies are

    z_t = m_t (a₁ e^{i2πf_t u₁} + a₂ e^{i2πf_t u₂}) + noise,   a₁, a₂ > 0,

with the common modulation trend m_t. The likelihood has one sharp peak for every pair of fringe orders, and the search
runs as carrier-phase ambiguities are resolved in satellite navigation:

1. *Float solution*: amplitudes free to be complex. A forward-backward matrix pencil in real arithmetic (unitary ESPRIT,
   Haardt & Nossek, IEEE Trans. Signal Process. 43, 1995) gives the poles, thus u₁ and u₂ modulo 1/Δf; Gauss-Newton
   brings them to the maximum of the likelihood.
2. *Fringe orders*: with real amplitudes the phase of each residue at the centre frequency f_c gives u_k modulo 1/f_c.
   All pairs of orders that the Fisher information of the float solution leaves open are tried.
3. *Fixed solution*: Levenberg-Marquardt from the best of them; the lowest cost wins.

A pixel that no pair fits gets a second start: the one-path maximum and the strongest path in what that leaves over.

Amplitudes enter linearly and are eliminated in every fit (variable projection, Golub & Pereyra 1973), which leaves
2 x 2 systems in closed form. The kernels carry a coordinate as the phase v = 2πf_c u (rad) and a frequency as
ξ_t = f_t/f_c - 1, and divide the phasors by m_t, which leaves the weights g_t = m_t².
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from drivers.errors import OperatorError

Floats = NDArray[np.float32]
Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

_BLOCK = 2048
"""Pixels that a thread works on at a time."""

_ORDER_CHI2 = 100.0
"""Fringe orders within this χ² of the float solution are tried."""
_ORDER_REACH = 8.0
"""Fringes to either side of the float solution at most."""
_ORDER_BEND = 0.2
"""Fringes by which the region widens per fringe from the float solution, because the valley of the likelihood bends."""
_ORDER_PAIRS = 100.0
"""Area of the region at most: one hopeless pixel must not cost the time of a hundred."""
_REFINED = 3
"""Pairs of orders that are refined to convergence."""
_CLOSEST_RAD = math.pi / 2
"""Nearer than a quarter fringe, two paths are as good as one."""
_CONVERGED_CHI2 = 1e-4
"""A step that lowers χ² by less ends a refinement: it moves no coordinate by more than 1/100 of its σ."""
_REGULAR = 1e-9
"""Floor of a determinant relative to its diagonal."""
_TINY = 1e-300
_STEPS = 30
"""Levenberg-Marquardt steps at most; two or three are usual."""

# NaN and infinity keep their meaning.
_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


class SeparationPlanError(OperatorError):
    """The frequencies of a plan do not let two paths be separated."""


@dataclass(frozen=True)
class TwoPaths:
    """Two light paths per pixel on one axis; path 0 has the larger amplitude. NaN where no pair of paths was found.

    Parameters
    ----------
    u
        (2, P) projector coordinates, px.
    amplitude
        (2, P) modulation of each path, DN.
    sigma_u
        (2, P) predicted standard deviation of ``u``, px: inverse Fisher matrix, given the fringe orders.
    sigma_amplitude
        (P,) predicted standard deviation of either amplitude, DN.
    chi2
        (P,) χ² of the two-path fit; far above ``dof`` there is a third path.
    margin
        (P,) growth of χ² to the next best pair of fringe orders; infinite where no other came into question. Below
        about 10 the orders are in doubt, and with them ``u`` by whole fringes.
    converged
        (P,) bool, the fit ended in a maximum of the likelihood within the projector's extent.
    dof
        Degrees of freedom of ``chi2``, 2T - 4.
    """

    u: Floats
    amplitude: Floats
    sigma_u: Floats
    sigma_amplitude: Floats
    chi2: Floats
    margin: Floats
    converged: NDArray[np.bool_]
    dof: int


def separate_two_paths(
    z: ArrayLike, frequency: ArrayLike, sigma_z: ArrayLike, extent: float, gain: ArrayLike | None = None
) -> TwoPaths:
    """Separate the two light paths of every pixel on one axis.

    Parameters
    ----------
    z
        (T, P) complex phasors of the pixels in question, DN.
    frequency
        (T,) f_t, 1/px; T ≥ 5, equidistant in any order.
    sigma_z
        (P,) standard deviation of the real and of the imaginary part of a phasor, DN.
    extent
        Projector pixels along the axis; coordinates lie in [-1/2, extent - 1/2).
    gain
        (T,) common modulation trend m_t > 0; None for 1.

    Raises
    ------
    SeparationPlanError
        Fewer than five frequencies, not equidistant, or Δf so wide that 1/Δf is below ``extent``.
    ValueError
        Shapes that do not belong together, or a gain that is not positive.

    Notes
    -----
    method.md §6. Every pixel is fitted; whether it needs two paths is for the one-path χ² to say.
    """
    phasors, sigma, comb = _prepare(z, frequency, sigma_z, extent, gain)
    pixels = phasors.shape[1]
    found = np.full((9, pixels), np.nan, np.float32)

    def separate(start: int) -> None:
        _separate_block(
            phasors, sigma, comb.gain, comb.weight, comb.xi, *comb.pencil, comb.carrier, comb.step_rad, comb.turn,
            comb.low, comb.high, found, start, min(start + _BLOCK, pixels),
        )  # fmt: skip

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(separate, range(0, pixels, _BLOCK)))
    return _two_paths(found, len(comb.gain))


def _two_paths(found: Floats, count: int) -> TwoPaths:
    return TwoPaths(
        u=found[0:2],
        amplitude=found[2:4],
        sigma_u=found[4:6],
        sigma_amplitude=found[6],
        chi2=found[7],
        margin=found[8],
        converged=np.isfinite(found[0]),
        dof=2 * count - 4,
    )


@dataclass(frozen=True)
class _Comb:
    """The equidistant frequencies in the kernels' terms.

    ``gain`` (T,) m_t; ``weight`` (T,) m_t²; ``xi`` (T,) ξ_t about the weighted mean frequency; ``carrier`` 2πf_c,
    rad/px; ``step_rad`` Δf/f_c, so that v·step_rad is the angle of a pole; ``turn`` the v after which all fringes
    coincide again, 0 where that is not 1/Δf; ``low`` and ``high`` the range of v; ``pencil`` the matrices of
    `_unitary_esprit`.
    """

    gain: Reals
    weight: Reals
    xi: Reals
    carrier: float
    step_rad: float
    turn: float
    low: float
    high: float
    pencil: tuple[Phasors, Reals, Reals]


def _prepare(
    z: ArrayLike, frequency: ArrayLike, sigma_z: ArrayLike, extent: float, gain: ArrayLike | None
) -> tuple[NDArray[np.complex64], Reals, _Comb]:
    """Check the arguments of `separate_two_paths` and bring the frequencies into ascending order."""
    phasors = np.ascontiguousarray(z, np.complex64)
    f = np.asarray(frequency, np.float64)
    sigma = np.ascontiguousarray(sigma_z, np.float64)
    trend = np.ones(f.shape) if gain is None else np.asarray(gain, np.float64)
    if phasors.ndim != 2 or f.shape != phasors.shape[:1] or trend.shape != f.shape or sigma.shape != phasors.shape[1:]:
        raise ValueError(f"z {phasors.shape}, frequency {f.shape}, gain {trend.shape}, sigma_z {sigma.shape}")
    if not np.all(trend > 0):
        raise ValueError(f"gain {trend}: must be positive")
    if f.size < 5:
        raise SeparationPlanError(
            f"Two-path separation: the plan has {f.size} frequencies on the axis, 5 are the least",
            "Use a plan of more frequencies, such as the nine of the method mfs.",
        )
    order = np.argsort(f)
    f, trend, phasors = f[order], trend[order], np.ascontiguousarray(phasors[order])
    spacing = (f[-1] - f[0]) / (f.size - 1)
    even = f[0] + spacing * np.arange(f.size)
    if spacing <= 0 or 2 * np.pi * extent * np.abs(f - even).max() > 0.01:
        periods = ", ".join(f"{1 / v:.6g}" for v in f)
        raise SeparationPlanError(
            f"Two-path separation: the frequencies of the periods {periods} px are not equidistant",
            "Choose frequencies f0 + t·Δf with t = 0, 1, 2, …, such as (80 + t)/1280 per px.",
        )
    if spacing * extent > 1 + 1e-9:
        raise SeparationPlanError(
            f"Two-path separation: a frequency spacing of 1/{1 / spacing:.6g} per px repeats within {extent:g} px",
            f"Choose a frequency spacing of 1/{extent:g} per px or less.",
        )
    centre = float(trend**2 @ even / (trend @ trend))
    carrier = 2 * math.pi * centre
    coincide = abs(even[0] / spacing - round(even[0] / spacing)) < 1e-6
    return (
        phasors,
        sigma,
        _Comb(
            gain=trend,
            weight=trend**2,
            xi=even / centre - 1,
            carrier=carrier,
            step_rad=spacing / centre,
            turn=carrier / spacing if coincide else 0.0,
            low=-0.5 * carrier,
            high=(extent - 0.5) * carrier,
            pencil=_unitary_esprit(f.size // 2 + 1),
        ),
    )


def _unitary_esprit(m: int) -> tuple[Phasors, Reals, Reals]:
    """Transform Qᴴ (m, m) that makes a forward-backward covariance real, and the matrices K₁, K₂ (m - 1, m) for poles.

    For the signal subspace E and a pole e^{iμ}: K₁ E tan(μ/2) = K₂ E.
    """

    def transform(size: int) -> Phasors:
        half = size // 2
        eye, flip = np.eye(half), np.eye(half)[::-1]
        q = np.zeros((size, size), np.complex128)
        q[:half, :half], q[:half, size - half :] = eye, 1j * eye
        q[size - half :, :half], q[size - half :, size - half :] = flip, -1j * flip
        if size % 2:
            q[half, half] = math.sqrt(2)
        return np.ascontiguousarray(q.conj().T) / math.sqrt(2)

    unitary = transform(m)
    shifted = transform(m - 1) @ np.eye(m)[1:] @ unitary.conj().T
    return unitary, np.ascontiguousarray(shifted.real), np.ascontiguousarray(shifted.imag)


@_compiled  # pragma: no cover
def _turn(angle: float) -> complex:
    return complex(math.cos(angle), math.sin(angle))


@_compiled  # pragma: no cover
def _float_fit(y: Phasors, g: Reals, xi: Reals, v1: float, v2: float) -> Any:
    """Least squares of y_t = ρ₁ e^{iξ_t v₁} + ρ₂ e^{iξ_t v₂} with complex ρ, for weights g.

    Returns ρ₁, ρ₂, the explained power, the information matrix of (v₁, v₂) (elements 11, 12, 22) and the gradient of
    half the power.
    """
    dx = xi[1] - xi[0]
    e1, turn1, e2, turn2 = _turn(xi[0] * v1), _turn(dx * v1), _turn(xi[0] * v2), _turn(dx * v2)
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


@_compiled  # pragma: no cover
def _fixed_fit(y: Phasors, g: Reals, xi: Reals, v1: float, v2: float) -> Any:
    """Least squares of y_t = a₁ e^{i(1+ξ_t)v₁} + a₂ e^{i(1+ξ_t)v₂} with real a, for weights g.

    Returns a₁, a₂, the explained power (-1 unless both amplitudes are positive), the diagonal and the off-diagonal
    element of the information matrix of (a₁v₁, a₂v₂), the gradient of half the power to these, and the two elements for
    (a₁, a₂).
    """
    dx, x = xi[1] - xi[0], 1 + xi[0]
    e1, turn1, e2, turn2 = _turn(x * v1), _turn(dx * v1), _turn(x * v2), _turn(dx * v2)
    c1 = c2 = f1 = f2 = m0 = m1 = m2 = s0 = s2 = 0.0
    for t in range(y.size):
        q1, q2, p = e1.conjugate() * y[t], e2.conjugate() * y[t], e1.conjugate() * e2
        w = g[t]
        c1 += w * q1.real
        c2 += w * q2.real
        m0 += w * p.real
        s0 += w
        w *= 1 + xi[t]
        f1 += w * q1.imag
        f2 += w * q2.imag
        m1 += w * p.imag
        w *= 1 + xi[t]
        m2 += w * p.real
        s2 += w
        e1 *= turn1
        e2 *= turn2
    inverse = 1 / max(s0 * s0 - m0 * m0, _REGULAR * s0 * s0)
    a1 = inverse * (s0 * c1 - m0 * c2)
    a2 = inverse * (s0 * c2 - m0 * c1)
    power = c1 * a1 + c2 * a2 if a1 > 0 and a2 > 0 else -1.0
    share = m1 * m1 / max(s2 * s2 - m2 * m2, _REGULAR * s2 * s2)
    return (
        a1, a2, power, s2 - inverse * s0 * m1 * m1, m2 - inverse * m0 * m1 * m1, f1 - a2 * m1, f2 + a1 * m1,
        s0 - share * s2, m0 - share * m2,
    )  # fmt: skip


@_compiled  # pragma: no cover
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


@_compiled  # pragma: no cover
def _refine_fixed(y: Phasors, g: Reals, xi: Reals, v1: float, v2: float, tolerance: float) -> Any:
    """Levenberg-Marquardt on `_fixed_fit`.

    Returns whether a step gained less than ``tolerance``, v₁, v₂, a₁, a₂, the power and the information there.
    """
    a1 = a2 = own = mutual = d1 = d2 = own_a = mutual_a = damping = 0.0
    power, converged = -1.0, False
    t1, t2 = v1, v2
    for _ in range(_STEPS):
        b1, b2, gained, n_own, n_mutual, e1, e2, n_own_a, n_mutual_a = _fixed_fit(y, g, xi, t1, t2)
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


@_compiled  # pragma: no cover
def _pencil(y: Phasors, unitary: Phasors, k1: Reals, k2: Reals, c: Reals, c2: Reals, e: Reals) -> Any:
    """Angles (rad per Δf) of the two strongest poles by unitary ESPRIT; NaN where they do not lie apart on the circle.

    ``c``, ``c2`` (m, m) and ``e`` (4, m) are workspace.
    """
    m = unitary.shape[0]
    for a in range(m):
        for b in range(m):
            c[a, b] = 0.0
    # Forward-backward covariance of the windows of m phasors, which the unitary transform makes real.
    for j in range(y.size - m + 1):
        for a in range(m):
            s = 0j
            for b in range(m):
                s += unitary[a, b] * y[j + b]
            e[0, a], e[1, a] = s.real, s.imag
        for a in range(m):
            for b in range(m):
                c[a, b] += e[0, a] * e[0, b] + e[1, a] * e[1, b]
    for a in range(m):
        e[0, a], e[1, a] = c[0, a], c[m - 1, a]
        for b in range(m):
            dot = 0.0
            for k in range(m):
                dot += c[a, k] * c[k, b]
            c2[a, b] = dot
    # Signal subspace: orthogonal iteration on the square of the covariance.
    for _ in range(5):
        s1 = s2 = dot = 0.0
        for a in range(m):
            n1 = n2 = 0.0
            for b in range(m):
                n1 += c2[a, b] * e[0, b]
                n2 += c2[a, b] * e[1, b]
            e[2, a], e[3, a] = n1, n2
            s1 += n1 * n1
            dot += n1 * n2
        s1 = 1 / max(s1, _TINY)
        for a in range(m):
            e[3, a] -= s1 * dot * e[2, a]
            s2 += e[3, a] * e[3, a]
        s1, s2 = math.sqrt(s1), 1 / math.sqrt(max(s2, _TINY))
        for a in range(m):
            e[0, a], e[1, a] = s1 * e[2, a], s2 * e[3, a]
    # Least squares of K₁ E Ω = K₂ E; the eigenvalues of the 2 x 2 matrix Ω are tan(μ/2).
    n11 = n12 = n22 = o11 = o12 = o21 = o22 = 0.0
    for a in range(m - 1):
        p1 = p2 = q1 = q2 = 0.0
        for b in range(m):
            p1 += k1[a, b] * e[0, b]
            p2 += k1[a, b] * e[1, b]
            q1 += k2[a, b] * e[0, b]
            q2 += k2[a, b] * e[1, b]
        n11 += p1 * p1
        n12 += p1 * p2
        n22 += p2 * p2
        o11 += p1 * q1
        o12 += p1 * q2
        o21 += p2 * q1
        o22 += p2 * q2
    inverse = 1 / max(n11 * n22 - n12 * n12, _TINY)
    half_trace = 0.5 * inverse * (n22 * o11 - n12 * o21 + n11 * o22 - n12 * o12)
    determinant = inverse * (o11 * o22 - o12 * o21)
    spread = half_trace**2 - determinant
    if not spread > 0:
        return 2 * math.atan(half_trace), math.nan
    spread = math.sqrt(spread)
    return 2 * math.atan(half_trace - spread), 2 * math.atan(half_trace + spread)


@_compiled  # pragma: no cover
def _strongest(y: Phasors, g: Reals, xi: Reals, low: float, high: float, step: float) -> Any:
    """Of v = low, low + step, … < high the one where y holds most of one path, and the path's complex amplitude."""
    dx = xi[1] - xi[0]
    place, residue, most, s0 = low, 0j, -1.0, 0.0
    for t in range(y.size):
        s0 += g[t]
    for k in range(int((high - low) / step) + 1):
        v = low + k * step
        e, turn = _turn(-xi[0] * v), _turn(-dx * v)
        c = 0j
        for t in range(y.size):
            c += g[t] * (e * y[t])
            e *= turn
        power = c.real**2 + c.imag**2
        if power > most:
            place, residue, most = v, 1 / s0 * c, power
    return place, residue


@_compiled  # pragma: no cover
def _nearest(v: float, r: complex) -> float:
    """The coordinate nearest to v whose phase is that of the residue r."""
    off = math.atan2(r.imag, r.real) - v
    return v + off - 2 * math.pi * round(off / (2 * math.pi))


@_compiled  # pragma: no cover
def _try_orders(
    y: Phasors, g: Reals, xi: Reals, total: float, variance: float, solution: Any, turn: float, low: float, high: float,
    seeds: Reals, best: Reals,
) -> None:  # fmt: skip
    """Fix the fringe orders of a float solution and improve ``best``.

    ``best`` holds the score, the runner-up's score, v₁, v₂, a₁, a₂ and, per σ_z², the variances of a·v and of a.
    """
    v1, v2, r1, r2, power, i11, i12, i22 = solution
    cycle = 2 * math.pi
    phase1, phase2 = math.atan2(r1.imag, r1.real), math.atan2(r2.imag, r2.real)
    n1, n2 = (v1 - phase1) / cycle, (v2 - phase2) / cycle
    # Where even the float solution misfits, the noise is not what limits it.
    scale = variance * max(1.0, (total - power) / (variance * (2 * y.size - 6)))
    determinant = max(i11 * i22 - i12 * i12, _REGULAR * i11 * i22)
    reach = min(_ORDER_CHI2 * scale / cycle**2, _ORDER_PAIRS / math.pi * math.sqrt(determinant))
    for j in range(_REFINED):
        seeds[j, 0] = math.inf
    # Of each interval at least the nearest order is tried.
    wide = max(0.5, min(math.sqrt(reach * i22 / determinant), _ORDER_REACH))
    for k1 in range(math.ceil(n1 - wide), math.floor(n1 + wide) + 1):
        centre = n2 - i12 / i22 * (k1 - n1)
        rest = max(reach - (k1 - n1) ** 2 * determinant / i22, 0.0)
        narrow = max(0.5, min(math.sqrt(rest / i22), _ORDER_REACH)) + _ORDER_BEND * abs(k1 - n1)
        for k2 in range(math.ceil(centre - narrow), math.floor(centre + narrow) + 1):
            t1, t2 = phase1 + cycle * k1, phase2 + cycle * k2
            if abs(t1 - t2) < _CLOSEST_RAD:
                continue
            r1, r2, _, _, _, _, _, _ = _float_fit(y, g, xi, t1, t2)
            t1, t2 = _nearest(t1, r1), _nearest(t2, r2)
            a1, a2, power, own, mutual, d1, d2, _, _ = _fixed_fit(y, g, xi, t1, t2)
            if power < 0:
                continue
            # What one Gauss-Newton step, of at most one radian, promises to gain.
            inverse = 1 / max(own * own - mutual * mutual, _REGULAR * own * own)
            step1, step2 = inverse * (own * d1 - mutual * d2), inverse * (own * d2 - mutual * d1)
            shorten = 1 / max(1.0, abs(step1) / a1, abs(step2) / a2)
            cost = total - power - shorten * (step1 * d1 + step2 * d2)
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
    for j in range(_REFINED):
        if not seeds[j, 0] < math.inf:
            break
        converged, t1, t2, a1, a2, power, own, mutual, own_a, mutual_a = _refine_fixed(
            y, g, xi, seeds[j, 1], seeds[j, 2], _CONVERGED_CHI2 * variance
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
        known = abs(t1 - best[2]) < 0.5 and abs(t2 - best[3]) < 0.5
        if score < best[0]:
            if not known:
                best[1] = best[0]
            best[0], best[2], best[3], best[4], best[5] = score, t1, t2, a1, a2
            # Diagonal elements of the inverse information matrices.
            best[6] = own / max(own * own - mutual * mutual, _REGULAR * own * own)
            best[7] = own_a / max(own_a * own_a - mutual_a * mutual_a, _REGULAR * own_a * own_a)
        elif not known:
            best[1] = min(best[1], score)


@_compiled  # pragma: no cover
def _separate_block(
    z: NDArray[np.complex64], sigma: Reals, gain: Reals, g: Reals, xi: Reals, unitary: Phasors, k1: Reals, k2: Reals,
    carrier: float, step_rad: float, turn: float, low: float, high: float, found: Floats, start: int, stop: int,
) -> None:  # fmt: skip
    """Two paths of the pixels start..stop; rows of ``found`` in the order of `_two_paths`."""
    count, m = z.shape[0], k1.shape[1]
    y, left = np.empty(count, np.complex128), np.empty(count, np.complex128)
    covariance, square, basis = np.empty((m, m)), np.empty((m, m)), np.empty((4, m))
    seeds, best = np.empty((_REFINED, 3)), np.empty(8)
    dof = 2 * count - 4
    # 1/Δf and the width of a path in the spectrum of the comb, 1/(TΔf), as phases of the carrier.
    period = 2 * math.pi / step_rad
    resolution = period / count
    middle = 0.5 * (low + high)
    for p in range(start, stop):
        variance = sigma[p] ** 2
        total = 0.0
        for t in range(count):
            y[t] = (1 / gain[t]) * z[t, p]
            total += g[t] * (y[t].real ** 2 + y[t].imag ** 2)
        if not (0 < total < math.inf and 0 < variance < math.inf):
            continue
        best[0], best[1], best[2], best[4], best[5] = math.inf, math.inf, math.nan, 1.0, 1.0
        pole1, pole2 = _pencil(y, unitary, k1, k2, covariance, square, basis)
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
                v1, r = _strongest(y, g, xi, low, high, resolution / 8)
                for t in range(count):
                    left[t] = y[t] - r * _turn(xi[t] * v1)
                v2, _ = _strongest(left, g, xi, low, high, resolution / 8)
            solution = _refine_float(y, g, xi, v1, v2, 0.1 * resolution)
            _try_orders(y, g, xi, total, variance, solution, turn, low, high, seeds, best)
            chi2 = best[0] / variance - 2 * math.log(best[4] + best[5])
            if chi2 < dof + 5 * math.sqrt(2 * dof):
                break
        if best[0] < math.inf:
            for k in range(2):
                found[k, p] = best[2 + k] / carrier
                found[2 + k, p] = best[4 + k]
                found[4 + k, p] = sigma[p] * math.sqrt(best[6]) / (best[4 + k] * carrier)
            found[6, p] = sigma[p] * math.sqrt(best[7])
            found[7, p] = max(chi2, 0.0)
            found[8, p] = (best[1] - best[0]) / variance


def separate_two_paths_twin(
    z: ArrayLike, frequency: ArrayLike, sigma_z: float, extent: float, gain: ArrayLike | None = None, reach: int = 2
) -> TwoPaths:
    """Plain NumPy twin of `separate_two_paths` for one pixel.

    Complex matrix pencil by singular value decomposition, every pair of fringe orders up to ``reach`` to either side,
    bounded least squares from each.

    Parameters
    ----------
    z
        (T,) complex phasors, DN.
    frequency, sigma_z, extent, gain
        As in `separate_two_paths`; ``sigma_z`` of the one pixel.
    reach
        Fringe orders tried to either side.
    """
    f, z = np.asarray(frequency, np.float64), np.asarray(z, np.complex128)
    m = np.ones(f.size) if gain is None else np.asarray(gain, np.float64)
    centre = m**2 @ f / (m @ m)
    windows = np.lib.stride_tricks.sliding_window_view(z / m, f.size // 2 + 1)
    signal = np.linalg.svd(np.vstack([windows, windows[:, ::-1].conj()]))[2][:2].T
    poles = np.linalg.eigvals(np.linalg.lstsq(signal[:-1], signal[1:])[0])
    coarse = np.angle(poles) / (2 * np.pi * (f[1] - f[0])) % (1 / (f[1] - f[0]))

    def model(p: Reals) -> tuple[Phasors, Phasors]:
        """Phasors of (a₁, u₁, a₂, u₂) and their derivatives (T, 4)."""
        first, second = (m * np.exp(2j * np.pi * f * u) for u in (p[1], p[3]))
        turn = 2j * np.pi * f
        slopes = np.stack([first, p[0] * turn * first, second, p[2] * turn * second], axis=1)
        return p[0] * first + p[2] * second, slopes

    def misfit(p: Reals) -> Reals:
        off = model(p)[0] - z
        return np.concatenate([off.real, off.imag]) / sigma_z

    def jacobian_of(p: Reals) -> Reals:
        slopes = model(p)[1]
        return np.concatenate([slopes.real, slopes.imag]) / sigma_z

    solutions: list[tuple[float, float, Reals]] = []
    for orders in np.ndindex(2 * reach + 1, 2 * reach + 1):
        near = coarse + (np.array(orders) - reach) / centre
        residues = np.linalg.lstsq(m[:, None] * np.exp(2j * np.pi * np.outer(f - centre, near)), z)[0]
        cycles = np.angle(residues) / (2 * np.pi) - centre * near
        fine = near + (cycles - np.round(cycles)) / centre
        start = np.array([abs(residues[0]), fine[0], abs(residues[1]), fine[1]])
        fit = least_squares(
            misfit,
            start,
            jacobian_of,
            bounds=([0, -np.inf, 0, -np.inf], np.inf),
            x_scale=[1.0, 0.1, 1.0, 0.1],
            ftol=1e-10,
        )
        p = fit.x if fit.x[0] >= fit.x[2] else fit.x[[2, 3, 0, 1]]
        p[1::2] = (p[1::2] + 0.5) % (1 / (f[1] - f[0])) - 0.5
        if np.all(p[::2] > 0) and np.all(p[1::2] < extent - 0.5):
            chi2 = 2 * fit.cost
            solutions.append((chi2 + 2 * math.log(p[0] + p[2]), chi2, p))
    solutions.sort(key=lambda solution: solution[0])
    score, chi2, p = solutions[0]
    others = (s[0] - score for s in solutions if np.abs(s[2] - p)[1::2].max() > 0.1 / centre)
    jacobian = jacobian_of(p)
    sigma = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    column = [p[1], p[3], p[0], p[2], sigma[1], sigma[3], sigma[0], chi2, next(others, math.inf)]
    return _two_paths(np.array(column, np.float32)[:, None], f.size)


_LARGER_IS_DIRECT = 0.9
"""Of bounces, the share that is weaker than the direct light (method.md §6)."""
_EPIPOLAR_PX, _EPIPOLAR_STRAY = 0.1, 0.02
"""Error of a calibrated rig, px, and the share of direct paths that a wrong fringe order throws off the line."""
_RATIO, _RATIO_STRAY = 0.05, 0.1
"""Relative difference of the optics' modulation between the axes, and the share of pixels where it is more."""
_NEIGHBOUR_PX, _NEIGHBOUR_STRAY = 3.0, 0.1
"""Change of a coordinate to the next pixels, px, and the share of pixels beyond a depth edge."""
_SPAN_PX = 1000.0
"""Range over which a coordinate or a distance that is wrong may lie, px."""


@dataclass(frozen=True)
class DirectPath:
    """Which of a pixel's two paths is the direct one.

    Parameters
    ----------
    ix, iy
        (P,) index 0 or 1 into the two paths of the first and of the second axis; equal where there is one axis.
    confidence
        (P,) log-likelihood ratio of the choice against the next best; NaN where an axis has no finite path.
    """

    ix: NDArray[np.intp]
    iy: NDArray[np.intp]
    confidence: Floats


def choose_direct(
    x: TwoPaths,
    y: TwoPaths | None = None,
    *,
    distance_px: ArrayLike | None = None,
    sigma_px: ArrayLike | None = None,
    near_x: ArrayLike | None = None,
    near_y: ArrayLike | None = None,
) -> DirectPath:
    """Choose the direct one of two paths per axis by likelihood (method.md §6).

    Four terms, each with a share of strays so that none overrules all others: the direct pair lies on the pixel's
    epipolar line, a bounce by chance only; the direct path has the same amplitude in both axes; the larger amplitude is
    direct in nine of ten; neighbours see nearby coordinates.

    Parameters
    ----------
    x, y
        Two paths of the same P pixels on one or two axes.
    distance_px, sigma_px
        (4, P) signed distance of (x_i, y_j) from the epipolar line and its standard deviation, px, in the order
        (i, j) = 00, 01, 10, 11; None without a rig. NaN in ``sigma_px`` counts as 0: the rig's own error is added.
    near_x, near_y
        (P,) coordinate that the neighbours suggest, px, NaN where they do not.

    Raises
    ------
    ValueError
        Different numbers of pixels, or a distance without its σ or without a second axis.
    """
    pixels = x.u.shape[1]
    shape = (2, 1 if y is None else 2, pixels)
    if (distance_px is None) != (sigma_px is None) or (distance_px is not None and y is None):
        raise ValueError("the epipolar term needs both axes, distance_px and sigma_px")
    if y is not None and y.u.shape != x.u.shape:
        raise ValueError(f"{pixels} pixels on the first axis, {y.u.shape[1]} on the second")
    score = np.zeros(shape)
    axes: list[tuple[TwoPaths, ArrayLike | None, Any]] = [(x, near_x, (slice(None), None))]
    if y is not None:
        axes.append((y, near_y, (None, slice(None))))
    for paths, near, spread in axes:
        # Where the amplitudes differ by no more than their noise, their order says nothing.
        lead = paths.amplitude[0] - paths.amplitude[1]
        sure = np.nan_to_num(ndtr(lead / (math.sqrt(2) * paths.sigma_amplitude)), nan=0.5)
        larger = _LARGER_IS_DIRECT * sure + (1 - _LARGER_IS_DIRECT) * (1 - sure)
        score += np.log([larger, 1 - larger])[spread] / len(axes)
        score[np.broadcast_to(~np.isfinite(paths.u)[spread], shape)] = -np.inf
        if near is not None:
            off = paths.u - np.asarray(near, np.float64)
            vote = _log_likelihood(off, np.hypot(paths.sigma_u, _NEIGHBOUR_PX), _NEIGHBOUR_STRAY, 1 / _SPAN_PX)
            score += np.nan_to_num(vote)[spread]
    if y is not None:
        one, two = x.amplitude[:, None], y.amplitude[None]
        noise = np.hypot(x.sigma_amplitude, y.sigma_amplitude)
        allowed = np.sqrt(noise**2 + (_RATIO * 0.5 * (one + two)) ** 2)
        ratio = _log_likelihood(one - two, allowed, _RATIO_STRAY, 1 / (x.amplitude[0] + y.amplitude[0]))
        score += np.nan_to_num(ratio)
    if distance_px is not None:
        distance = np.asarray(distance_px, np.float64).reshape(shape)
        noise = np.hypot(np.nan_to_num(np.asarray(sigma_px, np.float64)).reshape(shape), _EPIPOLAR_PX)
        line = _log_likelihood(distance, noise, _EPIPOLAR_STRAY, 1 / _SPAN_PX)
        score += np.where(np.isfinite(distance), line, math.log(_EPIPOLAR_STRAY / _SPAN_PX))
    flat = score.reshape(-1, pixels)
    best = flat.argmax(axis=0)
    ranked = np.sort(flat, axis=0)
    with np.errstate(invalid="ignore"):
        confidence = (ranked[-1] - ranked[-2]).astype(np.float32)
    ix, iy = (best, best) if y is None else (best // 2, best % 2)
    return DirectPath(ix, iy, confidence)


def _log_likelihood(off: Any, sigma: Any, stray: float, density: Any) -> Any:
    """Log density of a deviation that is normal or, in a share ``stray`` of cases, anywhere with ``density``."""
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = -0.5 * (off / sigma) ** 2 - np.log(math.sqrt(2 * math.pi) * sigma)
        return np.logaddexp(math.log(1 - stray) + normal, np.log(stray * density))
