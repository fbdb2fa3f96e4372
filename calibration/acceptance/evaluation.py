"""From scans of an artefact to its quality figures, and the maps that show them.

In the manner of VDI/VDE 2634 part 2 (August 2012): Gaussian elements, at most 3 of 1000 points left out. The guideline
asks for many positions in the measuring volume; each call here evaluates one, and a certificate collects as many as
were scanned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.acceptance.artefacts import BallBarArtefact, PlaneArtefact, SphereArtefact
from calibration.acceptance.elements import Element, gaussian_plane, gaussian_sphere
from calibration.acceptance.figures import Figure, Quantity
from calibration.acceptance.fits import Array, SphereFit
from calibration.acceptance.ranges import expected_range
from calibration.acceptance.repeatability import repeatability
from calibration.acceptance.segmentation import (
    Mask,
    find_plane,
    find_spheres,
    usable,
    viewing_rays,
)
from drivers.errors import OperatorError
from scanner.result import Maps
from scanner.rig import Rig


@dataclass(frozen=True, eq=False)
class Picture:
    """Deviations of one state of an artefact, to be shown.

    Parameters
    ----------
    title
        What is shown.
    deviation
        (H, W) float32 signed distance from the Gaussian element, mm; NaN where nothing was measured.
    region
        (H, W) bool, outlined: what was judged.
    residuals, sigma
        (N,) deviations that were judged, and the standard deviations that noise predicts for them, mm; the latter
        empty where noise is not what they come from.
    """

    title: str
    deviation: NDArray[np.float32]
    region: Mask
    residuals: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What one artefact at one place told.

    Parameters
    ----------
    artefact
        Its title.
    figures
        All that belong to the artefact, measured or not.
    pictures
        Of the scan that is shown.
    description
        The artefact's own document.
    """

    artefact: str
    figures: list[Figure]
    pictures: list[Picture] = field(default_factory=list)
    description: dict[str, Any] = field(default_factory=dict)


def evaluate(
    artefact: SphereArtefact | BallBarArtefact | PlaneArtefact,
    scans: Sequence[Maps],
    rig: Rig,
    rng: np.random.Generator,
    *,
    temperature_C: float | None = None,
) -> Evaluation:
    """Quality figures of an artefact that stood still while it was scanned once or several times.

    Parameters
    ----------
    artefact
        What was scanned.
    scans
        One or more scans of the same place. Each figure is that of the worst scan; more than one give repeatability.
    rig
        With which the scans were made.
    rng
        For the search of the artefact.
    temperature_C
        Of the artefact, where measured.

    Returns
    -------
    Evaluation
        What could not be measured is in it, with the reason.
    """
    measure: Callable[[Maps], _Measured]
    if isinstance(artefact, PlaneArtefact):
        measure = partial(_plane, artefact, rng=rng)
    else:
        measure = partial(_spheres, artefact, rig=rig, rng=rng, temperature_C=temperature_C)
    description = artefact.model_dump(mode="json")
    try:
        measured = [measure(scan) for scan in scans]
    except OperatorError as error:
        reason = f"{error.message}. {error.remedy}"
        missing = [Figure(quantity, artefact.title, None, note=reason) for quantity in EXPECTED[artefact.kind]]
        return Evaluation(artefact.title, missing, description=description)
    figures = [_worst([m.figures[i] for m in measured]) for i in range(len(measured[0].figures))]
    lengths = [m.length for m in measured if m.length is not None]
    figures += repeatability(artefact.title, scans, measured[0].region, lengths)
    return Evaluation(artefact.title, figures, [measured[0].picture], description)


EXPECTED: dict[str, tuple[Quantity, ...]] = {
    "sphere": (
        Quantity.PROBING_FORM,
        Quantity.PROBING_SIZE,
        Quantity.REPEATABILITY,
        Quantity.REPEATABILITY_LENGTH,
    ),
    "ball_bar": (Quantity.SPHERE_SPACING, Quantity.REPEATABILITY, Quantity.REPEATABILITY_LENGTH),
    "plane": (Quantity.FLATNESS, Quantity.REPEATABILITY),
}
"""Figures that each kind of artefact answers for."""


@dataclass(frozen=True, eq=False)
class _Measured:
    figures: list[Figure]
    length: tuple[float, float] | None
    """mm: the measured diameter or spacing, and its standard uncertainty by noise; None where there is none."""
    region: Mask
    picture: Picture


def _worst(figures: list[Figure]) -> Figure:
    worst = max(figures, key=lambda f: math.inf if f.value_mm is None else abs(f.value_mm))
    return worst if len(figures) == 1 else replace(worst, note=f"worst of {len(figures)} scans; {worst.note}")


