"""Spheres and planes through measured points: geometric least squares with the covariance of what is found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from drivers.errors import OperatorError

Array = NDArray[np.float64]
Values = NDArray[np.floating[Any]]

_REWEIGHTINGS = 3  # the weights follow the surface's slant, which follows the fit


class FitError(OperatorError):
    """Points that no sphere or plane can be fitted to."""


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere through points.

    Parameters
    ----------
    centre
        (3,) mm.
    radius
        mm.
    covariance
        (4, 4) of (centre, radius), mm², propagated from the points' noise; row and column of the radius are 0 where
        it was given.
    residuals
        (N,) radial distances |p − c| − r, mm; positive outside.
    sigma
        (N,) standard deviation of a residual by the points' noise, mm: σ along the ray times the cosine of incidence.
    """

    centre: Array
    radius: float
    covariance: Array
    residuals: Array
    sigma: Array

    @property
    def u_radius(self) -> float:
        """Standard uncertainty of the radius by the points' noise, mm."""
        return float(np.sqrt(self.covariance[3, 3]))


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """A plane n·X = d through points.

    Parameters
    ----------
    normal
        (3,) unit vector that looks to the camera's side.
    distance
        d, mm; negative with this normal.
    covariance
        (3, 3) of (d, tilt about the two in-plane axes `axes`, rad), at the centroid, from the points' noise.
    centroid, axes
        (3,) mm, and (2, 3) the in-plane unit vectors along which the tilts count.
    residuals
        (N,) signed distances n·p − d, mm; positive towards the camera.
    sigma
        (N,) standard deviation of a residual by the points' noise, mm.
    """

    normal: Array
    distance: float
    covariance: Array
    centroid: Array
    axes: Array
    residuals: Array
    sigma: Array


def fit_sphere(points: Values, sigma: Values, *, radius: float | None = None, weighted: bool = True) -> SphereFit:
    """Sphere of least squared radial distances.

    Minimises Σ w (|p − c| − r)² by Levenberg-Marquardt from the algebraic fit, whose bias towards small spheres on a
    noisy cap (Al-Sharadqah and Chernov, Electronic Journal of Statistics 3, 2009) it thereby loses.

    Parameters
    ----------
    points
        (N, 3) mm in the camera frame.
    sigma
        (N,) standard deviation along the viewing ray from the origin, mm.
    radius
        Holds the radius at this value, mm; None fits it.
    weighted
        True weights by the noise across the surface, the best estimate if noise is all there is. False takes all points
        alike: the Gaussian sphere of guidelines and standards.

    Raises
    ------
    FitError
        Fewer than four points (three for a plane), values that are not finite, or points that lie in one plane or line.
    """
    points, sigma = _checked(points, sigma, 4, "sphere")
    middle = points.mean(axis=0)
    scale = float(np.sqrt(np.square(points - middle).sum(axis=1).mean()))
    local = (points - middle) / scale
    fixed = None if radius is None else radius / scale
    start = _algebraic_sphere(local)
    if fixed is not None:
        start = _moved_to_radius(local, start, fixed)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    root = np.ones(len(points))
    found = start
    for _ in range(_REWEIGHTINGS if weighted else 1):
        if weighted:
            root = 1 / _across(rays, _outward(local, found), sigma)
            root /= root.max()
        found = _geometric_sphere(local, root, found, fixed)
    outward = _outward(local, found)
    across = _across(rays, outward, sigma)
    jacobian = -outward if fixed is not None else -np.column_stack([outward, np.ones(len(points))])
    covariance = np.zeros((4, 4))
    free = jacobian.shape[1]
    covariance[:free, :free] = _propagated(jacobian, root, across)
    centre, size = middle + scale * found[:3], scale * float(found[3])
    return SphereFit(centre, size, covariance, np.linalg.norm(points - centre, axis=1) - size, across)


