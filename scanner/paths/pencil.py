"""Matrix pencil in real arithmetic: unitary ESPRIT (Haardt & Nossek, IEEE Trans. Signal Process. 43, 1995).

Numba's cache of the kernels that call `poles` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.paths.rotation import compiled

Reals = NDArray[np.float64]
Phasors = NDArray[np.complex128]

_TINY = 1e-300


def unitary_esprit(m: int) -> tuple[Phasors, Reals, Reals]:
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


@compiled  # pragma: no cover
def poles(y: Phasors, unitary: Phasors, k1: Reals, k2: Reals, c: Reals, c2: Reals, e: Reals) -> Any:
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
