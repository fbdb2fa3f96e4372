"""Small pictures around points, and least squares of one model in all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ROUNDS = 12
_DONE_PX = 1e-3  # the next step would be its square
_LONGEST_STEP = 1.5  # px and, for logarithms and rad, far more than any sound step


@dataclass(frozen=True, eq=False)
class Patches:
    """Square pictures around points.

    Parameters
    ----------
    grey
        (n, m) grey values, the pixels of a patch in a row.
    x, y
        (n, m) px from the patch's point.
    weights
        (n, m) 1 for pixels that count, 0 for others.
    """

    grey: Array
    x: Array
    y: Array
    weights: Array

    def seen(self, mask: NDArray[np.bool_]) -> Patches:
        """The same pictures with only those pixels that also the mask (n, m) has."""
        return Patches(self.grey, self.x, self.y, self.weights * mask)


@dataclass(frozen=True, eq=False)
class Fit:
    """What least squares found in each patch.

    Parameters
    ----------
    parameters
        (n, k), the first two are x and y, px from the patch's point.
    covariance
        (n, 2, 2) of x and y, px², times max(1, χ²/ν).
    contrast
        (n,) half the difference of bright and dark, signed.
    is_sound
        (n,) bool; False where the fit did not settle.
    """

    parameters: Array
    covariance: Array
    contrast: Array
    is_sound: NDArray[np.bool_]


def cut(picture: Array, xy: Array, radius: int) -> Patches:
    """Cut patches of (2 radius + 1)² px around the pixels nearest to ``xy`` (n, 2); outside the picture weighs 0."""
    height, width = picture.shape
    nearest = np.rint(xy).astype(np.int64)
    dy, dx = (grid.ravel() for grid in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    columns, rows = nearest[:, 0:1] + dx, nearest[:, 1:2] + dy
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    grey = picture[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    return Patches(grey, columns - xy[:, 0:1], rows - xy[:, 1:2], (inside & np.isfinite(grey)).astype(np.float64))


def least_squares(
    patches: Patches,
    start: Array,
    model: Callable[[Array], tuple[Array, Array]],
    clipped: Callable[[Array], Array],
    noise_dn: float,
) -> Fit:
    """Fit I = a + aₓx + a_y y + (b + bₓx + b_y y) S(p) in every patch.

    The six levels are linear and solved for in every step (Gauss–Newton on all parameters; Golub & Pereyra 1973 in
    Kaufman's form comes to the same).

    Parameters
    ----------
    patches
        Where.
    start
        (n, k) parameters to start from, x and y first.
    model
        Gives S (n, m) and ∂S (n, m, k) of parameters (n, k).
    clipped
        Keeps parameters within their limits.
    noise_dn
        Standard deviation of a grey value.
    """
    count, free = start.shape
    ramp = np.stack((np.ones_like(patches.x), patches.x, patches.y), axis=2)
    grey = np.where(patches.weights > 0, patches.grey, 0.0)
    parameters, moved = start.copy(), np.full(count, np.inf)
    for _ in range(_ROUNDS):
        shape, derivatives = model(parameters)
        basis = np.concatenate((ramp, ramp * shape[:, :, None]), axis=2)
        levels = _solved(basis, grey, patches.weights)
        amplitude = (ramp @ levels[:, 3:, None])[:, :, 0]
        residual = grey - (basis @ levels[:, :, None])[:, :, 0]
        design = np.concatenate((derivatives * amplitude[:, :, None], basis), axis=2)
        step = _solved(design, residual, patches.weights)[:, :free]
        before, parameters = parameters, clipped(parameters + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP))
        moved = np.abs(step[:, :2]).max(axis=1)
        # All of them: a point that is in its place already has no χ² before its blur is right.
        if not (np.abs(parameters - before) > _DONE_PX).any():
            break
    used = np.maximum(patches.weights.sum(axis=1) - design.shape[2], 1)
    chi2 = (patches.weights * residual**2).sum(axis=1) / noise_dn**2
    normal = _normal(design, patches.weights)
    scale = noise_dn**2 * np.maximum(1.0, chi2 / used)
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True)[:, :2, :2] * scale[:, None, None], np.float64)
    is_sound = (moved < 10 * _DONE_PX) & np.isfinite(parameters).all(axis=1)
    is_sound &= patches.weights.sum(axis=1) >= 2 * design.shape[2]
    return Fit(parameters, covariance, levels[:, 3], is_sound)


def _normal(design: Array, weights: Array) -> Array:
    return np.asarray(np.swapaxes(design, 1, 2) @ (design * weights[:, :, None]))


def _solved(design: Array, target: Array, weights: Array) -> Array:
    """(n, k) least squares in every patch."""
    normal = _normal(design, weights)
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-30))
    right = (np.swapaxes(design, 1, 2) @ (target * weights)[:, :, None])[:, :, 0] / scale
    normal = normal / (scale[:, :, None] * scale[:, None, :])
    # A trace of damping: where a patch shows nothing, the step is small instead of a failure.
    normal += 1e-9 * np.eye(normal.shape[1])
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0] / scale)