def fit_plane(points: Values, sigma: Values, *, weighted: bool = True) -> PlaneFit:
    """Plane of least squared distances, by the eigenvectors of the points' scatter.

    Parameters and raises as `fit_sphere`. `scanner.comparison.fit_plane` is the robust one, for scans with outliers; a
    flatness error must see the outliers.
    """
    points, sigma = _checked(points, sigma, 3, "plane")
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    root = np.ones(len(points))
    for step in range(_REWEIGHTINGS if weighted else 1):
        weights = 1 / sigma**2 if weighted and step == 0 else root**2
        centroid = np.average(points, axis=0, weights=weights)
        off = points - centroid
        spread, vectors = np.linalg.eigh((off * weights[:, None]).T @ off / weights.sum())
        if spread[1] <= 1e-12 * spread[2]:
            raise FitError("the points of the plane lie on one line", "Show more of the plane to camera and projector.")
        normal, axes = vectors[:, 0], vectors[:, 2:0:-1].T
        normal = -normal if normal @ centroid > 0 else normal
        across = _across(rays, normal, sigma)
        if weighted:
            root = across.min() / across
    jacobian = -np.column_stack([np.ones(len(points)), off @ axes.T])
    covariance = _propagated(jacobian, root, across)
    return PlaneFit(normal, float(normal @ centroid), covariance, centroid, axes, off @ normal, across)


def _checked(points: Values, sigma: Values, least: int, what: str) -> tuple[Array, Array]:
    where, noise = np.asarray(points, np.float64), np.asarray(sigma, np.float64)
    if len(where) < least:
        raise FitError(
            f"{len(where)} points do not make a {what}", "Look at the scan's flags: most of the artefact is missing."
        )
    if not (np.isfinite(where).all() and np.isfinite(noise).all() and (noise > 0).all()):
        raise FitError(
            f"points of the {what} without a place or a standard deviation", "Fit the valid pixels of a scan only."
        )
    return where, noise


def _across(rays: Array, normals: Array, sigma: Array) -> Array:
    """Noise across the surface: a point errs along its ray, and only the part along the normal shows."""
    cosine = np.abs((rays * normals).sum(axis=-1))
    return np.asarray(sigma * np.maximum(cosine, 1e-3))


def _outward(local: Array, sphere: Array) -> Array:
    off = local - sphere[:3]
    return np.asarray(off / np.linalg.norm(off, axis=1, keepdims=True))


def _propagated(jacobian: Array, root: Array, across: Array) -> Array:
    """Covariance of a least-squares estimate with weights root² under independent noise ``across`` of each residual."""
    estimator = np.linalg.pinv(jacobian * root[:, None]) * root
    return np.asarray((estimator * across**2) @ estimator.T)


def _algebraic_sphere(local: Array) -> Array:
    """(4,) the sphere |p|² = 2 c·p + (r² − |c|²), linear in c and the bracket."""
    design = np.column_stack([2 * local, np.ones(len(local))])
    solution, _, rank, _ = np.linalg.lstsq(design, np.square(local).sum(axis=1), rcond=1e-9)
    square = solution[3] + solution[:3] @ solution[:3]
    if rank < 4 or square <= 0:
        raise FitError(
            "the points of the sphere lie in one plane", "Show more of the sphere to camera and projector, or a ball."
        )
    return np.append(solution[:3], np.sqrt(square))


def _moved_to_radius(local: Array, sphere: Array, radius: float) -> Array:
    """Sphere of a given radius that touches the cap where ``sphere`` does."""
    towards = local.mean(axis=0) - sphere[:3]
    towards /= np.linalg.norm(towards)
    return np.append(sphere[:3] + (sphere[3] - radius) * towards, radius)


def _geometric_sphere(local: Array, root: Array, start: Array, fixed: float | None) -> Array:
    free = 4 if fixed is None else 3

    def whole(p: Array) -> Array:
        return p if fixed is None else np.append(p, fixed)

    def residuals(p: Array) -> Array:
        return np.asarray(root * (np.linalg.norm(local - p[:3], axis=1) - whole(p)[3]))

    def jacobian(p: Array) -> Array:
        columns = np.column_stack([-_outward(local, p), -np.ones(len(local))])
        return np.asarray(root[:, None] * columns[:, :free])

    return whole(least_squares(residuals, start[:free], jacobian, method="lm", xtol=1e-12, ftol=1e-14).x)
