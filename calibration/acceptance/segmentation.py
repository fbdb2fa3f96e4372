"""Which pixels of a scan see the artefact: found robustly, then chosen by geometry and never by their deviation.

A point is taken because its viewing ray meets the artefact, not because it lies near the fitted surface: a selection
by distance would hide the very errors that are asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from calibration.acceptance.fits import Array, FitError, PlaneFit, SphereFit, fit_plane, fit_sphere
from drivers.errors import OperatorError
from scanner.result import Flag, Maps
from scanner.rig import Rig

Mask = NDArray[np.bool_]

_RADIUS_TOLERANCE = 0.2
"""A sphere may come out so much larger or smaller than its calibrated radius and is still found: a rig with a wrong
scale must fail by its size error, not by a missing sphere."""
_BALL_TOLERANCE = 0.03  # of the radius: distance from the surface up to which a point speaks for a hypothesis
_PLANE_TOLERANCE = 2e-3  # of the distance, the same for planes: above what any rig bends a plane by
_NOISE_SIGMAS = 5.0
_SAMPLE = 4000
_HYPOTHESES = 1500
_LEAST_POINTS = 40  # of the sample that speak for a surface, and pixels of a cap
_MARGIN_PX = 3
_PLANES = 4  # flat regions that are looked at
_EXTENT_TOLERANCE = 1.2  # times its description: a plane that comes out larger is something else
_GROUP = 50  # hypotheses that are judged at once
_UNUSABLE = np.uint16(Flag.LOW_MODULATION | Flag.SATURATED | Flag.DEPTH_EDGE | Flag.INCOMPLETE)


class ArtefactNotFoundError(OperatorError):
    """The scan does not show the artefact."""


@dataclass(frozen=True, eq=False)
class Cap:
    """The part of a sphere that a scan shows.

    Parameters
    ----------
    region
        (H, W) bool, pixels whose ray meets the sphere under the incidence limit, whether they have a point or not.
    fit
        A sphere through those of its points that lie near it: for the place, not for the figures.
    """

    region: Mask
    fit: SphereFit


def usable(maps: Maps) -> Mask:
    """(H, W) bool, pixels with a point whose flags do not say that it is none of the surface's.

    Edges, saturation and low modulation are left out; a bounce is not.
    """
    if maps.points is None or maps.sigma_point is None:
        raise FitError("the scan has coordinates but no points", "Scan with a calibrated rig.")
    known = np.isfinite(maps.points).all(axis=2) & (maps.sigma_point > 0)
    return np.asarray(known & ((maps.flags & _UNUSABLE) == 0))


def find_spheres(
    maps: Maps,
    rays: NDArray[np.float32],
    radius_mm: float,
    count: int,
    rng: np.random.Generator,
    *,
    incidence_limit_deg: float,
    projector_centre: Array | None = None,
) -> list[Cap]:
    """Find ``count`` spheres of about ``radius_mm`` in a scan.

    Hypotheses come from four points within one radius of each other; the best is refined by alternating choice by
    geometry and fit. Each found sphere, with all that its outline covers, is taken out before the next is looked for.

    Parameters
    ----------
    maps
        A scan with points.
    rays
        (H, W, 3) unit viewing directions of the pixels (`viewing_rays`).
    radius_mm
        Calibrated radius.
    count
        How many.
    rng
        Draws hypotheses.
    incidence_limit_deg
        Points whose surface is turned further from the camera, or from the projector, are not used: there the lateral
        pixel pitch and the smear of the fringes grow without bound.
    projector_centre
        (3,) mm in the camera frame; None judges the camera's side only.

    Raises
    ------
    ArtefactNotFoundError
        Fewer are there.
    """
    free = usable(maps)
    found: list[Cap] = []
    for number in range(count):
        sphere = _hypothesis(maps, free, radius_mm, rng)
        if sphere is None:
            what = "no sphere" if number == 0 else f"only {number} of {count} spheres"
            raise ArtefactNotFoundError(
                f"the scan shows {what} of {2 * radius_mm:g} mm diameter",
                "Place the artefact so that camera and projector see all of it, and check the diameter of its"
                " description.",
            )
        cap = _refined(maps, rays, free, sphere, incidence_limit_deg, projector_centre, radius_mm)
        found.append(cap)
        free = free & ~_outline(rays, cap.fit.centre, 1.15 * cap.fit.radius)
    return found


def find_plane(maps: Maps, rng: np.random.Generator, longest_mm: float = math.inf) -> Mask:
    """(H, W) bool, the largest flat region of a scan, without a margin of three pixels along its border.

    Holes are filled: what was not measured inside, or lies off the plane, belongs to the region all the same.

    Parameters
    ----------
    maps
        A scan with points.
    rng
        Draws hypotheses.
    longest_mm
        Regions that span more, such as a wall behind the artefact, are passed over.

    Raises
    ------
    ArtefactNotFoundError
        Nothing flat is there, or nothing but what spans more.
    """
    known = usable(maps)
    assert maps.points is not None
    assert maps.sigma_point is not None
    spans: list[float] = []
    for _ in range(_PLANES):
        plane = _plane_hypothesis(maps, known, rng)
        if plane is None:
            break
        off = np.abs(maps.points @ plane.normal - plane.distance)
        with np.errstate(invalid="ignore"):
            near = known & (off <= _NOISE_SIGMAS * maps.sigma_point + _PLANE_TOLERANCE * maps.points[..., 2])
        largest = _largest(near)
        region = _without_border(largest)
        if not region.any():
            break
        in_plane = (maps.points[region & near] - plane.centroid) @ plane.axes.T
        # The axes of the scatter may lie along a diagonal of the artefact.
        spans.append(float(np.ptp(in_plane, axis=0).max()))
        if spans[-1] <= _EXTENT_TOLERANCE * longest_mm:
            return region
        known = known & ~largest
    if spans:
        raise ArtefactNotFoundError(
            f"the flat regions of the scan span {', '.join(f'{span:.0f}' for span in spans)} mm, the plane "
            f"{longest_mm:.0f} mm",
            "Something else that is flat is in view: cover it, or correct the size in the plane's description.",
        )
    raise ArtefactNotFoundError(
        "the scan shows no flat region", "Place the plane so that camera and projector see all of it."
    )


def _plane_hypothesis(maps: Maps, known: Mask, rng: np.random.Generator) -> PlaneFit | None:
    """Plane that most of a sample of points lies on; None where there are too few."""
    points, sigma = _sampled(maps, known, rng, _SAMPLE)
    if len(points) < _LEAST_POINTS:
        return None
    triples = points[rng.integers(len(points), size=(_HYPOTHESES // 5, 3))]
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    normal, start = normal[length > 0] / length[length > 0, None], triples[length > 0, 0]
    tolerance = _NOISE_SIGMAS * sigma + _PLANE_TOLERANCE * points[:, 2]
    inside = np.abs(points @ normal.T - (start * normal).sum(axis=1)) <= tolerance[:, None]
    best = inside[:, int(np.argmax(inside.sum(axis=0)))]
    return fit_plane(points[best], sigma[best])


def viewing_rays(rig: Rig) -> NDArray[np.float32]:
    """(H, W, 3) unit viewing directions of the camera's pixels, NaN where the lens model reaches none."""
    rays = rig.camera.pixel_rays()
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def meets_sphere(
    rays: NDArray[np.float32], centre: Array, radius: float, limit_deg: float, projector_centre: Array | None
) -> Mask:
    """(H, W) bool, pixels whose viewing ray meets a sphere under the incidence limit of camera and projector."""
    with np.errstate(invalid="ignore", divide="ignore"):
        along = rays @ centre
        discriminant = along**2 - (centre @ centre - radius**2)
        hit = rays * (along - np.sqrt(discriminant))[..., None]
        normal = (hit - centre) / radius
        least = math.cos(math.radians(limit_deg))
        seen = -(rays * normal).sum(axis=2) >= least
        if projector_centre is not None:
            to_projector = projector_centre - hit
            to_projector /= np.linalg.norm(to_projector, axis=2, keepdims=True)
            seen &= (to_projector * normal).sum(axis=2) >= least
    return np.asarray(seen)


