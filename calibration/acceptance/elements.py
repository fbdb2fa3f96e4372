"""Gaussian spheres and planes by the guideline's rule: fit, leave out three of a thousand, fit again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.acceptance.fits import Array, PlaneFit, SphereFit, Values, fit_plane, fit_sphere
from calibration.acceptance.ranges import reject

_Fit = TypeVar("_Fit", SphereFit, PlaneFit)


@dataclass(frozen=True, eq=False)
class Element(Generic[_Fit]):
    """A Gaussian element through the retained points, and the deviations of all.

    Parameters
    ----------
    fit
        Through the retained points.
    keep
        (N,) bool, which of the points were retained.
    residuals, sigma
        (N,) signed distances of all points, and their standard deviations by noise, mm.
    """

    fit: _Fit
    keep: NDArray[np.bool_]
    residuals: Array
    sigma: Array

    @property
    def range_mm(self) -> float:
        """Range of the retained deviations: the form error of the guideline."""
        return float(np.ptp(self.residuals[self.keep]))

    @property
    def rejected(self) -> int:
        """How many were left out."""
        return int((~self.keep).sum())


def gaussian_sphere(points: Values, sigma: Values) -> Element[SphereFit]:
    """Sphere through (N, 3) points, mm, all of equal weight; ``sigma`` (N,) is along the viewing ray, mm.

    Raises
    ------
    FitError
        As `fit_sphere`.
    """
    keep = reject(fit_sphere(points, sigma, weighted=False).residuals)
    fit = fit_sphere(points[keep], sigma[keep], weighted=False)
    residuals, across = sphere_deviation(points, sigma, fit)
    return Element(fit, keep, residuals, across)


def gaussian_plane(points: Values, sigma: Values) -> Element[PlaneFit]:
    """Plane, as `gaussian_sphere`."""
    keep = reject(fit_plane(points, sigma, weighted=False).residuals)
    fit = fit_plane(points[keep], sigma[keep], weighted=False)
    residuals, across = plane_deviation(points, sigma, fit)
    return Element(fit, keep, residuals, across)


def sphere_deviation(points: Values, sigma: Values, fit: SphereFit) -> tuple[Array, Array]:
    """(N,) radial distances of points from a sphere, positive outside, and their standard deviations, mm."""
    points = np.asarray(points, np.float64)
    off = points - fit.centre
    length = np.linalg.norm(off, axis=1)
    cosine = np.abs((points * off).sum(axis=1)) / (length * np.linalg.norm(points, axis=1))
    return length - fit.radius, sigma * cosine


def plane_deviation(points: Values, sigma: Values, fit: PlaneFit) -> tuple[Array, Array]:
    """(N,) signed distances of points from a plane, positive towards the camera, and their standard deviations, mm."""
    points = np.asarray(points, np.float64)
    return points @ fit.normal - fit.distance, sigma * np.abs(points @ fit.normal) / np.linalg.norm(points, axis=1)
