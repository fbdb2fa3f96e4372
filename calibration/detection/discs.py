"""Centres of discs: least squares of a blurred disc that is seen through the map of the board's plane.

The centre of a disc's image is not the image of its centre: perspective and distortion shift it (Heikkilä 2000; by
r²·|curvature of the map|, tenths of a pixel on tilted boards). Here the outline is drawn in the board's plane and
mapped into the picture, so that what is fitted is the image of the centre itself:

    I(p) = a + aₓ·p + (b + bₓ·p) · erf(d / √2 s),   d = (|q| − r eᵍ) / |∇|q||,   p = c + J q + Q(q, q) / 2

with the centre's image c, growth g of the printed radius, blur s; J and Q are the map's derivatives.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calibration.detection.patches import Fit, Patches, least_squares

Array = NDArray[np.float64]

_BLUR_START_PX = 0.7
_BLUR_RANGE_PX = (0.22, 8.0)
_LARGEST_GROWTH = 0.4
_INVERSION_STEPS = 4  # each is exact to one more order of the map's curvature


def fit_discs(patches: Patches, radius_mm: float, first: Array, second: Array, reach_px: Array, noise_dn: float) -> Fit:
    """Fit all discs at once.

    Parameters
    ----------
    patches
        Pictures around the discs.
    radius_mm
        Of the printed disc.
    first, second
        (n, 2, 2) and (n, 2, 3) derivatives of the map at each disc (`PlaneMap.expanded`), px/mm and px/mm².
    reach_px
        (n,) how far beyond the outline pixels count.
    noise_dn
        Standard deviation of a grey value.

    Returns
    -------
    Images of the centres, relative to the patches' origins, with their covariance.
    """
    low, high = (math.log(limit) for limit in _BLUR_RANGE_PX)

    def clipped(parameters: Array) -> Array:
        parameters[:, 2] = np.clip(parameters[:, 2], -_LARGEST_GROWTH, _LARGEST_GROWTH)
        parameters[:, 3] = np.clip(parameters[:, 3], low, high)
        return parameters

    start = np.zeros((len(first), 4))
    start[:, 3] = math.log(_BLUR_START_PX)
    distance, _, _ = _distances(start, patches, radius_mm, first, second)
    near = patches.seen(distance <= reach_px[:, None])
    return least_squares(near, start, lambda p: _model(p, near, radius_mm, first, second), clipped, noise_dn)


def _distances(
    parameters: Array, patches: Patches, radius_mm: float, first: Array, second: Array
) -> tuple[Array, Array, Array]:
    """Distances from the outline, px (n, m), its normals (n, m, 2), and mm of radius per px (n, m)."""
    p = np.stack((patches.x - parameters[:, 0:1], patches.y - parameters[:, 1:2]), axis=2)
    inverse = np.swapaxes(np.linalg.inv(first), 1, 2)
    q = p @ inverse
    for _ in range(_INVERSION_STEPS):
        u, v = q[..., 0], q[..., 1]
        squares = np.stack((u * u / 2, u * v, v * v / 2), axis=2)
        q = (p - squares @ np.swapaxes(second, 1, 2)) @ inverse
    u, v = q[..., 0], q[..., 1]
    # ∂p/∂q = J + Q q, and the gradient of |q| over the picture is its inverse transpose times q/|q|.
    a = first[:, None, 0, 0] + second[:, None, 0, 0] * u + second[:, None, 0, 1] * v
    b = first[:, None, 0, 1] + second[:, None, 0, 1] * u + second[:, None, 0, 2] * v
    c = first[:, None, 1, 0] + second[:, None, 1, 0] * u + second[:, None, 1, 1] * v
    d = first[:, None, 1, 1] + second[:, None, 1, 1] * u + second[:, None, 1, 2] * v
    det = a * d - b * c
    reach = np.maximum(np.hypot(u, v), 1e-9)
    gradient = np.stack(((d * u - c * v) / (det * reach), (a * v - b * u) / (det * reach)), axis=2)
    steepness = np.maximum(np.hypot(gradient[..., 0], gradient[..., 1]), 1e-12)
    distance = (reach - radius_mm * np.exp(parameters[:, 2:3])) / steepness
    return distance, gradient / steepness[..., None], steepness


def _model(parameters: Array, patches: Patches, radius_mm: float, first: Array, second: Array) -> tuple[Array, Array]:
    """The shape (n, m) that the levels multiply, and its derivatives (n, m, 4)."""
    distance, normal, steepness = _distances(parameters, patches, radius_mm, first, second)
    blur = np.exp(parameters[:, 3:4])
    slope = math.sqrt(2 / math.pi) / blur * np.exp(-((distance / blur) ** 2) / 2)
    grown = radius_mm * np.exp(parameters[:, 2:3]) / steepness
    jacobian = np.stack((-slope * normal[..., 0], -slope * normal[..., 1], -slope * grown, -slope * distance), axis=2)
    return erf(distance / (math.sqrt(2) * blur)), jacobian
