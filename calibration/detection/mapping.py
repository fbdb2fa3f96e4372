"""The smooth map from a board's plane into a picture: a homography and what the lens adds to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POINTS_PER_TERM = 3  # of each polynomial; fewer, and it would follow the noise
_ROUNDS = 4
_REACH = 1.15  # of the known points; beyond, a polynomial runs away


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """A map of planes: x = y + P(y) with y = H(X), P a polynomial of both coordinates of y.

    With a flat board H is the view of a camera without distortion and P, of the third order where enough points are
    known and of none for few points, is the lens's share: k₁ alone is a cubic.

    Parameters
    ----------
    homography
        (3, 3).
    terms
        (k, 2) coefficients of the monomials of `_monomials`.
    order
        Of the polynomial; −1: none.
    centre, scale
        Of the normalisation y → (y − centre) / scale that the polynomial takes.
    """

    homography: Array
    terms: Array
    order: int
    centre: Array
    scale: float

    @classmethod
    def fitted(cls, source: Array, target: Array, weights: Array | None = None) -> Self | None:
        """Fit the map of known points.

        Parameters
        ----------
        source, target
            (n, 2) points of one plane and of the other, n ≥ 4.
        weights
            (n,) factors on residuals, such as 1/σ; None: all alike.

        Returns
        -------
        The map, or None where the points lie on a line.
        """
        centre = (target.min(axis=0) + target.max(axis=0)) / 2
        scale = float(np.abs(target - centre).max()) or 1.0
        homography = _homography(source, target)
        if homography is None:
            return None
        order = max((k for k in (1, 2, 3) if _POINTS_PER_TERM * _count(k) <= len(source)), default=-1)
        if order < 2:
            return cls(homography, np.empty((0, 2)), -1, centre, scale)
        w = np.ones(len(source)) if weights is None else weights / weights.max()
        for _ in range(_ROUNDS):
            straight = _applied(homography, source)
            monomials = _monomials((straight - centre) / scale, order)
            residual = (target - straight) * w[:, None]
            terms = np.asarray(np.linalg.lstsq(monomials * w[:, None], residual, rcond=None)[0], np.float64)
            found = cls(homography, terms, order, centre, scale)
            # The homography that bent lines gave is not yet that of the straight ones.
            homography = _homography(source, target - monomials @ terms)
            if homography is None:
                break
        return found

    def __call__(self, source: Array) -> Array:
        """Map points (n, 2); the polynomial is held fast a little outside of the points that it was fitted to."""
        straight = _applied(self.homography, source)
        if self.order < 0:
            return straight
        known = np.clip((straight - self.centre) / self.scale, -_REACH, _REACH)
        return np.asarray(straight + _monomials(known, self.order) @ self.terms)

    def expanded(self, source: Array, step: float) -> tuple[Array, Array]:
        """Expand the map at points to the second order.

        Parameters
        ----------
        source
            (n, 2) points.
        step
            Distance of the differences.

        Returns
        -------
        J (n, 2, 2), J[i, :, a] = ∂x/∂X_a, and Q (n, 2, 3), the second derivatives ∂²x/∂X², ∂²x/∂X∂Y, ∂²x/∂Y².
        """
        offsets = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]], float) * step
        x = self((source[:, None] + offsets).reshape(-1, 2)).reshape(len(source), 9, 2)
        first = np.stack((x[:, 1] - x[:, 2], x[:, 3] - x[:, 4]), axis=2) / (2 * step)
        second = np.stack(
            (
                x[:, 1] - 2 * x[:, 0] + x[:, 2],
                (x[:, 5] + x[:, 6] - x[:, 7] - x[:, 8]) / 4,
                x[:, 3] - 2 * x[:, 0] + x[:, 4],
            ),
            axis=2,
        )
        return first, second / step**2


def _homography(source: Array, target: Array) -> Array | None:
    import cv2

    found, _ = cv2.findHomography(source, target)
    return None if found is None or not np.isfinite(found).all() else np.asarray(found, np.float64)


def _applied(homography: Array, points: Array) -> Array:
    mapped = points @ homography[:, :2].T + homography[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _count(order: int) -> int:
    return (order + 1) * (order + 2) // 2


def _monomials(points: Array, order: int) -> Array:
    x, y = points[:, 0], points[:, 1]
    return np.stack([x ** (k - j) * y**j for k in range(order + 1) for j in range(k + 1)], axis=1)
