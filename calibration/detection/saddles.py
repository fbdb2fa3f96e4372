"""Corners of a chessboard to a hundredth of a pixel: least squares of two blurred edges that cross.

The image of a corner is a saddle. With albedo ±1 in the four squares and a Gaussian blur it is the product of two error
functions, one per edge (exact where the edges are at right angles; otherwise symmetric about the corner, so that its
misfit moves no corner):

    I(p) = a + aₓ·p + (b + bₓ·p) · erf(d₁ / √2 s₁) · erf(d₂ / √2 s₂),   dₖ = nₖ·(p − c) − κₖ (tₖ·(p − c))² / 2

with the corner c, two edge directions tₖ, two blurs sₖ, two levels with their gradients. Perspective keeps edges
straight, a lens does not: their curvatures κₖ come from the map that all corners agree on. The covariance is that of
the least squares, σ² (JᵀJ)⁻¹, times max(1, χ²/ν).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calibration.detection.patches import Fit, Patches, least_squares

Array = NDArray[np.float64]

_BLUR_START_PX = 0.7
_BLUR_RANGE_PX = (0.22, 6.0)
_FREE_OF_LEVELS = 6  # cx, cy, two directions, two blurs; the levels are linear


def fit_saddles(patches: Patches, axes: Array, curvatures: Array, noise_dn: float) -> Fit:
    """Fit all corners at once.

    Parameters
    ----------
    patches
        Pictures around the corners.
    axes
        (n, 2, 2) images of the board's unit vectors at each corner, ``axes[i, :, k]`` along edge k.
    curvatures
        (n, 2) 1/px, of either edge at the corner, positive where it bends towards its normal.
    noise_dn
        Standard deviation of a grey value.

    Returns
    -------
    Corners, relative to the patches' origins, with their covariance.
    """
    start = np.zeros((len(axes), _FREE_OF_LEVELS))
    start[:, 2:4] = np.arctan2(axes[:, 1], axes[:, 0])
    start[:, 4:6] = math.log(_BLUR_START_PX)
    low, high = (math.log(limit) for limit in _BLUR_RANGE_PX)

    def clipped(parameters: Array) -> Array:
        parameters[:, 4:6] = np.clip(parameters[:, 4:6], low, high)
        return parameters

    return least_squares(patches, start, lambda p: _model(p, patches, curvatures), clipped, noise_dn)


def _model(parameters: Array, patches: Patches, curvatures: Array) -> tuple[Array, Array]:
    """The shape (n, m) that the levels multiply, and its derivatives (n, m, 6)."""
    dx = patches.x - parameters[:, 0:1]
    dy = patches.y - parameters[:, 1:2]
    edges, slopes, derivatives = [], [], []
    for k in range(2):
        cos, sin = np.cos(parameters[:, 2 + k, None]), np.sin(parameters[:, 2 + k, None])
        blur = np.exp(parameters[:, 4 + k, None])
        along, across = cos * dx + sin * dy, cos * dy - sin * dx
        bend = curvatures[:, k, None] * along
        distance = across - bend * along / 2
        edges.append(erf(distance / (math.sqrt(2) * blur)))
        slopes.append(math.sqrt(2 / math.pi) / blur * np.exp(-((distance / blur) ** 2) / 2))
        derivatives.append((sin + bend * cos, -cos + bend * sin, -along - bend * across, -distance))
    by_edge = (slopes[0] * edges[1], slopes[1] * edges[0])
    (x0, y0, turn0, blur0), (x1, y1, turn1, blur1) = derivatives
    jacobian = np.stack(
        (
            by_edge[0] * x0 + by_edge[1] * x1,
            by_edge[0] * y0 + by_edge[1] * y1,
            by_edge[0] * turn0,
            by_edge[1] * turn1,
            by_edge[0] * blur0,
            by_edge[1] * blur1,
        ),
        axis=2,
    )
    return edges[0] * edges[1], jacobian
