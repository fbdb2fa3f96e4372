"""The data of a pixel on one axis, folded about the middle of the comb of frequencies.

The frequencies are equally spaced. About the middle one, ω_c, the two at either side of it, ω_c ± kΔω, see a path at u
turned by e^{∓ikΔωu}, so that of weighted data z₊ and z₋

    z₊ e^{-ikΔωu} + z₋ e^{ikΔωu} = (z₊ + z₋) cos kΔωu - i (z₊ - z₋) sin kΔωu:

sums and differences are taken once a pixel (`fold`), and a path costs half of the multiplications.

Numba's cache of the kernels does not see this file: `make` compiles them anew.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.rotation import compiled, rotation

Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

COLUMNS = 7
"""Of folded data."""


@compiled  # pragma: no cover
def fold(y: Phasors, gain: Reals, sigma: float, omega0: float, step: float, folded: Reals) -> None:
    """Sums and differences of the data about the middle of the comb.

    ``y`` (T,) are phasors over the trend. ``folded`` (T // 2 + 2, 7) gets a row for the middle frequency (zero where
    T is even), one for each pair: real and imaginary part of Σ g y and of the difference, Σ g and its difference, k;
    and a last one of Σ g|y|², Σ g, Σ g ω², ω_c, Δω.
    """
    count, pairs = y.size, y.size // 2
    middle, last = 0.5 * (count - 1), folded.shape[0] - 1
    for m in range(7):
        folded[0, m] = folded[last, m] = 0.0
    folded[last, 3], folded[last, 4] = omega0 + middle * step, step
    for t in range(count):
        g, omega = (gain[t] / sigma) ** 2, omega0 + t * step
        folded[last, 0] += g * (y[t].real * y[t].real + y[t].imag * y[t].imag)
        folded[last, 1] += g
        folded[last, 2] += g * omega * omega
    if count % 2:
        g = (gain[pairs] / sigma) ** 2
        folded[0, 0], folded[0, 1], folded[0, 4] = g * y[pairs].real, g * y[pairs].imag, g
    for j in range(1, pairs + 1):
        below, above = pairs - j, count - 1 - (pairs - j)
        g1, g2 = (gain[below] / sigma) ** 2, (gain[above] / sigma) ** 2
        folded[j, 0] = g2 * y[above].real + g1 * y[below].real
        folded[j, 1] = g2 * y[above].imag + g1 * y[below].imag
        folded[j, 2] = g2 * y[above].real - g1 * y[below].real
        folded[j, 3] = g2 * y[above].imag - g1 * y[below].imag
        folded[j, 4], folded[j, 5], folded[j, 6] = g2 + g1, g2 - g1, above - middle


@compiled  # pragma: no cover
def sums(folded: Reals, u1: float, u2: float) -> Any:
    """Weighted sums of one axis over its frequencies.

    With e_k = e^{-iωu_k} they are Σ g Re e₁y, Σ g Re e₂y, Σ gω Im e₁y, Σ gω Im e₂y, and of p = e₁ē₂
    Σ g Re p, Σ gω Im p, Σ gω² Re p.
    """
    last = folded.shape[0] - 1
    centre, step, k = folded[last, 3], folded[last, 4], folded[1, 6]
    middle1, middle2 = rotation(-centre * u1), rotation(-centre * u2)
    turn1, turn2 = rotation(k * step * u1), rotation(k * step * u2)
    cos1, sin1, cos2, sin2 = turn1.real, turn1.imag, turn2.real, turn2.imag
    if k < 1:
        # An even comb has no frequency in the middle: the first pair is half a step off.
        turn1, turn2 = turn1 * turn1, turn2 * turn2
    c1r, c1i, g1r, g1i = folded[0, 0], folded[0, 1], 0.0, 0.0
    c2r, c2i, g2r, g2i = c1r, c1i, 0.0, 0.0
    n0r, n0i, n1r, n1i, n2r, n2i = folded[0, 4], 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(1, last):
        sr, si, dr, di = folded[j, 0], folded[j, 1], folded[j, 2], folded[j, 3]
        weight, skew, k = folded[j, 4], folded[j, 5], folded[j, 6]
        c1r += sr * cos1 + di * sin1
        c1i += si * cos1 - dr * sin1
        g1r += k * (dr * cos1 + si * sin1)
        g1i += k * (di * cos1 - sr * sin1)
        c2r += sr * cos2 + di * sin2
        c2i += si * cos2 - dr * sin2
        g2r += k * (dr * cos2 + si * sin2)
        g2i += k * (di * cos2 - sr * sin2)
        cosine, sine = cos1 * cos2 + sin1 * sin2, sin1 * cos2 - cos1 * sin2
        even, odd = weight * cosine, skew * sine
        n0r += even
        n0i -= odd
        n2r += k * k * even
        n2i -= k * k * odd
        n1r += k * skew * cosine
        n1i -= k * weight * sine
        cos1, sin1 = cos1 * turn1.real - sin1 * turn1.imag, cos1 * turn1.imag + sin1 * turn1.real
        cos2, sin2 = cos2 * turn2.real - sin2 * turn2.imag, cos2 * turn2.imag + sin2 * turn2.real
    f1r, f1i = centre * c1r + step * g1r, centre * c1i + step * g1i
    f2r, f2i = centre * c2r + step * g2r, centre * c2i + step * g2i
    m1r, m1i = centre * n0r + step * n1r, centre * n0i + step * n1i
    m2r = centre * (m1r + step * n1r) + step * step * n2r
    m2i = centre * (m1i + step * n1i) + step * step * n2i
    p = middle1 * middle2.conjugate()
    return (
        middle1.real * c1r - middle1.imag * c1i,
        middle2.real * c2r - middle2.imag * c2i,
        middle1.real * f1i + middle1.imag * f1r,
        middle2.real * f2i + middle2.imag * f2r,
        p.real * n0r - p.imag * n0i,
        p.real * m1i + p.imag * m1r,
        p.real * m2r - p.imag * m2i,
    )


@compiled  # pragma: no cover
def turned_sums(folded: Reals, u1: float, u2: float) -> Any:
    """Σ g e₁y, Σ g e₂y and Σ g e₁ē₂ of `sums`, complex and over their turn at the middle frequency."""
    last = folded.shape[0] - 1
    step, k = folded[last, 4], folded[1, 6]
    turn1, turn2 = rotation(k * step * u1), rotation(k * step * u2)
    cos1, sin1, cos2, sin2 = turn1.real, turn1.imag, turn2.real, turn2.imag
    if k < 1:
        turn1, turn2 = turn1 * turn1, turn2 * turn2
    c1r, c1i = folded[0, 0], folded[0, 1]
    c2r, c2i, n0r, n0i = c1r, c1i, folded[0, 4], 0.0
    for j in range(1, last):
        sr, si, dr, di = folded[j, 0], folded[j, 1], folded[j, 2], folded[j, 3]
        c1r += sr * cos1 + di * sin1
        c1i += si * cos1 - dr * sin1
        c2r += sr * cos2 + di * sin2
        c2i += si * cos2 - dr * sin2
        n0r += folded[j, 4] * (cos1 * cos2 + sin1 * sin2)
        n0i -= folded[j, 5] * (sin1 * cos2 - cos1 * sin2)
        cos1, sin1 = cos1 * turn1.real - sin1 * turn1.imag, cos1 * turn1.imag + sin1 * turn1.real
        cos2, sin2 = cos2 * turn2.real - sin2 * turn2.imag, cos2 * turn2.imag + sin2 * turn2.real
    return complex(c1r, c1i), complex(c2r, c2i), complex(n0r, n0i)


@compiled  # pragma: no cover
def turned_sum(folded: Reals, u: float) -> complex:
    """The first of `turned_sums` alone."""
    last = folded.shape[0] - 1
    k = folded[1, 6]
    turn = rotation(k * folded[last, 4] * u)
    cosine, sine = turn.real, turn.imag
    if k < 1:
        turn *= turn
    real, imaginary = folded[0, 0], folded[0, 1]
    for j in range(1, last):
        real += folded[j, 0] * cosine + folded[j, 3] * sine
        imaginary += folded[j, 1] * cosine - folded[j, 2] * sine
        cosine, sine = cosine * turn.real - sine * turn.imag, cosine * turn.imag + sine * turn.real
    return complex(real, imaginary)
