"""Which pixels belong to a region? Evidence of single pixels, joined under a price for every pixel of boundary.

The labelling x ∈ {0, 1} minimises ``-Σ evidence·x + price·length of the boundary``: the Ising model of Greig, Porteous
and Seheult (J. R. Stat. Soc. B 51, 271 (1989)) with the boundary's length measured isotropically. Relaxed to
x ∈ [0, 1] the problem is convex, and its solution thresholded at 1/2 is a global minimum of the binary one (Chan,
Esedoglu and Nikolova, SIAM J. Appl. Math. 66, 1632 (2006)); the primal-dual iteration is that of Chambolle and Pock
(J. Math. Imaging Vis. 40, 120 (2011)).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.kernels import over_rows

BOUNDARY_PRICE = math.log(3)
"""Nats for a pixel of boundary: it goes on in one of three directions (Freeman's chain code; Leclerc 1989)."""

_STEP = np.float32(0.35)
"""Step of both iterations; their product must not exceed 1/8, one over the squared norm of the gradient."""

_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"})


def label(
    evidence: NDArray[np.float32],
    price: float = BOUNDARY_PRICE,
    iterations: int = 150,
    start: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Relaxed labelling (H, W), 0..1; above 1/2 a pixel belongs to the region.

    Parameters
    ----------
    evidence
        (H, W) log-likelihood ratio of "in the region" against "outside", nats; 0 where nothing is known.
    price
        Nats for a pixel of boundary.
    iterations
        Primal-dual iterations. Information travels about one pixel in each.
    start
        (H, W) a labelling to start from, 0..1; None starts from the sign of the evidence.
    """
    x = (evidence > 0).astype(np.float32) if start is None else start.astype(np.float32)
    ahead = x.copy()
    across, down = np.zeros_like(x), np.zeros_like(x)
    values = np.ascontiguousarray(evidence, np.float32)
    for _ in range(iterations):
        over_rows(lambda a, b: _dual(ahead, across, down, np.float32(price), a, b), len(x))
        over_rows(lambda a, b: _primal(x, ahead, across, down, values, a, b), len(x))
    return x


@_compiled
def _dual(ahead, across, down, price, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Ascend in the dual field (H, W) x 2, whose length is bounded by the price."""
    height, width = ahead.shape
    for y in range(start, stop):
        here = ahead[y]
        below = ahead[min(y + 1, height - 1)]
        p, q = across[y], down[y]
        for x in range(width):
            right = here[x + 1] if x + 1 < width else here[x]
            a = p[x] + _STEP * (right - here[x])
            b = q[x] + _STEP * (below[x] - here[x])
            over = np.sqrt(a * a + b * b) / price
            shrink = np.float32(1.0) / over if over > np.float32(1.0) else np.float32(1.0)
            p[x] = a * shrink
            q[x] = b * shrink


@_compiled
def _primal(x, ahead, across, down, evidence, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Descend in the labels, and extrapolate."""
    width = x.shape[1]
    for y in range(start, stop):
        row, next_row, p, q, e = x[y], ahead[y], across[y], down[y], evidence[y]
        q_above = down[y - 1] if y > 0 else down[y]
        from_above = np.float32(1.0) if y > 0 else np.float32(0.0)
        for j in range(width):
            left = p[j - 1] if j > 0 else np.float32(0.0)
            divergence = p[j] - left + q[j] - from_above * q_above[j]
            value = row[j] + _STEP * (divergence + e[j])
            value = min(max(value, np.float32(0.0)), np.float32(1.0))
            next_row[j] = np.float32(2.0) * value - row[j]
            row[j] = value