def _outline(rays: NDArray[np.float32], centre: Array, radius: float) -> Mask:
    """Pixels whose ray meets a sphere at all."""
    with np.errstate(invalid="ignore"):
        return np.asarray((rays @ centre) ** 2 > centre @ centre - radius**2)


def _sampled(maps: Maps, where: Mask, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    assert maps.points is not None
    assert maps.sigma_point is not None
    pixels = np.flatnonzero(where)
    if pixels.size > count:
        pixels = rng.choice(pixels, count, replace=False)
    return maps.points.reshape(-1, 3)[pixels].astype(np.float64), maps.sigma_point.reshape(-1)[pixels].astype(float)


def _hypothesis(maps: Maps, free: Mask, radius: float, rng: np.random.Generator) -> Array | None:
    """(4,) the sphere (centre, radius) that most of a sample of points lies on; None where there is none."""
    points, sigma = _sampled(maps, free, rng, _SAMPLE)
    if len(points) < 4:
        return None
    seeds = rng.integers(len(points), size=_HYPOTHESES)
    local = points - points.mean(axis=0)
    square = np.square(local).sum(axis=1)
    near = square[seeds, None] + square - 2 * local[seeds] @ local.T < radius**2
    neighbours = [np.flatnonzero(row) for row in near]
    spheres = [points[rng.choice(found, 4, replace=False)] for found in neighbours if found.size >= 2 * 4]
    if not spheres:
        return None
    candidates = _through_four(np.array(spheres), points.mean(axis=0))
    fits = np.abs(candidates[:, 3] - radius) <= _RADIUS_TOLERANCE * radius
    # The camera sees a ball from outside and from its near side.
    fits &= np.linalg.norm(candidates[:, :3], axis=1) > candidates[:, 3]
    candidates = candidates[fits]
    tolerance = _BALL_TOLERANCE * radius + _NOISE_SIGMAS * sigma
    votes = np.zeros(len(candidates), int)
    squared = np.square(points).sum(axis=1)[:, None]
    for i in range(0, len(candidates), _GROUP):
        centre, size = candidates[i : i + _GROUP, :3], candidates[i : i + _GROUP, 3]
        along, far = points @ centre.T, np.square(centre).sum(axis=1)
        distance = np.sqrt(np.maximum(squared - 2 * along + far, 0))
        on = np.abs(distance - size) <= tolerance[:, None]
        votes[i : i + _GROUP] = (on & (along < far)).sum(axis=0)
    if not votes.size or votes.max() < _LEAST_POINTS:
        return None
    return np.asarray(candidates[int(np.argmax(votes))])


def _through_four(quadruples: Array, origin: Array) -> Array:
    """(n, 4) spheres through four points each; those in one plane give an infinite radius."""
    local = quadruples - origin
    matrix = 2 * (local[:, 1:] - local[:, :1])
    right = np.square(local[:, 1:]).sum(axis=2) - np.square(local[:, :1]).sum(axis=2)
    flat = np.abs(np.linalg.det(matrix)) < 1e-9
    matrix[flat] = np.eye(3)
    centre = np.linalg.solve(matrix, right[..., None])[..., 0]
    radius = np.where(flat, np.inf, np.linalg.norm(local[:, 0] - centre, axis=1))
    return np.column_stack([centre + origin, radius])


def _refined(
    maps: Maps,
    rays: NDArray[np.float32],
    free: Mask,
    sphere: Array,
    limit_deg: float,
    projector_centre: Array | None,
    radius: float,
) -> Cap:
    assert maps.points is not None
    assert maps.sigma_point is not None
    near = free & _near_sphere(maps, sphere[:3], float(sphere[3]), radius)
    # The radius of a noisy hypothesis is worth less than the calibrated one: first the place, then the size.
    start = fit_sphere(maps.points[near], maps.sigma_point[near], radius=radius)
    for _ in range(3):
        region = meets_sphere(rays, start.centre, start.radius, limit_deg, projector_centre)
        # Outliers must not carry the region away; what is judged is all that the region holds.
        chosen = region & free & _near_sphere(maps, start.centre, start.radius, radius)
        if chosen.sum() < _LEAST_POINTS:
            raise ArtefactNotFoundError(
                f"a sphere at {np.round(start.centre, 1).tolist()} mm shows only {int(chosen.sum())} points",
                "Bring it nearer, or expose it better.",
            )
        start = fit_sphere(maps.points[chosen], maps.sigma_point[chosen], weighted=False)
    if abs(start.radius - radius) > _RADIUS_TOLERANCE * radius:
        raise ArtefactNotFoundError(
            f"the scan shows a sphere of {2 * start.radius:.4g} mm diameter, not of {2 * radius:g} mm",
            "Check the diameter in the artefact's description, and that no other ball is in view.",
        )
    return Cap(region, start)


def _near_sphere(maps: Maps, centre: Array, radius: float, calibrated: float) -> Mask:
    """(H, W) bool, points that lie on the near side of a sphere within the tolerance of the search."""
    assert maps.points is not None
    assert maps.sigma_point is not None
    off, tolerance = maps.points - centre, _BALL_TOLERANCE * calibrated + _NOISE_SIGMAS * maps.sigma_point
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(np.linalg.norm(off, axis=2) - radius) <= tolerance) & (off @ centre < 0))


def _largest(mask: Mask) -> Mask:
    # Noise leaves pinholes that would let the region fall into pieces.
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    if count < 2:
        return np.zeros_like(mask)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def _without_border(mask: Mask) -> Mask:
    filled = binary_fill_holes(mask).astype(np.uint8)
    side = 2 * _MARGIN_PX + 1
    # Beyond the picture there is no surface: its border is one of the artefact's.
    padded = cv2.copyMakeBorder(filled, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(cv2.erode(padded, np.ones((side, side), np.uint8))[1:-1, 1:-1], bool)
