"""The smooth surface of a window: a quadratic polynomial of the coordinate, and one of the amplitude."""

from __future__ import annotations

import numpy as np
from numba import njit

WINDOW = 24
"""Side of a window, cells: some turns of a ripple, over which the second path runs evenly."""

STRIDE = WINDOW // 2
"""From window to window: every cell lies in four."""

TERMS = 6
"""1, x, y, x², xy, y²."""

compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"})


@compiled
def terms(y, x, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Terms of the surface at a cell, the window's middle at zero and its ends at ±1."""
    half = np.float32(0.5 * (WINDOW - 1))
    yy, xx = (y - half) / half, (x - half) / half
    out[0], out[1], out[2] = 1.0, xx, yy
    out[3], out[4], out[5] = xx * xx, xx * yy, yy * yy


@compiled
def fit_surface(values, weights, terms, coefficients):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Coefficients of the weighted least squares fit."""
    normal = np.zeros((TERMS, TERMS))
    right = np.zeros(TERMS)
    for i in range(values.size):
        w = weights[i]
        if w > 0:
            for a in range(TERMS):
                p = w * terms[i, a]
                right[a] += p * values[i]
                for b in range(a + 1):
                    normal[a, b] += p * terms[i, b]
    for a in range(TERMS):
        normal[a, a] += 1e-9 * normal[0, 0]
        for b in range(a):
            normal[b, a] = normal[a, b]
    coefficients[:] = np.linalg.solve(normal, right)


@compiled
def values_of(coefficients, terms, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """The polynomial at the cells with these ``terms``."""
    for i in range(out.size):
        total = 0.0
        for a in range(TERMS):
            total += coefficients[a] * terms[i, a]
        out[i] = total
