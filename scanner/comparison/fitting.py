"""Planes and spheres through measured points, blind to the points of wrong fringes: Tukey's biweight."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.floating[Any]]

_TUKEY = 4.685
"""Tuning constant of Tukey's biweight, in units of σ: 95 % efficiency on Gaussian errors."""


def fit_plane(points: Points, iterations: int = 30) -> tuple[NDArray[np.float64], float]:
    """Robust plane n·X = d through (P, 3) points: (n, d), n a unit vector.

    Raises
    ------
    ValueError
        Fewer than three points.
    """
    if len(points) < 3:
        raise ValueError(f"{len(points)} points do not make a plane")
    centre = np.median(points, axis=0)
    off = np.asarray(points, np.float64) - centre
    weights = np.ones(len(off))
    for i in range(iterations):
        middle = np.average(off, axis=0, weights=weights)
        _, _, axes = np.linalg.svd((off - middle) * np.sqrt(weights)[:, None], full_matrices=False)
        normal = axes[2]
        distance = (off - middle) @ normal
        updated = _biweight(distance)
        if i and np.allclose(updated, weights, atol=1e-4):
            break
        weights = updated
    return normal, float(normal @ (centre + middle))


def fit_sphere(points: Points, iterations: int = 30) -> tuple[NDArray[np.float64], float]:
    """Robust sphere through (P, 3) points: (centre, radius), in the points' unit.

    Geometric distances by Gauss-Newton, from the algebraic fit |X|² = 2 c·X + (r² − |c|²) to the same weights.

    Raises
    ------
    ValueError
        Fewer than four points, or points on a plane.
    """
    if len(points) < 4:
        raise ValueError(f"{len(points)} points do not make a sphere")
    origin = np.median(points, axis=0)
    off = np.asarray(points, np.float64) - origin
    model = np.column_stack([2 * off, np.ones(len(off))])
    weights = np.ones(len(off))
    centre, radius = np.zeros(3), 1.0
    for i in range(iterations):
        if i < 5:
            root = np.sqrt(weights)
            solved, _, rank, _ = np.linalg.lstsq(model * root[:, None], root * np.square(off).sum(axis=1), rcond=None)
            square = solved[3] + solved[:3] @ solved[:3]
            if rank < 4 or square <= 0:
                raise ValueError("these points lie on no sphere")
            centre, radius = solved[:3], float(np.sqrt(square))
        else:
            away = off - centre
            length = np.linalg.norm(away, axis=1)
            jacobian = np.column_stack([-away / length[:, None], -np.ones(len(off))])
            weighted = jacobian * weights[:, None]
            step = np.linalg.solve(weighted.T @ jacobian, -weighted.T @ (length - radius))
            centre, radius = centre + step[:3], radius + float(step[3])
        updated = _biweight(np.linalg.norm(off - centre, axis=1) - radius)
        if i > 5 and np.allclose(updated, weights, atol=1e-4):
            break
        weights = updated
    return np.asarray(origin + centre, np.float64), radius


def residuals(points: Points, fit: str) -> NDArray[np.float64]:
    """(P,) signed distances of (P, 3) points from the robust ``plane`` or ``sphere`` through them; NaN without a fit.

    Positive towards the camera for a plane, outwards for a sphere.
    """
    try:
        if fit == "sphere":
            centre, radius = fit_sphere(points)
            return np.asarray(np.linalg.norm(points - centre, axis=1) - radius)
        normal, d = fit_plane(points)
    except (ValueError, np.linalg.LinAlgError):
        return np.full(len(points), np.nan)
    towards = -1.0 if normal[2] > 0 else 1.0
    return np.asarray(towards * (points @ normal - d))


def _biweight(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = 1.4826 * np.median(np.abs(distance - np.median(distance))) + 1e-12
    return np.asarray(np.clip(1 - (distance / (_TUKEY * scale)) ** 2, 0, None) ** 2)
