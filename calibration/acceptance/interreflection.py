"""The error that a mirror makes: the same artefact beside it, by round one alone, by both rounds, and without it.

No guideline has this test. The Gaussian element comes from the surface that the bounce does not reach, so that the
bounce region is judged by what it did not take part in; standard deviation and range are those of the deviations
inside the region, of the same pixels in all three states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.acceptance.artefacts import PlaneBesideMirror, SphereBesideMirror
from calibration.acceptance.elements import gaussian_plane, gaussian_sphere, plane_deviation, sphere_deviation
from calibration.acceptance.evaluation import Evaluation, Picture
from calibration.acceptance.figures import Figure, Quantity
from calibration.acceptance.fits import Array
from calibration.acceptance.ranges import expected_range, reject
from calibration.acceptance.segmentation import (
    ArtefactNotFoundError,
    Mask,
    find_plane,
    find_spheres,
    usable,
    viewing_rays,
)
from drivers.errors import OperatorError
from scanner.result import Flag, Maps
from scanner.rig import Rig
from scanner.triangulation import triangulate

Points = NDArray[np.float32]

_LEAST_REGION = 50  # pixels below which a standard deviation is not worth its name
_RIM_PX = 4  # around the detected region, judged with it: weak bounce that detection missed must count
_SPOILT = np.uint16(Flag.SATURATED | Flag.DEPTH_EDGE | Flag.LOW_MODULATION)

MIRROR_QUANTITIES = (
    Quantity.BOUNCE_STD_ROUND_ONE,
    Quantity.BOUNCE_RANGE_ROUND_ONE,
    Quantity.BOUNCE_STD,
    Quantity.BOUNCE_RANGE,
    Quantity.BOUNCE_STD_REMOVED,
    Quantity.BOUNCE_RANGE_REMOVED,
)
"""Figures that an artefact beside a mirror answers for."""


def evaluate_beside_mirror(
    artefact: PlaneBesideMirror | SphereBesideMirror,
    beside: Maps,
    removed: Maps | None,
    rig: Rig,
    rng: np.random.Generator,
) -> Evaluation:
    """Deviations in the bounce region: round one alone, both rounds, and with the mirror taken away.

    Parameters
    ----------
    artefact
        What stands beside the mirror.
    beside
        The scan with the mirror, by a method of two rounds.
    removed
        The scan with the mirror taken away and nothing else moved; None where there is none. With it, the artefact's
        pixels are known beyond doubt; without, they come from ``beside``.
    rig
        With which the scans were made.
    rng
        For the search of the artefact.
    """
    description = artefact.model_dump(mode="json")
    try:
        figures, pictures = _judge(artefact, beside, removed, rig, rng)
    except OperatorError as error:
        reason = f"{error.message}. {error.remedy}"
        figures, pictures = [Figure(q, artefact.title, None, note=reason) for q in MIRROR_QUANTITIES], []
    return Evaluation(artefact.title, figures, pictures, description)


def round_one_points(maps: Maps, rig: Rig) -> Points:
    """(H, W, 3) mm, the points that round one alone gives, as if there were one light path everywhere.

    Raises
    ------
    ArtefactNotFoundError
        The method has no second round.
    """
    if maps.x_p_round1 is None and maps.y_p_round1 is None:
        raise ArtefactNotFoundError(
            "the scan has no coordinates of round one", "Scan the artefact beside the mirror with method mfs."
        )
    # Equal weights: the σ of a coordinate with a bounce in it says nothing about its error.
    same = np.ones(maps.flags.shape, np.float32)
    return triangulate(rig, maps.x_p_round1, same, maps.y_p_round1, same).points


@dataclass(frozen=True, eq=False)
class _State:
    """One of the three: its points, their noise, and the quantities that it gives."""

    name: str
    points: Points
    sigma: NDArray[np.float32]
    std: Quantity
    range: Quantity
    predictable: bool
    """False where the errors are the bounce's and not the noise's."""


def _judge(
    artefact: PlaneBesideMirror | SphereBesideMirror,
    beside: Maps,
    removed: Maps | None,
    rig: Rig,
    rng: np.random.Generator,
) -> tuple[list[Figure], list[Picture]]:
    surface = _surface(artefact, beside if removed is None else removed, rig, rng)
    detected = surface & beside.interreflection
    if detected.sum() < _LEAST_REGION:
        raise ArtefactNotFoundError(
            f"a bounce was detected on {int(detected.sum())} px of the artefact only",
            "Turn the mirror until it throws projector light onto the artefact.",
        )
    rim = cv2.dilate(beside.interreflection.astype(np.uint8), np.ones((2 * _RIM_PX + 1,) * 2, np.uint8)) > 0
    region = surface & rim & ((beside.flags & _SPOILT) == 0)
    clean = surface & ~rim & usable(beside)
    figures: list[Figure] = []
    pictures = []
    for state in _states(beside, removed, rig):
        reference = clean & np.isfinite(state.points[..., 2]) & (state.sigma > 0)
        fit_points, fit_sigma = state.points[reference], state.sigma[reference]
        known = surface & np.isfinite(state.points[..., 2])
        points, sigma = state.points[known].astype(np.float64), state.sigma[known].astype(np.float64)
        if isinstance(artefact, SphereBesideMirror):
            deviation, across = sphere_deviation(points, sigma, gaussian_sphere(fit_points, fit_sigma).fit)
        else:
            deviation, across = plane_deviation(points, sigma, gaussian_plane(fit_points, fit_sigma).fit)
        shown = np.full(surface.shape, np.nan, np.float32)
        shown[known] = deviation
        inside = region[known]
        noise = across[inside] if state.predictable else np.empty(0)
        pictures.append(Picture(f"{artefact.title}: {state.name}", shown, region, deviation[inside], noise))
        figures += _figures(artefact.title, state, deviation[inside], across[inside], int(region.sum()))
    present = {figure.quantity for figure in figures}
    note = "the artefact was not scanned with the mirror removed"
    figures += [Figure(q, artefact.title, None, note=note) for q in MIRROR_QUANTITIES if q not in present]
    return figures, pictures


def _states(beside: Maps, removed: Maps | None, rig: Rig) -> list[_State]:
    assert beside.points is not None
    assert beside.sigma_point is not None
    first = round_one_points(beside, rig)
    states = [
        _State(
            "round one alone",
            first,
            beside.sigma_point,
            Quantity.BOUNCE_STD_ROUND_ONE,
            Quantity.BOUNCE_RANGE_ROUND_ONE,
            predictable=False,
        ),
        _State(
            "both rounds",
            beside.points,
            beside.sigma_point,
            Quantity.BOUNCE_STD,
            Quantity.BOUNCE_RANGE,
            predictable=True,
        ),
    ]
    if removed is not None and removed.points is not None and removed.sigma_point is not None:
        states.append(
            _State(
                "mirror removed",
                removed.points,
                removed.sigma_point,
                Quantity.BOUNCE_STD_REMOVED,
                Quantity.BOUNCE_RANGE_REMOVED,
                predictable=True,
            )
        )
    return states


def _surface(artefact: PlaneBesideMirror | SphereBesideMirror, maps: Maps, rig: Rig, rng: np.random.Generator) -> Mask:
    """(H, W) bool, pixels that see the artefact."""
    if isinstance(artefact, PlaneBesideMirror):
        return find_plane(maps, rng, math.hypot(artefact.width_mm, artefact.height_mm))
    cap = find_spheres(
        maps,
        viewing_rays(rig),
        artefact.diameter_mm / 2,
        1,
        rng,
        incidence_limit_deg=artefact.incidence_limit_deg,
        projector_centre=rig.projector_centre_cam,
    )[0]
    return cap.region


def _figures(title: str, state: _State, deviation: Array, across: Array, region_px: int) -> list[Figure]:
    note = f"{100 * deviation.size / region_px:.4g} % of the bounce region and its rim have a point"
    if deviation.size < _LEAST_REGION:
        return [Figure(q, title, None, points=deviation.size, note=note) for q in (state.std, state.range)]
    spread = float(deviation.std(ddof=1))
    keep = reject(deviation)
    rejected = int((~keep).sum())
    predicted = state.predictable and bool(np.isfinite(across).all())
    expected = float(np.sqrt(np.mean(across**2))) if predicted else None
    noise, noise_std = expected_range(across, rejected) if predicted else (None, None)
    u_std = _u_of_std(deviation)
    return [
        Figure(
            state.std,
            title,
            spread,
            {"scatter of the points": u_std},
            points=deviation.size,
            noise_mm=expected,
            noise_std_mm=None if expected is None else expected / math.sqrt(2 * deviation.size),
            note=note,
        ),
        Figure(
            state.range,
            title,
            float(np.ptp(deviation[keep])),
            {} if noise_std is None else {"noise of the points": noise_std},
            deviation.size,
            rejected,
            noise,
            noise_std,
            note,
        ),
    ]


def _u_of_std(deviation: Array) -> float:
    """Standard uncertainty of a standard deviation by the sample's own fourth moment: heavy tails make it worse."""
    off = deviation - deviation.mean()
    second = float(np.mean(off**2))
    if second == 0:
        return 0.0
    excess = max(float(np.mean(off**4)) - second**2, 0.0)
    return math.sqrt(excess / deviation.size) / (2 * math.sqrt(second))