def _form_figure(quantity: Quantity, title: str, element: Element[Any], form_mm: float, note: str) -> Figure:
    noise, spread = expected_range(element.sigma, element.rejected)
    # A calibrated form error adds to the range by an unknown share between nothing and all of it (ISO/TS 23165).
    budget = {"noise of the points": spread, "form of the artefact": form_mm / 2}
    return Figure(
        quantity, title, element.range_mm, budget, element.residuals.size, element.rejected, noise, spread, note
    )


def _spheres(
    artefact: SphereArtefact | BallBarArtefact,
    maps: Maps,
    *,
    rig: Rig,
    rng: np.random.Generator,
    temperature_C: float | None,
) -> _Measured:
    rays, good = viewing_rays(rig), usable(maps)
    assert maps.points is not None
    assert maps.sigma_point is not None
    count = 2 if isinstance(artefact, BallBarArtefact) else 1
    caps = find_spheres(
        maps,
        rays,
        artefact.diameter_mm / 2,
        count,
        rng,
        incidence_limit_deg=artefact.incidence_limit_deg,
        projector_centre=rig.projector_centre_cam,
    )
    deviation = np.full(maps.flags.shape, np.nan, np.float32)
    region = np.zeros(maps.flags.shape, bool)
    elements, shares = [], []
    for cap in caps:
        used = cap.region & good
        element = gaussian_sphere(maps.points[used], maps.sigma_point[used])
        deviation[used] = element.residuals
        region |= cap.region
        elements.append(element)
        shares.append(used.sum() / cap.region.sum())
    residuals, sigma = (np.concatenate([getattr(e, name) for e in elements]) for name in ("residuals", "sigma"))
    picture = Picture(f"{artefact.title}: deviation from the Gaussian sphere", deviation, region, residuals, sigma)
    covered = f"{100 * min(shares):.4g} % of the cap within {artefact.incidence_limit_deg:g}° has points"
    if isinstance(artefact, BallBarArtefact):
        spacing, length = _spacing(artefact, elements, temperature_C, covered)
        return _Measured([spacing], length, region, picture)
    fit = elements[0].fit
    form = _form_figure(Quantity.PROBING_FORM, artefact.title, elements[0], artefact.form_mm, covered)
    expected, u_thermal, thermal = artefact.length_at(artefact.diameter_mm, temperature_C)
    size = Figure(
        Quantity.PROBING_SIZE,
        artefact.title,
        2 * fit.radius - expected,
        {
            "noise of the points": 2 * fit.u_radius,
            "calibration of the artefact": artefact.diameter_uncertainty_mm / 2,
            "temperature": u_thermal,
        },
        residuals.size,
        elements[0].rejected,
        note=f"{covered}; {thermal}",
    )
    return _Measured([form, size], (2 * fit.radius, 2 * fit.u_radius), region, picture)


def _spacing(
    artefact: BallBarArtefact, elements: Sequence[Element[SphereFit]], temperature_C: float | None, covered: str
) -> tuple[Figure, tuple[float, float]]:
    """Sphere spacing error, and the measured spacing with its standard uncertainty by noise."""
    first, second = (e.fit for e in elements)
    off = second.centre - first.centre
    length = float(np.linalg.norm(off))
    along = off / length
    noise = math.sqrt(sum(float(along @ fit.covariance[:3, :3] @ along) for fit in (first, second)))
    expected, u_thermal, thermal = artefact.length_at(artefact.spacing_mm, temperature_C)
    budget = {
        "noise of the points": noise,
        "calibration of the artefact": artefact.spacing_uncertainty_mm / 2,
        "temperature": u_thermal,
    }
    figure = Figure(
        Quantity.SPHERE_SPACING,
        artefact.title,
        length - expected,
        budget,
        sum(e.residuals.size for e in elements),
        sum(e.rejected for e in elements),
        note=f"{covered}; {thermal}",
    )
    return figure, (length, noise)


def _plane(artefact: PlaneArtefact, maps: Maps, *, rng: np.random.Generator) -> _Measured:
    region = find_plane(maps, rng, math.hypot(artefact.width_mm, artefact.height_mm))
    used = region & usable(maps)
    assert maps.points is not None
    assert maps.sigma_point is not None
    points = maps.points[used]
    element = gaussian_plane(points, maps.sigma_point[used])
    spans = sorted(np.ptp((points[element.keep] - element.fit.centroid) @ element.fit.axes.T, axis=0))
    deviation = np.full(maps.flags.shape, np.nan, np.float32)
    deviation[used] = element.residuals
    note = f"over {spans[1]:.0f} × {spans[0]:.0f} mm; {100 * used.sum() / region.sum():.4g} % of the region has points"
    figure = _form_figure(Quantity.FLATNESS, artefact.title, element, artefact.form_mm, note)
    picture = Picture(
        f"{artefact.title}: deviation from the Gaussian plane", deviation, region, element.residuals, element.sigma
    )
    return _Measured([figure], None, region, picture)
